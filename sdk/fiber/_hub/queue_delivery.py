"""Delivery of a queue's items: from ``put`` into its channel, and to readers elsewhere.

A *feeder* sends the items that did not fit into the channel when they were put.  It also counts the
items and the slots that they take.  A process that puts an item into a bounded queue takes a slot
for it.  The slot of an item that was sent becomes free when the item is received.  An item that was
not sent yet is in the memory of its process, and is lost when the process dies.  So each process
keeps the number of its unsent items in a table in shared memory, where other processes find it.  A
reader that is just taking an item counts there, too, as the slot of that item is not free yet.

A *dealer* sends the items to the readers in turn, before they request them::

    put ── inbox ──► Dealer, a thread of the queue's maker ──┬─► the channel of a reader ──► get
                           ▲                                 └─► another reader's
    the first get ── arrivals
"""

from __future__ import annotations

import math
import os
import pickle
import select
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from multiprocessing import util
from queue import SimpleQueue
from typing import Any

from fiber._exceptions import report_uncaught
from fiber._hub import one_way, shared_blocks
from fiber._hub.client import ObjectUnreachable
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.one_way import ReceivingEnd, SendingEnd
from fiber._hub.remote import RemoteChannel, RemoteCounter, RemoteObject
from fiber._hub.shared_blocks import AnySemaphore, AnyWaitList
from fiber._sync.semaphore import COUNTING
from fiber._transport.channels import (
    Channel,
    ReceivingChannel,
    SendingChannel,
    SharedCounter,
)
from fiber._wire import bundle, packet
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

_DEAD_CHECK_AFTER = 1.0
"""Seconds that ``put`` waits before it looks for dead processes."""

_SURPLUS_CHECK_INTERVAL = 0.2
"""Seconds between two checks for surplus slots."""

_TRANSFER_POLL_INTERVAL = 1e-4
"""Seconds between two reads of the counts while an item goes from one count to the other."""
_READS = 1000
"""Reads of the counts after which ``size`` takes what it has read."""


PutItems = Callable[[Sequence[bytes]], AbstractContextManager[None]]
"""Function that sends items.  They are counted when its context begins."""


class QueueSlots:
    """Slots of a queue with a maximum size: the count of free ones.

    If a process dies before it has sent its items, their slots become free again.  If it dies while
    it sends or receives an item, one slot too many may become free.  Then there is a surplus slot
    until the queue is empty.
    """

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._claims = SlotClaims()
        self._free: SharedCounter = LocalCounter.create(maximum)
        self._next_count = math.inf

    def take(self, timeout: float | None, taken: list[Any]) -> bool:
        """Take a slot for an item and note it in ``taken``; False if none gets free in time."""
        now = time.monotonic()
        if now > self._next_count:
            self._next_count = now + _SURPLUS_CHECK_INTERVAL
            self._remove_excess()
        deadline = math.inf if timeout is None else now + timeout
        while True:
            left = deadline - time.monotonic()
            if self._free.claim(min(left, _DEAD_CHECK_AFTER), taken, self._claims):
                return True
            if not self._recover() and left <= _DEAD_CHECK_AFTER:
                return False

    def give_back(self) -> None:
        """Free the slot of an item that is not sent."""
        self._free.add(1)
        self._claims.drop()
        self._next_count = 0.0  # an interrupted put may free a slot twice

    def sending(self) -> None:
        """Note that an item leaves this process."""

    def not_sent(self) -> None:
        """Note that the item was not sent yet and is tried again."""

    def sent(self) -> None:
        """Note that the item was sent: its slot becomes free when it is received."""
        self._claims.drop()

    def put_items(self, outbox: SendingChannel) -> PutItems | None:
        """Return None: each item has a slot, so it is sent alone."""
        return None

    def receive(self, inbox: ReceivingChannel, *, wait: bool) -> Message | None:
        """Receive an item and free its slot; None if there is no item."""
        return inbox.recv_counting(self._free, self._claims, wait=wait)

    def used(self, waiting: int) -> int:
        """Return the number of items, of which ``waiting`` wait in this process."""
        return max(0, self._maximum - self._free.value())

    def full(self) -> bool:
        """Return True if no slot is free."""
        return not self._free.wait(0) and not self._recover()

    def _recover(self) -> bool:
        """Free the slots of dead processes; return whether there were any."""
        lost = self._claims.recover(self._free)
        if lost:
            self._next_count = 0.0
        return bool(lost)

    def _remove_excess(self) -> None:
        while self._free.value() > self._maximum and self._free.take(0):
            if self._free.value() < self._maximum:  # another process has removed a surplus slot too
                self._free.add(1)
                return


