"""Doing what a plan says, in its order: status, deletions, creations, events."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.cluster import (
    PODS,
    POOLS,
    ApiError,
    Body,
    Cluster,
    Conflict,
    Gone,
    Invalid,
    Refused,
)
from fiber_operator.creation import Creation, Draw, Order, Pace
from fiber_operator.dependents import Dependents
from fiber_operator.event_recorder import EventRecorder
from fiber_operator.logs import about
from fiber_operator.metrics import Metrics
from fiber_operator.planning import error_conditions, manifests
from fiber_operator.planning.documents import mapping, text
from fiber_operator.planning.plans import (
    QUOTA_IS_FULL,
    Deletion,
    Event,
    Obstacle,
    Plan,
    Refusal,
)
from fiber_operator.workqueue import GAP, Key, Result

ENOUGH = 1.0
"""Seconds that pods are changed for, so that the status is not out of date for long."""
DELETIONS = 50
"""Pods that are deleted at once."""

_NO_VERDICTS = ("does not support dry run", QUOTA_IS_FULL)
"""Refusals of a dry run that say nothing about the template: a webhook's fault, a full quota."""

RIVAL = (
    "another program wrote this pool's status, probably the operator of another release. Two "
    "operators each create and delete the pool's pods. Uninstall one of the two, or let them watch "
    "different namespaces"
)

log = logging.getLogger(__name__)


@dataclass
class State:
    """Memory of one pool between reconciles, by uid.  Losing it costs only calls."""

    uid: str
    dependents: Dependents | None = None
    accepted: str | None = None
    """The template hash that passed the dry run."""
    refusal: Refusal | None = None
    creation: Obstacle | None = None
    deletion: Obstacle | None = None
    """Why the last one came to nothing."""
    warnings: dict[str, str] = field(default_factory=dict)
    pace: Pace = field(default_factory=Pace)
    written: Mapping[str, Any] | None = None
    """Status that the API server returned for the last write; None if that is not known."""
    generation: int = -1
    """Generation of the pool at the last reconcile that did not fail, or the present one."""

    @property
    def address(self) -> str | None:
        """Address that agents dial, once it is known."""
        return self.dependents.address if self.dependents else None

    def refused(
        self, template_hash: str, error: ApiError, now: float, *, dry_run: bool = False
    ) -> None:
        """The API server does not take a pod of this template now."""
        self.creation = None
        before = self.refusal
        count = before.count + 1 if before and before.template_hash == template_hash else 1
        self.refusal = Refusal(template_hash, error.status, error.message, now, count, dry_run)

    def not_created(self, error: ApiError) -> None:
        """Note a failed creation, after which it is not known whether the template is good."""
        # Of a quota that is counted at the same time, which is nobody's trouble, comes a Conflict.
        self.creation = (
            None if isinstance(error, Conflict) else error_conditions.with_creation(error)
        )


@dataclass
class Work:
    """Pass over a pool: its state, and once it is planned the work to do."""

    key: Key
    document: Body
    state: State
    creation: Creation
    pool: FiberPool | None = None
    """None if the spec cannot be read."""
    plan: Plan = field(default_factory=Plan)
    rested: float = 0.0
    """Time of the loop's clock until which the pool rests from the list of its pods.  Pods may be
    changed until then."""


