"""Backend whose agents are pods, with one FiberPool for each pod shape that a program asks for.

``Pods`` has the pods of one FiberPool as hosts for children.

``serves_pools`` decides for ``backend="auto"`` whether this backend can be used.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from fiber import _worker_images
from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._backends.agent_set import AgentSet
from fiber._backends.blobs import Fanout
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import LOST, AttachedPool
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber._backends.kubernetes.problems import AgentRoute, PoolName, node_of, pod_end
from fiber._backends.kubernetes.provisioner import ListenerObserver, PoolProvisioner, PreparedPool
from fiber._backends.kubernetes.relay_client import RelayClient, RelayedPool
from fiber._backends.kubernetes.template import PodShape
from fiber._backends.kubernetes.waiting import Preparation, WaitingChildren
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Demand, Placement
from fiber._hub.hub import Hub
from fiber._logs import OutputWriter
from fiber._transport.authentication import Identity
from fiber._transport.link import Link
from fiber._transport.loop import Loop, LoopTimer
from fiber.config import Config
from fiber.errors import ConfigError, FiberError, FiberPoolError
from fiber_api import names
from fiber_api.rest import LEASES, ApiError, Body, Forbidden, NotFound, NotServed
from fiber_api.times import format_time, parse_time


class KubernetesBackend:
    """Backend that shares the pods of each shape among the program's pools and processes."""

    name = "kubernetes"
    same_host = False
    same_pids = False
    elastic = True
    sends_program = True

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = OutputWriter(config.log_to, config.log_times)
        self._shape = PodShape.of(config)
        self._provisioner = PoolProvisioner(config)
        self._pods: dict[tuple[PodShape | str, int], Pods] = {}
        """``Pods`` by their shape or pool name, and by the number of earlier ones for the same."""
        self._closing = False
        _worker_images.use(True)

    @property
    def passes_on(self) -> bool:
        """True if agents pass large blobs on to each other."""
        return self._config.pass_on != "never"

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """Return a child, not started yet, for a pod that has the resources it asks for."""
        pool = spec.resources.pool or self._config.pool
        key = pool or self._shape.with_resources(spec.resources)
        return self._find(key).agents.child(spec, observer)

    def _find(self, key: PodShape | str) -> Pods:
        """Return the ``Pods`` in use, or new ones.  No lock: a finalizer may call this."""
        before = 0
        while True:
            pods = self._pods.get((key, before))
            if pods is None:  # another thread may make some too; unused ones have no effect
                pods = self._pods.setdefault((key, before), self._make(key))
                if self._closing:  # ``close`` may have passed over them
                    pods.begin_close()
            if not pods.over:
                return pods
            before += 1

    def _make(self, key: PodShape | str) -> Pods:
        make = partial(
            Pods, self._loop, self._hub, self._output, self._config, self._provisioner.api
        )
        make = partial(make, on_unreached=self._provisioner.use_relay)
        if isinstance(key, str):
            return make(partial(self._provisioner.prepare_warm, key, self._loop))
        prepare = partial(self._provisioner.prepare_own, key, self._loop)
        return make(prepare, successor=lambda: self._find(key).agents)

    def close(self) -> None:
        """End all pods: delete the program's own pools, and detach from others."""
        self._closing = True
        with contextlib.ExitStack() as rest:  # does all, also if it is interrupted
            rest.callback(_worker_images.use, False)
            rest.callback(self._output.close)
            rest.callback(self._provisioner.close)
            for pods in list(self._pods.values()):
                pods.begin_close()
                rest.callback(pods.close)


_END_TIMEOUT = 10.0
"""Seconds that the API server may take at the end, and seconds for the agents."""

RELAY_LOST_AFTER = 120.0
"""Seconds of silence after which an agent behind a relay counts as lost, at least.  A laptop that
sleeps or changes its network is silent for longer than a master in the cluster.  Pods that end are
known from the API server sooner."""

_ENDED = ("Failed", "Succeeded")

_NOT_OURS = "its FiberPool no longer belongs to this program"

Document = Mapping[str, Any]


