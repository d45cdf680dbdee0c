"""The part that locks and semaphores in shared memory have in common: waiting, and reviving.

A token is a POSIX semaphore's, so to acquire and to release is one atomic step in C, which can be
waited for.  What it does not say is who has it.  So that the token of a dead process comes back:

* *Notes* beside it say who holds it (``_note``, ``_unnote``: the subclasses').  Only who has a
  token writes a note of it.
* Between the token's step and the note's, nobody can tell.  So whoever is about to make one says
  before, in a slot of the arena, at which record it is, and takes that back after both.

::

    acquire                               release
      slot = this record                    slot = this record
      stop?  then not                       stop?  then not
      take the token                        clear the note
      write the note                        give the token back
      slot = 0                              slot = 0

To revive is to give back the tokens of which no living process has a note.  One process at a time
does it, which a robust mutex sees to:

1. ``stop`` is set.  After a moment, longer than any processor keeps a store for itself, whoever
   reads it sees it; whoever read it before is seen in its slot.
2. It waits until no living process is at the record: all those have noted what they have, and none
   takes or gives anything now.  (One that never gets on, since it is stopped, puts the revival off:
   it may have the token.)
3. A token that is neither there nor noted by the living is lost.  It is given back.
4. ``stop`` is cleared.

Nobody ever has a token that another one has: only lost ones are made anew, and what makes them lost,
that who had them is dead and everybody else has noted what he has, stays so.  A reviver that dies
leaves ``stop`` set and the mutex to the next one, who finds the same or less that is lost.
"""

from __future__ import annotations

import time
import warnings
from itertools import starmap

from fiber._sync.abandonment import Abandoned
from fiber._sync.arena import AT, WHO, Arena

SEMAPHORE, RECURSIVE = 1, 0  # SemLock's kinds, in its own numbers

SLICE = 0.2
"""Seconds that one wait in the kernel lasts: so long a signal may be slept over, and a token of a
dead process lie unnoticed.
"""

MOMENT = 0.002
"""Seconds until what is stored here is seen by all."""

_QUIET = 1.0
"""Seconds that a revival waits for those who are at the record, before it is put off."""

_NAP = 0.001

_UNNOTED = 10
"""Looks in a row that must find a token with nobody before it is thought lost."""

# Words of a record, counted from its first.  The first four are the semaphore.
ATTENTION = 4
NOTE = 5
TOTAL = 6
DEAD = 7
WORDS = 16

# Bytes of the word ``ATTENTION``, as bits of it.
STOP = 1
RING = 1 << 8
ABANDONED = 1 << 16

_ONCE = ((),)


