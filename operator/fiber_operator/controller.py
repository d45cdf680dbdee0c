"""Reconcile of one pool: read, plan, act.

While pods are being created this is done again and again beside it, so that neither waits for the
other.  Nothing that an event said is used: the pool and its pods are read anew, from the API
server's own store.  Every step may be the last one before this process dies, and any may fail; the
next reconcile goes on from what there is.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable, Mapping, Sequence

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, InvalidPool
from fiber_operator import pod_events
from fiber_operator.apply import ENOUGH, Applier, State, Work
from fiber_operator.cluster import PODS, POOLS, ApiError, Body, Cluster, Gone, TooMany, Unavailable
from fiber_operator.creation import Creation, Draw, draw_suffix
from fiber_operator.dependents import DependentsReconciler
from fiber_operator.event_recorder import EventRecorder
from fiber_operator.leader_election import NotLeader
from fiber_operator.lease_monitor import LeaseMonitor, MasterLease
from fiber_operator.logs import about
from fiber_operator.metrics import Metrics, PoolSample
from fiber_operator.planning import error_conditions, reconcile
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.planning.plans import Memory, Plan
from fiber_operator.planning.pods import PodView, observe
from fiber_operator.planning.pods import State as Life
from fiber_operator.workqueue import Key, Result

LIST_SHARE = 2.0
"""A pool rests for this many times as long as the list of its pods took: what it does meanwhile
is part of that."""
LONGEST_REST = 10.0
LONGEST = 60.0
"""Seconds for which one reconcile goes on while pods are being created."""
OBSTRUCTED = 5.0
"""Seconds until a pool that lacks something other than pods is looked at again."""

log = logging.getLogger(__name__)


class Controller:
    """Reconciles pools.  One at a time of a pool; different pools at the same time."""

    def __init__(
        self,
        cluster: Cluster,
        *,
        lease_monitor: LeaseMonitor,
        recorder: EventRecorder,
        metrics: Metrics,
        draw: Draw = draw_suffix,
        now: Callable[[], float] = time.time,
        requests: Mapping[str, str],
    ) -> None:
        self._cluster = cluster
        self._lease_monitor = lease_monitor
        self._metrics = metrics
        self._dependents = DependentsReconciler(cluster, now)
        self._applier = Applier(
            cluster, draw=draw, recorder=recorder, metrics=metrics, now=now, requests=requests
        )
        self._draw = draw
        self._now = now
        self._states: dict[Key, State] = {}

    def is_news(self, key: Key, uid: str, generation: int) -> bool:
        """Tell whether a reconcile would see another spec than the last one did."""
        state = self._states.get(key)
        return state is None or state.uid != uid or state.generation != generation

    def forget(self) -> None:
        """Remember nothing: another operator may have acted meanwhile."""
        for key in list(self._states):
            self._drop(key)

    async def reconcile(self, key: Key) -> Result:
        """Work at the pool and do what is to be done; never raises what the API server causes."""
        started = time.perf_counter()
        outcome, result = "error", Result(failed=True)
        try:
            result = await self._reconcile(key)
            outcome = "gone" if result.forget else "incomplete" if result.failed else "ok"
        except NotLeader:
            # Whoever acts now looks at every pool when it begins.
            outcome, result = "not_leader", Result()
        except ApiError as error:
            outcome = type(error).__name__.lower()
            log.warning("%s", error, extra=about(*key, reason=error.reason or outcome))
            rest = error.retry_after if isinstance(error, TooMany) else 0.0
            result = Result(failed=True, rest=rest)
        finally:
            self._metrics.reconciled(outcome, time.perf_counter() - started)
        return result

    async def _reconcile(self, key: Key) -> Result:
        """Make one pass, and more passes while pods are being created."""
        found = await self._read(key)
        if found is None:
            return Result(forget=True)
        state = found[1]
        creation = Creation(self._cluster, key, state.pace, self._draw)
        result = Result(failed=True)
        try:
            result = await self._passes(key, found, creation)
        finally:
            if result.failed:
                state.generation = -1
            await creation.cancel()
        return result

    async def _passes(
        self, key: Key, found: tuple[Body, State] | None, creation: Creation
    ) -> Result:
        clock = asyncio.get_running_loop().time
        state, end = found[1] if found else None, clock() + LONGEST
        while found is not None and found[1] is state:
            self._cluster.check_permit()
            work = Work(key, *found, creation)
            self._applier.warn_of_rival(work)
            result = await self._pass(work)
            began, last = clock(), clock() > end
            if last:
                creation.stop()
            over = await creation.wait(None if last else max(ENOUGH, result.rest))
            made = self._applier.created(key, found[1], creation)
            if over:
                return _together(result, made, clock() - began)
            found = await self._read(key)
        return Result(requeue_after=0.0)

    async def _read(self, key: Key) -> tuple[Body, State] | None:
        """The pool as it is now, and what is remembered of it."""
        try:
            document = await self._cluster.read(POOLS, *key)
        except Gone:
            self._drop(key)
            return None
        uid = text(mapping(document, "metadata").get("uid"))
        if not uid:
            raise Unavailable("the answer has no uid", what=f"get fiberpools {key.name}")
        state = self._states.get(key)
        if state is None or state.uid != uid:
            state = self._states[key] = State(uid)
        # Events about this very spec, our own status among them, are no news while this lasts.
        state.generation = whole(mapping(document, "metadata").get("generation"))
        return document, state

    async def _pass(self, work: Work) -> Result:
        try:
            work.pool = pool = FiberPool.read(work.document)
        except InvalidPool as error:
            container = text(mapping(work.document, "spec").get("workerContainer"))
            pods = await self._pods(work, container or names.WORKER_CONTAINER)
            now = self._now()
            work.plan = reconcile.plan_unreadable(work.document, pods, error.errors, now)
            return await self._act(work, pods)
        state, failure = work.state, None
        if pool.unread:
            complaint = f"the status was damaged: {'; '.join(pool.unread)}"
            log.warning("%s", complaint, extra=about(*work.key, uid=state.uid))
        if pool.metadata.deletion_timestamp is None:
            state.dependents = await self._dependents.ensure(pool, state.dependents)
            failure = state.dependents.failure
        pods = await self._pods(work, pool.spec.worker_container)
        plan = self._plan(work.key, pool, pods, state)
        if plan.inspect:
            # Not added to: what is not asked about any more may be over.
            state.warnings = await pod_events.warnings(self._cluster, work.key, plan.inspect, pods)
        if plan.dry_run:
            failure = await self._applier.dry_run(pool, plan, state) or failure
        if plan.inspect or plan.dry_run:
            plan = self._plan(work.key, pool, pods, state)
        work.plan = plan
        result = await self._act(work, pods)
        if failure is not None:
            raise failure
        return result

    async def _pods(self, work: Work, container: str) -> list[PodView]:
        """The pool's pods, from a fresh list, from which it rests then."""
        clock, state = asyncio.get_running_loop().time, work.state
        started = clock()
        try:
            listed = await self._cluster.list(
                PODS,
                work.key.namespace,
                lambda pod: observe(pod, container),
                selector=f"{names.LABEL_POOL_UID}={state.uid}",
            )
        except ApiError as error:
            obstacle = error_conditions.with_list(error)
            work.plan = reconcile.plan_blind(work.document, obstacle, self._now())
            await self._applier.apply(work)
            raise
        ended = clock()
        work.rested = ended + min(LIST_SHARE * (ended - started), LONGEST_REST)
        pods = work.creation.expect(listed, started)
        there = {pod.name for pod in pods}
        state.warnings = {name: text for name, text in state.warnings.items() if name in there}
        return pods

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

    async def _act(self, work: Work, pods: Sequence[PodView]) -> Result:
        plan, dependents = work.plan, work.state.dependents
        status = mapping(work.document, "status") if plan.status is None else plan.status
        self._metrics.pools[work.key] = PoolSample.of(status, pods)
        result = await self._applier.apply(work)
        wishes = [
            result.requeue_after,
            plan.requeue_at - self._now() if plan.requeue_at is not None else None,
        ]
        if dependents is not None and dependents.obstacles:
            wishes.append(OBSTRUCTED)
        again = min((max(wish, 0.0) for wish in wishes if wish is not None), default=None)
        rest = work.rested - asyncio.get_running_loop().time()
        lull = bool(plan.create or plan.delete) or any(pod.state is not Life.READY for pod in pods)
        return dataclasses.replace(
            result, requeue_after=again, rest=max(result.rest, rest), lull=lull
        )

    def _drop(self, key: Key) -> None:
        self._states.pop(key, None)
        self._metrics.pools.pop(key, None)
        self._lease_monitor.follow(key, None)


def _master_lease(pool: FiberPool) -> MasterLease | None:
    master = pool.spec.master
    if master is None or master.lease_name is None:
        return None
    return MasterLease(master.lease_name, master.epoch, master.lease_duration_seconds)


def _together(result: Result, made: Result, waited: float) -> Result:
    """Combine the results of a pass and of the creation that it ``waited`` for."""
    after = made.requeue_after
    if after is None and result.requeue_after is not None:
        after = max(0.0, result.requeue_after - waited)
    rest = max(made.rest, result.rest - waited)
    return dataclasses.replace(result, requeue_after=after, rest=rest, failed=made.failed)