class Pods:
    """Pods of one FiberPool, which begins with the first child and scales with the children.

    ``on_unreached`` is called if pods do not reach this program, which then uses a relay.

    ``prepare`` returns the pool, and begins to listen for its agents.  It blocks until the event
    that it gets is set, and raises FiberError.  ``successor`` returns the agents of the next pool,
    if another one can follow.  Any thread may call ``agents.child`` and ``close``.  All else runs
    on the loop thread.
    """

    def __init__(
        self,
        loop: Loop,
        hub: Hub,
        output: OutputWriter,
        config: Config,
        api: Api,
        prepare: Callable[[ListenerObserver, threading.Event], PreparedPool],
        successor: Callable[[], AgentSet] | None = None,
        on_unreached: Callable[[], None] = lambda: None,
    ) -> None:
        self._loop = loop
        self._note_unreached = on_unreached
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
            loop,
            hub,
            output,
            self._placement,
            fanout=None if config.pass_on == "never" else Fanout(names.PEER_PORT),
            on_change=self._changed,
            on_lost=self._lost,
        )
        self._waiting = WaitingChildren(
            self.agents,
            output,
            api,
            config.pod_timeout,
            on_begin=self._warn_anew,
            on_unreached=None if config.relay == "never" else self._use_relay,
        )
        self._attached: AttachedPool | None = None
        self._relay: RelayClient | None = None
        self.over = False
        """True once the pool has failed or ended, and was deleted or detached from."""
        self._goes_on = False
        """True if waiting children move to the successor once these pods are over."""
        self._preparation: Preparation | None = None
        self._prepared: PreparedPool | None = None
        self._client: FiberPoolClient | None = None
        self._closing = threading.Event()
        """Set once these pods end."""
        self._decision_is_due = False
        self._timer: LoopTimer | None = None
        self._wanted = 0
        self._pods: dict[str, Document] = {}
        self._given_up: set[str] = set()
        """Existing pods whose agents are released or lost; they are served no more."""
        self._back_again: RemoteAgent | None = None
        """Earlier connection of an agent that has dialed again: its pod is not replaced."""

    def begin_close(self) -> None:
        """Begin to end the pool; return at once."""
        self._closing.set()
        if self._client is not None:
            self._client.begin_close(_END_TIMEOUT)

    def close(self) -> None:
        """End the children and the pool, or detach.  Must not be called on the loop thread."""
        self._closing.set()
        self._wait_for(lambda then: self._loop.call_soon(self._shut_down, then))
        if (preparation := self._preparation) is not None:  # no other one begins after this
            preparation.join(_END_TIMEOUT)
            self._wait_for(self._loop.call_soon)  # until ``_begin_with`` has run
        if self._client is not None:
            self._client.close(_END_TIMEOUT)
        if self._prepared is not None:
            listener = self._prepared.listener
            self._wait_for(lambda then: listener.close("the master ended", then=then))
        if self._relay is not None:
            self._relay.close()

    def _wait_for(self, ask: Callable[[Callable[[], None]], None]) -> None:
        """Call ``ask`` with a callback, and wait for the callback, unless the loop is broken."""
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

    # -- Begin of the pool

    def _begin(self) -> None:
        self._preparation = Preparation(
            self._loop,
            partial(self._prepare, self, self._closing),
            on_prepared=self._begin_with,
            on_failed=self._failed_to_prepare,
        )
        self._preparation.start()

    def _failed_to_prepare(self, error: FiberError) -> None:
        self._preparation = None  # the next child tries again
        self._waiting.refuse(error)

    def _begin_with(self, prepared: PreparedPool) -> None:
        self._prepared = prepared
        if self._closing.is_set():
            return  # the pool was not made yet, and is not needed
        self.agents.set_slots(prepared.slots)
        self._demand.floor, self._demand.maximum = prepared.min_pods, prepared.max_pods
        attachment = prepared.attachment
        self._waiting.on_named(PoolName(attachment.name, attachment.namespace))
        self._client = FiberPoolClient(self._api, self._loop, attachment, self)
        self._client.start()
        self._changed()

    def _warn_anew(self) -> None:
        if self._client is not None:
            self._client.warn_anew()

    # -- Demand for pods

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
        """Note that pods reach this program.  Connections of strangers do not prove that."""
        self._waiting.reached()

    def on_refused(self, why: str) -> None:
        """Report a connection that was refused."""
        if not self._closing.is_set():  # else refusals are expected
            self._output.write("fiber", f"an agent was refused: {why}")

    def objection(self, identity: Identity) -> str | None:
        """Return why an agent is refused; "" if it is admitted, None while its pod is unknown."""
        name = identity.name
        if name in self._given_up:
            return f"{name}, which this program has released or lost"
        if (pod := self._pods.get(name)) is None:
            return None
        if pod["metadata"]["uid"] != identity.uid:
            return f"{name}, whose pod has another uid than {identity.uid!r}"
        if pod_end(pod) is not None:
            return f"{name}, whose pod is ending"
        return ""

    def on_agent(self, link: Link) -> str | None:
        """Add an agent that has dialed in; return a reason if it is refused."""
        name = link.peer.name
        if (reason := self.objection(link.peer)) != "":  # it was admitted a moment ago
            return reason or f"{name}, whose pod is gone"
        if (before := self.agents.agents.get(name)) is not None:
            # The agent had lost this program, for example because that was stopped.  It has ended
            # its children, and dials again.
            self._back_again = before
            before.lose("it had lost this program and connected again")
        agent = self.agents.join(name, link)
        agent.pod = name
        self._describe(agent)
        return None

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        name = agent.host
        if agent is self._back_again:
            return  # its pod stays in use
        if name in self._pods and name not in self._given_up and not self._closing.is_set():
            # The pod may still run, out of reach.  Another one takes its place.
            self._given_up.add(name)
            if self._client is not None:
                self._client.demand(self._wanted, [name])

    def _describe(self, agent: RemoteAgent) -> None:
        """Give the agent the facts of its pod; retire it if the pod's template is outdated."""
        pod = self._pods.get(agent.host)
        if pod is None:
            return
        end = pod_end(pod)
        reason = "" if end is None else end.reason
        disrupted = end is not None and end.disrupted
        agent.describe_pod(agent.host, node_of(pod), ending=reason, disrupted=disrupted)
        made_from = pod["metadata"]["labels"].get(names.LABEL_TEMPLATE_HASH)
        if self._waiting.status.get("templateHash", made_from) != made_from:
            self._retire(agent)

    def _retire(self, agent: RemoteAgent) -> None:
        if agent in self._placement.loads:
            self._demand.retire(agent)
            self._changed()

    # -- Events of the pool, as a ``PoolObserver``

    def on_pod(self, name: str, pod: Document | None) -> None:
        """Take a pod's present document; None once the pod is deleted."""
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
            self._describe(agent)
            if (pod.get("status") or {}).get("phase") in _ENDED:
                agent.lose("its pod has ended")
            elif pod["metadata"].get("deletionTimestamp"):
                agent.leave(agent.ending)  # its SIGTERM comes after a preStop hook
            else:
                self.agents.withhold(agent, bool(agent.ending), "ending")

    def on_status(self, status: Document) -> None:
        """Take the pool's present status."""
        before = self._waiting.status
        self._waiting.on_status(status)
        if self._prepared is not None:
            if not before:  # agents may wait until the operator has signed for this program
                self._prepared.listener.look_again()
            # A warm pool keeps ``min_pods``, unless the operator has detached this program.
            self._demand.floor = min(self._prepared.min_pods, status.get("desiredReplicas") or 0)
        if before.get("templateHash") != status.get("templateHash"):
            for agent in self.agents.agents.values():
                self._describe(agent)
        self._changed()

    def connected(self) -> int:
        """Return how many agents are linked; any thread may ask."""
        return len(self._placement.loads)

    def on_attached(self, pool: AttachedPool) -> None:
        """Note that the pool exists, with this program as its master."""
        self._attached = pool
        route = AgentRoute("")
        if (prepared := self._prepared) is not None:
            route = AgentRoute(prepared.address, prepared.attachment.displaced)
        self._waiting.on_attached(route)
        if pool.relay:
            self._connect_to_relay(pool)

    # -- Relay

    def _use_relay(self) -> None:
        """Ask for a relay."""
        pool, client = self._attached, self._client
        if pool is None or client is None or self._closing.is_set():
            return
        self._output.write(
            "fiber",
            f"pods do not reach this program at {self._waiting.route.address}, so Fiber starts a "
            "relay in the cluster and reaches it through the API server. Set relay='always' "
            "(FIBER_RELAY=always) to begin with it",
        )
        self._note_unreached()
        client.ask_for_relay(pool)
        self._connect_to_relay(pool)

    def _connect_to_relay(self, pool: AttachedPool) -> None:
        if self._prepared is None or self._closing.is_set() or self._relay is not None:
            return
        listener = self._prepared.listener
        listener.be_patient(RELAY_LOST_AFTER)
        self._relay = RelayClient(
            self._api,
            RelayedPool(pool.name, pool.namespace, pool.uid, pool.master.identity, pool.epoch),
            take=listener.take,
            on_trouble=partial(self._loop.call_soon, self._on_relay_trouble),
            on_refused=partial(self._loop.call_soon, self._on_relay_refused),
        )
        self._relay.start()
        self._waiting.use_relay(names.relay_name(pool.name))

    def _on_relay_trouble(self, trouble: str) -> None:
        if not self._closing.is_set():
            self._waiting.on_relay_trouble(trouble)

    def _on_relay_refused(self, error: ApiError) -> None:
        if self._attached is None or self._closing.is_set():
            return
        pool = PoolName(self._attached.name, self._attached.namespace)
        self._waiting.refuse(
            pool.error(
                f"this program may not open a port-forward to the relay of its pods: "
                f"{error.message}. Give its account the role fiber-user, which has the rights get "
                "and create for pods/portforward, or set relay='never' (FIBER_RELAY=never) and "
                "run the program where pods reach it",
                "Forbidden",
            )
        )

    def on_lease_expired(self) -> None:
        """Make the agents dial the pool's Service again, which leads to its present master."""
        if self._prepared is not None:
            self._prepared.listener.break_connections()

    def on_warning(self, message: str) -> None:
        """Report a problem of the pool that may pass."""
        self._output.write("fiber", message)

    def on_error(self, error: FiberPoolError) -> None:
        """Note that the pool has failed."""
        # Another pool follows a lost one of this program.  If no agent ever joined, it would be
        # lost again, so none follows.
        self._goes_on = bool(self._successor and error.reason in LOST and self.agents.joined)
        if self._goes_on or not self._placement.waiting:
            self._output.write("fiber", str(error))  # no child reports it
        if not self._goes_on:
            self._waiting.refuse(error)
            self.agents.fail(error)

    def on_end(self) -> None:
        """End these pods: the pool was deleted or detached from.  New children get another one."""
        for agent in self.agents.agents.values():
            agent.close()
        if self._prepared is None:
            self._end()
        else:
            self._prepared.listener.close(_NOT_OURS, then=self._end)

    def _end(self) -> None:
        self.over = True
        if self._relay is not None:
            self._relay.begin_close()
        for agent in list(self.agents.agents.values()):
            agent.lose(_NOT_OURS)
        if self._successor is not None and self._goes_on:
            self.agents.hand_over(self._successor)


