"""Children that wait for a pod.

* ``Preparation`` makes the FiberPool on a thread, because that waits for the API server.
* ``WaitingChildren`` holds the children until an agent arrives or the time for that is over.
* ``Progress`` shows on stderr what the children wait for.
* ``ReachabilityProbe`` tells when running pods send no agent.  It is pure: ``now`` is an argument.
"""

from __future__ import annotations

import enum
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.problems import (
    AgentRoute,
    PoolName,
    failure,
    new_problems,
    overdue,
    running,
    summary,
    unreachable,
)
from fiber._backends.kubernetes.provisioner import PreparedPool
from fiber._logs import OutputWriter
from fiber._transport.loop import EventLoop, Loop, ScheduledCall
from fiber.errors import FiberError


class WaitingChildren:
    """The children of one FiberPool that have no agent yet.  On the loop's thread.

    ``on_begin`` is called as somebody begins to wait while there is no agent at all.
    """

    def __init__(
        self,
        agents: AgentSet,
        output: OutputWriter,
        api: Api,
        timeout: float,
        *,
        on_begin: Callable[[], None],
    ) -> None:
        self.pool = PoolName("", "")
        """Pool that they wait for, once it has a name."""
        self.way = AgentRoute("")
        """Way of its agents to this program, once it has a name."""
        self.status: Mapping[str, Any] = {}
        """Present status of the pool."""
        self.attached = False
        """True if the pool is there, with this program as its master."""
        self._output = output
        self._api = api
        self._agents = agents
        self._placement = agents.placement
        self._timeout = timeout
        self._on_begin = on_begin
        self._patience: ScheduledCall | None = None
        self._reachability = ReachabilityProbe()
        self._verdict = Reachability.OPEN
        self._told_of_verdict = False
        self._next_judgement: ScheduledCall | None = None
        self._told_of_limit = False
        self._progress = Progress(agents.loop, output, self._describe)

    def stop(self) -> None:
        """End the waiting."""
        self._progress.stop()
        self._wait_no_more()
        self._cancel_judgement()

    def _wait_no_more(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def on_status(self, status: Mapping[str, Any]) -> None:
        """Say what is new in the pool's status, and end the wait if nobody will come."""
        before, self.status = self.status, status
        for problem in new_problems(self.pool, before, status):
            self._output.write("fiber", problem)
        error = failure(self.pool, status, len(self._placement.loads))
        if error is not None:
            self.refuse(error)
        self._judge_reachability()

    def reached(self) -> None:
        """Note that an agent of the pool has dialled: pods reach this program."""
        self._reachability.prove()
        self._judge_reachability()

    def refuse(self, error: Exception) -> None:
        """Refuse all that wait with ``error``."""
        self._progress.stop()  # first: whoever is refused may write where its line stands
        if self._has_processes:
            # Whoever started it has gone on.  Pools raise it to their callers.
            self._output.write("fiber", str(error))
        self._agents.refuse_waiting(error)

    def look(self, most: int) -> None:
        """Somebody has come or gone; there are to be at most so many pods."""
        placement = self._placement
        alone = self._alone
        known = self._agents.error or failure(self.pool, self.status, 0) or self._unreachable()
        if alone and known is not None:
            self.refuse(known)  # it was heard before they came
            return
        self._tell_of_doubts()
        if self.pool.name:
            self._look_at_limit(most)
        # A pool works with the workers that it has: nobody waits for the others.
        if alone or (len(placement.loads) < most and self._has_processes):
            self._progress.start()
        else:
            self._progress.stop()
        if not alone:
            self._wait_no_more()
        elif self._patience is None:
            self._patience = self._agents.loop.call_later(self._timeout, self._give_up)
            self._on_begin()

    @property
    def _alone(self) -> bool:
        """Return whether children wait and no agent is there."""
        return bool(self._placement.waiting) and not self._placement.loads

    @property
    def _has_processes(self) -> bool:
        """True if other children than workers wait.  No other process can do their work."""
        return not all(child.is_worker for child in self._placement.waiting)

    def _look_at_limit(self, most: int) -> None:
        """Processes for which there is no room in ``most`` pods until others end are spoken of,
        once: these may wait for them.
        """
        placement = self._placement
        too_many = placement.children + len(placement.waiting) > most * placement.slots
        if not too_many:
            self._told_of_limit = False
        elif not self._told_of_limit and self._has_processes:
            self._told_of_limit = True
            self._output.write(
                "fiber",
                f"{len(placement.waiting)} processes wait until others end: there are to be no "
                f"more than {most} pods with {placement.slots} processes each. Raise max_pods, for "
                "a pool of somebody else's its maxReplicas, or processes_per_pod",
            )

    def _judge_reachability(self) -> None:
        loop = self._agents.loop
        self._cancel_judgement()
        self._verdict = self._reachability.judge(running(self.status), now := loop.now())
        if self._verdict is Reachability.OPEN:
            self._told_of_verdict = False
        if self._reachability.due < math.inf:
            pause = self._reachability.due - now
            self._next_judgement = loop.call_later(pause, self._judge_reachability)
        error = self._unreachable()
        if error is not None and self._alone:
            self.refuse(error)
        else:
            self._tell_of_doubts()

    def _cancel_judgement(self) -> None:
        if self._next_judgement is not None:
            self._next_judgement.cancel()
            self._next_judgement = None

    def _unreachable(self) -> FiberError | None:
        # The agents of a pool that was taken over may serve its last master, for as long as that
        # lives.
        if self._verdict is not Reachability.UNREACHABLE or self.way.displaced:
            return None
        return unreachable(self.pool, self.status, DOUBTED_AFTER + GIVEN_UP_AFTER, self.way)

    def _tell_of_doubts(self) -> None:
        if self._verdict is Reachability.OPEN or self._told_of_verdict or not self._alone:
            return
        self._told_of_verdict = True
        doubt = unreachable(self.pool, self.status, DOUBTED_AFTER, self.way)
        patience = "" if self.way.displaced else f". Waiting for {GIVEN_UP_AFTER:g} s more"
        self._output.write("fiber", f"{doubt}{patience}")

    def _give_up(self) -> None:
        self._patience = None
        if self.pool.name:
            error = overdue(self.pool, self.status, self._timeout, time.time(), self.way)
            self.refuse(error)
        else:
            self.refuse(
                FiberError(
                    f"no pod could be asked for within {self._timeout:g} s: {self._api_state()}. "
                    "Look with `kubectl get fiberpools` whether it answers, and whether its login "
                    "waits for somebody"
                )
            )

    def _describe(self) -> str:
        state = summary(self.status, time.time()) if self.attached else self._api_state()
        unreached = self._verdict is not Reachability.OPEN
        where = f", no agent has reached {self.way.address}" if unreached else ""
        return f"waiting for pods: {state}{where}"

    def _api_state(self) -> str:
        trouble = self._api.trouble
        if trouble is None:
            return f"the API server {self._api.server} has not answered yet"
        return f"the API server {self._api.server} is asked again and again: {trouble}"


_FIRST_SHOWN, _SHOWN_AGAIN = 1.0, 1.0
"""Seconds on a terminal, where each line takes the place of the one before."""

_FIRST_WRITTEN, _WRITTEN_AGAIN = 5.0, 60.0
"""Seconds elsewhere, where lines stay."""

_COLUMNS = 80


class Progress:
    """Says what ``describe()`` does, again and again while a wait lasts.

    On the loop's thread.
    """

    def __init__(self, loop: EventLoop, output: OutputWriter, describe: Callable[[], str]) -> None:
        self._loop = loop
        self._output = output
        self._describe = describe
        self._timer: ScheduledCall | None = None
        self._shows = False

    def start(self) -> None:
        """The wait begins, or goes on."""
        if self._timer is None:
            self._shows = _is_terminal()
            first = _FIRST_SHOWN if self._shows else _FIRST_WRITTEN
            self._timer = self._loop.call_later(first, self._say)

    def stop(self) -> None:
        """End the waiting: remove the line from a terminal."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
            if self._shows:
                self._output.show("")

    def _say(self) -> None:
        text = self._describe()
        if self._shows:
            # A line that wraps cannot be taken away.
            self._output.show(f"[fiber] {text}"[: _columns() - 1])
        else:
            self._output.write("fiber", text)
        again = _SHOWN_AGAIN if self._shows else _WRITTEN_AGAIN
        self._timer = self._loop.call_later(again, self._say)


def _is_terminal() -> bool:
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # there is none, or it is closed
        return False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _COLUMNS
    except (AttributeError, OSError, ValueError):  # some terminals do not say
        return _COLUMNS


DOUBTED_AFTER = 8.0
"""Seconds from the first running pod until the missing agent is reported.  An agent needs a second
or two to start and to dial."""

GIVEN_UP_AFTER = 60.0
"""Seconds from that report to the error."""

_LATE = 2.0
"""Seconds by which a judgement may be late.  A longer delay means that this program was stopped or
held up, and that agents had to wait for it."""


class Reachability(enum.Enum):
    """Conclusion from running pods that send no agent."""

    OPEN = enum.auto()
    DOUBTFUL = enum.auto()
    UNREACHABLE = enum.auto()


class ReachabilityProbe:
    """Record of the running pods of one pool, and of the first sign of an agent."""

    def __init__(self) -> None:
        self.due = math.inf
        """Time of the next judgement that can differ from the last."""
        self._proven = False
        self._running = 0
        self._since = math.inf
        self._newest = math.inf

    def prove(self) -> None:
        """Note that an agent has dialled: the address works."""
        self._proven = True
        self.due = math.inf

    def judge(self, running: int, now: float) -> Reachability:
        """Return the conclusion, with ``running`` pods there now."""
        late, self.due = now > self.due + _LATE, math.inf
        if not running or self._proven:
            self._running = 0
            return Reachability.OPEN
        if not self._running or late:
            self._since = now
        if running > self._running or late:
            self._newest = now  # as much time for this pod's agent as for the first
        self._running = running
        doubted_at = self._since + DOUBTED_AFTER
        given_up_at = max(doubted_at + GIVEN_UP_AFTER, self._newest + DOUBTED_AFTER)
        if now >= given_up_at:
            return Reachability.UNREACHABLE
        self.due = given_up_at if now >= doubted_at else doubted_at
        return Reachability.OPEN if now < doubted_at else Reachability.DOUBTFUL


class Preparation:
    """Calls ``prepare`` once, and on the loop's thread ``on_prepared`` with what it returns or
    ``on_failed`` with what it raises.
    """

    def __init__(
        self,
        loop: Loop,
        prepare: Callable[[], PreparedPool],
        *,
        on_prepared: Callable[[PreparedPool], None],
        on_failed: Callable[[FiberError], None],
    ) -> None:
        self._loop = loop
        self._prepare = prepare
        self._on_prepared = on_prepared
        self._on_failed = on_failed
        self._thread = threading.Thread(target=self._run, name="fiber-prepare", daemon=True)

    def start(self) -> None:
        """Begin.  On the loop's thread."""
        try:
            self._thread.start()
        except RuntimeError as error:  # the system has no room for it
            self._on_failed(_unexpected(error))

    def join(self, timeout: float) -> None:
        """Wait until it is over."""
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            prepared = self._prepare()
        except FiberError as error:
            self._loop.call_soon(self._on_failed, error)
        except Exception as error:  # a fault of ours must not leave anybody waiting
            self._loop.call_soon(self._on_failed, _unexpected(error))
        else:
            self._loop.call_soon(self._on_prepared, prepared)


def _unexpected(error: Exception) -> FiberError:
    failure = FiberError(f"no pods can be asked for, after an unexpected {error!r}")
    failure.__cause__ = error
    return failure
