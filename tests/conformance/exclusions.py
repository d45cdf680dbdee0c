"""The tests that Fiber does not pass, and why. Each run prints its part of this list.

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
    "local": {**_CLOSED_AT_ONCE},
    "loopback": {**_CLOSED_AT_ONCE},
    "kubernetes": {**_CLOSED_AT_ONCE},
}