class ItemCount:
    """Count of the items of a queue without a maximum that have left their process.

    It makes no system call for an item while a feeder runs.  A system call releases the
    interpreter, and two threads that take it from each other at each item are several times slower
    than one.
    """

    def __init__(self) -> None:
        self._sent: SharedCounter = LocalCounter.create()

    def take(self, timeout: float | None, taken: list[Any]) -> bool:
        """Take a slot.  There is always one."""
        taken.append(1)
        return True

    def give_back(self) -> None:
        """Free the slot of an item that is not sent."""

    def sending(self) -> None:
        """Count an item before it leaves this process.  Its receiver lowers the count."""
        self._sent.add(1)

    def not_sent(self) -> None:
        """Note that the item was not sent yet and is tried again."""
        self._sent.take(0)

    def sent(self) -> None:
        """Do nothing: ``sending`` has counted the item."""

    def put_items(self, outbox: SendingChannel) -> PutItems | None:
        """Return a function that sends and counts items in one request to another host."""
        if isinstance(outbox, RemoteChannel) and isinstance(self._sent, RemoteCounter):
            return partial(outbox.put_items, counter=self._sent)
        return None

    def receive(self, inbox: ReceivingChannel, *, wait: bool) -> Message | None:
        """Receive an item and lower the count; None if there is no item."""
        return inbox.recv_uncounting(self._sent, wait=wait)

    def used(self, waiting: int) -> int:
        """Return the number of items, of which ``waiting`` wait in this process."""
        return self._sent.value() + waiting

    def full(self) -> bool:
        """Return False: there is always a slot."""
        return False


