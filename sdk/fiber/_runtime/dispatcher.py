"""The dispatcher: what is asked of a pool.  ``exchange.py`` sees to it that it is done."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from time import monotonic
from typing import Any

from fiber import reduction
from fiber._agent.interface import UNKNOWN, ChildHandle, ExitReport
from fiber._engine.chunks import FLOOR, Pace
from fiber._runtime.exchange import Exchange
from fiber._runtime.outcome import Failure
from fiber._runtime.reader import Reader
from fiber._runtime.requests import Call, Function, Request, Sink, name_of
from fiber._runtime.shield import unbroken
from fiber._runtime.staff import Plan, Terms
from fiber._runtime.workers import PoolProcess
from fiber._wire import work
from fiber.errors import FiberError

__all__ = ["Dispatcher", "Terms"]

FUNCTIONS = 128
"""Functions that are recognized when they come again."""

FUNCTION_SIZE = 1 << 16
"""Bytes of a pickled function up to which it is."""

KILL_AFTER = 2.0
"""Seconds between SIGTERM and SIGKILL for workers that are to end at once."""


class Dispatcher(Exchange):
    """The working half of a pool; ``fiber.pool.Pool`` is its face, and may be forgotten first."""

    def __init__(self, terms: Terms) -> None:
        super().__init__(terms)
        self._functions: dict[bytes, Function] = {}
        self._function_ids = itertools.count(1)
        self._calls = self._open(work.CALLS, exact=True)
        self._last_post = 0.0

    def start(self) -> None:
        """Start the first workers; raises what stands in the way of one."""
        self._loop.depend(self)
        with self._lock:
            self.crew.order(self.crew.minimum)
        try:
            while self.crew.hire() is not None:
                pass
        except BaseException as error:
            self.terminate(error)
            raise

    # Requests

    def call(
        self,
        sink: Sink,
        function: Callable[..., Any],
        args: Iterable[Any],
        kwargs: Mapping[str, Any],
        timeout: float | None = None,
        *,
        until: Callable[[], bool] | None = None,
    ) -> ChildHandle | None:
        """One call of a function.

        With ``until`` this thread waits a little for what its worker says, if one has it already
        and ``until`` does not hold.  Returns that worker if it said something; it may have been
        something else.
        """
        call = _make_call(sink, function, args, kwargs)
        if call is None:
            return None
        with unbroken:
            with self._lock:
                self._check()
                request = self._calls
                if timeout is not None:
                    request = self._open(work.CALLS, timeout=timeout)
                self._ledger.feed(request.job, [call])
                if request is not self._calls:
                    self._ledger.close(request.job)
                plan = self._step()
                if call.buffers and not any(call in batch.items for batch in plan.batches):
                    call.detach()
            self._follow(plan)
            if until is None or len(plan.batches) != 1 or until():
                return None
            port: ChildHandle | None = plan.batches[0].worker.key.port
            return port if port is not None and port.attend() else None

    def attend(self, port: ChildHandle) -> bool:
        """Wait a little more for what a worker says; False if it is left to the loop."""
        with unbroken:
            return port.attend()

    def post(
        self,
        sink: Sink,
        function: Callable[..., Any],
        args: Iterable[Any],
        kwargs: Mapping[str, Any],
        timeout: float | None = None,
    ) -> None:
        """One call that nobody waits for yet: of many short ones in a row, several travel together.

        Each would else wake a worker, which costs more than the call.
        """
        job = self._calls.job
        now = monotonic()
        hurried = now - self._last_post < FLOOR and job.fed - job.done >= self.crew.size
        self._last_post = now
        if timeout is not None or not hurried or not job.pace.short:
            self.call(sink, function, args, kwargs, timeout)
            return
        call = _make_call(sink, function, args, kwargs)
        if call is not None:
            call.detach()
            with unbroken, self._lock:
                self._check()
                self._ledger.feed(job, [call])
                self._later("calls", 0.0, self._reconsider)

    def broadcast(self, sink: Sink, function: Callable[..., Any], args: Sequence[Any]) -> None:
        """The same call on every worker, present or starting; ``sink`` gets one outcome of each."""
        call = _make_call(sink, function, args, {})
        if call is None:
            return
        ends: list[Sink] = []
        with unbroken:
            with self._lock:
                self._check()
                request = self._open(work.CALLS, sink=sink)
                for link in self.crew.staying():
                    self._ledger.pin(request.job, link.worker, call)
                for _ in range(self.crew.ordered):
                    self._ledger.pin(request.job, None, call)
                self._ledger.close(request.job)
                self._check_finished(request.job, ends)
                plan = self._step()
            self._follow(plan, ends)

    def function(self, function: Callable[..., Any]) -> Function:
        """``function``, pickled; one that pickles as an earlier one did is the same."""
        try:
            data, buffers, kept = reduction.encode_reusable(function)
        except reduction.REFUSALS as error:
            what = f"the function {name_of(function)}"
            raise reduction.blame({what: function}, error) from error
        with unbroken, self._lock:
            known = self._functions.get(data)
            if known is not None:
                return known
            made = Function(next(self._function_ids), name_of(function), data, buffers, kept)
            if not buffers and kept is None and len(data) <= FUNCTION_SIZE:
                self._functions[data] = made
                if len(self._functions) > FUNCTIONS:
                    del self._functions[next(iter(self._functions))]
        return made

    def map(
        self,
        kind: int,
        function: Function,
        items: Sequence[Any],
        sink: Sink,
        *,
        unit: int = 1,
        exact: bool = False,
        timeout: float | None = None,
    ) -> Request:
        """Apply ``function`` to ``items``, which must not change until they are done."""
        ends: list[Sink] = []
        request = None
        try:
            with unbroken:
                with self._lock:
                    self._check()
                    request = self._open(
                        kind, function=function, sink=sink, unit=unit, exact=exact, timeout=timeout
                    )
                    self._ledger.feed(request.job, items)
                    self._ledger.close(request.job)
                    self._check_finished(request.job, ends)
                    plan = self._step()
                self._follow(plan, ends)
                return request
        except BaseException:
            self._disown(request)
            raise

    def stream(
        self,
        kind: int,
        function: Function,
        sink: Sink,
        *,
        unit: int = 1,
        exact: bool = False,
        timeout: float | None = None,
        limit: int | None = None,
    ) -> Request:
        """Apply ``function`` to what ``read`` will read."""
        request = None
        try:
            with unbroken, self._lock:
                self._check()
                request = self._open(
                    kind, function=function, sink=sink, unit=unit, exact=exact, timeout=timeout
                )
                request.reader = Reader(request.job, self._lock, limit)
                self._readers.append(request.reader)
                return request
        except BaseException:
            self._disown(request)
            raise

    def _disown(self, request: Request | None) -> None:
        """Whoever asked for it was interrupted and never heard of it."""
        if request is not None:
            self.cancel(request)

    def read(self, request: Request, iterable: Iterable[Any]) -> None:
        """Read the tasks of a stream on this thread, as fast as they are worked off.

        Raises what the iterable raises; the stream then still has to be finished or cancelled.
        """
        assert request.reader is not None
        request.reader.read(iterable, self._feed_hungry)

    def finish(self, request: Request, error: BaseException | None = None) -> None:
        """The stream has no more tasks; ``error``, if any, takes the place of the next one."""
        ends: list[Sink] = []
        with unbroken:
            with self._lock:
                if request.job not in self._ledger.jobs:
                    return  # aborted or cancelled meanwhile
                request.reader.absorb(self._ledger)  # type: ignore[union-attr]
                if error is not None and request.sink is not None:
                    request.sink.put(request.job.fed, [Failure(error)], True)
                self._ledger.close(request.job)
                self._check_finished(request.job, ends)
                plan = self._step()
            self._follow(plan, ends)

    def cancel(self, request: Request) -> None:
        """Nobody wants the rest of it any more; what runs is left to end."""
        with unbroken:
            with self._lock:
                for worker in self._ledger.cancel(request.job):
                    worker.key.port.recall()
                self._over(request)
                plan = self._step()
            self._act(plan)

    def soon(self, action: Callable[..., None], *args: Any) -> None:
        """Have something done on the loop's thread: for finalizers, which run where any lock may be
        held, the loop's too.
        """
        self._loop.interrupt(action, *args)

    def on_loop(self) -> bool:
        """Whether this is the loop's thread, which must not wait."""
        return self._loop.on_thread()

    def _feed_hungry(self) -> None:
        if self.hungry:
            with unbroken:
                with self._lock:
                    plan = self._step()
                self._follow(plan)

    def _follow(self, plan: Plan, ends: Iterable[Sink] = ()) -> None:
        """Do what was decided, on a caller's thread, which may run the user's code; unbroken."""
        self._send(plan.batches)
        self._tell(plan, ends)

    def _open(
        self,
        kind: int,
        *,
        function: Function | None = None,
        sink: Sink | None = None,
        unit: int = 1,
        exact: bool = False,
        timeout: float | None = None,
    ) -> Request:
        pace = Pace(function.pace if function is not None else None)
        job = self._ledger.open(
            pace=pace,
            retries=self.terms.retries,
            unit=unit,
            alone=timeout is not None,
            exact=exact,
        )
        if function is not None:
            function.pace = pace
        request = Request(kind, job, function=function, sink=sink, timeout=timeout)
        job.owner = request
        return request

    def _check(self) -> None:
        """Refuse what cannot be done any more.  Lock held."""
        if self.crew.error is not None:
            raise self.crew.error
        if self._closing:
            raise ValueError("Pool not running")

    # The end

    def close(self) -> None:
        """Take no more requests; the workers leave once those that are there are done."""
        with unbroken:
            with self._lock:
                self._closing = True
                self._ledger.close(self._calls.job)
                plan = self._step()
            self._follow(plan)

    def terminate(self, error: BaseException) -> None:
        """End the workers now; ``error`` is what those hear who wait for a result."""
        with unbroken:
            with self._lock:
                self._closing = self._terminated = True
                self.callbacks.stop()
                links = list(self.crew.links)
                self._give_up(error)
                for link in links:
                    link.terminate()
                if links:
                    self._later("kill", KILL_AFTER, partial(_kill, links))
                plan = self._step()
            self._act(plan)

    def broken(self, error: FiberError) -> None:
        """The loop has failed: nobody will hear of the workers any more."""
        with self._lock:
            self.crew.error = error
            links = list(self.crew.links)
        self.terminate(error)
        for link in links:
            link.kill()
            link.exited(ExitReport(UNKNOWN, str(error)))

    def join(self) -> None:
        """Wait until all workers and threads are gone; after ``close`` or ``terminate``."""
        with unbroken, self._lock:
            for reader in self._readers:
                reader.unbind()
        self.ended.wait()
        self.pump.join()
        self.callbacks.join()

    def processes(self) -> list[PoolProcess]:
        """The processes of the workers that are there."""
        with unbroken, self._lock:
            return [link.process for link in self.crew.links if link.process is not None]


