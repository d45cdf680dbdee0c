"""A lock or semaphore of this host as its hub sees it, which has tokens for processes elsewhere.

The loop never waits.  While somebody elsewhere waits for a token, whoever releases one rings the
hub's doorbell.  Of those who wait the first to ask is the first to get it.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable

from fiber._hub.doorbell import Doorbell
from fiber._hub.hosted import Waiter
from fiber._hub.protocol import Status
from fiber._sync.abandonment import Abandoned
from fiber._sync.semaphore import COUNTING, SLICE, Block, SharedSemaphore, warn_of
from fiber._transport.loop import Loop

_RELEASE_AGAIN = 0.005
"""Seconds until the next try while dead processes' tokens are given back."""


class HostedSemaphore:
    """Semaphore that the hub serves.  Runs on the loop's thread."""

    def __init__(self, loop: Loop, doorbell: Doorbell, block: Block) -> None:
        self._loop = loop
        self._doorbell = doorbell
        # A view of its own, and no recursive one: the tokens are not this process's.
        self._semaphore = SharedSemaphore(block, COUNTING)
        self._waiters: deque[tuple[Waiter, Callable[[bool], None]]] = deque()
        self._is_listening = False
        self._revival = threading.Thread()  # none yet

    def acquire(self, waiter: Waiter, granted: Callable[[bool], None]) -> None:
        """Answer once there is a token for it, having told ``granted`` whether it is to keep it."""
        self._waiters.append((waiter, granted))
        self._serve()
        if self._waiters and not self._is_listening:
            self._is_listening = True
            self._doorbell.listen(self._serve)
            self._semaphore.listen(True)
            self._look()

    def release(self) -> None:
        """Give a token back; ValueError if there are as many as there can be."""
        if self._semaphore.release(wait=False):
            self._serve()
        else:
            self._loop.call_later(_RELEASE_AGAIN, self.release)

    def abandon(self, holder: str) -> None:
        """Give back a token of a process that has ended."""
        self._semaphore.abandon(holder)
        with contextlib.suppress(RuntimeWarning):  # as an error it would end the hub
            warn_of(holder)
        self.release()

    def value(self) -> int:
        """Return how often it can be acquired now."""
        return self._semaphore._get_value()

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        for entry in self._waiters:
            if entry[0] is waiter:
                self._waiters.remove(entry)
                return True
        return False

    def close(self) -> None:
        """Stop serving it: no process of another host uses it."""
        self._waiters.clear()
        self._stop_listening()

    def _serve(self) -> None:
        while self._waiters and (result := self._semaphore.try_acquire()):
            waiter, granted = self._waiters.popleft()
            tracked = not self._semaphore.is_untracked()
            granted(tracked)
            holder = [memoryview(result.holder.encode())] if isinstance(result, Abandoned) else []
            waiter.answer(Status.OK, tracked, holder)

    def _look(self) -> None:
        """Now and then: who would ring may die before it does, or while it has a token."""
        self._serve()
        if not self._waiters:
            self._stop_listening()
            return
        if not self._revival.is_alive() and self._semaphore.is_suspicious():
            self._revival = threading.Thread(target=self._semaphore.revive, name="fiber-revival")
            self._revival.start()
        self._loop.call_later(SLICE, self._look)

    def _stop_listening(self) -> None:
        if self._is_listening:
            self._is_listening = False
            self._semaphore.listen(False)
            self._doorbell.forget(self._serve)
