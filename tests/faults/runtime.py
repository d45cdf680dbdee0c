"""Fiber's runtime in the process of the tests, with settings of one's own."""

from __future__ import annotations

from types import TracebackType
from typing import Any

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
