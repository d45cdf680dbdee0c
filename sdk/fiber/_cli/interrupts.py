"""Ctrl-C while a program is followed: the first one is for the program, the second for Fiber."""

from __future__ import annotations

import queue
import signal
import threading
from collections.abc import Callable
from typing import Any


class Interrupts:
    """Context in which the first Ctrl-C calls ``act`` on another thread.

    Further ones, and all before ``is_armed``, raise KeyboardInterrupt.  The handler makes no call
    to the cluster: it may run while the main thread holds a lock of the client.
    """

    def __init__(self, act: Callable[[], None]) -> None:
        self.is_armed = False
        self._act = act
        self._due: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._before: Any = None

    def __enter__(self) -> Interrupts:
        threading.Thread(target=self._serve, name="fiber-interrupt", daemon=True).start()
        self._before = signal.getsignal(signal.SIGINT)
        if self._before is not signal.SIG_IGN:  # a shell's background job
            signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        self._due.put(False)
        signal.signal(signal.SIGINT, self._before)

    def _handle(self, *_: object) -> None:
        if not self.is_armed:
            raise KeyboardInterrupt
        self.is_armed = False
        self._due.put(True)

    def _serve(self) -> None:
        if self._due.get():
            self._act()
