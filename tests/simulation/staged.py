"""Stand-ins for the threads, processes and runtime of the real executor.

One thread runs at a time, so that a seed decides the order.  What the executor does on its
background threads, and its callers on theirs, happens at moments that the seed chooses, and may be
interrupted where it runs the user's code or starts a process.
"""

from __future__ import annotations

import math
import random
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

from fiber._agent import service
from fiber._agent.interface import UNKNOWN, Cause, ExitReport
from fiber._backends import remote
from fiber._backends.remote import RemoteTaskChannel
from fiber._engine.activity import Activity
from fiber._runtime import exchange, executor, workers
from fiber._wire.packet import Message
from simulation.agents import Agent, Child
from simulation.remote_hosts import NoCapture, RemoteHost
from simulation.schedule import Famine, Refusal
from simulation.wire import PlannedError
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.world import World


class Stage:
    """Stands in for the runtime, as an executor's host; a context manager for the rest."""

    def __init__(self, world: World) -> None:
        self.loop = world.loop
        self.config = SimpleNamespace(start_timeout=1.0)
        self.elastic = False
        self.backend = SimpleNamespace(passes_on=False)
        self.activity = Activity(0.0)
        self.pools: set[object] = set()
        self.rng = random.Random(f"{world.schedule.seed} stage")
        self.world = world
        self._started = 0
        self._interrupts = self.rng.random() < 0.3
        self._refusals = {
            fault.start for fault in world.schedule.faults if isinstance(fault, Refusal)
        }
        self._stack = ExitStack()
        self._actors: list[Actor] = []
        self.running: Actor | None = None
        """The thread whose turn it is."""
        self.user_code_on_loop = False
        self.item = _item_of(self)
        world.make_channel = partial(StagedChannel, self)
        self.bad_item = BadItem

    def enter(self) -> None:
        """Replace functions that cannot be passed as arguments."""
        self._stack.enter_context(mock.patch.object(service, "Capture", NoCapture))
        channel = partial(StagedTaskChannel, self)
        self._stack.enter_context(mock.patch.object(remote, "RemoteTaskChannel", channel))
        self._stack.enter_context(mock.patch.object(executor, "say", self._say))
        self._stack.enter_context(mock.patch.object(exchange, "say", self._say))
        self._stack.enter_context(mock.patch.object(workers, "Latch", partial(StagedLatch, self)))
        self._stack.enter_context(mock.patch.object(PlannedError, "unpickled", self.run_user_code))

    def leave(self) -> None:
        """Give them back, and end all threads."""
        for actor in self._actors:
            actor.abandon()
        self._stack.close()

    def _say(self, news: str) -> None:
        self.world.note("the user is told: %s", news)

    def thread(self, name: str) -> StagedThread:
        """Return a stand-in for a BackgroundThread, sometimes one that may be interrupted."""
        return InterruptedThread(self, name) if self._interrupts else StagedThread(self, name)

    def act(self, name: str, body: Callable[[Actor], None]) -> Actor:
        """A thread that does ``body``, once it is resumed."""
        actor = Actor(self, name, body)
        self._actors.append(actor)
        return actor

    def look_at_program(self) -> None:
        """No file is sent here."""

    def start(self, process: Any, owner: Any, *, tasks: bool, method: str, shared: object) -> None:
        """Start a worker on some agent."""
        if self.running is not None:
            # The result comes after all earlier requests of this thread.
            self.running.sleep(self.loop.heard_in(self.running.name) + self.loop.moment())
        self._started += 1
        famine = self.world.famine()
        if self._started in self._refusals or famine is Famine.REFUSED:
            self.world.note("the start of a worker is refused")
            self._refuse(owner)
            return
        agent = self.rng.choice([agent for agent in self.world.agents if not agent.lost])
        if isinstance(agent, RemoteHost):
            child = agent.child_of_master(f"start {self._started}", owner)
            self.loop.call_soon(owner.begin, child)
        else:
            self.loop.call_soon(self._begin, agent, owner)
        self.pause()

    def _begin(self, agent: Agent, owner: Any) -> None:
        owner.begin(self.world.child(agent, owner))

    def _refuse(self, owner: Any) -> None:
        """The system has no room for it, as is seen at once, or by its agent."""
        error = OSError("too many open files")
        if self.rng.random() < 0.5:
            raise error
        attributes = "start", "start_error", "name", "deliver", "signal"
        child = mock.Mock(spec_set=attributes, start_error=None)
        self.loop.call_soon(owner.begin, child)
        self.loop.call_soon(self._tell_refusal, child, owner, error)

    def _tell_refusal(self, child: Any, owner: Any, error: OSError) -> None:
        child.start_error = error
        owner.exited(ExitReport(UNKNOWN, f"could not be started: {error}", cause=Cause.REFUSED))

    def run_user_code(self) -> None:
        """Take the time of a piece of the user's code, which may raise."""
        self.user_code_on_loop |= self.loop.on_thread()
        self.pause()

    def pause(self) -> None:
        """Let others go on, if this is a thread that may be interrupted."""
        if self.running is not None and self.rng.random() < 0.3:
            self.running.sleep(self.loop.moment())

    def run_actor(self, actor: Actor, run: Callable[[], None]) -> None:
        """Let ``actor`` run."""
        before, self.running = self.running, actor
        try:
            with self.loop.off_thread(actor.name):
                run()
        finally:
            self.running = before


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
        self._turn, self._back = threading.Lock(), threading.Lock()
        self._turn.acquire()
        self._back.acquire()
        self._entries: deque[Any] = deque()
        self._waits = False
        self._alarm: Any = None
        self._error: BaseException | None = None
        self._abandoned = False
        self._thread = threading.Thread(target=self._run, name=f"simulated {name}", daemon=True)

    @property
    def starves(self) -> bool:
        """Return whether it waits for an entry, and none is there."""
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
        """End it, even while it waits."""
        if self._thread.is_alive():
            self._abandoned = True
            self._turn.release()
            self._thread.join()

    def sleep(self, seconds: float) -> None:
        """Pause the actor: let time pass."""
        self._stage.loop.call_later(seconds, self.resume)
        self._pause()

    def wait(self, seconds: float) -> None:
        """Pause the actor until another one wakes it."""
        self._alarm = self._stage.loop.call_later(seconds, self._wake_up)
        self._pause()

    def wake(self) -> None:
        """Let it go on, if it waits, when its thread gets its turn."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = self._stage.loop.call_later(self._stage.loop.moment(), self._wake_up)

    def _wake_up(self) -> None:
        self._alarm = None
        self.resume()

    # As the queue that a thread waits at

    def get(self, timeout: float = math.inf) -> Any:
        """Pause the actor until the next entry, and return it."""
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


class StagedLatch:
    """Stand-in for a ``Latch`` that one actor waits at."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._set = False
        self._waiting: Actor | None = None

    def set(self) -> None:
        """Set the latch."""
        self._set = True
        if self._waiting is not None:
            self._waiting.wake()

    def wait(self, timeout: float) -> bool:
        """Pause the actor until the latch is set."""
        if not self._set:
            assert self._stage.running is not None
            self._waiting = self._stage.running
            self._waiting.wait(timeout)
        return self._set


