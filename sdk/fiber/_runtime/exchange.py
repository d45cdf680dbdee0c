"""Between the ledger and the workers: sends what is assigned, takes what comes back.

::

    caller's thread              loop's thread                   worker
    step ───────┐                                                  │
                ├────────── send ────────────────────────────────► │ run
    pump ───────┘                                                  │
        step ◄── receive ◄── heard ◄────────────────────────────── │ answer
                    │
                    └─► sink.put, sink.end ──► results, iterators, callbacks

Who touches what: the ledger, the crew, ``_unsent``, ``_readers``, timers and flags are guarded by
``_lock``.  ``heard`` runs on the loop's thread or on that of a caller who attends to a worker,
``recalled``, ``lost`` and timers on the loop's thread.  None of them may run any of the user's
code: a batch whose pickling could goes to the pump, values whose unpickling could stay ``Encoded``.
A batch in ``_unsent`` is assigned and not known to be sent: nobody can have run it, unless its
worker says so.

A job and its request know each other, and a request its results: ``_over`` parts them, so that they
are freed when the user lets go of them, not when the collector comes.
"""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Iterable, Sequence
from time import monotonic
from typing import Any

from fiber import reduction
from fiber._agent.interface import ExitReport
from fiber._engine.ledger import Batch, Job, Loss, Receipt
from fiber._runtime.crew import Crew
from fiber._runtime.outcome import Encoded, Failure, outcomes
from fiber._runtime.pump import Pump
from fiber._runtime.reader import Reader
from fiber._runtime.requests import Request, Sink, encode, is_plain
from fiber._runtime.shield import unbroken
from fiber._runtime.staff import Staff, Terms
from fiber._runtime.state import runtime
from fiber._runtime.workers import Link
from fiber._transport.loop import Timer
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import TimeoutError, WorkerDied


