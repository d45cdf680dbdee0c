"""Between the ledger and the workers: sends what is assigned, takes what comes back.

::

    caller's thread            loop's thread                     worker
    assign ─────┐                                                  │
                ├────────── send ────────────────────────────────► │ run
    pump ───────┘                                                  │
                       receive ◄── heard ◄──────────────────────── │ answer
                          │
                          └─► sink.put, sink.end ──► results, iterators, callbacks

Who touches what: the ledger, the crew, ``_unsent``, ``_readers`` and the flags are guarded by
``_lock``.  Work is assigned under it by whichever thread found that there is some, and sent after
it is released.  ``heard``, ``recalled``, ``lost`` and ``_expired`` run on the loop's thread, which
must not run any of the user's code: a batch whose pickling could goes to the pump, values whose
unpickling could stay ``Encoded``.  A batch in ``_unsent`` is assigned but not sent: nobody can have
run it.
"""

from __future__ import annotations

import pickle
import threading
from collections import deque
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Any, NamedTuple

from fiber._agent.port import ExitReport
from fiber._engine.ledger import Batch, Job, Ledger, Loss, Receipt
from fiber._runtime.outcome import Encoded, Failure, outcomes
from fiber._runtime.pump import Pump
from fiber._runtime.reader import Reader
from fiber._runtime.requests import Request, Sink, encode, is_plain
from fiber._runtime.state import runtime
from fiber._runtime.workers import Crew, Link, dismiss
from fiber._transport.loop import Timer
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import TimeoutError, WorkerDied

HESITATION = 1.0
"""Seconds before a worker is replaced when many die without having done anything."""


class Terms(NamedTuple):
    """What a pool promises its workers and callers."""

    context: Any
    initializer: Callable[..., object] | None = None
    initargs: tuple[Any, ...] = ()
    minimum: int = 1
    maximum: int = 1
    maxtasks: int | None = None
    retries: int = 3
    retryable: tuple[type[BaseException], ...] = ()
    idle_timeout: float = 60.0