class StagedThread:
    """Stand-in for a ``BackgroundThread``: runs each piece of work at once, in its turn."""

    def __init__(self, stage: Stage, name: str) -> None:
        self._stage = stage
        self._name = name
        self._entries: deque[Any] = deque()
        self.stopped = False

    def submit(self, action: Callable[..., object], *args: Any) -> bool:
        """Have it done later, in order."""
        if not self.stopped:
            self._put(partial(action, *args))
        return not self.stopped

    def stop(self, then: Callable[[], object] | None = None) -> None:
        """Take no more work, and call ``then`` at the end."""
        self.stopped = True
        if then is not None:
            self._put(then)

    def _put(self, action: Callable[[], object]) -> None:
        self._entries.append(action)
        self._stage.loop.call_later(self._stage.loop.moment(), self._do_next)

    def _do_next(self) -> None:
        with self._stage.loop.off_thread(self._name):
            self._entries.popleft()()


class InterruptedThread(StagedThread):
    """Thread that may pause within its work."""

    def __init__(self, stage: Stage, name: str) -> None:
        super().__init__(stage, name)
        self._actor: Actor | None = None

    def _put(self, action: Callable[[], object]) -> None:
        if self._actor is None:
            self._actor = self._stage.act(self._name, self._run)
            self._stage.loop.call_later(self._stage.loop.moment(), self._actor.start)
        self._actor.put(action)

    def _run(self, actor: Actor) -> None:
        while True:
            actor.get()()