class Feeder:
    """Sender of the items that did not fit into the channel when they were put.

    It has a thread, which ends with its ``owner``, a queue.  The feeder has no reference to the
    queue, nor to the reading end: when no process can read any longer, it does not have to wait.

    There is no lock: a finalizer or a signal's handler may interrupt ``put`` at any step, put into
    the same queue, and raise.  Shared state changes by single steps of the interpreter.
    """

    def __init__(
        self,
        owner: Any,
        outbox: SendingChannel,
        slots: QueueSlots | ItemCount,
        *,
        on_error: Callable[[Exception, Any], None],
        close: Callable[[], None],
    ) -> None:
        self._owner = weakref.ref(owner)
        self._outbox = outbox
        self._slots = slots
        self._put_items = slots.put_items(outbox)
        self._on_error = on_error
        self._close_outbox = close
        self._unsent: deque[tuple[bytes, list[memoryview]]] = deque()
        # True when there are items, False at the end.
        self._wake: SimpleQueue[bool] = SimpleQueue()
        self._sending = False
        self._thread = 0
        # Raised before and after an item goes from ``_unsent`` into the count of ``_slots``.  While
        # it is odd, the item may be in neither count.
        self._transfer_steps = 0
        # Has one element while no thread runs.  A caller that sees it starts a thread, which takes
        # it.  If two callers start a thread, the second thread finds no element and ends.
        self._no_thread = [True]
        self._joins: list[util.Finalize] = []
        self._join_cancelled = False

    def put(self, payload: bytes, buffers: list[memoryview]) -> None:
        """Send a message now if no item waits and there is room, otherwise later."""
        # Read ``_unsent`` first: the feeder sets ``_sending`` before it takes an item out.
        may_send_now = not self._unsent and not self._sending
        if may_send_now and self._outbox.can_try_send and self._send_now(payload, buffers):
            return
        # The caller may change the arrays behind the buffers when ``put`` has returned.
        self._unsent.append((payload, packet.kept(buffers)))
        self._wake.put(True)
        if self._no_thread:
            self._start_thread()

    def size(self) -> int:
        """Return the number of items in the channel and in this process.

        If items go on all the time, one that is on its way may be counted twice or not at all.
        """
        size = 0
        for _ in range(_READS):
            steps = self._transfer_steps
            size = self._slots.used(len(self._unsent))
            consistent = steps == self._transfer_steps and not steps % 2
            is_feeder = threading.get_ident() == self._thread  # then it interrupts the transfer
            if consistent or is_feeder:
                return size
            time.sleep(_TRANSFER_POLL_INTERVAL)
        return size

    def _send_now(self, payload: bytes, buffers: list[memoryview]) -> bool:
        self._slots.sending()
        try:
            if self._outbox.try_send_directly(payload, buffers):
                self._slots.sent()
                return True
        except OSError:
            self._slots.not_sent()
            raise
        self._slots.not_sent()
        return False

    def close(self) -> None:
        """Accept no more items; close the channel when all items are sent."""
        if self._no_thread and not self._unsent:
            self._close_outbox()
            return
        if self._no_thread:  # an interrupted ``put`` has not started the thread
            self._start_thread()
        self._wake.put(False)

    def join(self) -> None:
        """Wait until all items are sent."""
        for join in self._joins:
            join()

    def cancel_join(self) -> None:
        """Do not wait for the feeder at the end of the process."""
        self._join_cancelled = True
        for join in self._joins:
            join.cancel()

    def _start_thread(self) -> None:
        thread = threading.Thread(target=self._feed, name="QueueFeederThread", daemon=True)
        util.Finalize(self._owner(), self.close, exitpriority=10)
        if not self._join_cancelled:
            join = util.Finalize(thread, _join, [weakref.ref(thread)], exitpriority=-5)
            self._joins.append(join)
        thread.start()

    def _feed(self) -> None:
        try:
            self._no_thread.pop()
        except IndexError:
            return
        self._thread = threading.get_ident()
        more = True
        while more:
            more = self._wake.get()
            self._sending = True
            while self._unsent:
                if self._put_items is None or not self._send_bundle(self._put_items):
                    self._send_next()
            self._sending = False
        self._close_outbox()

    def _send_next(self) -> None:
        self._transfer_steps += 1
        item = self._unsent.popleft()
        reachable = self._count_as_sent()
        self._transfer_steps += 1
        if reachable:
            self._send(*item)

    def _send_bundle(self, put_items: PutItems) -> bool:
        """Send the next small items in one request; False if the next item is large.

        While a request is on its way, further items gather for the next one.
        """
        self._transfer_steps += 1
        counted = False
        items = self._take_small()
        try:
            if items:
                with put_items(items):
                    self._transfer_steps += 1
                    counted = True
        except (BrokenPipeError, EOFError):
            self._unsent.clear()  # no process can ever read them
        except OSError as error:
            for _ in items:
                self._report(error)
        if not counted:
            self._transfer_steps += 1
        return bool(items)

    def _take_small(self) -> list[bytes]:
        """Take as many items as a bundle holds."""
        items: list[bytes] = []
        room = bundle.LIMIT
        while self._unsent:
            payload, buffers = self._unsent[0]
            room -= len(payload)
            if buffers or room < 0:
                break
            items.append(payload)
            self._unsent.popleft()
        return items

    def _count_as_sent(self) -> bool:
        """Count an item as sent; False if the count is gone, and the queue with it."""
        try:
            self._slots.sending()
        except EOFError:
            self._unsent.clear()
            return False
        return True

    def _send(self, payload: bytes, buffers: list[memoryview]) -> None:
        try:
            self._outbox.post(payload, buffers)
            self._slots.sent()
        except (BrokenPipeError, EOFError):
            self._unsent.clear()  # no process can ever read them
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        self._slots.not_sent()
        self._slots.give_back()
        self._report(error)

    def _report(self, error: OSError) -> None:
        if util.is_exiting():
            util.info("error in queue thread: %s", error)
        else:
            try:
                self._on_error(error, None)
            except BaseException:  # raised by the user's hook: the other items must be sent too
                report_uncaught()


def _join(thread: weakref.ref[threading.Thread]) -> None:
    running = thread()
    if running is not None and running.ident is not None:  # otherwise it could not be started
        running.join()


_RECOVERY_INTERVAL = 0.2
"""Seconds between two searches for dead processes."""


class SlotClaims:
    """Table with the number of slots that each process holds.  Any thread may use it."""

    def __init__(self) -> None:
        # Silent: a process that dies with the lock leaves the table consistent.
        lock = shared_blocks.create_semaphore(COUNTING, 1, 1, silent=True)
        self.__setstate__((shared_blocks.create_wait_list(), lock))

    def __getstate__(self) -> tuple[AnyWaitList, AnySemaphore]:
        return self._table, self._lock

    def __setstate__(self, state: tuple[Any, AnySemaphore]) -> None:
        self._table, self._lock = state
        self._next_recovery = 0.0
        self._begin()

    def _begin(self) -> None:
        self._pid = os.getpid()
        self._own: list[None] = []
        self._entry: list[Any] = []

    def add(self) -> None:
        """Note that this process has taken a slot."""
        if self._pid != os.getpid():  # a fork does not hold its parent's slots
            self._begin()
        self._own.append(None)
        self._publish()

    def drop(self) -> None:
        """Note that this process has one slot less: its item was sent, or it was freed."""
        try:
            self._own.pop()
        except IndexError:  # an interrupt came before ``add`` noted it
            return
        self._publish()

    def recover(self, counter: SharedCounter) -> int:
        """Add the slots of dead processes to ``counter``; return their number."""
        now = time.monotonic()
        if now < self._next_recovery:
            return 0
        self._next_recovery = now + _RECOVERY_INTERVAL
        self._lock.acquire()
        try:
            return int(self._table.reclaim(counter))
        finally:
            self._lock.release()

    def _publish(self) -> None:
        if not self._entry:
            self._enter()
        if not self._entry:
            return
        entry, own = self._entry[0], self._own
        try:
            while True:
                count = len(own)
                self._table.hold(entry, count)
                if count == len(own):  # otherwise another thread may have written last
                    return
        except (OSError, ObjectUnreachable):
            pass  # the hub has ended, and the queue with it

    def _enter(self) -> None:
        self._lock.acquire()
        try:
            with suppress(OSError):  # the table is full: this process has no entry
                self._entry.append(self._table.enter())
                weakref.finalize(self, self._table.dismiss, self._entry[-1])
        finally:
            self._lock.release()


