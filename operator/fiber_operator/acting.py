"""Doing what a plan says, in its order: status, deletions, creations, events."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fiber_api.v1alpha1 import FiberPool
from fiber_operator import manifests
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
from fiber_operator.creation import ENOUGH, Creator, Pace
from fiber_operator.documents import mapping, text
from fiber_operator.events import Recorder
from fiber_operator.logs import about
from fiber_operator.metrics import Metrics
from fiber_operator.plans import Deletion, Event, Plan, Refusal
from fiber_operator.surroundings import Surroundings
from fiber_operator.worker import Key, Turn

DELETIONS = 50
"""Pods that are deleted at once."""

log = logging.getLogger(__name__)


@dataclass
class State:
    """What is remembered of one pool between looks, by uid.  Losing it costs only calls."""

    uid: str
    surroundings: Surroundings | None = None
    accepted: str | None = None
    """The template hash that passed the dry run."""
    refusal: Refusal | None = None
    deleted: set[str] = field(default_factory=set)
    """Pods that this process asked to delete and that are still there."""
    warnings: dict[str, str] = field(default_factory=dict)
    pace: Pace = field(default_factory=Pace)
    generation: int = -1
    """Of the pool at the last look that did not fail, the one under way included."""

    @property
    def address(self) -> str | None:
        """Where agents dial, once that is known."""
        return self.surroundings.address if self.surroundings else None

    def refused(
        self, template_hash: str, error: ApiError, now: float, *, dry_run: bool = False
    ) -> None:
        """The API server does not take a pod of this template now."""
        before = self.refusal
        count = before.count + 1 if before and before.template_hash == template_hash else 1
        self.refusal = Refusal(template_hash, error.status, error.message, now, count, dry_run)


@dataclass(frozen=True)
class Look:
    """One look at a pool, once it is planned what to do."""

    key: Key
    document: Body
    pool: FiberPool | None
    """None if the spec cannot be read."""
    state: State
    plan: Plan
    rested: float = 0.0
    """When the pool has rested from the list of its pods, by the loop's clock.  No look comes
    before, so pods may be changed until then."""


class Actor:
    """Carries out plans.  ``now`` gives unix seconds."""

    def __init__(
        self,
        cluster: Cluster,
        *,
        creator: Creator,
        recorder: Recorder,
        metrics: Metrics,
        now: Callable[[], float],
    ) -> None:
        self._cluster = cluster
        self._creator = creator
        self._recorder = recorder
        self._metrics = metrics
        self._now = now

    async def dry_run(self, pool: FiberPool, plan: Plan, state: State) -> ApiError | None:
        """Ask whether the API server takes a pod of this template; returns what hindered that."""
        body = manifests.pod(pool, self._creator.name(pool.metadata.name), state.address or "")
        try:
            await self._cluster.create(PODS, pool.metadata.namespace, body, dry_run=True)
        except (Refused, Invalid) as error:
            state.refused(plan.template_hash, error, self._now(), dry_run=True)
        except ApiError as error:
            return error
        else:
            state.accepted, state.refusal = plan.template_hash, None
        return None

    async def act(self, look: Look) -> Turn:
        """Do what is planned; the first error that is not part of the game is raised."""
        if look.plan.delete_pool:
            await self._delete_pool(look)
            return Turn()
        await self._write_status(look)
        failure = None
        turn = Turn()
        try:
            turn = await self._change_pods(look)
        except ApiError as error:
            failure = error
        # The status says already what they tell of: they would not be planned again.
        await self._tell(look, look.plan.events)
        if failure is not None:
            raise failure
        return turn

    async def _write_status(self, look: Look) -> None:
        if look.plan.status is None:
            return
        # The uid keeps it from a new pool of the same name.
        patch = {"metadata": {"uid": look.state.uid}, "status": dict(look.plan.status)}
        await self._cluster.patch(POOLS, *look.key, patch, "status")

    async def _delete_pool(self, look: Look) -> None:
        version = text(mapping(look.document, "metadata").get("resourceVersion"))
        try:
            await self._cluster.delete(
                POOLS, *look.key, uid=look.state.uid, resource_version=version
            )
        except (Gone, Conflict):
            return  # it was changed meanwhile, by its master perhaps; the next look sees
        await self._tell(look, look.plan.events)

    async def _change_pods(self, look: Look) -> Turn:
        deleted, as_planned = await self._delete(look)
        if deleted < len(look.plan.delete):
            return Turn(again=0.0)
        turn = await self._create(look)
        return turn if as_planned else dataclasses.replace(turn, again=0.0)

    async def _delete(self, look: Look) -> tuple[int, bool]:
        """How many of the pods were seen to, and whether each was as the plan had it.

        Like creation this stops after a while, so that the status is not out of date for long.
        """
        key, state, deletions = look.key, look.state, look.plan.delete
        clock = asyncio.get_running_loop().time
        enough, done, as_planned = clock() + _enough(look), 0, True
        while done < len(deletions) and (not done or clock() < enough):
            batch = deletions[done : done + DELETIONS]
            state.deleted |= {deletion.name for deletion in batch}
            results = await asyncio.gather(
                *(self._delete_pod(key.namespace, deletion) for deletion in batch),
                return_exceptions=True,
            )
            for deletion, result in zip(batch, results, strict=True):
                if isinstance(result, Conflict):
                    state.deleted.discard(deletion.name)
                    as_planned = False
                elif isinstance(result, BaseException) and not isinstance(result, Gone):
                    raise result
                else:
                    self._metrics.deleted(str(deletion.reason))
            done += len(batch)
        return done, as_planned

    async def _delete_pod(self, namespace: str, deletion: Deletion) -> None:
        await self._cluster.delete(
            PODS,
            namespace,
            deletion.name,
            uid=deletion.uid,
            resource_version=deletion.resource_version,
            grace=deletion.grace,
        )

    async def _create(self, look: Look) -> Turn:
        pool, state, plan, address = look.pool, look.state, look.plan, look.state.address
        if pool is None or address is None or not plan.create:
            return Turn()
        done = await self._creator.create(
            pool.metadata.name,
            pool.metadata.namespace,
            manifests.pod_maker(pool, address),
            plan.create,
            plan.batch_limit,
            state.pace,
            enough=_enough(look),
        )
        if done.names:
            self._metrics.created(len(done.names))
            state.refusal = None
            log.info("created %s", _some(done.names), extra=about(*look.key, uid=state.uid))
        if done.refusal is not None:
            state.refused(plan.template_hash, done.refusal, self._now())
            return Turn(again=0.0)  # so that the status says it
        if done.failure is not None:
            log.warning("%s", done.failure, extra=about(*look.key, uid=state.uid))
            return Turn(failed=True, rest=done.wait)
        return Turn(again=0.0) if len(done.names) < plan.create else Turn()

    async def _tell(self, look: Look, events: Sequence[Event]) -> None:
        for event in events:
            await self._recorder.record(look.key, look.state.uid, event)


def _enough(look: Look) -> float:
    """Seconds that may be spent on pods before the next look."""
    return max(ENOUGH, look.rested - asyncio.get_running_loop().time())


def _some(pods: list[str]) -> str:
    more = f" and {len(pods) - 3} more" if len(pods) > 3 else ""
    return ", ".join(pods[:3]) + more
