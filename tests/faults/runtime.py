"""Fiber's runtime in the process of the tests, with settings of one's own."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import Any

from faults.program import wait_for
from fiber import config
from fiber._runtime import state


class running:
    """A fresh runtime with the given settings, for a ``with`` block."""

    def __init__(self, **settings: Any) -> None:
        self._settings = settings

    def __enter__(self) -> state.Runtime:
        state.shutdown()
        self._before = config._current
        config.install(config.load(self._settings))
        return state.runtime()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        state.shutdown()
        config._current = self._before


BACKENDS = ("local", "loopback")


def running_on(backend: str) -> Iterator[str]:
    """Yield the name of the backend, on which this very process runs meanwhile."""
    with running(backend=backend, agents=2) as runtime:
        if backend == "loopback":
            # The thread that writes the agents' output lives as long as the runtime.
            loopback: Any = runtime.backend
            loopback._output.write("test", "begins")
            wait_for(lambda: len(loopback.agents.agents) == len(loopback._slots))
        yield backend
