"""The tests that Fiber does not pass, and why. Each run prints its part of this list.

A test that is listed and passes fails the run as much as one that fails and is not listed: the
list says what is so.
"""

from __future__ import annotations

_MANAGERS = {
    f"TestInitializers.test_{name}_initializer": "its set-up makes a manager: not in Fiber yet"
    for name in ("manager", "pool")
}

# backend -> id of the test -> reason
EXCLUSIONS: dict[str, dict[str, str]] = {
    "local": {**_MANAGERS},
    "loopback": {**_MANAGERS},
}