class Exchange:
    """The part of a dispatcher that talks to workers."""

    def __init__(self, terms: Terms) -> None:
        self.terms = terms
        self.pump = Pump("fiber-pool")
        self.callbacks = Pump("fiber-pool-callbacks")
        self.ended = threading.Event()
        self._loop = runtime().loop
        self._lock = threading.Lock()
        self._ledger = Ledger()
        self._unsent: set[int] = set()
        self._readers: list[Reader] = []
        self.hungry = False
        self._deadlines: dict[int, Timer] = {}
        self._recall_timer: Timer | None = None
        self._idle_timer: Timer | None = None
        self._kill_timer: Timer | None = None
        self._closing = False
        self._terminated = False
        self.crew = Crew(
            self,
            self._lock,
            terms.context,
            (terms.initializer, terms.initargs, terms.retryable),
            terms.minimum,
            terms.maximum,
        )

    # Giving

    def _assign(self) -> list[Batch]:
        """Decide what can be sent now; whoever calls sends it.  Lock held."""
        now = monotonic()
        ledger = self._ledger
        batches: list[Batch] = []
        while True:
            for reader in self._readers:
                reader.absorb(ledger)
            while (batch := ledger.assign(now)) is not None:
                self._unsent.add(batch.seq)
                batches.append(batch)
            self.hungry = ledger.hungry()
            if not (self.hungry and any(reader.inbox for reader in self._readers)):
                break
        for reader in self._readers:
            reader.make_room(len(ledger.workers))
        self._recall(now)
        return batches

    def _send(self, batches: Iterable[Batch]) -> None:
        """Send batches, on a thread that may run the user's code."""
        todo = deque(batches)
        while todo:
            todo.extend(self._send_one(todo.popleft(), plain=False))

    def _send_from_loop(self, batches: Iterable[Batch]) -> None:
        """Send batches from the loop's thread, or have the pump send those that it must not."""
        for batch in batches:
            job = batch.job
            if job is None or job.owner.kind == work.CALLS or is_plain(batch.items):
                self._send_from_loop(self._send_one(batch, plain=True))
            else:
                self.pump.post(self._send, (batch,))

    def _send_one(self, batch: Batch, *, plain: bool) -> list[Batch]:
        """Send one batch; returns what can be sent since it could not.

        ``plain``: its items are known to pickle without the user's code.
        """
        job = batch.job
        if job is None:
            return self._withdraw(batch)
        request: Request = job.owner
        link: Link = batch.worker.key
        assert link.port is not None
        try:
            message, buffers = encode(request, batch, link.known, plain)
            if not link.port.deliver(batch.seq, message, buffers):
                return []  # it is gone: ``lost`` will find the batch unsent
        except Exception as error:
            # Whatever the user's pickler raises, or the system for want of memory or descriptors,
            # concerns the tasks of this batch only.
            return self._unsendable(batch, error)
        self._unsent.discard(batch.seq)
        if request.timeout is not None:
            timer = self._loop.call_later(request.timeout, self._expired, batch.seq)
            self._deadlines[batch.seq] = timer
        return []

    def _withdraw(self, batch: Batch) -> list[Batch]:
        """The batch was cancelled before it was sent."""
        with self._lock:
            self._unsent.discard(batch.seq)
            self._ledger.put_back(batch.worker, (batch.seq,), monotonic())
            batches = self._assign()
        self._wind_down()
        return batches

    def _unsendable(self, batch: Batch, error: BaseException) -> list[Batch]:
        ends: list[Sink] = []
        with self._lock:
            self._unsent.discard(batch.seq)
            receipt = self._ledger.split(batch.seq, monotonic())
            if receipt is not None:
                self._put(receipt, [Failure(error)], ends)
            batches = self._assign()
        self._end(ends)
        self._wind_down()
        return batches

    # Taking: on the loop's thread

    def heard(self, link: Link, message: Message) -> None:
        """A packet from a worker."""
        words = pickle.loads(message.payload)
        buffers = message.buffers
        message.release()
        kind = words[0]
        if type(kind) is int:
            self._answered(link, words, buffers)
        elif kind == work.READY:
            self._ready(link)
        elif kind == work.BIRTH:
            link.complaint = words[1]
        elif kind == work.UNREADABLE:
            self._unread(words[1], words[2])
        elif kind == work.UNKNOWN:
            self.recalled(link, [words[1]])
        elif kind == work.BROKEN:
            self._broken(words[1], words[2])
        if self._closing:
            self._wind_down()

    def _answered(
        self,
        link: Link,
        words: tuple[Any, ...],
        buffers: list[memoryview],
    ) -> None:
        seq, offset, kept, seconds, values, odd = words
        results = outcomes(values, odd, buffers) if odd else values
        ends: list[Sink] = []
        with self._lock:
            receipt = self._ledger.receive(
                seq, offset, len(results), monotonic(), seconds=seconds, kept=kept
            )
            self.crew.idle_deaths = 0
            if receipt is not None:
                if odd and self.terms.retryable:
                    self._put_or_retry(receipt, results, ends)
                else:
                    self._put(receipt, results, ends, mixed=bool(odd))
            if self._deadlines:
                self._cancel_deadline(seq)
            spent = self._spent(link)
            batches = self._assign()
        self._send_from_loop(batches)
        self._end(ends)
        dismiss(spent)

    def _put(
        self, receipt: Receipt, results: list[Any], ends: list[Sink], *, mixed: bool = True
    ) -> None:
        """Hand results on.  Lock held; the caller ends the sinks when it is released."""
        request: Request = receipt.job.owner
        if request.sink is None:
            for task, outcome in enumerate(results, receipt.start):
                sink = receipt.item(task).sink
                sink.put(0, [outcome], mixed)
                ends.append(sink)
        else:
            request.sink.put(receipt.start, results, mixed)
        self._check_finished(receipt.job, ends)

    def _put_or_retry(self, receipt: Receipt, results: list[Any], ends: list[Sink]) -> None:
        """Hand results on but those whose tasks get another try.  Lock held."""
        start = receipt.start
        again = {
            at
            for at, result in enumerate(results)
            if type(result) is Encoded
            and result.kind == work.AGAIN
            and self._ledger.retry(receipt, start + at)
        }
        good = [at for at in range(len(results)) if at not in again]
        for at in good:
            self._put(receipt._replace(start=start + at), [results[at]], ends)

    def _check_finished(self, job: Job, ends: list[Sink]) -> None:
        if not job.finished:
            return
        request: Request = job.owner
        self._stop_reader(request)
        if request.sink is not None and request.sink not in ends:
            ends.append(request.sink)

    def _end(self, ends: list[Sink]) -> None:
        """Tell sinks that they have it all."""
        for sink in ends:
            sink.end()

    def _unread(self, seq: int, error: bytes) -> None:
        """A worker could not unpickle a batch."""
        ends: list[Sink] = []
        with self._lock:
            receipt = self._ledger.split(seq, monotonic())
            if receipt is not None:
                self._put(receipt, [Encoded(work.ERROR, error, ())], ends)
            batches = self._assign()
        self._send_from_loop(batches)
        self._end(ends)

    def _broken(self, seq: int, error: bytes) -> None:
        """A worker could not unpickle a function: no task of its job can run."""
        failure = Encoded(work.ERROR, error, ()).decode()
        with self._lock:
            batch = self._ledger.batches.get(seq)
            job = batch.job if batch is not None else None
            if job is not None:
                self._abort(job, failure.error)
            if batch is not None:
                self._ledger.put_back(batch.worker, (seq,), monotonic())
            batches = self._assign()
        self._send_from_loop(batches)

    def recalled(self, link: Link, seqs: list[int]) -> None:
        """A worker will never see these batches."""
        if link.worker is None:
            return
        with self._lock:
            for seq in seqs:
                batch = self._ledger.batches.get(seq)
                if batch is not None and batch.job is not None:
                    function = batch.job.owner.function
                    if function is not None:
                        link.known.pop(function.id, None)
            self._ledger.put_back(link.worker, seqs, monotonic())
            batches = self._assign()
        self._send_from_loop(batches)
        if self._closing:
            self._wind_down()

    def _recall(self, now: float) -> None:
        """Ask busy workers for what they have not begun, if others are idle.  Lock held."""
        for worker in self._ledger.recall(now):
            worker.key.port.take_back()
        due = self._ledger.next_recall()
        if due is not None and self._recall_timer is None:
            self._recall_timer = self._loop.call_later(max(due - now, 0.0), self._look_again)

    def _look_again(self) -> None:
        with self._lock:
            self._recall_timer = None
            batches = self._assign()
        self._send_from_loop(batches)

    # Deadlines

    def _expired(self, seq: int) -> None:
        """A task had its time."""
        ends: list[Sink] = []
        with self._lock:
            timer = self._deadlines.pop(seq, None)
            receipt = self._ledger.expire(seq) if timer is not None else None
            if receipt is None:
                return
            request: Request = receipt.job.owner
            link: Link = receipt.batch.worker.key
            link.leaving = True
            name = request.task_name(receipt.start, receipt.item(receipt.start))
            error = TimeoutError(
                f"{name} took longer than its timeout of {request.timeout:g} s; "
                f"its worker {link.name!r} was killed"
            )
            self._put(receipt, [Failure(error)], ends)
        link.kill()
        self._end(ends)
        self._wind_down()

    def _cancel_deadline(self, seq: int) -> None:
        timer = self._deadlines.pop(seq, None)
        if timer is not None:
            timer.cancel()

    # Workers' lives

    def _ready(self, link: Link) -> None:
        """A worker is initialized."""
        if link.port is None:  # whoever started it is still about to note how to reach it
            self._loop.call_soon(self._ready, link)
            return
        with self._lock:
            if link.leaving:
                return
            link.worker = self._ledger.add(link, monotonic(), self.terms.maxtasks)
            self.crew.failures = 0
            self._count()
            self._watch_idle()
            batches = self._assign()
        self._send_from_loop(batches)

    def lost(self, link: Link, report: ExitReport) -> None:
        """A worker is gone, with or without having been told to."""
        ends: list[Sink] = []
        with self._lock:
            self.crew.gone(link, report)
            if link.worker is not None:
                held = [batch.seq for batch in link.worker.queue]
                unread = {*report.unread, *self._unsent.intersection(held)}
                self._unsent.difference_update(held)
                for seq in held:
                    self._cancel_deadline(seq)
                for loss in self._ledger.lose(link.worker, unread, report.running):
                    self._put_loss(loss, link, report, ends)
            self._count()
            if self.crew.error is not None:
                self._give_up(self.crew.error)
            elif self.crew.hesitant():
                self._loop.call_later(HESITATION, self._replace_late)
            else:
                self._replace()
            batches = self._assign()
        self._send_from_loop(batches)
        self._end(ends)
        self._wind_down()

    def _put_loss(self, loss: Loss, link: Link, report: ExitReport, ends: list[Sink]) -> None:
        request: Request = loss.job.owner
        error = WorkerDied(
            task=request.task_name(loss.task, loss.item),
            worker=link.name,
            host=report.host,
            pid=link.pid,
            exitcode=report.exitcode,
            reason=report.reason,
            log=report.log,
            attempts=loss.attempts,
        )
        sink = request.sink if request.sink is not None else loss.item.sink
        sink.put(loss.task if request.sink is not None else 0, [Failure(error)], True)
        if request.sink is None:
            ends.append(sink)
        self._check_finished(loss.job, ends)

    def _spent(self, link: Link) -> list[Link]:
        """The worker, if it did all that it may do.  Lock held; the caller dismisses it."""
        worker = link.worker
        if worker is None or not worker.spent or link.leaving:
            return []
        self._ledger.leave(worker)
        link.leaving = True
        return [link]

    def _replace(self) -> None:
        """See that there are as many workers as there should be.  Lock held."""
        if self._terminated or self.crew.error is not None:
            return
        demand = self._ledger.demand()
        if self._closing and not demand and not self._ledger.jobs:
            return
        # Degraded: those that are there go on, until there is a reason to try again.
        count = 0 if self.crew.degraded() else self.crew.missing(demand)
        if count:
            self.crew.hiring += count
            self._count()
            self.pump.post(self._hire, count)

    def _replace_late(self) -> None:
        with self._lock:
            self._replace()

    def _hire(self, count: int) -> None:
        """Start workers; not on the loop's thread, which agents may need for it."""
        for _ in range(count):
            link = None
            try:
                link = self.crew.hire()
            except Exception as error:
                # Want of descriptors or memory: with some workers the pool goes on.
                with self._lock:
                    self.crew.refused(error)
                    if self.crew.error is not None:
                        self._give_up(self.crew.error)
            with self._lock:
                self._count()
            if link is not None and self._terminated:
                link.kill()
        self._wind_down()

    def _count(self) -> None:
        """Tell the ledger how many workers are on their way.  Lock held."""
        self._ledger.starting = self.crew.starting()

    # Leaving

    def _watch_idle(self) -> None:
        """See to it that those who are not needed leave after a while.  Lock held."""
        if self._idle_timer is None and len(self.crew.staying()) > self.crew.minimum:
            self._idle_timer = self._loop.call_later(self.terms.idle_timeout, self._thin_out)

    def _thin_out(self) -> None:
        """Let go workers above the minimum that have had nothing to do for a while."""
        long_ago = monotonic() - 0.9 * self.terms.idle_timeout
        with self._lock:
            self._idle_timer = None
            spare = len(self.crew.staying()) - self.crew.minimum
            idle = [worker for worker in self._ledger.idle() if worker.since <= long_ago]
            leaving: list[Link] = []
            for worker in idle[: max(spare, 0)]:
                # The ledger has the last word: one that was given work since stays.
                if self._ledger.leave(worker):
                    worker.key.leaving = True
                    leaving.append(worker.key)
            self._watch_idle()
        dismiss(leaving)

    # Ending

    def _abort(self, job: Job, error: BaseException) -> None:
        """Fail what is not done of a job.  Lock held."""
        request: Request = job.owner
        if request.sink is not None:
            request.sink.abort(error)
        else:
            for call in self._ledger.unfinished(job):
                call.sink.abort(error)
        self._stop_reader(request)
        self._ledger.cancel(job)

    def _stop_reader(self, request: Request) -> None:
        if request.reader in self._readers:
            self._readers.remove(request.reader)
            request.reader.stop()

    def _give_up(self, error: BaseException) -> None:
        """Fail all that is not done, and end the workers.  Lock held."""
        for job in list(self._ledger.jobs):
            self._abort(job, error)
        for link in self.crew.staying():
            link.leaving = True
            link.terminate()

    def _wind_down(self) -> None:
        """Let the workers go once the pool is closed and has nothing left to do."""
        leaving: list[Link] = []
        if not self._closing:
            return
        with self._lock:
            if not self._ledger.jobs:
                for link in self.crew.staying():
                    if link.worker is None or self._ledger.leave(link.worker):
                        link.leaving = True
                        leaving.append(link)
            over = not self.crew.links and not self.crew.hiring
            if over:
                for timer in (self._recall_timer, self._idle_timer, self._kill_timer):
                    if timer is not None:
                        timer.cancel()
        dismiss(leaving)
        if over:
            self.pump.stop()
            self.callbacks.stop()
            self.ended.set()