class Exchange(Staff):
    """The part of a dispatcher that talks to workers."""

    def __init__(self, terms: Terms) -> None:
        super().__init__(terms, runtime().loop, Pump("fiber-pool"), Pump("fiber-pool-callbacks"))
        self.hungry = True
        """Whether a task that is read now could be sent, or hire a worker, at once."""
        self._unsent: set[int] = set()
        self._readers: list[Reader] = []
        self._deadlines: dict[int, Timer] = {}
        arguments = (terms.initializer, terms.initargs, terms.retryable)
        self.crew = Crew(self, self._lock, terms.context, arguments, terms.minimum, terms.maximum)

    # Giving

    def _assign(self) -> list[Batch]:
        now = monotonic()
        ledger, readers = self._ledger, self._readers
        batches: list[Batch] = []
        while True:
            for reader in readers:
                reader.absorb(ledger)
            while (batch := ledger.assign(now)) is not None:
                self._unsent.add(batch.seq)
                batches.append(batch)
            # A reader looks whether somebody is hungry after it put something in: so say it, and
            # then look whether something was put in.
            self.hungry = ledger.hungry() or self.crew.size < self.crew.maximum
            if not (self.hungry and any(reader.inbox for reader in readers)):
                break
        for reader in readers:
            reader.make_room(len(ledger.workers))
        if ledger.uneven():
            self._recall(now)
        return batches

    def _recall(self, now: float) -> None:
        """Ask busy workers for what they have not begun, if others are idle."""
        for worker in self._ledger.recall(now):
            worker.key.port.recall()
        due = self._ledger.next_recall()
        if due is not None:
            self._later("recall", due - now, self._reconsider)

    def _send(self, batches: Sequence[Batch]) -> None:
        """Send batches, on a thread that may run the user's code."""
        left = deque(batches)
        try:
            while left:
                left.extend(self._send_one(left[0], plain=False))
                left.popleft()
        except BaseException:
            # Ctrl-C, while the user's code ran: others wait for these tasks' results, too.
            self.pump.post(self._send, left)
            raise

    def _send_safely(self, batches: Iterable[Batch]) -> None:
        """Send batches, on any thread: the pump does it where the user's code could run."""
        for batch in batches:
            request = _request(batch)
            if request is None or request.kind == work.CALLS or is_plain(batch.items):
                self._send_safely(self._send_one(batch, plain=True))
            else:
                self.pump.post(self._send, (batch,))

    def _send_one(self, batch: Batch, *, plain: bool) -> list[Batch]:
        """Send one batch; returns what can be sent since it could not.

        ``plain``: its items are known to pickle without the user's code.
        """
        request = _request(batch)
        if request is None:
            return self._withdraw(batch)
        link: Link = batch.worker.key
        assert link.port is not None
        try:
            if plain or request.kind == work.CALLS:
                message, buffers = encode(request, batch, link.known, plain)
            else:
                with unbroken.lifted:
                    message, buffers = encode(request, batch, link.known, plain)
            if request.timeout is not None:
                timer = self._loop.call_later(request.timeout, self._expired, batch.seq)
                self._deadlines[batch.seq] = timer
            if not link.port.deliver(batch.seq, message, buffers):
                return []  # it is gone: ``lost`` will find the batch unsent
        except Exception as error:
            # Whatever the user's pickler raises, or the system for want of memory or descriptors,
            # concerns the tasks of this batch only.
            return self._unsendable(batch, error)
        except BaseException as error:
            if unbroken.up():  # it may have been a signal's handler
                raise
            return self._unsendable(batch, error)
        self._unsent.discard(batch.seq)
        return []

    def _withdraw(self, batch: Batch) -> list[Batch]:
        """The batch was cancelled before it was sent."""
        with self._lock:
            self._unsent.discard(batch.seq)
            self._ledger.put_back(batch.worker, (batch.seq,), monotonic())
            plan = self._step()
        self._tell(plan)
        return plan.batches

    def _unsendable(self, batch: Batch, error: BaseException) -> list[Batch]:
        ends: list[Sink] = []
        if len(batch.items) == 1 and isinstance(error, Exception):
            error = _blame_item(batch, error)
        with self._lock:
            self._unsent.discard(batch.seq)
            self._cancel_deadline(batch.seq)
            self._split(batch.seq, Failure(error), ends)
            plan = self._step()
        self._tell(plan, ends)
        return plan.batches

    # Taking

    def heard(self, link: Link, message: Message) -> None:
        """A packet from a worker."""
        words = pickle.loads(message.payload)
        buffers = message.buffers
        message.release()
        kind = words[0]
        if type(kind) is int:
            self._answered(words, buffers)
        elif kind == work.READY:
            self._ready(link)
        elif kind == work.BIRTH:
            link.complaint = words[1]
        elif kind == work.UNKNOWN:
            self.recalled(link, [words[1]])
        else:
            self._unreadable(kind, words[1], Encoded(work.ERROR, words[2], ()))

    def _answered(self, words: tuple[Any, ...], buffers: list[memoryview]) -> None:
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
                self._check_finished(receipt.job, ends)
            if self._deadlines:
                self._cancel_deadline(seq)
            plan = self._step()
        self._act(plan, ends)

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
        if request.sink is not None:
            ends.append(request.sink)
        self._over(request)

    def _over(self, request: Request) -> None:
        """Its job is finished, or nobody wants the rest.  Lock held."""
        self._stop_reader(request)
        request.job.owner = None
        request.kept.clear()

    def _unreadable(self, kind: str, seq: int, error: Encoded) -> None:
        """A worker cannot unpickle a batch, or its function: then no task of its job can run."""
        ends: list[Sink] = []
        with self._lock:
            batch = self._ledger.batches.get(seq)
            self._cancel_deadline(seq)
            if kind == work.UNREADABLE:
                self._split(seq, error, ends)
            elif batch is not None:
                if batch.job is not None:
                    self._abort(batch.job, error.decode().error)
                self._ledger.put_back(batch.worker, (seq,), monotonic())
            plan = self._step()
        self._act(plan, ends)

    def _split(self, seq: int, failure: Any, ends: list[Sink]) -> None:
        """Send the tasks of a batch one by one; of a single one, that is its outcome."""
        receipt = self._ledger.split(seq, monotonic())
        if receipt is not None:
            self._put(receipt, [failure], ends)
            self._check_finished(receipt.job, ends)

    def recalled(self, link: Link, seqs: list[int]) -> None:
        """A worker will never see these batches."""
        if link.worker is None:
            return
        with self._lock:
            for seq in seqs:
                self._cancel_deadline(seq)
                batch = self._ledger.batches.get(seq)
                if batch is not None and batch.job is not None:
                    function = batch.job.owner.function
                    if function is not None:
                        link.known.pop(function.id, None)
            self._ledger.put_back(link.worker, seqs, monotonic())
            plan = self._step()
        self._act(plan)

    # Deadlines

    def _expired(self, seq: int) -> None:
        """A task had its time."""
        ends: list[Sink] = []
        with self._lock:
            batch = self._ledger.batches.get(seq)
            if self._deadlines.pop(seq, None) is None or batch is None:
                return
            link: Link = batch.worker.key
            receipt = self._ledger.expire(seq)
            if receipt is not None:
                request: Request = receipt.job.owner
                name = request.task_name(receipt.start, receipt.item(receipt.start))
                error = TimeoutError(
                    f"{name} took longer than its timeout of {request.timeout:g} s; "
                    f"its worker {link.name!r} was killed"
                )
                self._put(receipt, [Failure(error)], ends)
                self._check_finished(receipt.job, ends)
            self.crew.let_go(link)
            plan = self._step()
        link.kill()
        self._act(plan, ends)

    def _cancel_deadline(self, seq: int) -> None:
        timer = self._deadlines.pop(seq, None)
        if timer is not None:
            timer.cancel()

    # Workers come and go

    def _ready(self, link: Link) -> None:
        """A worker is initialized."""
        if link.port is None:  # whoever started it is still about to note how to reach it
            self._loop.call_soon(self._ready, link)
            return
        with self._lock:
            if link.leaving:
                return
            link.worker = self._ledger.add(link, monotonic(), self.terms.maxtasks)
            self.crew.ready()
            plan = self._step()
        self._act(plan)

    def lost(self, link: Link, report: ExitReport) -> None:
        """A worker is gone, with or without having been told to."""
        ends: list[Sink] = []
        with self._lock:
            self.crew.gone(link, report)
            if link.worker is not None:
                held = [batch.seq for batch in link.worker.queue]
                unread = {*report.unread, *self._unsent.intersection(held)}
                if report.running is not None:
                    # Whoever sent it may not have come to say so.
                    unread.discard(report.running[0])
                self._unsent.difference_update(held)
                for seq in held:
                    self._cancel_deadline(seq)
                losses = self._ledger.lose(link.worker, unread, report.running)
                for loss in losses:
                    self._put_loss(loss, link, report, ends)
                for job in {loss.job for loss in losses}:
                    self._check_finished(job, ends)
            self._check_crew()
            plan = self._step()
        self._act(plan, ends)

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
        if request.sink is not None:
            request.sink.put(loss.task, [Failure(error)], True)
        else:
            loss.item.sink.put(0, [Failure(error)], True)
            ends.append(loss.item.sink)

    # What ends before its time

    def _abort(self, job: Job, error: BaseException) -> None:
        """Fail what is not done of a job.  Lock held."""
        request: Request = job.owner
        if request.sink is not None:
            request.sink.abort(error)
        else:
            for call in self._ledger.unfinished(job):
                call.sink.abort(error)
        self._ledger.cancel(job)
        self._over(request)

    def _stop_reader(self, request: Request) -> None:
        if request.reader in self._readers:
            self._readers.remove(request.reader)
            request.reader.stop()


def _blame_item(batch: Batch, error: Exception) -> Exception:
    """What the caller hears of a task that cannot be sent."""
    request = _request(batch)
    if request is None or request.function is None:
        return error
    name = request.task_name(batch.start, batch.items[0])
    return reduction.blame({f"the item of {name}": batch.items[0]}, error)


def _request(batch: Batch) -> Request | None:
    """Whose batch it is; None once nobody wants it."""
    job = batch.job
    return None if job is None else job.owner
