"""Threads of other hosts that wait at a barrier.  The hub takes each step of a wait for them.

``fiber.Barrier`` has the same steps for the processes of the barrier's host, in the same memory::

    lock ─► no pass is unfinished ─► count + 1 ─► unlock ─► notified ─► lock ─► count - 1 ─► unlock

The state and the count are words of two wait lists: that of the barrier's condition, and that of
its members.  A member's place says whether its thread is counted.  So a member that dies is no
longer counted as soon as its place is removed.  The index of a thread is the count after it has
left: an interrupt, a death or a late thread cannot give an index twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeAlias

from fiber._hub.hosted import HostedSemaphore, HostedWaitList, Waiter
from fiber._hub.protocol import RECHECK, BarrierState, Breach, Status
from fiber._hub.registry import Registry
from fiber._sync.semaphore import SEM_VALUE_MAX
from fiber._transport.loop import EventLoop, ScheduledCall

Locked: TypeAlias = Callable[[], bool]
"""Step with the barrier's lock; True if the party keeps the lock."""


class _PartyStep:
    """Wait of a party for the lock or for a notice; a ``Waiter``."""

    def __init__(self, done: Callable[[bool], None]) -> None:
        self._done = done

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        """Go on.  A lock comes with the name of its dead holder in ``buffers``, if it has one."""
        self._done(bool(buffers))


