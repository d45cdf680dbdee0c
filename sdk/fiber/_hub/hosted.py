"""Objects that a hub serves to other hosts, and the requests that wait for them.

All classes run on the loop thread.  A hub takes a message out of a channel, or lowers a counter,
only for a request that waits for it, and replies at once.  So a client that dies has taken no more
than it requested.

``HostedSemaphore`` holds tokens for processes of other hosts.  The loop does not wait: while such
a process waits for a token, each release rings the hub's doorbell.  Requests get tokens in their
order.  ``HostedWaitList`` is the wait list of a condition.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.one_way import LOOK_AGAIN, ReceivingEnd, SendingEnd
from fiber._hub.protocol import HALF_FULL, TAKEN, Doorbell, Status
from fiber._hub.streams import EDGE, IN, OUT, Poller
from fiber._sync.semaphore import COUNTING, SLICE, Abandoned, SharedBlock, SharedSemaphore, warn_of
from fiber._sync.wait_list import WaitList
from fiber._transport.loop import Loop
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import INLINE_LIMIT, Message

Parts = tuple[BytesLike, Sequence[memoryview]]
"""Message of a channel: its payload and its buffers."""


class Waiter(Protocol):
    """Request that waits.

    ``PendingRequest`` implements it.  Its module stands above this one.
    """

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        """Reply to the request, once."""


class WaitingSender(Waiter, Protocol):
    """Request to send, as ``PendingRequest`` and ``QueuedMessage`` are."""

    def refuse(self, error: Exception) -> None:
        """End the request's stream instead of a reply."""


class HostedChannel:
    """End of a channel that the hub serves."""

    def __init__(self, poller: Poller, channel: LocalChannel) -> None:
        self._poller = poller
        self._channel = channel
        self._senders: deque[tuple[WaitingSender, deque[Parts]]] = deque()
        self._events = 0
        """Event after which to try again to send; 0 if there is none."""
        self._receivers: deque[Waiter] = deque()
        self._pollers: deque[Waiter] = deque()
        self._watchers: set[Callable[[], None]] = set()

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._channel.fileno()

    def send(self, waiter: WaitingSender, messages: deque[Parts]) -> None:
        """Send messages, in the order of the requests.

        Messages leave ``messages`` as they are sent.  The reply follows the last one.
        """
        self._senders.append((waiter, messages))
        self._serve_senders()
        self._watch()

    def receive(self, waiter: Waiter) -> None:
        """Reply with the next message."""
        self._receivers.append(waiter)
        self._serve_receivers()
        self._watch()

    def poll(self, waiter: Waiter) -> None:
        """Reply once the channel is readable."""
        if self.readable():
            waiter.answer(Status.OK)
        else:
            self._pollers.append(waiter)
            self._watch()

    def readable(self) -> bool:
        """Tell whether there is a message or the end."""
        return self._channel.poll(0)

    def watch(self, watcher: Callable[[], None]) -> None:
        """Call ``watcher`` once when the channel is readable."""
        if self.readable():
            watcher()
        else:
            self._watchers.add(watcher)
            self._watch()

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        for queue in (self._receivers, self._pollers):
            if waiter in queue:
                queue.remove(waiter)
                self._watch()
                return True
        for entry in self._senders:
            if entry[0] is waiter:
                self._senders.remove(entry)
                self._watch()
                return True
        return False

    def forget(self, watcher: Callable[[], None]) -> None:
        """Stop watching for ``watcher``."""
        self._watchers.discard(watcher)
        self._watch()

    def close(self) -> None:
        """Stop serving the channel, and close it."""
        self._poller.forget(self._channel.fileno())
        self._channel.close()

    def _watch(self) -> None:
        mask = IN if self._is_awaited() else 0
        if self._senders:
            mask |= self._events
        self._poller.watch(self._channel.fileno(), mask, self._event)

    def _is_awaited(self) -> bool:
        return bool(self._receivers or self._pollers or self._watchers)

    def _event(self, events: int) -> None:
        if self._senders:
            self._serve_senders()
        if events & ~OUT:
            self._serve_receivers()
            self._tell()
        self._watch()

    def _serve_senders(self) -> None:
        while self._senders:
            waiter, messages = self._senders[0]
            try:
                while messages:
                    if not self._try_send(*messages[0]):
                        return
                    messages.popleft()
            except BrokenPipeError:
                status = Status.BROKEN
            except OSError as error:  # no descriptor is free, for example
                self._senders.popleft()
                waiter.refuse(error)
                continue
            else:
                status = Status.OK
            self._senders.popleft()
            waiter.answer(status, TAKEN | (HALF_FULL if self._is_half_full() else 0))

    def _is_half_full(self) -> bool:
        return self._channel.is_half_full()

    def _try_send(self, payload: BytesLike, buffers: Sequence[memoryview]) -> bool:
        sent = self._channel.try_send(payload, buffers)
        self._events = self._channel.room_events
        return sent

    def _serve_receivers(self) -> None:
        while self._receivers:
            try:
                message = self._channel.try_recv()
            except EOFError:
                while self._receivers:
                    self._receivers.popleft().answer(Status.EOF)
                return
            if message is None:
                return
            self._hand_over(self._receivers.popleft(), message)

    def _hand_over(self, waiter: Waiter, message: Message) -> None:
        payload, buffers = message.payload, message.buffers
        if len(payload) <= INLINE_LIMIT:
            # It may be in borrowed memory, and the reply may have to wait.
            payload = memoryview(message.tobytes())
        waiter.answer(Status.OK, self.readable(), [payload, *buffers])

    def _tell(self) -> None:
        if (self._pollers or self._watchers) and self.readable():
            while self._pollers:
                self._pollers.popleft().answer(Status.OK)
            watchers, self._watchers = self._watchers, set()
            for watcher in watchers:
                watcher()