_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

_TIMEOUT = 5.0
"""Seconds that a program may wait for an answer before it goes on without a cluster."""


def serves_pools(namespace: str | None) -> bool:
    """Return True if this pod's account may make FiberPools and an operator serves them.

    If the account has the right and an operator does not show that it lives, a warning says so.
    """
    try:
        with contextlib.closing(Api.connect()) as api:
            return _serves(api, namespace or api.namespace)
    except (ConfigError, ApiError):  # no account, no client, no answer
        return False


def _serves(api: Api, namespace: str) -> bool:
    answer = api.create(_REVIEWS, _review(namespace), timeout=_TIMEOUT)
    if not answer.get("status", {}).get("allowed"):
        return False
    missing = []
    try:
        for place in dict.fromkeys((names.SERVING_NAMESPACE, namespace)):
            why = _why_not_served(api, place)
            if why is None:
                return True
            missing.append(f"{why} in the namespace {place!r}")
        api.get(f"/apis/{names.API_VERSION}", timeout=_TIMEOUT)
    except NotServed:
        return _on_this_machine("the cluster knows no FiberPools. Install the operator's chart")
    except ApiError as error:
        return _on_this_machine(
            f"the API server does not say whether an operator serves the namespace {namespace!r} "
            f"({error.message}). Set backend='kubernetes' to try again"
        )
    return _on_this_machine(
        f"no operator shows that it serves the namespace {namespace!r}: its Lease "
        f"{names.SERVING_LEASE} {' and '.join(missing)}. Start or install the operator"
    )


def _on_this_machine(why: str) -> bool:
    logging.getLogger("fiber").warning(
        "processes run on this machine and not in pods: %s, or set backend='local' "
        "(FIBER_BACKEND=local) to have no such warning",
        why,
    )
    return False


def _why_not_served(api: Api, place: str) -> str | None:
    """Return why the Lease there does not show a living operator; None if it does."""
    try:
        lease = api.get(LEASES.path(place, names.SERVING_LEASE), timeout=_TIMEOUT)
    except NotFound:
        return "does not exist"
    except Forbidden:
        return "may not be read"
    spec = lease.get("spec") or {}
    try:
        renewed = parse_time(str(spec.get("renewTime")))
        fresh_until = renewed + int(spec.get("leaseDurationSeconds") or 0)
    except (TypeError, ValueError):
        return "has no time"
    # The clocks of two machines: they differ by less than an operator's restart takes.
    return None if time.time() < fresh_until else f"was last renewed at {format_time(renewed)}"


def _review(namespace: str) -> Body:
    attributes = {
        "group": names.GROUP,
        "resource": names.PLURAL,
        "verb": "create",
        "namespace": namespace,
    }
    return {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SelfSubjectAccessReview",
        "spec": {"resourceAttributes": attributes},
    }
