"""What the real executor finds in place of threads, processes and the runtime.

One thread runs at a time, so that a seed decides the order.  What the executor does on its
background threads, and its callers on theirs, happens at moments that the seed chooses, and may be
interrupted where it runs the user's code or starts a process.
"""

from __future__ import annotations

import random
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

from fiber._agent import service
from fiber._backends.remote import RemoteChild
from fiber._runtime import executor
from fiber.process import Process
from simulation.agents import Child
from simulation.remote_hosts import NoCapture, RemoteHost
from simulation.schedule import Famine, Refusal
from simulation.wire import PlannedError
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.world import World


class StagedProcess(Process):
    """Makes the executor's processes leave the start method of this program alone."""

    _start_method = "fork"


class Stage:
    """Stands in for the runtime, as an executor's host; a context manager for the rest."""

    def __init__(self, world: World) -> None:
        self.loop = world.loop
        self.config = SimpleNamespace(start_timeout=1.0)
        self.rng = random.Random(f"{world.schedule.seed} stage")
        self.world = world
        self._started = 0
        self._refusals = {
            fault.start for fault in world.schedule.faults if isinstance(fault, Refusal)
        }
        self._stack = ExitStack()
        self._actors: list[Actor] = []
        self._running: Actor | None = None
        self.user_code_on_loop = False
        self.item = _item_of(self)
        self.bad_item = BadItem

    def enter(self) -> None:
        """Take the places of what cannot be handed over."""
        self._stack.enter_context(mock.patch.object(service, "Capture", NoCapture))
        self._stack.enter_context(mock.patch.object(executor, "_say", self._say))
        self._stack.enter_context(mock.patch.object(PlannedError, "unpickled", self.run_user_code))

    def leave(self) -> None:
        """Give them back, and end all threads."""
        for actor in self._actors:
            actor.abandon()
        self._stack.close()

    def _say(self, news: str) -> None:
        self.world.note("the user is told: %s", news)

    def thread(self, name: str) -> StagedThread:
        """In place of a BackgroundThread."""
        return StagedThread(self, name)

    def act(self, name: str, body: Callable[[Actor], None]) -> Actor:
        """A thread that does ``body``, once it is resumed."""
        actor = Actor(self, name, body)
        self._actors.append(actor)
        return actor

    def start(
        self, process: Any, observer: Any, *, tasks: bool, method: str
    ) -> Child | RemoteChild:
        """Start a worker on some agent."""
        assert self._running is not None
        # What comes of it comes after all that this thread has asked for.
        self._running.sleep(self.loop.heard_in(self._running.name) + self.loop.moment())
        self._started += 1
        famine = self.world.famine()
        if self._started in self._refusals or famine is Famine.REFUSED:
            self.world.note("the start of a worker is refused")
            raise OSError("too many open files")
        agent = self.rng.choice([agent for agent in self.world.agents if not agent.lost])
        if isinstance(agent, RemoteHost):
            return agent.start_for_master(f"start {self._started}", observer)
        return self.world.start(agent, observer)

    def run_user_code(self) -> None:
        """What every piece of the user's code does."""
        self.user_code_on_loop |= self.loop.on_thread()
        self.pause()

    def pause(self) -> None:
        """Let others go on, if this is a thread that may be interrupted."""
        if self._running is not None and self.rng.random() < 0.3:
            self._running.sleep(self.loop.moment())

    def run_actor(self, actor: Actor, run: Callable[[], None]) -> None:
        """Let ``actor`` run."""
        before, self._running = self._running, actor
        try:
            with self.loop.off_thread(actor.name):
                run()
        finally:
            self._running = before


def _item_of(stage: Stage) -> type[tuple[int, int]]:
    class Item(tuple[int, int]):
        """A task whose pickling is the user's code."""

        __slots__ = ()

        def __reduce__(self) -> tuple[Any, ...]:
            stage.run_user_code()
            return Ref, tuple(self)

    return Item


class BadItem(tuple[int, int]):
    """A task that does not pickle."""

    __slots__ = ()

    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError("cannot pickle this")


class Actor:
    """A thread that runs only while the simulation waits for it, until it pauses."""

    def __init__(self, stage: Stage, name: str, body: Callable[[Actor], None]) -> None:
        self.name = name
        self._stage = stage
        self._body = body
        self._turn = threading.Semaphore(0)
        self._back = threading.Semaphore(0)
        self._entries: deque[Any] = deque()
        self._waits = False
        self._error: BaseException | None = None
        self._abandoned = False
        self._thread = threading.Thread(target=self._run, name=f"simulated {name}", daemon=True)

    @property
    def starves(self) -> bool:
        """Whether it waits for an entry, and none is there."""
        return self._waits and not self._entries

    def start(self) -> None:
        """Let it go."""
        self._thread.start()
        self.resume()

    def resume(self) -> None:
        """Let it run until it waits or ends."""
        if not self._thread.is_alive():
            return
        self._stage.run_actor(self, self._take_turn)
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _take_turn(self) -> None:
        self._turn.release()
        self._back.acquire()

    def abandon(self) -> None:
        """End it, whatever it waits for."""
        if self._thread.is_alive():
            self._abandoned = True
            self._turn.release()
            self._thread.join()

    def sleep(self, seconds: float) -> None:
        """In the actor: let time pass."""
        self._stage.loop.call_later(seconds, self.resume)
        self._pause()

    # As the queue that a thread waits at

    def get(self) -> Any:
        """In the actor: the next entry, once there is one."""
        while not self._entries:
            self._waits = True
            self._pause()
        return self._entries.popleft()

    def put(self, entry: Any) -> None:
        """Let it have an entry, when its thread gets its turn."""
        self._entries.append(entry)
        if self._waits:
            self._waits = False
            self._stage.loop.call_later(self._stage.loop.moment(), self.resume)

    def _pause(self) -> None:
        if not self._abandoned:
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


class StagedThread:
    """In place of a ``BackgroundThread``: the same, as an actor."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage = stage
        self._name = name
        self._actor: Actor | None = None
        self.stopped = False

    def submit(self, action: Callable[..., object], *args: Any) -> bool:
        """Have it done later, in order."""
        if self.stopped:
            return False
        if self._actor is None:
            self._actor = self._stage.act(self._name, self._run)
            self._actor.put((action, args))
            self._stage.loop.call_later(self._stage.loop.moment(), self._actor.start)
        else:
            self._actor.put((action, args))
        return True

    def stop(self) -> None:
        """Take nothing more."""
        self.stopped = True
        if self._actor is not None:
            self._actor.put(None)

    def _run(self, actor: Actor) -> None:
        while (entry := actor.get()) is not None:
            action, args = entry
            action(*args)