def _kill(links: list[Any]) -> None:
    for link in links:
        link.kill()


def _make_call(
    sink: Sink, function: Callable[..., Any], args: Iterable[Any], kwargs: Mapping[str, Any]
) -> Call | None:
    """A call, pickled; None if it does not pickle, which the sink is told."""
    try:
        data, buffers, kept = reduction.encode_reusable((function, args, kwargs))
        if len(buffers) > work.BUFFERS:
            data, buffers = reduction.dumps((function, args, kwargs), 5), []
    except Exception as error:
        sink.put(0, [Failure(_blame_call(function, args, kwargs, error))], True)
        sink.end()
        return None
    return Call(name_of(function), data, buffers, kept, sink)


def _blame_call(
    function: Callable[..., Any],
    args: Iterable[Any],
    kwargs: Mapping[str, Any],
    error: Exception,
) -> Exception:
    """What the caller hears of a call that does not pickle."""
    name = name_of(function)
    if not isinstance(args, Sequence) or not isinstance(kwargs, Mapping):
        args, kwargs = (), {}
    parts = {f"argument {at} of {name}()": value for at, value in enumerate(args)}
    parts |= {f"argument {key!r} of {name}()": value for key, value in kwargs.items()}
    parts[f"the function {name}"] = function
    return reduction.blame(parts, error, f"the call of {name}()")