class HostedSender(HostedChannel):
    """Sending end of a one-way channel, a patient sender (see ``one_way``)."""

    _channel: SendingEnd

    def __init__(self, loop: Loop, poller: Poller, channel: SendingEnd) -> None:
        super().__init__(poller, channel)
        self._loop = loop
        self._begin: float | None = None
        """Time of the first attempt to send the next message."""
        self._is_timed = False

    def _is_half_full(self) -> bool:
        return False  # the backlog takes what the socket does not

    def close(self) -> None:
        """Stop serving the channel, and close it."""
        self._senders.clear()
        super().close()

    def _try_send(self, payload: BytesLike, buffers: Sequence[memoryview]) -> bool:
        sent = self._channel.try_send_directly(payload, buffers)
        if not sent:
            self._begin = self._begin or time.monotonic()
            self._events, patience = self._channel.patience(self._begin)
            if patience:
                self._try_again_after(patience)
                return False
            sent = super()._try_send(payload, buffers)
        if sent:
            self._begin = None
        return sent

    def _try_again_after(self, seconds: float) -> None:
        if not self._is_timed:
            self._is_timed = True
            self._loop.call_later(seconds, self._try_again)

    def _try_again(self) -> None:
        self._is_timed = False
        if self._senders:
            self._event(OUT)


class HostedReceiver(HostedChannel):
    """Receiving end of a one-way channel.

    While a request waits, it looks at the backlog each second.  A process of this host may have
    taken the packet that wakes readers, and died before it woke the next one.
    """

    def __init__(self, loop: Loop, poller: Poller, channel: ReceivingEnd) -> None:
        super().__init__(poller, channel)
        self._loop = loop
        self._is_looking = False

    def close(self) -> None:
        """Stop serving the channel, and close it."""
        self._receivers.clear()
        self._pollers.clear()
        self._watchers.clear()
        super().close()

    def _watch(self) -> None:
        super()._watch()
        if self._is_awaited() and not self._is_looking:
            self._is_looking = True
            self._loop.call_later(LOOK_AGAIN, self._look)

    def _look(self) -> None:
        self._is_looking = False
        if self._is_awaited():
            self._event(IN)


class HostedCounter:
    """Counter that the hub serves."""

    def __init__(self, poller: Poller, counter: LocalCounter) -> None:
        self._poller = poller
        self._counter = counter
        self._takers: deque[Waiter] = deque()
        self._changes: dict[Waiter, int] = {}

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._counter.fileno()

    def add(self, n: int) -> None:
        """Raise the count."""
        self._counter.add(n)

    def clear(self) -> int:
        """Set the count to zero and return the count before."""
        return self._counter.clear()

    def lower(self, n: int) -> None:
        """Lower the count by ``n``, or to zero."""
        self._counter.lower(n)

    def duplicate(self) -> LocalCounter:
        """Return a counter of the same count, which does not end with this one."""
        return LocalCounter.from_fd(os.dup(self._counter.fileno()))

    def value(self) -> int:
        """Return the count."""
        return self._counter.value()

    def take(self, waiter: Waiter) -> None:
        """Reply once the count was lowered for this request."""
        self._takers.append(waiter)
        self._event(IN)

    def changed(self, waiter: Waiter, since: int) -> None:
        """Reply once the count is not ``since``."""
        self._changes[waiter] = since
        self._event(IN)

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        found = self._changes.pop(waiter, None) is not None
        if waiter in self._takers:
            self._takers.remove(waiter)
            found = True
        self._watch()
        return found

    def close(self) -> None:
        """Stop serving the counter, and close it."""
        self._poller.forget(self._counter.fileno())
        self._counter.close()

    def _watch(self) -> None:
        mask = IN if self._takers else 0
        if not mask and self._changes:
            # Without EDGE, a count that stays above zero would be reported again and again.
            mask = IN | EDGE
        self._poller.watch(self._counter.fileno(), mask, self._event)

    def _event(self, _events: int) -> None:
        if self._changes:
            value = self._counter.value()
            for waiter in [waiter for waiter, since in self._changes.items() if since != value]:
                del self._changes[waiter]
                waiter.answer(Status.OK)
        while self._takers and self._counter.take(0):
            self._takers.popleft().answer(Status.OK)
        self._watch()