class SharedSemaphore:
    """One record, as this process sees it."""

    __slots__ = (
        "__weakref__", "_arena", "_at", "_attention", "_free", "_give", "_looks", "_me", "_sem",
        "_take", "_words", "maximum", "offset",
    )  # fmt: skip

    kind = SEMAPHORE
    noun = "semaphore"

    def __init__(self, arena: Arena, offset: int, maximum: int) -> None:
        self.offset = offset
        self.maximum = maximum
        self._arena = arena
        self._words = arena.words
        self._free = arena.free
        self._me = arena.me
        self._at = offset // 8
        self._attention = self._at + ATTENTION
        self._looks = 0
        self._sem = arena.semaphore(offset, self.kind, maximum)
        self._take = self._sem.acquire
        self._give = self._sem.release

    def create(self, value: int) -> None:
        """Begin the record's life."""
        words, at = self._words, self._at
        for word in range(at + ATTENTION, at + WORDS):
            words[word] = 0
        words[at + TOTAL] = value
        self._arena.make_semaphore(self.offset, value)

    # What multiprocessing's SemLock has

    def is_mine(self) -> bool:
        """Whether this thread has it, having been the last in this process to acquire it."""
        return self._sem._is_mine()

    def count(self) -> int:
        """How often this process has acquired it and not released it."""
        return self._sem._count()

    def value(self) -> int:
        """How often it can be acquired now."""
        return self._sem._get_value()

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool | Abandoned:
        """Take a token; False if there is none, nor within ``timeout`` seconds."""
        taken: list[bool | Abandoned] = []
        try:
            return self._acquire(block, timeout, taken)
        except BaseException:
            if taken:
                self.release()
            raise

    def release(self) -> None:
        """Give a token back; ValueError if there are as many as there can be."""
        while not self._try_release():
            self._park()
        if self._words[self._attention] & RING:
            self._arena.ring()

    # Notes: for subclasses

    def _note(self) -> None:
        """This process has a token more."""
        raise NotImplementedError

    def _unnote(self) -> None:
        """This process is about to give one back."""
        raise NotImplementedError

    def _holders(self) -> list[tuple[int, int]]:
        """Processes and how many tokens each has a note of."""
        raise NotImplementedError

    def _forget(self, who: int) -> None:
        """Clear the notes of a dead process."""
        raise NotImplementedError

    # Waiting

    def _acquire(
        self, block: bool, timeout: float | None, taken: list[bool | Abandoned]
    ) -> bool | Abandoned:
        deadline = None if timeout is None else time.monotonic() + timeout
        left = 0.0
        while not self._try_acquire(left, taken):
            left = SLICE if deadline is None else min(SLICE, deadline - time.monotonic())
            if not block or left <= 0:
                if not self._look_after_the_dead():
                    return False
                left = 0.0
            elif self._words[self._attention] & STOP:
                self._park()
            else:
                self._look_after_the_dead()
        self._looks = 0
        return taken[0]

    def _try_acquire(self, seconds: float, taken: list[bool | Abandoned]) -> bool:
        """One try, noted in ``taken`` if it succeeds."""
        slot = self._slot()
        words = self._words
        try:
            words[slot] = self._at
            attention = words[self._attention]
            if not attention & STOP:
                # Noted in the step that takes it: no signal strikes in between.
                taken.extend(filter(None, map(self._take, (True,), (seconds,))))
                if taken:
                    self._note()
                    if attention & ABANDONED:
                        taken[0] = self._told()
            return bool(taken)
        except BaseException:
            if taken:
                taken.clear()
                self._unnote()
                self._give()
            raise
        finally:
            words[slot] = 0
            self._free.append(slot)

    def _try_release(self) -> bool:
        """One try: not while dead processes' tokens are given back."""
        slot = self._slot()
        words = self._words
        given: list[None] = []
        try:
            words[slot] = self._at
            if words[self._attention] & STOP:
                return False
            self._unnote()
            given.extend(starmap(self._give, _ONCE))
            return True
        except ValueError:
            raise
        except BaseException:
            if not given:  # begun, so it is done
                self._give()
            raise
        finally:
            words[slot] = 0
            self._free.append(slot)

    def _slot(self) -> int:
        try:
            return self._free.pop()
        except IndexError:
            return self._arena.claim()

    def _told(self) -> Abandoned:
        """Take note of an abandonment, so that nobody else is told of it."""
        self._arena.bytes[self._attention * 8 + 2] = 0
        return Abandoned(self._arena.name(self._words[self._at + DEAD]))

    # Reviving

    def _park(self) -> None:
        """Wait until a revival is over, and go on with it if its process died."""
        self._warn(self._arena.exclusively(lambda: self._revive() if self._stopped() else []))

    def _stopped(self) -> bool:
        return bool(self._words[self._attention] & STOP)

    def _look_after_the_dead(self) -> bool:
        """Give back what dead processes have; whether there was any."""
        if self.value() or not self._is_suspicious():
            return False
        self._looks = 0
        released = self._arena.exclusively(self._revive)
        self._warn(released)
        return bool(released)

    def _is_suspicious(self) -> bool:
        noted = 0
        for who, tokens in self._holders():
            if not self._arena.is_alive(who):
                return True
            noted += tokens
        self._looks = self._looks + 1 if noted < self._words[self._at + TOTAL] else 0
        return self._looks > _UNNOTED

    def _revive(self) -> list[int]:
        """Give back the tokens of the dead; whose they were, 0 for one that was not noted."""
        stop = self._attention * 8
        released: list[int] = []
        self._arena.bytes[stop] = 1
        try:
            self._arena.sleep(MOMENT)
            if self._is_quiet():
                for who in self._lost():
                    self._abandon(who)
                    released.append(who)
        finally:
            self._arena.bytes[stop] = 0
        return released

    def _is_quiet(self) -> bool:
        """Wait until no living process is at the record; False if that takes too long."""
        naps = round(_QUIET / _NAP)
        while any(map(self._is_at_it, self._arena.slots())):
            naps -= 1
            if not naps:
                return False
            self._arena.sleep(_NAP)
        return True

    def _is_at_it(self, slot: int) -> bool:
        words = self._words
        if words[slot + AT] != self._at:
            return False
        if self._arena.is_alive(words[slot + WHO]):
            return True
        words[slot + AT] = 0  # it died at it
        return False

    def _lost(self) -> list[int]:
        """For each lost token whose it was.  Clears the notes of the dead."""
        missing = self._words[self._at + TOTAL] - self.value()
        lost: list[int] = []
        for who, tokens in self._holders():
            if self._arena.is_alive(who):
                missing -= tokens
            else:
                self._forget(who)
                lost += [who] * tokens
        # One may be noted twice or not at all: its holder died between the token and the note.
        return (lost + [0] * max(0, missing))[: max(0, missing)]

    def _abandon(self, who: int) -> None:
        self._words[self._at + DEAD] = who
        self._arena.bytes[self._attention * 8 + 2] = 1
        # By another view of it: this one counts what this process has.
        self._arena.semaphore(self.offset, SEMAPHORE, self.maximum).release()

    def _warn(self, released: list[int]) -> None:
        for who in dict.fromkeys(released):
            warnings.warn(
                f"a {self.noun} was released for {self._arena.name(who)}, which ended while it had "
                "it: what it guards may be half changed",
                RuntimeWarning,
                stacklevel=5,
            )

    def after_fork(self) -> None:
        """In a process that somebody else forked: what the parent has is not ours."""
        self._sem._after_fork()
        self._me = self._arena.me
