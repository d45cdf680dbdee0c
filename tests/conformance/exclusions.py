"""The tests that Fiber does not pass, and why. Each run prints its part of this list.

A test that is listed and passes fails the run as much as one that fails and is not listed: the
list says what is so.
"""

from __future__ import annotations

_MANAGERS = {
    f"TestInitializers.test_{name}_initializer": "its set-up makes a manager: not in Fiber yet"
    for name in ("manager", "pool")
}
_MEMORY_MANAGERS = {
    f"WithProcessesTestSharedMemory.test_shared_memory_{name}": "SharedMemoryManager: not yet"
    for name in ("SharedMemoryManager_basics", "SharedMemoryServer_ignores_sigint")
}
_CLOSED_AT_ONCE = {
    "WithProcessesTestQueue.test_closed_queue_empty_exceptions": (
        "from Python 3.13 on: close() gives the descriptors back also if nothing was ever put"
    )
}
_COUNTED_BY_A_VALUE = (
    "abort",
    "abort_and_reset",
    "action",
    "barrier",
    "barrier_10",
    "default_timeout",
    "reset",
    "timeout",
    "wait_return",
)
_ONE_HOST = {
    f"WithProcesses{test}": (
        "memory is shared by the processes of one host: to start one elsewhere with a shared value "
        "is an error that says what to use"
    )
    for test in (
        "TestArray.test_array",
        *(f"TestBarrier.test_{name}" for name in _COUNTED_BY_A_VALUE),
        "TestCondition.test_waitfor",
        "TestCondition.test_waitfor_timeout",
        "TestArray.test_rawarray",
        "TestSharedCTypes.test_sharedctypes",
        "TestSharedCTypes.test_synchronize",
        "TestValue.test_rawvalue",
        "TestValue.test_value",
    )
}

# backend -> id of the test -> reason
EXCLUSIONS: dict[str, dict[str, str]] = {
    "local": {**_MANAGERS, **_MEMORY_MANAGERS, **_CLOSED_AT_ONCE},
    "loopback": {**_MANAGERS, **_CLOSED_AT_ONCE, **_ONE_HOST},
    "kubernetes": {**_MANAGERS, **_CLOSED_AT_ONCE, **_ONE_HOST},
}
