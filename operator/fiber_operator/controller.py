"""Reconcile of one pool: read the pool and its pods, plan, and carry out the plan.

Each pass reads the pool from the API server and takes its pods from the informer's cache.  While
pods are being created, passes go on beside the creation, so that neither waits for the other.  The
process may die after any step and any step may fail; the next reconcile starts from what is in the
cluster.
"""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.rest import (
    PODS,
    POOLS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    Invalid,
    NotFound,
    ServerUnreachable,
    Transient,
)
from fiber_api.v1alpha1 import FiberPool, InvalidPool
from fiber_operator.cluster import Cluster
from fiber_operator.creation import Creation, CreationPace, Draw, Order, draw_suffix
from fiber_operator.dependents import Dependents, DependentsReconciler
from fiber_operator.events import EventRecorder, pod_warnings
from fiber_operator.informer import PodInformer
from fiber_operator.lease_monitor import LeaseMonitor, MasterLease
from fiber_operator.logs import about
from fiber_operator.metrics import Metrics, PoolSample
from fiber_operator.operator_leases import NotLeader
from fiber_operator.planning import messages, podspec, reconcile
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.planning.plans import (
    QUOTA_IS_FULL,
    Deletion,
    Knowledge,
    Obstacle,
    Plan,
    PodRefusal,
    PoolEvent,
)
from fiber_operator.planning.pods import PodState, PodView
from fiber_operator.responses import Oversized
from fiber_operator.workqueue import Key, Result

log = logging.getLogger(__name__)


ENOUGH = 1.0
"""Seconds that a pass changes pods before the next pass writes the status again."""
DELETIONS = 50
"""Most pods that are deleted at the same time."""

_NO_VERDICTS = ("does not support dry run", QUOTA_IS_FULL)
"""Texts of dry-run refusals that say nothing about the template.

The cause is a webhook that does not support dry run, or a full quota.
"""

RIVAL = (
    "another program wrote this pool's status, probably the operator of another release. Two "
    "operators each create and delete the pool's pods. Uninstall one of the two, or let them watch "
    "different namespaces"
)


@dataclass
class PoolMemory:
    """Memory about one pool between reconciles, by uid.  Its loss only costs calls."""

    uid: str
    dependents: Dependents | None = None
    accepted: str | None = None
    """Template hash that passed the dry run."""
    refusal: PodRefusal | None = None
    creation: Obstacle | None = None
    deletion: Obstacle | None = None
    """Failure of the last deletion."""
    warnings: dict[str, str] = field(default_factory=dict)
    pace: CreationPace = field(default_factory=CreationPace)
    written: Mapping[str, Any] | None = None
    """Status that the API server returned for the last write; None if that is not known."""
    oversized: str = ""
    """Error of a spec that has too many values to be read; empty if it was read."""
    blind_status: Mapping[str, Any] = field(default_factory=dict)
    """Last status that was written while the spec was not read; empty if none was."""
    generation: int = -1
    """Generation of the pool in this reconcile, or in the last one that did not fail."""

    @property
    def address(self) -> str | None:
        """Address that agents dial; None while it is not known."""
        return self.dependents.address if self.dependents else None

    def refused(
        self, template_hash: str, error: ApiError, now: float, *, dry_run: bool = False
    ) -> None:
        """Note that the API server refuses a pod of this template now."""
        self.creation = None
        before = self.refusal
        count = before.count + 1 if before and before.template_hash == template_hash else 1
        self.refusal = PodRefusal(template_hash, error.status, error.message, now, count, dry_run)

    def not_created(self, error: ApiError) -> None:
        """Note a failed creation that says nothing about the template."""
        # A Conflict comes from a quota that is updated at the same time, and is no problem.
        self.creation = None if isinstance(error, Conflict) else messages.creation_obstacle(error)


