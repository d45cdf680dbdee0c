"""A semaphore with any number of tokens: each process notes how many it has."""

from __future__ import annotations

from collections.abc import Iterator

from fiber._sync.semaphore import NOTE, TOTAL, WORDS, SharedSemaphore

PROCESSES = 128
"""Of a host, that can use one semaphore so that what they have is released when they die."""

SIZE = (WORDS + 2 * PROCESSES) * 8

_SIGN = 1 << 63
_MASK = (1 << 64) - 1


class CountingSemaphore(SharedSemaphore):
    """What a process has acquired more often than released is released when it dies.

    Unless some process has released it more often than acquired: then it carries a signal from one
    to another, and what was acquired is nobody's to give back.
    """

    __slots__ = ("_entry",)

    noun = "Semaphore"

    def _open(self) -> None:
        self._entry = 0

    def create(self, value: int) -> None:
        """Begin the record's life."""
        super().create(value)
        for word in self._entries():
            self._words[word] = self._words[word + 1] = 0
        self._words[self._at + NOTE] = value == 0

    def _note(self) -> None:
        self._write(0)

    def _unnote(self) -> None:
        self._write(-1)

    def _write(self, change: int) -> None:
        """Note how many this process has, ``change`` more than its semaphore knows of.

        Other threads do so, too: who writes last has read last.
        """
        words, tokens = self._words, self._entry or self._enter()
        while True:
            count = self._sem._count() + change
            words[tokens] = count & _MASK
            if self._sem._count() + change == count:
                break
        if count < 0:
            words[self._at + NOTE] = True

    def _holders(self) -> list[tuple[int, int]]:
        words = self._words
        if words[self._at + NOTE]:
            return []
        found = [(words[word], words[word + 1]) for word in self._entries()]
        return [(who, tokens) for who, tokens in found if who and 0 < tokens < _SIGN]

    def _is_suspicious(self) -> bool:
        return not self._words[self._at + NOTE] and super()._is_suspicious()

    def _lost(self) -> list[int]:
        return [] if self._words[self._at + NOTE] else super()._lost()

    def _forget(self, who: int) -> None:
        words = self._words
        for word in self._entries():
            if words[word] == who:
                words[word + 1] = 0

    def _entries(self) -> Iterator[int]:
        first = self._at + WORDS
        return iter(range(first, first + 2 * PROCESSES, 2))

    def _enter(self) -> int:
        """Find a place for this process's count."""
        self._entry = self._arena.exclusively(self._claim)
        return self._entry

    def _claim(self) -> int:
        words, me = self._words, self._me
        entries = [(words[word], word) for word in self._entries()]
        for is_ours in (lambda who: who == me, lambda who: not who):
            for who, word in entries:
                if is_ours(who):
                    words[word] = me
                    return word + 1
        for who, word in entries:
            if not words[word + 1] and not self._arena.is_alive(who):
                words[word] = me
                return word + 1
        # More than can be told apart: from here on nobody's death is heeded.
        words[self._at + NOTE] = True
        return self._at + DEAD + 1