class Party:
    """Thread of another host that takes part in a barrier.  Runs on the loop thread.

    Its stream keeps it, and with it a place among the members, from the first wait on.
    """

    def __init__(
        self,
        loop: EventLoop,
        lock: HostedSemaphore,
        condition: HostedWaitList,
        members: HostedWaitList,
    ) -> None:
        self._loop = loop
        self._lock = lock
        self._condition = condition
        self._members = members
        self._member: int | None = None
        """Place among the members."""
        self._place: int | None = None
        """Place in the condition, from falling asleep until it has the lock again."""
        self._step: _PartyStep | None = None
        """Present wait for the lock or for a notice."""
        self._timer: ScheduledCall | None = None
        self._request: Waiter | None = None
        self._is_counted = False
        self._actor = ""
        """Name of the process, if it has to call the action."""
        self._acts = False
        """True while the process calls the action.  The party keeps the lock."""
        self._when_free: Callable[[], None] | None = None

    def meet(self, request: Waiter, parties: int, timeout: float, actor: str) -> None:
        """Wait at the barrier.

        Reply with OK and the index, with BROKEN and the ``Breach``, or with NO if there are too
        many threads.  The reply ACT comes first if the process, ``actor``, has to call the action.
        ValueError if the party is still busy.
        """
        if self._step is not None or self._acts or self._is_counted:
            raise ValueError("the thread is already at the barrier")
        self._request, self._parties, self._timeout = request, parties, timeout
        self._actor = actor
        self._with_lock(self._arrive)

    def acted(self, request: Waiter) -> None:
        """Let all go, as the process has called the action.  ValueError if it was not asked to."""
        if not self._acts:
            raise ValueError("the barrier's action was not to be called")
        self._request = request
        self._return_lock(self._release)

    def withdraw(self, then: Callable[[], None] = lambda: None) -> None:
        """Stop waiting without a reply: the thread was interrupted.

        The others wait for another one.  If the thread was to call the action, the barrier breaks.
        Call ``then`` once the thread is no longer counted.
        """
        self._request = None
        self._stop_waiting()
        if self._acts:
            self._return_lock(self._fail)
        elif self._is_counted:
            self._with_lock(self._leave)
        if self._is_counted:  # the lock is not free
            self._when_free = then
        else:
            then()

    def dismiss(self) -> None:
        """Give up the place among the members: the process ends in good order."""
        self.withdraw(self._give_up_membership)

    def abandon(self) -> None:
        """Note that the process has died.  Others find its place, and break the barrier."""
        self._request = self._when_free = None
        self._stop_waiting()
        member, self._member, self._is_counted = self._member, None, False
        if member is not None:
            self._members.places.lose(member)
        if self._acts:
            self._acts = False
            self._lock.abandon(self._actor)

    # Steps

    def _with_lock(self, action: Locked) -> None:
        def locked(holder_died: bool) -> None:
            self._step = None
            self._lock.lend(partial(self._locked, action, holder_died))

        self._step = _PartyStep(locked)
        self._lock.acquire(self._step, lambda _: None)

    def _return_lock(self, action: Locked) -> None:
        self._acts = False
        self._lock.lend(action)

    def _sleep(self, seconds: float, then: Callable[[bool], bool]) -> bool:
        """Sleep until notified, or for ``seconds``; then call ``then`` with the lock."""
        try:
            self._place = self._condition.places.enter(afar=True)
        except OSError:  # all places are taken
            return self._end(Status.NO)
        self._timer = self._loop.call_later(seconds, self._wake, then)
        self._step = _PartyStep(lambda _: self._wake(then))
        self._condition.sleep(self._step, self._place)
        return False

    def _wake(self, then: Callable[[bool], bool]) -> None:
        self._drop_step()
        self._with_lock(partial(self._woken, then))

    def _drop_step(self) -> None:
        step, self._step = self._step, None
        if step is not None and not self._lock.withdraw(step):
            self._condition.withdraw(step)
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    def _stop_waiting(self) -> None:
        self._drop_step()
        place, self._place = self._place, None
        if place is not None:
            self._condition.places.leave(place)

    def _give_up_membership(self) -> None:
        member, self._member = self._member, None
        if member is not None:
            self._members.places.dismiss(member)

    # With the lock

    def _locked(self, action: Locked, holder_died: bool) -> bool:
        if holder_died:
            self._remove_dead()
            self._break()
        return action()

    def _woken(self, then: Callable[[bool], bool]) -> bool:
        place, self._place = self._place, None
        assert place is not None
        return then(self._condition.places.leave(place))

    def _arrive(self) -> bool:
        if self._member is None:
            try:
                self._member = self._members.places.enter(afar=True)
            except OSError:  # all places are taken
                return self._end(Status.NO)
        return self._enter()

    def _enter(self) -> bool:
        if self._state in (BarrierState.DRAINING, BarrierState.RESETTING):
            return self._sleep(RECHECK, self._enter_later)
        if self._state == BarrierState.BROKEN:
            return self._end(Status.BROKEN)
        self._change_count(1)
        self._deadline = self._loop.now() + self._timeout
        if self._count < self._parties:
            return self._wait()
        if not self._actor:
            return self._release()
        self._acts = True
        self._answer(Status.ACT)
        return True

    def _enter_later(self, notified: bool) -> bool:
        if not notified and self._remove_dead():
            self._break()
        return self._enter()

    def _wait(self) -> bool:
        left = max(0.0, self._deadline - self._loop.now())
        return self._sleep(min(left, RECHECK), self._look)

    def _look(self, notified: bool) -> bool:
        died = not notified and self._remove_dead()
        if self._state != BarrierState.FILLING:
            return self._leave()
        late = self._loop.now() >= self._deadline
        if not died and not late:
            return self._wait()
        self._break()
        return self._end(Status.BROKEN, Breach.DIED if died else Breach.LATE)

    def _release(self) -> bool:
        self._set_state(BarrierState.DRAINING)
        return self._leave()

    def _fail(self) -> bool:
        self._break()
        return self._leave()

    def _leave(self) -> bool:
        if self._state == BarrierState.DRAINING:
            return self._end(Status.OK, self._count - 1)
        return self._end(Status.BROKEN)

    def _end(self, status: Status, value: int = 0) -> bool:
        if self._is_counted:
            self._change_count(-1)
            if not self._count and self._state in (BarrierState.DRAINING, BarrierState.RESETTING):
                self._set_state(BarrierState.FILLING)
        self._answer(status, value)
        then, self._when_free = self._when_free, None
        if then is not None:
            then()
        return False

    def _break(self) -> None:
        self._set_state(BarrierState.BROKEN)

    def _remove_dead(self) -> bool:
        """Stop counting members that died; tell whether there were any."""
        members = self._members.places
        died = self._condition.places.remove_dead() + members.remove_dead()
        if died:
            members.set(1, members.held())
        return bool(died)

    def _change_count(self, by: int) -> None:
        assert self._member is not None
        self._is_counted = by > 0
        self._members.places.tally(self._member, int(self._is_counted), self._count + by)

    @property
    def _count(self) -> int:
        return self._members.places.get(1)

    @property
    def _state(self) -> int:
        return self._condition.places.get(0)

    def _set_state(self, state: BarrierState) -> None:
        self._condition.places.set(0, state)
        self._condition.places.notify(SEM_VALUE_MAX)

    def _answer(self, status: Status, value: int = 0) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.answer(status, value)


def new_party(
    loop: EventLoop, registry: Registry, members: HostedWaitList, condition: bytes, lock: bytes
) -> Party:
    """Return a new party at the barrier of ``members``, a condition and a lock, by their tokens.

    ValueError if these are not the parts of a barrier.
    """
    waiters, semaphore = registry.hosted(condition), registry.hosted(lock)
    if not (isinstance(waiters, HostedWaitList) and isinstance(semaphore, HostedSemaphore)):
        raise ValueError("the request is not for a barrier")
    return Party(loop, semaphore, waiters, members)
