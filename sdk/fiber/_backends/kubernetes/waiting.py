"""Children that wait for a pod.

* ``Preparation`` makes the FiberPool on a thread, because that waits for the API server.
* ``WaitingChildren`` ends the wait of children for which no agent can come.
* ``Progress`` shows on stderr what the children wait for.
* ``ReachabilityProbe`` concludes that running pods cannot reach the program.  It is pure: ``now``
  is an argument.
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
    """Children of one FiberPool that have no agent yet.  Runs on the loop thread.

    ``on_begin`` is called when children begin to wait while the pool has no agent.
    ``on_unreached``, if there is another way for agents, is called once when those of running pods
    seem not to reach this program.
    """

    def __init__(
        self,
        agents: AgentSet,
        output: OutputWriter,
        api: Api,
        timeout: float,
        *,
        on_begin: Callable[[], None],
        on_unreached: Callable[[], None] | None = None,
    ) -> None:
        self.pool = PoolName("", "")
        """Pool that the children wait for; without a name before ``on_named``."""
        self.route = AgentRoute("")
        """Route of agents to this program; empty before ``on_attached``."""
        self.status: Mapping[str, Any] = {}
        """Present status of the pool."""
        self.attached = False
        """True if the pool exists, with this program as its master."""
        self._output = output
        self._api = api
        self._agents = agents
        self._placement = agents.placement
        self._timeout = timeout
        self._on_begin = on_begin
        self._timeout_timer: ScheduledCall | None = None
        self._on_unreached = on_unreached
        self._relay_trouble: str | None = None
        """Reason why the relay cannot be used now; None if no relay is used or it works."""
        self._reachability = ReachabilityProbe(
            DOUBTED_AFTER if on_unreached is None else RELAYED_AFTER
        )
        self._verdict = Reachability.OPEN
        self._verdict_reported = False
        self._next_judgement: ScheduledCall | None = None
        self._limit_reported = False
        self._progress = Progress(agents.loop, output, self._describe)

    def stop(self) -> None:
        """End the waiting."""
        self._progress.stop()
        self._cancel_timeout()
        self._cancel_judgement()

    def _cancel_timeout(self) -> None:
        if self._timeout_timer is not None:
            self._timeout_timer.cancel()
            self._timeout_timer = None

    def on_named(self, pool: PoolName) -> None:
        """Take the name of the pool that the children wait for."""
        self.pool = pool

    def on_attached(self, route: AgentRoute) -> None:
        """Note that the pool exists, with this program as its master."""
        self.attached = True
        self.route = route

    def on_status(self, status: Mapping[str, Any]) -> None:
        """Report new problems in the pool's status; end the wait if no agent will come."""
        before, self.status = self.status, status
        for problem in new_problems(self.pool, before, status):
            self._output.write("fiber", problem)
        error = failure(self.pool, status, len(self._placement.loads))
        if error is not None:
            self.refuse(error)
        self._judge_reachability()

    def use_relay(self, relay: str) -> None:
        """Note that agents connect to a relay from now on."""
        self._on_unreached = None
        self.route = self.route._replace(address=f"the relay {relay}", relay=relay)
        self._relay_trouble = "it is being made"
        self._judge_anew()

    def on_relay_trouble(self, trouble: str) -> None:
        """Take the reason why the relay cannot be used now; empty if it can."""
        self._relay_trouble = trouble or None
        if not trouble:
            self._judge_anew()

    def _judge_anew(self) -> None:
        self._reachability = ReachabilityProbe()
        self._judge_reachability()

    def reached(self) -> None:
        """Note that an agent of the pool has dialed: pods reach this program."""
        self._reachability.prove()
        self._judge_reachability()

    def refuse(self, error: Exception) -> None:
        """Refuse all waiting children with ``error``."""
        self._progress.stop()  # first: an observer may write where the status line is
        if self._has_processes:
            # No caller waits for the start of a process.  Pools raise the error to their callers.
            self._output.write("fiber", str(error))
        self._agents.refuse_waiting(error)

    def look(self, most: int) -> None:
        """Check the waiting children after a change; ``most`` is the largest number of pods."""
        placement = self._placement
        alone = self._alone
        known = self._agents.error or failure(self.pool, self.status, 0) or self._unreachable()
        if alone and known is not None:
            self.refuse(known)  # the error was known before these children came
            return
        self._report_doubts()
        if self.pool.name:
            self._look_at_limit(most)
        # A pool works with the workers that it has, and waits for no others.
        if alone or (len(placement.loads) < most and self._has_processes):
            self._progress.start()
        else:
            self._progress.stop()
        if not alone:
            self._cancel_timeout()
        elif self._timeout_timer is None:
            self._timeout_timer = self._agents.loop.call_later(self._timeout, self._give_up)
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
        """Report once that processes wait until others end, since ``most`` pods are full.

        The running processes may wait for the waiting ones, without an end.
        """
        placement = self._placement
        too_many = placement.children + len(placement.waiting) > most * placement.slots
        if not too_many:
            self._limit_reported = False
        elif not self._limit_reported and self._has_processes:
            self._limit_reported = True
            self._output.write(
                "fiber",
                f"{len(placement.waiting)} processes wait until others end: at most {most} pods "
                f"with {placement.slots} processes each are allowed. Raise max_pods or "
                "processes_per_pod; for an existing FiberPool, raise its maxReplicas",
            )

    def _judge_reachability(self) -> None:
        loop = self._agents.loop
        self._cancel_judgement()
        # While the relay cannot be used, the pods are not to blame.
        pods = running(self.status) if self._relay_trouble is None else 0
        self._verdict = self._reachability.judge(pods, now := loop.now())
        if self._verdict is not Reachability.OPEN and self._on_unreached is not None:
            use_another_way, self._on_unreached = self._on_unreached, None
            self._judge_anew()
            use_another_way()
            return
        if self._verdict is Reachability.OPEN:
            self._verdict_reported = False
        if self._reachability.due < math.inf:
            pause = self._reachability.due - now
            self._next_judgement = loop.call_later(pause, self._judge_reachability)
        error = self._unreachable()
        if error is not None and self._alone:
            self.refuse(error)
        else:
            self._report_doubts()

    def _cancel_judgement(self) -> None:
        if self._next_judgement is not None:
            self._next_judgement.cancel()
            self._next_judgement = None

    def _unreachable(self) -> FiberError | None:
        # The agents of a pool that was taken over may still serve the master before.
        if self._verdict is not Reachability.UNREACHABLE or self.route.displaced:
            return None
        return unreachable(self.pool, self.status, DOUBTED_AFTER + GIVEN_UP_AFTER, self.route)

    def _report_doubts(self) -> None:
        if self._verdict is Reachability.OPEN or self._verdict_reported or not self._alone:
            return
        self._verdict_reported = True
        doubt = unreachable(self.pool, self.status, DOUBTED_AFTER, self.route)
        patience = "" if self.route.displaced else f". Waiting for {GIVEN_UP_AFTER:g} s more"
        self._output.write("fiber", f"{doubt}{patience}")

    def _give_up(self) -> None:
        self._timeout_timer = None
        if self.pool.name:
            error = overdue(self.pool, self.status, self._timeout, time.time(), self.route)
            self.refuse(error)
        else:
            self.refuse(
                FiberError(
                    f"no pod could be requested within {self._timeout:g} s: {self._api_state()}. "
                    "Check with `kubectl get fiberpools` that the API server answers and that the "
                    "login needs no input"
                )
            )

    def _describe(self) -> str:
        state = summary(self.status, time.time()) if self.attached else self._api_state()
        if self._relay_trouble is not None:
            return f"waiting for pods: {state}; waiting for the relay: {self._relay_trouble}"
        unreached = self._verdict is not Reachability.OPEN
        where = f", no agent has reached {self.route.address}" if unreached else ""
        return f"waiting for pods: {state}{where}"

    def _api_state(self) -> str:
        trouble = self._api.trouble
        if trouble is None:
            return f"the API server {self._api.server} has not answered yet"
        return f"calls to the API server {self._api.server} fail and are repeated: {trouble}"


