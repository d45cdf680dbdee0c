"""Tests that Fiber does not pass, with reasons. Each run prints its part of this list.

A test that is listed and passes fails the run as much as one that fails and is not listed: the
list says what is so.
"""

from __future__ import annotations

_CLOSED_AT_ONCE = {
    "WithProcessesTestQueue.test_closed_queue_empty_exceptions": (
        "from Python 3.13 on: close() gives the descriptors back also if nothing was ever put"
    )
}

# backend -> id of the test -> reason
EXCLUSIONS: dict[str, dict[str, str]] = {
    "local": _CLOSED_AT_ONCE,
    "loopback": _CLOSED_AT_ONCE,
    "kubernetes": _CLOSED_AT_ONCE,
}

_CONCERNS_ONE_TASK = "concerns one task, which gets the error itself: the executor is not broken"
_DOES_NOT_PICKLE = "a result that does not pickle is a MaybeEncodingError, as for a pool"

_EXECUTORS = {
    "ExecutorDeadlockTest.test_error_at_task_unpickle": _CONCERNS_ONE_TASK,
    "ExecutorDeadlockTest.test_exit_at_task_unpickle": _CONCERNS_ONE_TASK,
    "ExecutorDeadlockTest.test_error_during_result_pickle_on_worker": _DOES_NOT_PICKLE,
    "ExecutorDeadlockTest.test_exit_during_result_pickle_on_worker": _DOES_NOT_PICKLE,
    "ExecutorDeadlockTest.test_error_during_result_unpickle_in_result_handler": _DOES_NOT_PICKLE,
    "ExecutorDeadlockTest.test_exit_during_result_unpickle_in_result_handler": _DOES_NOT_PICKLE,
    "FailingInitializerMixin.test_initializer": (
        "what the initializer raised is told by the error, not by a log of the worker"
    ),
    "ProcessPoolExecutorTest.test_killed_child": "a task whose worker dies runs again elsewhere",
    "ProcessPoolExecutorTest.test_max_tasks_per_child_defaults_to_spawn_context": "_mp_context",
    "ProcessPoolExecutorTest.test_python_finalization_error": "no thread starts that could fail",
    "ProcessPoolExecutorTest.test_traceback": (
        "the cause is multiprocessing's RemoteTraceback, not that of concurrent.futures"
    ),
}
_ELSEWHERE = {
    "ProcessPoolShutdownTest.test_interpreter_shutdown": (
        "what a worker on another host writes comes on stderr, with its name before it"
    ),
}
_ONE_PORT = {
    "ProcessPoolShutdownTest.test_submit_after_interpreter_shutdown": (
        "starts another program, and the one port that is reserved for programs is taken"
    ),
}

# Exclusions of process pool executors: backend -> id of the test -> reason
EXECUTORS: dict[str, dict[str, str]] = {
    "local": _EXECUTORS,
    "loopback": {**_EXECUTORS, **_ELSEWHERE},
    "kubernetes": {**_EXECUTORS, **_ELSEWHERE, **_ONE_PORT},
}

_REGISTERED_HERE = "starts another interpreter, which does not import fiber.joblib"
_NO_MEMORY_MAPS = "large arrays are in shared memory that has no name, and not in a file"

# Exclusions of joblib's tests of a backend: name of the test -> reason
JOBLIB: dict[str, str] = {
    "test_parallel_with_interactively_defined_functions": _REGISTERED_HERE,
    "test_parallel_with_unpicklable_functions_in_args": _REGISTERED_HERE,
    "test_auto_memmap_on_arrays_from_generator": _NO_MEMORY_MAPS,
    "test_memmapping_leaks": _NO_MEMORY_MAPS,
}