@dataclass
class Work:
    """Pass of a reconcile: the pool, what is known of it, and the plan."""

    key: Key
    document: Body
    state: PoolMemory
    creation: Creation
    pool: FiberPool | None = None
    """None if the spec is invalid."""
    plan: Plan = field(default_factory=Plan)


class Applier:
    """Carries out plans.  ``now`` returns unix seconds.

    ``requests`` are the workers' requests for resources that their template does not mention.
    """

    def __init__(
        self,
        cluster: Cluster,
        informer: PodInformer,
        *,
        draw: Draw,
        recorder: EventRecorder,
        metrics: Metrics,
        now: Callable[[], float],
        requests: Mapping[str, str],
    ) -> None:
        self._cluster = cluster
        self._informer = informer
        self._draw = draw
        self._recorder = recorder
        self._metrics = metrics
        self._now = now
        self._requests = requests

    async def dry_run(self, pool: FiberPool, plan: Plan, state: PoolMemory) -> ApiError | None:
        """Send a dry run of a pod; return the error if the call itself failed."""
        name = names.pod_name(pool.metadata.name, self._draw())
        body = podspec.pod(pool, name, state.address or "", self._requests)
        try:
            await self._cluster.create(PODS, pool.metadata.namespace, body, dry_run=True)
        except (Forbidden, Invalid) as error:
            if any(words in error.message for words in _NO_VERDICTS):
                # The creation of the first pods will judge the template.
                state.accepted, state.creation = plan.template_hash, None
                return None
            state.refused(plan.template_hash, error, self._now(), dry_run=True)
        except ApiError as error:
            state.not_created(error)
            return error
        else:
            state.accepted, state.refusal, state.creation = plan.template_hash, None, None
        return None

    async def apply(self, work: Work) -> Result:
        """Carry out the plan; the first unexpected error is raised."""
        if work.plan.delete_pool:
            try:
                await self._delete_pool(work)
            except ApiError as error:
                work.state.deletion = messages.deletion_obstacle(error)
                await self._write_status(work)
                raise
            return Result()
        await self._write_status(work)
        # Once the status is written, these events are not planned again.
        self._tell(work, work.plan.events)
        return await self._change_pods(work)

    def created(self, key: Key, state: PoolMemory, creation: Creation) -> Result:
        """Note the outcome of the creation so far, and return what follows from it."""
        done = creation.take()
        if done.names:
            self._metrics.created(len(done.names))
            state.refusal = state.creation = None
            log.info("created %s", _some(done.names), extra=about(*key, uid=state.uid))
        if done.refusal is not None:
            state.refused(creation.order.template_hash, done.refusal, self._now())
            return Result(requeue_after=0.0)  # so that the status shows it
        if done.failure is not None:
            state.not_created(done.failure)
            log.warning("%s", done.failure, extra=about(*key, uid=state.uid))
            return Result(failed=True, rest=done.wait)
        return Result()

    async def _write_status(self, work: Work) -> None:
        if work.plan.status is None:
            return
        # The uid protects a new pool of the same name.  The status is right even if the pool has
        # changed since it was read, because it names the generation that it describes.
        patch = {"metadata": {"uid": work.state.uid}, "status": dict(work.plan.status)}
        work.state.written = None
        try:
            answer = await self._cluster.patch(POOLS, *work.key, patch, "status")
            work.state.written = mapping(answer, "status")
        except Oversized:
            work.state.blind_status = work.plan.status
        except (Forbidden, Invalid) as error:
            event = PoolEvent("Warning", Reason.FORBIDDEN, messages.unwritable_status(error))
            self._tell(work, [event])
            raise

    def warn_of_rival(self, work: Work) -> None:
        """Warn if another program has changed the status since this operator wrote it."""
        written = work.state.written
        if written is not None and written != mapping(work.document, "status"):
            work.state.written = None
            log.warning("%s", RIVAL, extra=about(*work.key, reason=Reason.SERVED_TWICE))
            self._tell(work, [PoolEvent("Warning", Reason.SERVED_TWICE, RIVAL)])

    async def _delete_pool(self, work: Work) -> None:
        version = text(mapping(work.document, "metadata").get("resourceVersion"))
        try:
            await self._cluster.delete(
                POOLS, *work.key, uid=work.state.uid, resource_version=version
            )
        except (NotFound, Conflict):
            return  # its master may have changed it meanwhile; the next reconcile decides
        self._tell(work, work.plan.events)

    async def _change_pods(self, work: Work) -> Result:
        if work.plan.delete or not work.plan.create:
            work.creation.stop()
        deleted, as_planned = await self._delete(work)
        if deleted < len(work.plan.delete):
            return Result(requeue_after=0.0) if as_planned else Result(failed=True)
        if work.pool is not None and work.state.address is not None and work.plan.create:
            body = podspec.pod_maker(work.pool, work.state.address, self._requests)
            order = Order(work.plan.template_hash, body, work.plan.batch_limit)
            work.creation.aim(work.plan.create, order)
        return Result(failed=not as_planned)

    async def _delete(self, work: Work) -> tuple[int, bool]:
        """Delete pods; return how many were handled, and whether all were as in the plan.

        Where they were not, the watch shows soon what has changed.  A watch that is behind makes
        the API server refuse the same deletions again, so the next attempts come ever later.

        It stops after some time, so that the status is not out of date for long.
        """
        key = work.key
        deletions = sorted(work.plan.delete, key=lambda deletion: deletion.may_work)
        clock = asyncio.get_running_loop().time
        enough, done, as_planned = clock() + ENOUGH, 0, True
        while done < len(deletions) and (not done or clock() < enough):
            batch = deletions[done : done + DELETIONS]
            if batch[-1].may_work and await self._has_changed(work):
                # A master may have attached since: these pods may have work.
                batch = [deletion for deletion in batch if not deletion.may_work]
                deletions = deletions[:done] + batch
                as_planned = False
            results = await asyncio.gather(
                *(self._delete_pod(key.namespace, deletion) for deletion in batch),
                return_exceptions=True,
            )
            failure = None
            for deletion, result in zip(batch, results, strict=True):
                if isinstance(result, Conflict):
                    as_planned = False
                elif isinstance(result, BaseException) and not isinstance(result, NotFound):
                    if not isinstance(result, ApiError):
                        raise result
                    failure = failure or result
                else:
                    self._metrics.deleted(str(deletion.reason))
            work.state.deletion = None if failure is None else messages.deletion_obstacle(failure)
            if failure is not None:
                raise failure
            done += len(batch)
        return done, as_planned

    async def _has_changed(self, work: Work) -> bool:
        """Return True if the pool has changed since the plan was made."""
        try:
            document = await self._cluster.read(POOLS, *work.key)
        except NotFound:
            return True
        return _version(document) != _version(work.document)

    async def _delete_pod(self, namespace: str, deletion: Deletion) -> None:
        try:
            await self._cluster.delete(
                PODS,
                namespace,
                deletion.name,
                uid=deletion.uid,
                resource_version=deletion.resource_version,
            )
        except NotFound:
            self._informer.deleted(namespace, deletion.uid, gone=True)
            raise
        self._informer.deleted(namespace, deletion.uid, gone=False)

    def _tell(self, work: Work, events: Sequence[PoolEvent]) -> None:
        for event in events:
            self._recorder.tell(work.key, work.state.uid, event)


