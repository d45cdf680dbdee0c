"""Waits of processes of other hosts at a barrier, each carried out by one request.

``fiber.Barrier`` has the algorithm: a lock, a state, a count, and a condition's wait list.  From
another host each of its steps would be a round trip with the lock held.  Here the hub takes
the steps of a usual pass by itself::

    lock ─► count + 1, a place ─► unlock ─► notified ─► lock ─► count - 1, no place ─► unlock

Everything unusual is left to the process, which then takes each step itself: a barrier that still
drains, or an action to call.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fiber._hub.hosted import HostedSemaphore, HostedWaitList, Waiter
from fiber._hub.protocol import Status
from fiber._sync.semaphore import SEM_VALUE_MAX
from fiber._sync.wait_list import PLACES

FILLING, DRAINING, BROKEN = 0, 1, -2
"""States of threading's barrier."""


class _MeetingStep:
    """Wait of a meeting for the lock or for a notice; a ``Waiter``."""

    def __init__(self, done: Callable[[bool], None]) -> None:
        self._done = done

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        """Go on.  A lock comes with the name of its dead holder in ``buffers``, if it has one."""
        self._done(bool(buffers))


class Meeting:
    """Wait of a process of another host at a barrier.  Runs on the loop thread.

    The reply to ``request`` is OK with the index of the process, BROKEN, or NO: then the process is
    not counted.
    """

    def __init__(
        self,
        request: Waiter,
        lock: HostedSemaphore,
        condition: HostedWaitList,
        members: HostedWaitList,
    ) -> None:
        self._request: Waiter | None = request
        self._lock = lock
        self._condition = condition
        self._members = members
        self._step: _MeetingStep | None = None
        self._place: int | None = None
        self._index = 0

    def begin(self, member: int, parties: int, has_action: bool) -> None:
        """Count the process, which has the place ``member`` among the members.

        ValueError if there is no such place.
        """
        PLACES.index(member)
        self._member, self._parties, self._has_action = member, parties, has_action
        self._with_lock(self._enter)

    def withdraw(self) -> None:
        """Stop waiting, and count the process no longer.

        The request gets NO, unless the barrier was just passed.
        """
        self._drop_step()
        if self._place is None:
            self._answer(Status.NO)
        else:
            self._with_lock(self._withdraw)

    def abandon(self) -> None:
        """Stop, as the process has ended.  Others find its place, and break the barrier."""
        self._request = None
        self._drop_step()
        if self._place is not None:
            self._condition.places.lose(self._place)

    # Steps

    def _with_lock(self, action: Callable[[], None]) -> None:
        def locked(holder_died: bool) -> None:
            self._step = None
            try:
                if holder_died:
                    self._break()
                action()
            finally:
                self._lock.release()

        self._step = _MeetingStep(locked)
        self._lock.acquire(self._step, lambda _: None)

    def _drop_step(self) -> None:
        step, self._step = self._step, None
        if step is not None and not self._lock.withdraw(step):
            self._condition.withdraw(step)

    def _notified(self, _: bool) -> None:
        self._step = None
        self._with_lock(self._leave)

    # With the lock

    def _enter(self) -> None:
        places = self._condition.places
        self._index = self._members.places.get(1)
        is_last = self._index + 1 == self._parties
        if places.get(0) != FILLING or (is_last and self._has_action):
            self._answer(Status.NO)
        elif is_last:
            places.set(0, DRAINING if self._index else FILLING)
            places.notify(SEM_VALUE_MAX)
            self._answer(Status.OK, self._index)
        else:
            self._wait()

    def _wait(self) -> None:
        try:
            place = self._condition.places.enter(afar=True)
        except OSError:  # all places are taken: the process gets this error itself
            self._answer(Status.NO)
            return
        if self._place is None:
            self._members.places.tally(self._member, 1)
        self._place = place
        self._step = _MeetingStep(self._notified)
        self._condition.sleep(self._step, place)

    def _leave(self) -> None:
        assert self._place is not None
        self._condition.places.leave(self._place)
        if self._condition.places.get(0) == FILLING:
            self._wait()
        else:
            self._end()

    def _withdraw(self) -> None:
        assert self._place is not None
        self._condition.places.leave(self._place)
        self._end()

    def _end(self) -> None:
        places, members = self._condition.places, self._members.places
        state = places.get(0)
        self._place = None
        members.tally(self._member, -1)
        if not members.get(1) and state not in (FILLING, BROKEN):
            places.set(0, FILLING)
            places.notify(SEM_VALUE_MAX)
        if state == FILLING:
            self._answer(Status.NO)
        elif state == DRAINING:
            self._answer(Status.OK, self._index)
        else:
            self._answer(Status.BROKEN)

    def _break(self) -> None:
        """Break the barrier, as a process has died with the lock."""
        places, members = self._condition.places, self._members.places
        if places.remove_dead() + members.remove_dead():
            members.set(1, members.held())
        places.set(0, BROKEN)
        places.notify(SEM_VALUE_MAX)

    def _answer(self, status: Status, value: int = 0) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.answer(status, value)