# Dealing to readers

_DEALER_CHECK_INTERVAL = 0.5
"""Seconds between two checks by a new reader that the dealer is alive."""


class Dealer:
    """Thread that sends the items of ``inbox`` to the readers that come by ``arrivals``.

    Each item goes to the next reader with room for it.  Without such a reader the item waits, and
    later items wait in ``inbox``.  The dealer ends with ``inbox``.
    """

    def __init__(self, inbox: ReceivingEnd, arrivals: LocalChannel) -> None:
        self._inbox = inbox
        self._arrivals = arrivals
        self._readers: deque[SendingEnd] = deque()
        self._item: Message | None = None

    def start(self) -> None:
        """Start dealing on a daemon thread."""
        threading.Thread(target=self._run, name="fiber-dealer", daemon=True).start()

    def _run(self) -> None:
        try:
            while True:
                self._wait()
                if self._arrivals.poll(0):
                    self._add_reader()
                if self._item is None:
                    self._item = self._inbox.try_recv()
                if self._item is not None and self._deal(self._item):
                    self._item.release()
                    self._item = None
        except ConnectionClosed:  # no process has the queue
            pass
        finally:
            for channel in (self._inbox, self._arrivals, *self._readers):
                channel.close()

    def _wait(self) -> None:
        poller = select.poll()
        poller.register(self._arrivals.fileno(), select.POLLIN)
        timeout = None
        if self._item is None:
            poller.register(self._inbox.fileno(), select.POLLIN)
            timeout = one_way.LOOK_AGAIN * 1000
        else:
            for reader in self._readers:
                poller.register(reader.fileno(), reader.room_events)
        poller.poll(timeout)

    def _add_reader(self) -> None:
        message = self._arrivals.try_recv()
        if message is None:
            return
        try:
            answer: Channel = packet.loads(message)
        except Exception:  # the reader has ended already
            return
        readers_end, dealers_end = one_way.pair()
        with collecting_grants(reusable=False) as grants:
            invitation = pickle.dumps(readers_end)
        try:
            answer.send(invitation)
            answer.recv().release()  # the reader has its channel
            self._readers.append(dealers_end)
        except (OSError, ConnectionClosed):
            dealers_end.close()
        finally:
            grants.release()
            readers_end.close()
            answer.close()

    def _deal(self, item: Message) -> bool:
        """Deal an item to a reader with room; return False if there was none."""
        for _ in range(len(self._readers)):
            reader = self._readers.popleft()
            try:
                dealt = reader.try_send(item.payload, item.buffers)
            except BrokenPipeError:  # the reader has ended
                reader.close()
                continue
            self._readers.append(reader)
            if dealt:
                return True
        return False


def become_reader(arrivals: Channel) -> Channel:
    """Register with the dealer as a reader.  Return the channel on which the dealer sends.

    Raises ConnectionClosed if the dealer has ended.
    """
    own_end, dealers_end = LocalChannel.pair()
    with collecting_grants(reusable=False) as grants:
        request = pickle.dumps(dealers_end)
    dealers_end.close()
    try:
        arrivals.send(request)
        while not own_end.poll(_DEALER_CHECK_INTERVAL):
            if arrivals.poll(0):  # the dealer sends nothing on this channel, so it has closed it
                raise ConnectionClosed()
        channel: Channel = own_end.recv_object()
        if isinstance(channel, RemoteObject):  # attach before the grant ends
            channel.confirm()
        own_end.send(b"")
        return channel
    except BrokenPipeError as error:
        raise ConnectionClosed() from error
    finally:
        grants.release()
        own_end.close()