def _version(document: Body) -> tuple[object, ...]:
    """Return a version that changes with the inputs of a plan, but not with the status."""
    metadata = mapping(document, "metadata")
    return tuple(metadata.get(key) for key in ("uid", "generation", "deletionTimestamp"))


def _some(pods: list[str]) -> str:
    more = f" and {len(pods) - 3} more" if len(pods) > 3 else ""
    return ", ".join(pods[:3]) + more


# -- Reconcile

LONGEST = 60.0
"""Longest time in seconds of one reconcile while pods are being created."""
OBSTRUCTED = 5.0
"""Seconds until the next reconcile of a pool with an obstacle."""


class Controller:
    """Reconciles pools: each pool once at a time, different pools at the same time."""

    def __init__(
        self,
        cluster: Cluster,
        informer: PodInformer,
        *,
        lease_monitor: LeaseMonitor,
        recorder: EventRecorder,
        metrics: Metrics,
        draw: Draw = draw_suffix,
        now: Callable[[], float] = time.time,
        requests: Mapping[str, str],
    ) -> None:
        self._cluster = cluster
        self._informer = informer
        self._lease_monitor = lease_monitor
        self._metrics = metrics
        self._dependents = DependentsReconciler(cluster, now)
        self._applier = Applier(
            cluster,
            informer,
            draw=draw,
            recorder=recorder,
            metrics=metrics,
            now=now,
            requests=requests,
        )
        self._draw = draw
        self._now = now
        self._states: dict[Key, PoolMemory] = {}

    def is_news(self, key: Key, uid: str, generation: int) -> bool:
        """Return True if a reconcile would see another spec than the last one."""
        state = self._states.get(key)
        return state is None or state.uid != uid or state.generation != generation

    def forget(self) -> None:
        """Forget all pools, because another operator may have acted meanwhile."""
        for key in list(self._states):
            self._drop(key)

    async def reconcile(self, key: Key) -> Result:
        """Reconcile the pool.  Errors of the API server are handled here."""
        started = time.perf_counter()
        outcome, result = "error", Result(failed=True)
        try:
            result = await self._reconcile(key)
            outcome = "gone" if result.forget else "incomplete" if result.failed else "ok"
        except NotLeader:
            # The process that acts now looks at every pool when it begins.
            outcome, result = "not_leader", Result()
        except ApiError as error:
            outcome = type(error).__name__.lower()
            log.warning("%s", error, extra=about(*key, reason=error.reason or outcome))
            rest = error.retry_after if isinstance(error, Transient) else 0.0
            result = Result(failed=True, rest=rest)
        finally:
            self._metrics.reconciled(outcome, time.perf_counter() - started)
        return result

    async def _reconcile(self, key: Key) -> Result:
        """Make a pass, and further passes while pods are being created."""
        found = await self._read(key)
        if found is None:
            return Result(forget=True)
        state = found[1]
        expect = functools.partial(self._informer.created, key.namespace)
        creation = Creation(self._cluster, key, state.pace, self._draw, expect)
        result = Result(failed=True)
        try:
            result = await self._passes(key, found, creation)
        finally:
            if result.failed:
                state.generation = -1
            await creation.cancel()
        return result

    async def _passes(
        self, key: Key, found: tuple[Body, PoolMemory] | None, creation: Creation
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

    async def _read(self, key: Key) -> tuple[Body, PoolMemory] | None:
        """Return the pool as it is now, and the memory about it; None if it is gone."""
        try:
            document, oversized = await self._document(key)
        except NotFound:
            self._drop(key)
            return None
        uid = text(mapping(document, "metadata").get("uid"))
        if not uid:
            raise ServerUnreachable("the answer has no uid", what=f"get fiberpools {key.name}")
        state = self._states.get(key)
        if state is None or state.uid != uid:
            state = self._states[key] = PoolMemory(uid)
        # During the reconcile, events about this generation are no news; writes of the status cause
        # such events.
        state.generation = whole(mapping(document, "metadata").get("generation"))
        state.oversized = oversized
        if oversized:
            document = {**document, "status": dict(state.blind_status)}
        return document, state

    async def _document(self, key: Key) -> tuple[Body, str]:
        """Read the pool.  If it has too many values, return its metadata and the error."""
        try:
            return await self._cluster.read(POOLS, *key), ""
        except Oversized as error:
            wrong = f"spec: {error.message}, so the operator does not read it"
        return await self._cluster.read(POOLS, *key, only_metadata=True), wrong

    async def _pass(self, work: Work) -> Result:
        try:
            if work.state.oversized:
                raise InvalidPool((work.state.oversized,))
            work.pool = pool = FiberPool.read(work.document)
        except InvalidPool as error:
            pods = await self._pods(work)
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
        pods = await self._pods(work)
        plan = self._plan(work.key, pool, pods, state)
        if plan.inspect:
            # Replaces the earlier warnings: those of other pods may be over.
            state.warnings = await pod_warnings(self._cluster, work.key, plan.inspect, pods)
        if plan.dry_run:
            failure = await self._applier.dry_run(pool, plan, state) or failure
        if plan.inspect or plan.dry_run:
            plan = self._plan(work.key, pool, pods, state)
        work.plan = plan
        result = await self._act(work, pods)
        if failure is not None:
            raise failure
        return result

    async def _pods(self, work: Work) -> list[PodView]:
        """Return the pool's pods; if they are not known, say so in the status and raise why."""
        state = work.state
        try:
            pods = await self._informer.pods(work.key, state.uid)
        except ApiError as error:
            obstacle = messages.list_obstacle(error)
            work.plan = reconcile.plan_blind(work.document, obstacle, self._now())
            await self._applier.apply(work)
            raise
        work.creation.see(pods)
        there = {pod.name for pod in pods}
        state.warnings = {name: text for name, text in state.warnings.items() if name in there}
        return pods

    def _plan(self, key: Key, pool: FiberPool, pods: Sequence[PodView], state: PoolMemory) -> Plan:
        dependents = state.dependents
        knowledge = Knowledge(
            address=state.address,
            credentials=dependents.credentials if dependents else None,
            secret=dependents.secret if dependents else None,
            obstacles=dependents.obstacles if dependents else (),
            led=dependents is None or dependents.master == pool.spec.master,
            relay=dependents.relay_name if dependents else None,
            creation=state.creation,
            deletion=state.deletion,
            accepted=state.accepted,
            refusal=state.refusal,
            master=self._lease_monitor.follow(key, _master_lease(pool)),
            warnings=dict(state.warnings),
        )
        return reconcile.plan(pool, pods, knowledge, self._now())

    async def _act(self, work: Work, pods: Sequence[PodView]) -> Result:
        plan, dependents = work.plan, work.state.dependents
        status = mapping(work.document, "status") if plan.status is None else plan.status
        self._metrics.pools[work.key] = PoolSample.of(status, pods)
        result = await self._applier.apply(work)
        wishes = [
            result.requeue_after,
            plan.requeue_at - self._now() if plan.requeue_at is not None else None,
        ]
        if dependents is not None and (dependents.obstacles or dependents.awaits_relay):
            wishes.append(OBSTRUCTED)
        again = min((max(wish, 0.0) for wish in wishes if wish is not None), default=None)
        early = bool(plan.create or plan.delete) or any(
            pod.state is not PodState.READY for pod in pods
        )
        return dataclasses.replace(result, requeue_after=again, early=early)

    def _drop(self, key: Key) -> None:
        self._states.pop(key, None)
        self._metrics.pools.pop(key, None)
        self._lease_monitor.follow(key, None)
        self._dependents.forget(*key)


def _master_lease(pool: FiberPool) -> MasterLease | None:
    master = pool.spec.master
    if master is None or master.lease_name is None:
        return None
    return MasterLease(master.lease_name, master.epoch, master.lease_duration_seconds)


def _together(result: Result, made: Result, waited: float) -> Result:
    """Combine the results of a pass and of a creation that was ``waited`` for."""
    after = made.requeue_after
    if after is None and result.requeue_after is not None:
        after = max(0.0, result.requeue_after - waited)
    rest = max(made.rest, result.rest - waited)
    return dataclasses.replace(
        result, requeue_after=after, rest=rest, failed=result.failed or made.failed
    )
