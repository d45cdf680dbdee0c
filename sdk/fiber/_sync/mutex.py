"""A lock: a semaphore with one token, whose holder is in one word."""

from __future__ import annotations

from fiber._sync.abandonment import Abandoned
from fiber._sync.semaphore import NOTE, RECURSIVE, RING, SharedSemaphore


class Mutex(SharedSemaphore):
    """Any thread of any process may release it."""

    __slots__ = ("_holder", "_is_mine")

    noun = "Lock"

    def _open(self) -> None:
        self._holder = self._at + NOTE
        self._is_mine = self._sem._is_mine

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool | Abandoned:
        """Take it; False if it is taken, and stays so for ``timeout`` seconds."""
        if self._is_mine():
            return self._acquire_again(block, timeout)
        # The same as ``_try_acquire``, in the fewest steps: nobody else is likely to be here.
        try:
            slot = self._free.pop()
        except IndexError:
            slot = self._arena.claim()
        words = self._words
        try:
            words[slot] = self._at
            if not words[self._attention] and self._take(False):
                words[self._holder] = self._me
                return True
        except BaseException:
            if self._is_mine():
                words[self._holder] = 0
                self._give()
            raise
        finally:
            words[slot] = 0
            self._free.append(slot)
        return super().acquire(block, timeout)

    def release(self) -> None:
        """Let it go; ValueError if nobody has it."""
        try:
            slot = self._free.pop()
        except IndexError:
            slot = self._arena.claim()
        words = self._words
        try:
            words[slot] = self._at
            attention = words[self._attention]
            if not attention:
                words[self._holder] = 0
                self._give()
        except BaseException:
            if not words[self._holder] and self._is_mine():  # begun, so it is done
                self._give()
            raise
        finally:
            words[slot] = 0
            self._free.append(slot)
        if attention:
            super().release()
        elif words[self._attention] & RING:
            self._arena.ring()

    def _acquire_again(self, block: bool, timeout: float | None) -> bool | Abandoned:
        return super().acquire(block, timeout)

    def _note(self) -> None:
        self._words[self._holder] = self._me

    def _unnote(self) -> None:
        self._words[self._holder] = 0

    def _holders(self) -> list[tuple[int, int]]:
        who = self._words[self._holder]
        return [(who, 1)] if who else []

    def _forget(self, who: int) -> None:
        self._words[self._holder] = 0


class RecursiveMutex(Mutex):
    """One that its thread may acquire again, and that only its thread may release."""

    __slots__ = ()

    kind = RECURSIVE
    noun = "RLock"

    def release(self) -> None:
        """Let it go once; AssertionError if it is not this thread's."""
        if self._is_mine() and self._sem._count() == 1:
            super().release()
        else:
            self._give()

    def _acquire_again(self, block: bool, timeout: float | None) -> bool:
        taken: list[bool] = []
        try:
            taken.extend(map(self._take, _NO_WAIT))
            return True
        except BaseException:
            if taken:
                self._give()
            raise


_NO_WAIT = (False,)
