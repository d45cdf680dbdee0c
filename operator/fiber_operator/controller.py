"""One look at one pool: read, plan, act.

Nothing that an event said is used: the pool and its pods are read anew, from the API server's own
store.  Every step may be the last one before this process dies, and any may fail; the next look
goes on from what there is.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable, Sequence

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, InvalidPool
from fiber_operator import inspection
from fiber_operator.acting import Actor, Look, State
from fiber_operator.cluster import PODS, POOLS, ApiError, Body, Cluster, Gone, TooMany, Unavailable
from fiber_operator.creation import Creator
from fiber_operator.dependents import DependentsReconciler
from fiber_operator.events import Recorder
from fiber_operator.leader_election import NotLeader
from fiber_operator.lease_monitor import LeaseMonitor, MasterLease
from fiber_operator.logs import about
from fiber_operator.metrics import Metrics, PoolSample
from fiber_operator.planning import reconcile, setbacks
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.planning.plans import Memory, Plan
from fiber_operator.planning.pods import PodView, observe
from fiber_operator.planning.pods import State as Life
from fiber_operator.turns import Key, Turn

LIST_SHARE = 2.0
"""A pool rests for this many times as long as the list of its pods took: what it does meanwhile
is part of that."""
LONGEST_REST = 10.0
OBSTRUCTED = 5.0
"""Seconds until a pool that lacks something other than pods is looked at again."""

log = logging.getLogger(__name__)


class Controller:
    """Looks at pools.  One look at a pool at a time; different pools at the same time."""

    def __init__(
        self,
        cluster: Cluster,
        *,
        lease_monitor: LeaseMonitor,
        recorder: Recorder,
        metrics: Metrics,
        creator: Creator,
        now: Callable[[], float] = time.time,
    ) -> None:
        self._cluster = cluster
        self._lease_monitor = lease_monitor
        self._metrics = metrics
        self._dependents = DependentsReconciler(cluster, now)
        self._actor = Actor(cluster, creator=creator, recorder=recorder, metrics=metrics, now=now)
        self._now = now
        self._states: dict[Key, State] = {}

    def is_news(self, key: Key, uid: str, generation: int) -> bool:
        """Whether a look would see a spec that the last one did not; our own status is none."""
        state = self._states.get(key)
        return state is None or state.uid != uid or state.generation != generation

    def forget(self) -> None:
        """Remember nothing: another operator may have acted meanwhile."""
        for key in list(self._states):
            self._drop(key)

    async def look(self, key: Key) -> Turn:
        """Look at the pool and do what is to be done; never raises what the API server causes."""
        started = time.perf_counter()
        outcome, turn = "error", Turn(failed=True)
        try:
            turn = await self._look(key)
            outcome = "gone" if turn.forget else "incomplete" if turn.failed else "ok"
        except NotLeader:
            # Whoever acts now looks at every pool when it begins.
            outcome, turn = "not_leader", Turn()
        except ApiError as error:
            outcome = type(error).__name__.lower()
            log.warning("%s", error, extra=about(*key, reason=error.reason or outcome))
            rest = error.retry_after if isinstance(error, TooMany) else 0.0
            turn = Turn(failed=True, rest=rest)
        finally:
            self._metrics.reconciled(outcome, time.perf_counter() - started)
        return turn

    async def _look(self, key: Key) -> Turn:
        try:
            document = await self._cluster.read(POOLS, *key)
        except Gone:
            self._drop(key)
            return Turn(forget=True)
        uid = text(mapping(document, "metadata").get("uid"))
        if not uid:
            raise Unavailable("the answer has no uid", what=f"get fiberpools {key.name}")
        state = self._states.get(key)
        if state is None or state.uid != uid:
            state = self._states[key] = State(uid)
        # Events about this very spec, our own status among them, are no news while this look lasts.
        state.generation = whole(mapping(document, "metadata").get("generation"))
        try:
            turn = await self._look_at(key, document, state)
        except BaseException:
            state.generation = -1
            raise
        if turn.failed:
            state.generation = -1
        return turn

    async def _look_at(self, key: Key, document: Body, state: State) -> Turn:
        try:
            pool = FiberPool.read(document)
        except InvalidPool as error:
            return await self._look_at_unreadable(key, document, state, error)
        return await self._look_at_readable(key, document, pool, state)

    async def _look_at_readable(
        self, key: Key, document: Body, pool: FiberPool, state: State
    ) -> Turn:
        if pool.unread:
            complaint = "; ".join(pool.unread)
            log.warning("the status was damaged: %s", complaint, extra=about(*key, uid=state.uid))
        failure = None
        if pool.metadata.deletion_timestamp is None:
            state.dependents = await self._dependents.ensure(pool, state.dependents)
            failure = state.dependents.failure
        pods, rested = await self._pods(key, document, state, pool.spec.worker_container)
        plan = self._plan(key, pool, pods, state)
        if plan.inspect:
            # Not added to: what is not asked about any more may be over.
            state.warnings = await inspection.warnings(self._cluster, key, plan.inspect, pods)
        if plan.dry_run:
            failure = await self._actor.dry_run(pool, plan, state) or failure
        if plan.inspect or plan.dry_run:
            plan = self._plan(key, pool, pods, state)
        turn = await self._act(Look(key, document, pool, state, plan, rested), pods)
        if failure is not None:
            raise failure
        return turn

    async def _look_at_unreadable(
        self, key: Key, document: Body, state: State, error: InvalidPool
    ) -> Turn:
        container = text(mapping(document, "spec").get("workerContainer"))
        pods, rested = await self._pods(key, document, state, container or names.WORKER_CONTAINER)
        plan = reconcile.plan_unreadable(document, pods, error.errors, self._now())
        return await self._act(Look(key, document, None, state, plan, rested), pods)

    async def _pods(
        self, key: Key, document: Body, state: State, container: str
    ) -> tuple[list[PodView], float]:
        """The pool's pods, from a fresh list, and until when to rest from it."""
        clock = asyncio.get_running_loop().time
        started = clock()
        try:
            pods = await self._cluster.list(
                PODS,
                key.namespace,
                lambda pod: observe(pod, container),
                selector=f"{names.LABEL_POOL_UID}={state.uid}",
            )
        except ApiError as error:
            plan = reconcile.plan_blind(document, setbacks.with_list(error), self._now())
            await self._actor.act(Look(key, document, None, state, plan))
            raise
        ended = clock()
        rested = ended + min(LIST_SHARE * (ended - started), LONGEST_REST)
        there = {pod.name for pod in pods}
        state.warnings = {name: text for name, text in state.warnings.items() if name in there}
        state.pace.unsure = [name for name in state.pace.unsure if name not in there]
        return pods, rested

    def _plan(self, key: Key, pool: FiberPool, pods: Sequence[PodView], state: State) -> Plan:
        dependents = state.dependents
        memory = Memory(
            address=state.address,
            credentials=dependents.credentials if dependents else None,
            credentials_made=dependents.credentials_made if dependents else 0.0,
            obstacles=dependents.obstacles if dependents else (),
            led=dependents is None or dependents.master == pool.spec.master,
            creation=state.creation,
            deletion=state.deletion,
            accepted=state.accepted,
            refusal=state.refusal,
            master=self._lease_monitor.follow(key, _master_lease(pool)),
            warnings=dict(state.warnings),
        )
        return reconcile.plan(pool, pods, memory, self._now())

    async def _act(self, look: Look, pods: Sequence[PodView]) -> Turn:
        plan, dependents = look.plan, look.state.dependents
        status = mapping(look.document, "status") if plan.status is None else plan.status
        self._metrics.pools[look.key] = PoolSample.of(status, pods)
        turn = await self._actor.act(look)
        wishes = [turn.again, plan.again - self._now() if plan.again is not None else None]
        if dependents is not None and dependents.obstacles:
            wishes.append(OBSTRUCTED)
        again = min((max(wish, 0.0) for wish in wishes if wish is not None), default=None)
        rest = look.rested - asyncio.get_running_loop().time()
        lull = bool(plan.create or plan.delete) or any(pod.state is not Life.READY for pod in pods)
        return dataclasses.replace(turn, again=again, rest=max(turn.rest, rest), lull=lull)

    def _drop(self, key: Key) -> None:
        self._states.pop(key, None)
        self._metrics.pools.pop(key, None)
        self._lease_monitor.follow(key, None)


def _master_lease(pool: FiberPool) -> MasterLease | None:
    master = pool.spec.master
    if master is None or master.lease_name is None:
        return None
    return MasterLease(master.lease_name, master.epoch, master.lease_duration_seconds)
