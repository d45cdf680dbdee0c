"""Tiers of CPython's tests: which of them matter for a distributed drop-in.

A test belongs to the first table that names it, as ``Class.test``, ``Class.test[type]`` (type is
processes or manager) or ``Class.*``; ``Class`` is CPython's base name without the leading
underscore. What no table names is `core` when its class is known, else `ext`: a class that a newer
Python added is looked at before anything is promised about it.
"""

from __future__ import annotations

from typing import Literal

Tier = Literal["core", "prompt", "local", "ext", "na"]

# Reads at once a state that pods have only after the first use.  It may pass by chance.
PROMPT = {
    "TestInitializers.test_manager_initializer": "a manager's server may wait for its pod",
    "TestInitializers.test_pool_initializer": "a pool's workers start with its first task",
}

# Needs one host: pids, signals, shared files, raw sockets.
LOCAL = {
    "TestProcess.test_set_executable": "path of a local interpreter",
    "TestProcess.test_process_mainthread_native_id": "kernel thread ids",
    "TestProcess.test_child_fd_inflation": "number of open files of children",
    "TestSubclassingProcess.test_stderr_flush": "file shared with the child",
    "TestSubclassingProcess.test_sys_exit": "file shared with the child",
    "TestCondition.test_wait_result[processes]": "child signals the parent's pid",
    "TestListener.test_multiple_bind": "addresses of one host",
    "TestListenerClient.*": "Listener and Client, AF_UNIX among them",
    "TestSharedMemory.*": "names that processes of one host find",
    "TestManagerRestart.*": "an address of one host",
    "TestRemoteManager.*": "an address of one host",
    "OtherTest.*": "Listener and Client on one host",
    "TestPollEintr.*": "child signals the parent's pid",
    "TestWait.test_wait_socket": "raw sockets in wait()",
    "TestWait.test_wait_socket_slow": "raw sockets in wait()",
    "TestTimeouts.*": "Listener and Client on one host",
    "TestIgnoreEINTR.*": "parent signals the child's pid",
}

# Private attributes, cosmetics, names of contexts, internals of the standard library.
EXT = {
    "TestQueue.test_queue_feeder_on_queue_feeder_error": "private hook",
    "TestEvent.test_repr": "cosmetic",
    "TestPool.test_make_pool[processes]": "Pool._pool",
    "TestPool.test_resource_warning": "Pool._state",
    "TestPoolWorkerLifetime.test_pool_worker_lifetime": "_pool, _repopulate_pool",
    "TestInvalidFamily.test_invalid_family": "address families",
    "TestStartMethod.test_context": "child reports the parent's method",
    "TestStartMethod.test_context_check_module_types": "types of forkserver preload",
    "TestStartMethod.test_get_all": "exact list of methods",
}

# Never expected: shared memory, descriptors, forkserver, resource tracker, or the text of the
# test itself runs the standard library in another interpreter.
NOT_APPLICABLE = {
    "TestInternalDecorators.*": "tests the suite itself",
    "TestProcess.test_forkserver_sigint": "forkserver internals",
    "TestProcess.test_forkserver_sigkill": "forkserver internals",
    "TestQueue.test_no_import_lock_contention": "text imports the standard library",
    "TestPoolWorkerLifetime.test_worker_finalization_via_atexit_handler_of_multiprocessing": (
        "text runs the standard library in another interpreter"
    ),
    "TestConnection.test_fd_transfer": "passes descriptors",
    "TestConnection.test_large_fd_transfer": "passes descriptors",
    "TestConnection.test_missing_fd_transfer": "passes descriptors",
    "TestListener.test_abstract_socket": "abstract AF_UNIX",
    "TestPicklingConnections.test_pickling": "pickles raw sockets",
    "TestHeap.*": "insides of multiprocessing's heap; of Fiber's: tests/unit/test_heap.py",
    "TestSharedMemory.test_shared_memory_SharedMemoryManager_reuses_resource_tracker": (
        "script uses the standard library"
    ),
    "TestSharedMemory.test_shared_memory_cleaned_after_process_termination": (
        "script uses the standard library"
    ),
    "TestFinalize.*": "util internals",
    "TestImportStar.*": "files of the standard library",
    "TestInvalidHandle.*": "Connection(fd) internals",
    "TestInvalidFamily.test_invalid_family_win32": "Windows",
    "TestFlags.*": "another interpreter imports the standard test module",
    "TestNoForkBomb.*": "script uses the standard library",
    "TestForkAwareThreadLock.*": "util internals",
    "TestCloseFds.*": "inherits descriptors",
    "TestStartMethod.test_preload_resources": "forkserver preload",
    "TestStartMethod.test_mixed_startmethod": "SemLocks of fork",
    "TestResourceTracker.*": "resource tracker",
    "TestPoolNotLeakOnFailure.*": "mocks internals of Pool",
    "TestNamedResource.*": "script uses the standard library",
    "MiscTestCase.*": "__all__ of the standard library, another interpreter",
    "SemLockTests.*": "_multiprocessing.SemLock",
}