class Interrupted(BaseException):
    """Ctrl-C."""


class StagedChannel:
    """The channel of a worker on this host in the hands of callers; a ``DirectChannel``."""

    def __init__(self, stage: Stage, child: Child) -> None:
        self._stage = stage
        self._child = child
        self._received: deque[Any] = deque()
        self._reader: Actor | None = None
        self._ended = False
        stage.world.note("%s is leased", child.name)

    def send(self, seq: int, payload: Any, buffers: Sequence[memoryview] = ()) -> None:
        """Send it a packet."""
        self._stage.pause()
        if self._child.gone:
            raise BrokenPipeError
        self._stage.world.note("%s is called directly", self._child.name)
        self._child.deliver(seq, payload, buffers)
        self._stage.pause()

    def receive(self, timeout: float) -> Message | None:
        """The next packet; sometimes Ctrl-C comes first."""
        assert self._stage.running is not None
        if not self._received and not self._ended:
            self._reader = self._stage.running
            self._reader.wait(timeout)
            self._reader = None
        if self._stage.rng.random() < 0.03:
            self._stage.world.note("the caller of %s is interrupted", self._child.name)
            raise Interrupted
        if self._received:
            message: Message = self._stage.world.language.message(self._received.popleft())
            return message
        if self._ended:
            raise EOFError
        return None

    def close(self) -> None:
        """Close the channel, which has no resources."""

    def hear(self, message: Any) -> None:
        """The worker sent it."""
        self._received.append(message)
        if self._reader is not None:
            self._reader.wake()

    def drain(self) -> list[Any]:
        """Return the packets that were not received."""
        left = list(self._received)
        self._received.clear()
        return left

    def end(self) -> None:
        """The worker is gone."""
        self._ended = True
        if self._reader is not None:
            self._reader.wake()


class StagedTaskChannel(RemoteTaskChannel):
    """The channel of a worker on another host: the real one with another wait for callers."""

    def __init__(self, stage: Stage, loop: Any, deliver: Callable[..., bool]) -> None:
        super().__init__(loop, deliver)
        self._stage = stage
        self._reader: Actor | None = None
        stage.world.note("a worker is leased to callers on another host")

    def send(self, seq: int, payload: Any, buffers: Sequence[memoryview] = ()) -> None:
        """Send it a packet."""
        self._stage.pause()
        super().send(seq, payload, buffers)
        self._stage.pause()

    def receive(self, timeout: float) -> Message | None:
        """The next packet; sometimes Ctrl-C comes first."""
        message = super().receive(timeout)
        if self._stage.rng.random() < 0.03:
            self._stage.world.note("the caller over there is interrupted")
            raise Interrupted
        return message

    def _wait(self, timeout: float) -> None:
        assert self._stage.running is not None
        self._reader = self._stage.running
        self._reader.wait(timeout)
        self._reader = None

    def _wake(self) -> None:
        if self._reader is not None:
            self._reader.wake()