class Applier:
    """Carries out plans.  ``now`` gives unix seconds.

    ``requests`` says what workers request of resources that their template says nothing of.
    """

    def __init__(
        self,
        cluster: Cluster,
        *,
        draw: Draw,
        recorder: EventRecorder,
        metrics: Metrics,
        now: Callable[[], float],
        requests: Mapping[str, str],
    ) -> None:
        self._cluster = cluster
        self._draw = draw
        self._recorder = recorder
        self._metrics = metrics
        self._now = now
        self._requests = requests

    async def dry_run(self, pool: FiberPool, plan: Plan, state: State) -> ApiError | None:
        """Ask whether the API server takes a pod of this template; returns what hindered that."""
        name = names.pod_name(pool.metadata.name, self._draw())
        body = manifests.pod(pool, name, state.address or "", self._requests)
        try:
            await self._cluster.create(PODS, pool.metadata.namespace, body, dry_run=True)
        except (Refused, Invalid) as error:
            if any(words in error.message for words in _NO_VERDICTS):
                # The first pods will show.
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
        """Do what is planned; the first error that is not part of the game is raised."""
        if work.plan.delete_pool:
            try:
                await self._delete_pool(work)
            except ApiError as error:
                work.state.deletion = error_conditions.with_deletion(error)
                await self._write_status(work)
                raise
            return Result()
        await self._write_status(work)
        # The status says already what they tell of: they would not be planned again.
        self._tell(work, work.plan.events)
        return await self._change_pods(work)

    def created(self, key: Key, state: State, creation: Creation) -> Result:
        """Remember what came of the creation so far; what follows from it."""
        done = creation.take()
        if done.names:
            self._metrics.created(len(done.names))
            state.refusal = state.creation = None
            log.info("created %s", _some(done.names), extra=about(*key, uid=state.uid))
        if done.refusal is not None:
            state.refused(creation.order.template_hash, done.refusal, self._now())
            return Result(requeue_after=0.0)  # so that the status says it
        if done.failure is not None:
            state.not_created(done.failure)
            log.warning("%s", done.failure, extra=about(*key, uid=state.uid))
            return Result(failed=True, rest=done.wait)
        return Result()

    async def _write_status(self, work: Work) -> None:
        if work.plan.status is None:
            return
        # The uid keeps it from a new pool of the same name.  What is written is true whatever has
        # been changed since the pool was read: it names the generation that it is of.
        patch = {"metadata": {"uid": work.state.uid}, "status": dict(work.plan.status)}
        work.state.written = None
        try:
            answer = await self._cluster.patch(POOLS, *work.key, patch, "status")
            work.state.written = mapping(answer, "status")
        except (Refused, Invalid) as error:
            event = Event("Warning", Reason.FORBIDDEN, error_conditions.with_status(error))
            self._tell(work, [event])
            raise

    def warn_of_rival(self, work: Work) -> None:
        """Warn if another program has changed the status since this operator wrote it."""
        written = work.state.written
        if written is not None and written != mapping(work.document, "status"):
            work.state.written = None
            log.warning("%s", RIVAL, extra=about(*work.key, reason=Reason.SERVED_TWICE))
            self._tell(work, [Event("Warning", Reason.SERVED_TWICE, RIVAL)])

    async def _delete_pool(self, work: Work) -> None:
        version = text(mapping(work.document, "metadata").get("resourceVersion"))
        try:
            await self._cluster.delete(
                POOLS, *work.key, uid=work.state.uid, resource_version=version
            )
        except (Gone, Conflict):
            return  # it was changed meanwhile, by its master perhaps; the next reconcile sees
        self._tell(work, work.plan.events)

    async def _change_pods(self, work: Work) -> Result:
        if work.plan.delete or not work.plan.create:
            work.creation.stop()
        deleted, as_planned = await self._delete(work)
        if deleted < len(work.plan.delete):
            # Of a change an event tells; a pool that changes all the time is not looked at so.
            return Result(requeue_after=0.0 if as_planned else GAP)
        if work.pool is not None and work.state.address is not None and work.plan.create:
            body = manifests.pod_maker(work.pool, work.state.address, self._requests)
            container, limit = work.pool.spec.worker_container, work.plan.batch_limit
            order = Order(work.plan.template_hash, body, container, limit)
            work.creation.aim(work.plan.create, order)
        return Result() if as_planned else Result(requeue_after=0.0)

    async def _delete(self, work: Work) -> tuple[int, bool]:
        """Delete pods; return how many were handled, and whether each was as the plan had it.

        This stops after a while, so that the status is not out of date for long.
        """
        key = work.key
        deletions = sorted(work.plan.delete, key=lambda deletion: deletion.may_work)
        clock = asyncio.get_running_loop().time
        enough, done, as_planned = clock() + _enough(work), 0, True
        while done < len(deletions) and (not done or clock() < enough):
            batch = deletions[done : done + DELETIONS]
            if batch[-1].may_work and await self._has_changed(work):
                # A master may have attached since: what was free to go may be at work.
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
                elif isinstance(result, BaseException) and not isinstance(result, Gone):
                    if not isinstance(result, ApiError):
                        raise result
                    failure = failure or result
                else:
                    self._metrics.deleted(str(deletion.reason))
            work.state.deletion = (
                None if failure is None else error_conditions.with_deletion(failure)
            )
            if failure is not None:
                raise failure
            done += len(batch)
        return done, as_planned

    async def _has_changed(self, work: Work) -> bool:
        """Tell whether the pool has changed since the plan was made."""
        try:
            document = await self._cluster.read(POOLS, *work.key)
        except Gone:
            return True
        return _version(document) != _version(work.document)

    async def _delete_pod(self, namespace: str, deletion: Deletion) -> None:
        await self._cluster.delete(
            PODS,
            namespace,
            deletion.name,
            uid=deletion.uid,
            resource_version=deletion.resource_version,
        )

    def _tell(self, work: Work, events: Sequence[Event]) -> None:
        for event in events:
            self._recorder.tell(work.key, work.state.uid, event)


def _version(document: Body) -> tuple[object, ...]:
    """Return a version that changes with all inputs of a plan, and not with the status."""
    metadata = mapping(document, "metadata")
    return tuple(metadata.get(key) for key in ("uid", "generation", "deletionTimestamp"))


def _enough(work: Work) -> float:
    """Seconds that may be spent on pods before the next reconcile."""
    return max(ENOUGH, work.rested - asyncio.get_running_loop().time())


def _some(pods: list[str]) -> str:
    more = f" and {len(pods) - 3} more" if len(pods) > 3 else ""
    return ", ".join(pods[:3]) + more