_FIRST_SHOWN, _SHOWN_AGAIN = 1.0, 1.0
"""Seconds on a terminal, where each status replaces the one before."""

_FIRST_WRITTEN, _WRITTEN_AGAIN = 5.0, 60.0
"""Seconds elsewhere, where each status is a line that stays."""

_COLUMNS = 80


class Progress:
    """Display of ``describe()`` on stderr, repeated while a wait lasts.

    Runs on the loop thread.
    """

    def __init__(self, loop: EventLoop, output: OutputWriter, describe: Callable[[], str]) -> None:
        self._loop = loop
        self._output = output
        self._describe = describe
        self._timer: ScheduledCall | None = None
        self._shows = False

    def start(self) -> None:
        """Begin or continue the display."""
        if self._timer is None:
            self._shows = _is_terminal()
            first = _FIRST_SHOWN if self._shows else _FIRST_WRITTEN
            self._timer = self._loop.call_later(first, self._show)

    def stop(self) -> None:
        """End the display; remove it from a terminal."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
            if self._shows:
                self._output.show("")

    def _show(self) -> None:
        text = self._describe()
        if self._shows:
            # A line that wraps cannot be erased.
            self._output.show(f"[fiber] {text}"[: _columns() - 1])
        else:
            self._output.write("fiber", text)
        again = _SHOWN_AGAIN if self._shows else _WRITTEN_AGAIN
        self._timer = self._loop.call_later(again, self._show)


def _is_terminal() -> bool:
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # stderr is None or closed
        return False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _COLUMNS
    except (AttributeError, OSError, ValueError):  # some terminals have no known size
        return _COLUMNS


DOUBTED_AFTER = 8.0
"""Seconds from the first running pod until the missing agent is reported.  An agent needs a second
or two to start and to dial."""

RELAYED_AFTER = 4.0
"""Seconds from the first running pod until a relay is asked for, if no agent has dialed."""

GIVEN_UP_AFTER = 60.0
"""Seconds from that report to the error."""

_LATE = 2.0
"""Seconds by which a judgement may be late.  A longer delay means that this program was stopped or
blocked, and that agents had to wait for it."""


class Reachability(enum.Enum):
    """Conclusion from running pods whose agents do not dial."""

    OPEN = enum.auto()
    DOUBTFUL = enum.auto()
    UNREACHABLE = enum.auto()


class ReachabilityProbe:
    """Record of the running pods of one FiberPool, and of the first agent that dialed."""

    def __init__(self, doubted_after: float = DOUBTED_AFTER) -> None:
        self._doubted_after = doubted_after
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
        """Return the conclusion, with ``running`` pods at ``now``."""
        late, self.due = now > self.due + _LATE, math.inf
        if not running or self._proven:
            self._running = 0
            return Reachability.OPEN
        if not self._running or late:
            self._since = now
        if running > self._running or late:
            self._newest = now  # the agent of a new pod gets as much time as the first
        self._running = running
        doubted_at = self._since + self._doubted_after
        given_up_at = max(doubted_at + GIVEN_UP_AFTER, self._newest + self._doubted_after)
        if now >= given_up_at:
            return Reachability.UNREACHABLE
        self.due = given_up_at if now >= doubted_at else doubted_at
        return Reachability.OPEN if now < doubted_at else Reachability.DOUBTFUL


class Preparation:
    """Thread that calls ``prepare`` once.

    On the loop thread, ``on_prepared`` gets its result, or ``on_failed`` its error.
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
        """Start the thread.  Runs on the loop thread."""
        try:
            self._thread.start()
        except RuntimeError as error:  # the system has no room for a thread
            self._on_failed(_unexpected(error))

    def join(self, timeout: float) -> None:
        """Wait until ``prepare`` has ended."""
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            prepared = self._prepare()
        except FiberError as error:
            self._loop.call_soon(self._on_failed, error)
        except Exception as error:  # a bug must not leave children waiting
            self._loop.call_soon(self._on_failed, _unexpected(error))
        else:
            self._loop.call_soon(self._on_prepared, prepared)


def _unexpected(error: Exception) -> FiberError:
    failure = FiberError(f"no pods can be requested, after an unexpected {error!r}")
    failure.__cause__ = error
    return failure
