"""The pods of one FiberPool as hosts for children: as many as these need, while they do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber._backends.kubernetes.pod_reasons import node_of, pod_end
from fiber._backends.kubernetes.problems import PoolName, failure, new_problems, overdue, summary
from fiber._backends.kubernetes.program import Opened, Serve
from fiber._backends.kubernetes.progress import Progress
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.demand import Demand
from fiber._engine.placement import Placement
from fiber._hub.hub import Hub
from fiber._transport.link import Link
from fiber._transport.loop import Loop, Timer
from fiber.config import Config
from fiber.errors import FiberError, FiberPoolError
from fiber_api import names

_END_TIMEOUT = 10.0
"""Seconds for the API server, and as many for the agents, to hear of the end."""

_ENDED = ("Failed", "Succeeded")

Document = Mapping[str, Any]


class Pods:
    """Begins with the first child, and asks for pods as children come and go.

    ``open`` makes the pool, or attaches to it; it blocks and raises FiberError.  Everything but
    ``agents.child`` and ``close`` happens on the loop's thread.
    """

    def __init__(
        self,
        loop: Loop,
        hub: Hub,
        output: Output,
        config: Config,
        api: Api,
        open: Callable[[Serve], Opened],
    ) -> None:
        self._loop = loop
        self._output = output
        self._config = config
        self._api = api
        self._open = open
        self._placement: Placement[RemoteAgent, RemoteChild] = Placement(
            config.processes_per_pod, spread=False
        )
        self._demand = Demand(
            self._placement, maximum=config.max_pods, idle_timeout=config.idle_timeout
        )
        self.agents = AgentSet(
            loop, hub, output, self._placement, on_change=self._changed, on_lost=self._lost
        )
        self.over = False
        """Nothing comes of its pool any more, and it was given back."""
        self._opener: threading.Thread | None = None
        self._opened: Opened | None = None
        self._client: FiberPoolClient | None = None
        self._closing = threading.Event()
        """Nothing more is to be asked of the API server than the end."""
        self._decision_is_due = False
        self._timer: Timer | None = None
        self._patience: Timer | None = None
        self._wanted = 0
        self._pods: dict[str, Document] = {}
        self._told_of_limit = False
        self._given_up: set[str] = set()
        """Pods that are there and of which nothing is expected any more."""
        self._back_again: RemoteAgent | None = None
        """Which agent is lost only to be there again."""
        self._status: Document = {}
        self._progress = Progress(loop, output, self._describe)

    def begin_close(self) -> None:
        """Begin to end; waits for nothing."""
        self._closing.set()
        if self._client is not None:
            self._client.begin_close(_END_TIMEOUT)

    def close(self) -> None:
        """End the children, and the pool or its use.  Not on the loop's thread."""
        self._closing.set()
        self._wait_for(lambda then: self._loop.call_soon(self._shut_down, then))
        opener = self._opener  # from here on there will be no other
        if opener is not None:
            opener.join(_END_TIMEOUT)
            self._wait_for(self._loop.call_soon)  # until what it opened is known
        if self._client is not None:
            self._client.close(_END_TIMEOUT)
        if self._opened is not None:
            listener = self._opened.listener
            self._wait_for(lambda then: listener.close("the master ended", then=then))

    def _wait_for(self, ask: Callable[[Callable[[], None]], None]) -> None:
        """Until what is asked for is done on the loop's thread, if that still does anything."""
        done = threading.Event()
        ask(done.set)
        if not self._loop.broken:
            done.wait(_END_TIMEOUT)

    def _shut_down(self, then: Callable[[], None]) -> None:
        for timer in (self._timer, self._patience):
            if timer is not None:
                timer.cancel()
        self._progress.stop()
        for agent in self.agents.agents.values():
            agent.close()
        then()

    # -- The pool begins

    def _begin(self) -> None:
        """Calls of the API server take their time: a thread makes them."""
        opener = threading.Thread(target=self._run_open, name="fiber-open", daemon=True)
        try:
            opener.start()
        except RuntimeError as error:  # the system has no room for it
            self._refuse(_unexpected(error))
        else:
            self._opener = opener

    def _run_open(self) -> None:
        serve = Serve(
            self._joined,
            self._refused,
            self._closing,
        )
        try:
            opened = self._open(serve)
        except FiberError as error:
            self._loop.call_soon(self._failed_to_open, error)
        except Exception as error:  # a fault of ours must not leave anybody waiting
            self._loop.call_soon(self._failed_to_open, _unexpected(error))
        else:
            self._loop.call_soon(self._began, opened)

    def _failed_to_open(self, error: FiberError) -> None:
        self._opener = None  # the next child may have more luck
        self._refuse(error)

    def _began(self, opened: Opened) -> None:
        self._opened = opened
        if self._closing.is_set():
            return  # there is no pool yet, and nobody who wants one
        self._placement.slots = opened.slots
        self._demand.floor, self._demand.maximum = opened.minimum, opened.maximum
        self._client = FiberPoolClient(self._api, self._loop, opened.tenure, self)
        self._client.start()
        self._changed()

    # -- What it needs

    def _changed(self) -> None:
        if not self._decision_is_due:
            self._decision_is_due = True
            self._loop.call_soon(self._decide)

    def _decide(self) -> None:
        self._decision_is_due = False
        if self._closing.is_set():
            return
        desired = self._demand.decide(self._loop.now())
        if self._placement.waiting and self._opener is None:
            self._begin()
        released = [agent.host for agent in desired.release]
        self._given_up.update(released)
        if self._client is not None and (released or desired.agents != self._wanted):
            self._wanted = desired.agents
            self._client.demand(desired.agents, released)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if desired.wake_at < float("inf"):
            self._timer = self._loop.call_later(desired.wake_at - self._loop.now(), self._decide)
        self._watch_the_limit()
        self._watch_the_wait()

    def _watch_the_limit(self) -> None:
        """Processes for which there is no room until others end are spoken of, once: these may
        wait for them.  A pool works with the workers that it has.
        """
        placement, most = self._placement, self._demand.maximum
        too_many = placement.children + len(placement.waiting) > most * placement.slots
        if not too_many or self._opened is None:
            self._told_of_limit = False
        elif not self._told_of_limit and not all(child.is_worker for child in placement.waiting):
            self._told_of_limit = True
            self._output.write(
                "fiber",
                f"{len(placement.waiting)} processes wait until others end: there are to be no "
                f"more than {most} pods with {placement.slots} processes each. Raise max_pods, for "
                "a pool of somebody else's its maxReplicas, or processes_per_pod",
            )

    def _watch_the_wait(self) -> None:
        """Somebody who waits for a first host is told what for, and not kept for ever."""
        waits = bool(self._placement.waiting) and not self._placement.loads
        known = self.agents.error or failure(self._name, self._status, 0)
        if waits and known is not None:
            self._refuse(known)  # it was heard before they came
        elif not waits:
            self._progress.stop()
            if self._patience is not None:
                self._patience.cancel()
                self._patience = None
        elif self._patience is None:
            self._progress.start()
            timeout = self._config.pod_timeout
            self._patience = self._loop.call_later(timeout, self._give_up_waiting)

    def _give_up_waiting(self) -> None:
        self._patience = None
        timeout = self._config.pod_timeout
        if self._opened is not None:
            self._refuse(overdue(self._name, self._status, timeout, time.time()))
        else:
            self._refuse(
                FiberError(
                    f"no pod could be asked for within {timeout:g} s: {self._asking}. Look with "
                    "`kubectl get fiberpools` whether it answers, and whether its login waits for "
                    "somebody"
                )
            )

    def _refuse(self, error: Exception) -> None:
        """Nobody is to wait any longer."""
        self._progress.stop()  # first: whoever is refused may write where its line stands
        if not all(child.is_worker for child in self._placement.waiting):
            # Whoever started it has gone on.  Pools raise it to their callers.
            self._output.write("fiber", str(error))
        self.agents.refuse_waiting(error)

    # -- Agents

    def _refused(self, why: str) -> None:
        if not self._closing.is_set():  # else that is how it is to be
            self._output.write("fiber", f"an agent was refused: {why}")

    def _joined(self, link: Link) -> str | None:
        name = link.peer.name
        if name in self._given_up:
            return f"{name}, which had been given up"
        if (pod := self._pods.get(name)) is not None and pod_end(pod) is not None:
            return f"{name}, whose pod is about to go"
        if (before := self.agents.agents.get(name)) is not None:
            # It had given this program up, ended its children, and is back: after a program was
            # stopped for a while, say.
            self._back_again = before
            before.lose("it had lost this program, and began anew")
        agent = self.agents.join(name, link)
        agent.pod = name
        self._tell(agent)
        return None

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        name = agent.host
        if agent is self._back_again:
            return  # its pod is as good as before
        if name in self._pods and name not in self._given_up and not self._closing.is_set():
            # Its pod may live on where nobody hears it: another takes its place.
            self._given_up.add(name)
            if self._client is not None:
                self._client.demand(self._wanted, [name])

    def _tell(self, agent: RemoteAgent) -> None:
        """Say what is known of its pod, and of that pod's template."""
        pod = self._pods.get(agent.host)
        if pod is None:
            return
        end = pod_end(pod)
        agent.node = node_of(pod)
        agent.ending = end.reason if end is not None else ""
        made_from = pod["metadata"]["labels"].get(names.LABEL_TEMPLATE_HASH)
        if self._status.get("templateHash", made_from) != made_from:
            self._retire(agent)

    def _retire(self, agent: RemoteAgent) -> None:
        if agent in self._placement.loads:
            self._demand.retire(agent)
            self._changed()

    # -- What the API server says

    def on_pod(self, name: str, pod: Document | None) -> None:
        """A pod of the pool, as it is now; None once it is gone."""
        agent = self.agents.agents.get(name)
        if pod is None:
            self._pods.pop(name, None)
            self._given_up.discard(name)
            if agent is not None:
                agent.lose("its pod is gone")
            return
        self._pods[name] = pod
        if agent is not None:
            self._tell(agent)
            if (pod.get("status") or {}).get("phase") in _ENDED:
                agent.lose("its pod has ended")
            else:
                self.agents.withhold(agent, bool(agent.ending), "ending")

    def on_status(self, status: Document) -> None:
        """The pool's status, as it is now."""
        before, self._status = self._status, status
        for problem in new_problems(self._name, before, status):
            self._output.write("fiber", problem)
        if self._opened is not None:
            # Somebody else's pool keeps so many, unless it finds this program forgotten.
            self._demand.floor = min(self._opened.minimum, status.get("desiredReplicas") or 0)
        if before.get("templateHash") != status.get("templateHash"):
            for agent in self.agents.agents.values():
                self._tell(agent)
        self._changed()
        error = failure(self._name, status, len(self._placement.loads))
        if error is not None:
            self._refuse(error)

    def on_warning(self, message: str) -> None:
        """Something that keeps the pool waiting, and may pass."""
        self._output.write("fiber", message)

    def on_error(self, error: FiberPoolError) -> None:
        """Nothing comes of the pool any more."""
        if not self._placement.waiting:
            self._output.write("fiber", str(error))  # nobody else says it
        self._refuse(error)
        self.agents.fail(error)

    def on_end(self) -> None:
        """The pool is given back: whoever starts something now gets another."""
        self.over = True
        for agent in list(self.agents.agents.values()):
            agent.close()
            agent.lose("its FiberPool is not this program's any more")
        if self._opened is not None:
            self._opened.listener.close("its FiberPool is not this program's any more")

    def _describe(self) -> str:
        state = summary(self._status, time.time())
        if self._client is None or not self._client.made:
            state = self._asking
        return f"waiting for pods: {state}"

    @property
    def _asking(self) -> str:
        return f"the API server {self._api.server} has not answered yet"

    @property
    def _name(self) -> PoolName:
        tenure = None if self._opened is None else self._opened.tenure
        return PoolName("", "") if tenure is None else PoolName(tenure.name, tenure.namespace)


def _unexpected(error: Exception) -> FiberError:
    failure = FiberError(f"no pods can be asked for, after an unexpected {error!r}")
    failure.__cause__ = error
    return failure