# The same for tests of process pool executors: some would hang, or pass now and then.
EXECUTORS_NOT_APPLICABLE = {
    "ProcessPoolExecutorTest.test_ressources_gced_in_workers": (
        "waits one second for a manager, which is little on a busy machine"
    ),
    "ProcessPoolExecutorTest.test_saturation": "counts processes at once: they start meanwhile",
    "ProcessPoolShutdownTest.test_processes_terminate": (
        "counts processes at once: they start meanwhile"
    ),
    "ProcessPoolShutdownTest.test_cancel_futures": (
        "says that some task had begun: if no worker was up yet, all are cancelled"
    ),
    "ProcessPoolShutdownTest.test_del_shutdown": "_executor_manager_thread",
    "ProcessPoolShutdownTest.test_shutdown_no_wait": "_executor_manager_thread",
    "ExecutorDeadlockTest.test_shutdown_deadlock_pickle": "_executor_manager_thread",
    "ExecutorDeadlockTest.test_gh105829_should_not_deadlock_if_wakeup_pipe_full": (
        "mocks internals of the standard library"
    ),
}

KNOWN_CLASSES = frozenset(
    {
        "TestArray",
        "TestBarrier",
        "TestCondition",
        "TestConnection",
        "TestContainers",
        "TestEvent",
        "TestInitializers",
        "TestListener",
        "TestLock",
        "TestLogging",
        "TestMyManager",
        "TestPicklingConnections",
        "TestPoll",
        "TestPool",
        "TestPoolWorkerErrors",
        "TestPoolWorkerLifetime",
        "TestProcess",
        "TestQueue",
        "TestSemaphore",
        "TestSharedCTypes",
        "TestSimpleQueue",
        "TestStartMethod",
        "TestStdinBadfiledescriptor",
        "TestSubclassingProcess",
        "TestSyncManagerTypes",
        "TestValue",
        "TestWait",
    }
)

_TABLES: tuple[tuple[Tier, dict[str, str]], ...] = (
    ("na", NOT_APPLICABLE),
    ("local", LOCAL),
    ("prompt", PROMPT),
    ("ext", EXT),
)


def tier_of(class_name: str, method: str, type_: str | None = None) -> Tier:
    """The tier of one test; `type_` is processes, manager, or None for an untyped class."""
    return _find(class_name, method, type_)[0]


def reason_of(class_name: str, method: str, type_: str | None = None) -> str:
    """Return why a test is in its tier; empty if it is part of every run."""
    return _find(class_name, method, type_)[1]


def _find(class_name: str, method: str, type_: str | None) -> tuple[Tier, str]:
    keys = (f"{class_name}.{method}[{type_}]", f"{class_name}.{method}", f"{class_name}.*")
    for tier, table in _TABLES:
        for key in keys:
            if key in table:
                return tier, table[key]
    if class_name in KNOWN_CLASSES:
        return "core", ""
    return "ext", "a class that is newer than this list"
