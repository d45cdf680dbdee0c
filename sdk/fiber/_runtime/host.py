"""Interface of the runtime for pools, small enough for a fake of a few lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from fiber._runtime.shared_arguments import SharedArguments

TICK = 1e-4
"""Seconds that any timer waits: less, by a rounding error, would be too early again and again."""


class Timer(Protocol):
    """A call that is due."""

    due: float

    def cancel(self) -> None:
        """Never call it."""


class Loop(Protocol):
    """The part of ``fiber._transport.loop.Loop`` that pools use."""

    def now(self) -> float:
        """Return the time in seconds of a monotonic clock."""

    def on_thread(self) -> bool:
        """Tell whether the caller runs on the loop's thread."""

    def depend(self, dependent: Any) -> None:
        """Tell ``dependent`` if the loop fails."""

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        """Call it on the loop's thread, in order; from anywhere."""

    def call_later(self, seconds: float, callback: Callable[..., object], *args: Any) -> Timer:
        """Call it once, later."""


class Host(Protocol):
    """The part of ``fiber._runtime.state.Runtime`` that pools use."""

    @property
    def loop(self) -> Loop:
        """Event loop of the process."""

    @property
    def elastic(self) -> bool:
        """True if hosts are made for new processes."""

    @property
    def config(self) -> Any:
        """Configuration of the program.  Pools read ``start_timeout``."""

    def start(
        self,
        process: Any,
        owner: Any,
        *,
        tasks: bool,
        method: str,
        shared: SharedArguments | None,
    ) -> object:
        """Start a worker's process, whose ``owner`` hears of it; ``shared`` are its arguments."""

    def look_at_program(self) -> None:
        """Have the workers that are started from now on see the program's files as they are.

        Raises what is in the way of that.
        """