class HostedMemory:
    """Shared memory that the hub keeps.  Its changes do not travel on streams."""

    def withdraw(self, waiter: Waiter) -> bool:
        """Return False: no request waits for memory."""
        return False

    def close(self) -> None:
        """Do nothing: the registry closes the descriptors."""


_RELEASE_AGAIN = 0.005
"""Seconds until the next attempt to return a token during a revival."""


class HostedSemaphore:
    """Semaphore that the hub serves.  Runs on the loop thread."""

    def __init__(self, loop: Loop, doorbell: Doorbell, block: SharedBlock) -> None:
        self._loop = loop
        self._doorbell = doorbell
        # COUNTING also for a recursive lock: this process acquires tokens for others.
        self._semaphore = SharedSemaphore(block, COUNTING)
        self._waiters: deque[tuple[Waiter, Callable[[bool], None]]] = deque()
        self._is_listening = False
        self._is_serving = False
        self._revival = threading.Thread()  # none yet

    def acquire(self, waiter: Waiter, granted: Callable[[bool], None]) -> None:
        """Reply once there is a token for this request.

        Before that, call ``granted`` with whether the stream keeps the token.
        """
        self._waiters.append((waiter, granted))
        self._serve()

    def lend(self, action: Callable[[], bool]) -> None:
        """Call ``action`` with a token that a waiter got, and return the token unless it is True.

        Other waiters are served after that.
        """
        keeps = False
        before, self._is_serving = self._is_serving, True
        try:
            keeps = action()
        finally:
            self._is_serving = before
            if not keeps:
                self.release()

    def release(self) -> None:
        """Return a token; ValueError if the semaphore is at its maximum."""
        if self._semaphore.release(wait=False):
            self._serve()
        else:
            self._loop.call_later(_RELEASE_AGAIN, self.release)

    def disown(self) -> None:
        """Leave a token taken.  A waiter gets it back, or another process releases it."""
        self._semaphore.disown()

    def abandon(self, holder: str) -> None:
        """Note the dead holder for the next acquirer, warn, and return its token."""
        if not self._semaphore.is_silent():
            self._semaphore.note_death(holder)
            with contextlib.suppress(RuntimeWarning):  # as an error it would end the hub
                warn_of(holder)
        self.release()

    def value(self) -> int:
        """Return the number of tokens that are available."""
        return self._semaphore._get_value()

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        for entry in self._waiters:
            if entry[0] is waiter:
                self._waiters.remove(entry)
                return True
        return False

    def close(self) -> None:
        """Stop serving it, as no process of another host uses it."""
        self._waiters.clear()
        self._stop_listening()

    def _serve(self) -> None:
        if self._is_serving:  # by a caller of this call, which goes on
            return
        self._is_serving = True
        try:
            self._serve_waiters()
        finally:
            self._is_serving = False
        if self._waiters and not self._is_listening:
            self._is_listening = True
            self._doorbell.listen(self._serve)
            self._semaphore.listen(True)
            self._look()

    def _serve_waiters(self) -> None:
        while self._waiters and (result := self._semaphore.try_acquire()):
            waiter, granted = self._waiters.popleft()
            tracked = not self._semaphore.is_untracked()
            granted(tracked)
            holder = [memoryview(result.holder.encode())] if isinstance(result, Abandoned) else []
            waiter.answer(Status.OK, tracked, holder)

    def _look(self) -> None:
        """Look for tokens, also lost ones.

        A process may die before it rings the doorbell, or while it holds a token.
        """
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


_LOOK = 1.0
"""Seconds until the hub looks by itself for notified waiters.

A process may die after it notified a waiter and before it rings the doorbell.
"""


class HostedWaitList:
    """Wait list that the hub serves.  Runs on the loop thread."""

    def __init__(self, loop: Loop, doorbell: Doorbell, block: SharedBlock) -> None:
        self._loop = loop
        self._doorbell = doorbell
        self.places = WaitList(block, self._serve)
        self._sleepers: dict[Waiter, int] = {}
        self._is_looking = False

    def sleep(self, waiter: Waiter, place: int) -> None:
        """Reply once ``place`` is notified."""
        if not self._sleepers:
            self._doorbell.listen(self._serve)
        self._sleepers[waiter] = place
        self._serve()
        if self._sleepers and not self._is_looking:
            self._is_looking = True
            self._loop.call_later(_LOOK, self._look)

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        return self._sleepers.pop(waiter, None) is not None

    def close(self) -> None:
        """Stop serving it, as no process of another host uses it."""
        self._sleepers.clear()
        self._doorbell.forget(self._serve)

    def _serve(self) -> None:
        for waiter, place in list(self._sleepers.items()):
            # A waiter that was answered may have served others.
            if waiter in self._sleepers and self.places.is_notified(place):
                del self._sleepers[waiter]
                waiter.answer(Status.OK)
        if not self._sleepers:
            self._doorbell.forget(self._serve)

    def _look(self) -> None:
        self._is_looking = False
        self._serve()
        if self._sleepers:
            self._is_looking = True
            self._loop.call_later(_LOOK, self._look)
