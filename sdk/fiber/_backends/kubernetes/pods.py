"""The pods of one FiberPool as hosts for children: as many as these need, while they do."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import LOST
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber._backends.kubernetes.problems import PoolName, Way, node_of, pod_end
from fiber._backends.kubernetes.program import ListenerObserver, PreparedPool
from fiber._backends.kubernetes.waiting import Preparation, Waiting
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Demand, Placement
from fiber._hub.hub import Hub
from fiber._transport.authentication import Identity
from fiber._transport.link import Link
from fiber._transport.loop import Loop, LoopTimer
from fiber.config import Config
from fiber.errors import FiberError, FiberPoolError
from fiber_api import names

_END_TIMEOUT = 10.0
"""Seconds for the API server, and as many for the agents, to hear of the end."""

_ENDED = ("Failed", "Succeeded")

_NOT_OURS = "its FiberPool is not this program's any more"

Document = Mapping[str, Any]


class Pods:
    """Begins with the first child, and asks for pods as children come and go.

    ``prepare`` says which pool that is and begins to listen for its agents; it blocks, until the
    event that it is given is set, and raises FiberError.  ``successor`` has the agents of the next
    such pool, where this one can be followed by another.  Everything but ``agents.child`` and
    ``close`` happens on the loop's thread.
    """

    def __init__(
        self,
        loop: Loop,
        hub: Hub,
        output: Output,
        config: Config,
        api: Api,
        prepare: Callable[[ListenerObserver, threading.Event], PreparedPool],
        successor: Callable[[], AgentSet] | None = None,
    ) -> None:
        self._loop = loop
        self._output = output
        self._api = api
        self._prepare = prepare
        self._successor = successor
        self._placement: Placement[RemoteAgent, RemoteChild] = Placement(
            config.processes_per_pod, spread=False
        )
        self._demand = Demand(
            self._placement, maximum=config.max_pods, idle_timeout=config.idle_timeout
        )
        self.agents = AgentSet(
            loop, hub, output, self._placement, on_change=self._changed, on_lost=self._lost
        )
        self._waiting = Waiting(
            self.agents, output, api, config.pod_timeout, on_begin=self._warn_anew
        )
        self.over = False
        """True once the pool has failed or ended, and was given back."""
        self._goes_on = False
        """True if the children that wait then go to the successor."""
        self._preparation: Preparation | None = None
        self._prepared: PreparedPool | None = None
        self._client: FiberPoolClient | None = None
        self._closing = threading.Event()
        """Set once the API server is asked for nothing but the end."""
        self._decision_is_due = False
        self._timer: LoopTimer | None = None
        self._wanted = 0
        self._pods: dict[str, Document] = {}
        self._given_up: set[str] = set()
        """Pods that are there and of which nothing is expected any more."""
        self._back_again: RemoteAgent | None = None
        """Agent that is lost only because it has come again."""

    def begin_close(self) -> None:
        """Begin to end; waits for nothing."""
        self._closing.set()
        if self._client is not None:
            self._client.begin_close(_END_TIMEOUT)

    def close(self) -> None:
        """End the children, and the pool or its use.  Not on the loop's thread."""
        self._closing.set()
        self._wait_for(lambda then: self._loop.call_soon(self._shut_down, then))
        if (preparation := self._preparation) is not None:  # from here on there is no other
            preparation.join(_END_TIMEOUT)
            self._wait_for(self._loop.call_soon)  # until what it prepared is known
        if self._client is not None:
            self._client.close(_END_TIMEOUT)
        if self._prepared is not None:
            listener = self._prepared.listener
            self._wait_for(lambda then: listener.close("the master ended", then=then))

    def _wait_for(self, ask: Callable[[Callable[[], None]], None]) -> None:
        """Until what is asked for is done on the loop's thread, if that still does anything."""
        done = threading.Event()
        ask(done.set)
        if not self._loop.broken:
            done.wait(_END_TIMEOUT)

    def _shut_down(self, then: Callable[[], None]) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._waiting.stop()
        for agent in self.agents.agents.values():
            agent.close()
        then()

    # -- The pool begins

    def _begin(self) -> None:
        self._preparation = Preparation(
            self._loop,
            partial(self._prepare, self, self._closing),
            on_prepared=self._begin_with,
            on_failed=self._failed_to_prepare,
        )
        self._preparation.start()

    def _failed_to_prepare(self, error: FiberError) -> None:
        self._preparation = None  # the next child may have more luck
        self._waiting.refuse(error)

    def _begin_with(self, prepared: PreparedPool) -> None:
        self._prepared = prepared
        if self._closing.is_set():
            return  # there is no pool yet, and nobody who wants one
        self._placement.slots = prepared.slots
        self._demand.floor, self._demand.maximum = prepared.min_pods, prepared.max_pods
        attachment = prepared.attachment
        self._waiting.pool = PoolName(attachment.name, attachment.namespace)
        self._client = FiberPoolClient(self._api, self._loop, attachment, self)
        self._client.start()
        self._changed()

    def _warn_anew(self) -> None:
        if self._client is not None:
            self._client.warn_anew()

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
        if self._placement.waiting and self._preparation is None:
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
        self._waiting.look(self._demand.maximum)

    # -- Agents

    def on_proven(self) -> None:
        """Note that pods reach this program.  A stranger's connection does not show that."""
        self._waiting.reached()

    def on_refused(self, why: str) -> None:
        """Somebody dialled who is not served."""
        if not self._closing.is_set():  # else that is how it is to be
            self._output.write("fiber", f"an agent was refused: {why}")

    def objection(self, identity: Identity) -> str | None:
        """Why this agent is not wanted; None until the watch has its pod."""
        name = identity.name
        if name in self._given_up:
            return f"{name}, which had been given up"
        if (pod := self._pods.get(name)) is None:
            return None
        if pod["metadata"]["uid"] != identity.uid:
            return f"{name}, which says that its pod has the uid {identity.uid!r}; it has another"
        if pod_end(pod) is not None:
            return f"{name}, whose pod is about to go"
        return ""

    def on_agent(self, link: Link) -> str | None:
        """An agent has dialled; why it is not wanted, if it is not."""
        name = link.peer.name
        if (reason := self.objection(link.peer)) != "":  # it was welcome a moment ago
            return reason or f"{name}, whose pod is gone"
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
        agent.disrupted = end is not None and end.disrupted
        made_from = pod["metadata"]["labels"].get(names.LABEL_TEMPLATE_HASH)
        if self._waiting.status.get("templateHash", made_from) != made_from:
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
                agent.lose("its pod is gone", disrupted=not agent.ending)
            return
        is_new = name not in self._pods
        self._pods[name] = pod
        if is_new and self._prepared is not None:
            self._prepared.listener.look_again()
        if agent is not None:
            self._tell(agent)
            if (pod.get("status") or {}).get("phase") in _ENDED:
                agent.lose("its pod has ended")
            elif pod["metadata"].get("deletionTimestamp"):
                agent.leave(agent.ending)  # its SIGTERM may be late: a preStop hook comes before it
            else:
                self.agents.withhold(agent, bool(agent.ending), "ending")

    def on_status(self, status: Document) -> None:
        """The pool's status, as it is now."""
        before = self._waiting.status
        self._waiting.on_status(status)
        if self._prepared is not None:
            # Somebody else's pool keeps so many, unless it finds this program forgotten.
            self._demand.floor = min(self._prepared.min_pods, status.get("desiredReplicas") or 0)
        if before.get("templateHash") != status.get("templateHash"):
            for agent in self.agents.agents.values():
                self._tell(agent)
        self._changed()

    def connected(self) -> int:
        """Return how many agents are linked; any thread may ask."""
        return len(self._placement.loads)

    def on_attached(self, epoch: int) -> None:
        """The pool is there, with this program as its master."""
        self._waiting.attached = True
        if (prepared := self._prepared) is not None:
            prepared.listener.epoch = epoch
            self._waiting.way = Way(prepared.address, prepared.attachment.displaced)

    def on_lease_expired(self) -> None:
        """Have the agents dial the pool's Service, which leads to its master of the moment."""
        if self._prepared is not None:
            self._prepared.listener.break_connections()

    def on_warning(self, message: str) -> None:
        """Something that keeps the pool waiting, and may pass."""
        self._output.write("fiber", message)

    def on_error(self, error: FiberPoolError) -> None:
        """Note that the pool has failed."""
        # What works with one of our own goes on with another.  One that was lost before it was of
        # any use would be made and lost again and again.
        self._goes_on = bool(self._successor and error.reason in LOST and self.agents.joined)
        if self._goes_on or not self._placement.waiting:
            self._output.write("fiber", str(error))  # nobody else says it
        if not self._goes_on:
            self._waiting.refuse(error)
            self.agents.fail(error)

    def on_end(self) -> None:
        """The pool is given back: whoever starts something now gets another."""
        for agent in self.agents.agents.values():
            agent.close()
        if self._prepared is None:
            self._end()
        else:
            self._prepared.listener.close(_NOT_OURS, then=self._end)

    def _end(self) -> None:
        self.over = True
        for agent in list(self.agents.agents.values()):
            agent.lose(_NOT_OURS)
        if self._successor is not None and self._goes_on:
            self.agents.hand_over(self._successor)
