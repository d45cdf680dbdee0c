"""What the real dispatcher finds in place of threads, processes and the runtime.

One thread runs everything, so that a seed decides the order.  What the dispatcher does on other
threads (its pump, its caller sending a batch, a reader of input) happens at later moments that the
seed chooses, as it may with threads.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

from fiber._runtime.dispatcher import Dispatcher, Terms

from fiber._agent import service
from fiber._backends.remote import RemoteChild
from fiber._engine.ledger import Batch
from fiber._runtime import dispatcher, exchange, workers
from fiber.process import Process
from simulation.agents import Child
from simulation.remote_hosts import NoCapture, RemoteHost
from simulation.schedule import Refusal
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.world import World

MOMENTS = 1e-5, 1e-4, 3e-3
"""Seconds until another thread gets its turn, at most: on an idle machine, on a busy one."""


class StagedProcess(Process):
    """Makes the dispatcher's processes leave the start method of this program alone."""

    _start_method = "fork"


class Stage:
    """Stands in for the runtime; a context manager while it does."""

    def __init__(self, world: World) -> None:
        self.loop = world.loop
        self.config = SimpleNamespace(start_timeout=1.0)
        self.rng = random.Random(f"{world.schedule.seed} stage")
        self._world = world
        self._started = 0
        self._refusals = {
            fault.start for fault in world.schedule.faults if isinstance(fault, Refusal)
        }
        self._longest = self.rng.choice(MOMENTS)
        self._stack = ExitStack()
        self.pickled_on_loop = False
        self.item = _item_of(self)
        self.bad_item = BadItem

    def enter(self) -> None:
        """Take the places."""
        enter = self._stack.enter_context
        enter(mock.patch.object(exchange, "runtime", return_value=self))
        enter(mock.patch.object(workers, "runtime", return_value=self))
        enter(mock.patch.object(exchange, "monotonic", self.loop.now))
        enter(mock.patch.object(dispatcher, "monotonic", self.loop.now))
        enter(mock.patch.object(exchange, "Pump", partial(StagedPump, self)))
        enter(mock.patch.object(service, "Capture", NoCapture))

    def leave(self) -> None:
        """Give them back."""
        self._stack.close()

    def start(
        self, process: Any, observer: Any, *, tasks: bool, method: str
    ) -> Child | RemoteChild:
        """Start a worker on some agent."""
        self._started += 1
        if self._started in self._refusals:
            self._world.note("the start of a worker is refused")
            self._world.oracle.stillborn += 1
            raise OSError("too many open files")
        agent = self.rng.choice([agent for agent in self._world.agents if not agent.lost])
        if isinstance(agent, RemoteHost):
            return agent.start_for_master(f"start {self._started}", observer)
        return self._world.start(agent, observer)

    def soon(self, callback: Callable[..., object], *args: Any) -> None:
        """Call it when another thread gets its turn."""
        self.loop.call_later(self.moment(), self._off_loop, callback, args)

    def moment(self) -> float:
        """Seconds until another thread gets its turn."""
        return self.rng.random() * self._longest

    def _off_loop(self, callback: Callable[..., object], args: tuple[Any, ...]) -> None:
        with self.loop.off_thread():
            callback(*args)


def _item_of(stage: Stage) -> type[tuple[int, int]]:
    class Item(tuple[int, int]):
        """A task whose pickling is the user's code."""

        __slots__ = ()

        def __reduce__(self) -> tuple[Any, ...]:
            stage.pickled_on_loop |= stage.loop.on_thread()
            return Ref, tuple(self)

    return Item


class BadItem(tuple[int, int]):
    """A task that does not pickle."""

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError("cannot pickle this")


class StagedPump:
    """A ``Pump`` without a thread."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage = stage
        self._todo: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        self.stopped = False

    def post(self, action: Callable[..., object], *args: Any) -> bool:
        """Have it done later, in order."""
        if not self.stopped:
            self._todo.append((action, args))
            self._stage.soon(self._run)
        return not self.stopped

    def stop(self) -> None:
        """Take nothing more."""
        self.stopped = True

    def _run(self) -> None:
        action, args = self._todo.pop(0)
        action(*args)


class StagedDispatcher(Dispatcher):
    """Sends what a caller's thread assigned a moment later: other threads may come first."""

    def __init__(self, stage: Stage, terms: Terms) -> None:
        super().__init__(terms)
        self._stage = stage

    def _send(self, batches: Iterable[Batch]) -> None:
        self._send_later(super()._send, list(batches))

    def _send_safely(self, batches: Iterable[Batch]) -> None:
        if self._loop.on_thread():
            super()._send_safely(batches)
        else:
            self._send_later(super()._send_safely, list(batches))

    def _send_later(self, send: Callable[[list[Batch]], None], batches: list[Batch]) -> None:
        if batches:
            self._stage.soon(send, batches)


class WatchedLock:
    """The dispatcher's lock.  Whenever it is released, everything behind it must be in order."""

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check
        self._held = False

    def __enter__(self) -> None:
        if self._held:
            raise RuntimeError("the dispatcher waits for a lock that it holds itself")
        self._held = True

    def __exit__(self, kind: object, *rest: object) -> None:
        self._held = False
        if kind is None:
            self._check()


class Actor:
    """A thread that runs only while the simulation waits for it: what it does happens at once."""

    def __init__(self, stage: Stage, body: Callable[[Actor], None]) -> None:
        self._stage = stage
        self._body = body
        self._turn = threading.Semaphore(0)
        self._back = threading.Semaphore(0)
        self._open = False
        self._waits = False
        self._error: BaseException | None = None
        self._abandoned = False
        self._thread = threading.Thread(target=self._run, name="simulated reader")

    def start(self) -> None:
        """Let it go."""
        self._thread.start()
        self.resume()

    def resume(self) -> None:
        """Let it run until it waits or ends."""
        if not self._thread.is_alive():
            return
        with self._stage.loop.off_thread():
            self._turn.release()
            self._back.acquire()
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def abandon(self) -> None:
        """End it, whatever it waits for."""
        self._abandoned = True
        self._turn.release()
        self._thread.join()

    def sleep(self, seconds: float) -> None:
        """In the actor: let time pass."""
        self._stage.loop.call_later(seconds, self.resume)
        self._pause()

    # As the lock that a reader waits at

    def acquire(self) -> None:
        """In the actor: wait until somebody releases it."""
        while not self._open:
            self._waits = True
            self._pause()
        self._open = False

    def release(self) -> None:
        """Let it go on, when its thread gets its turn."""
        self._open = True
        if self._waits:
            self._waits = False
            self._stage.loop.call_later(self._stage.moment(), self.resume)

    def _pause(self) -> None:
        self._back.release()
        self._turn.acquire()
        if self._abandoned:
            raise SystemExit

    def _run(self) -> None:
        self._turn.acquire()
        try:
            if not self._abandoned:
                self._body(self)
        except SystemExit:
            pass
        except BaseException as error:
            self._error = error
        finally:
            self._back.release()
