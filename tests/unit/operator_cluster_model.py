"""A model of a cluster that does what plans say: the API server, the kubelets and an SDK."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.plans import Knowledge, Plan
from fiber_operator.planning.pods import PodState, PodView, Trouble
from fiber_operator.planning.reconcile import plan
from unit.operator_objects import ADDRESS, NOW, UID, name_of, pool_document

STARTING_TAKES = 2.0
ENDING_TAKES = 3.0


def view(number: int, state: PodState, **fields: Any) -> PodView:
    """A pod of the pool in some state."""
    known: dict[str, Any] = {
        "name": name_of(number),
        "uid": f"uid-{number}",
        "resource_version": str(number),
        "owner": UID,
        "created": NOW - 60,
        "template_hash": "",
        "state": state,
        "since": NOW - 50,
        "was_ready": state in (PodState.READY, PodState.NOT_READY),
        "scheduled": True,
    }
    return PodView(**{**known, **fields})


@dataclass
class Model:
    """Model of one pool and its pods. Time passes in ``pass_time`` alone."""

    document: dict[str, Any] = field(default_factory=pool_document)
    pods: dict[str, PodView] = field(default_factory=dict)
    knowledge: Knowledge = field(default_factory=lambda: Knowledge(address=ADDRESS))
    now: float = NOW
    fails: bool = False
    """New workers fail instead of getting Ready."""
    completes: bool = False
    """New workers end with exit code 0 instead."""
    created: int = 0
    numbers: Iterable[int] = field(default_factory=lambda: itertools.count(10_000))

    @property
    def pool(self) -> FiberPool:
        return FiberPool.read(self.document)

    @property
    def live(self) -> list[PodView]:
        return [pod for pod in self.pods.values() if pod.live]

    def plan(self) -> Plan:
        return plan(self.pool, list(self.pods.values()), self.knowledge, self.now)

    def write_status(self, made: Plan) -> None:
        if made.status is not None:
            self.document["status"] = made.status

    def delete(self, made: Plan) -> None:
        for deletion in made.delete:
            pod = self.pods[deletion.name]
            assert deletion.uid == pod.uid
            assert deletion.resource_version in (None, pod.resource_version)
            if pod.state is PodState.ENDED:
                del self.pods[pod.name]
            else:
                ending = replace(pod, state=PodState.TERMINATING, since=self.now)
                self.pods[pod.name] = ending

    def create(self, made: Plan) -> None:
        if made.dry_run:
            self.knowledge = replace(self.knowledge, accepted=made.template_hash)
        for number in itertools.islice(self.numbers, made.create):
            pod = view(
                number,
                PodState.PENDING,
                created=float(int(self.now)),
                since=self.now,
                template_hash=made.template_hash,
            )
            self.pods[pod.name] = pod
        self.created += made.create

    def act(self) -> Plan:
        """Run one whole reconcile."""
        made = self.plan()
        self.write_status(made)
        self.delete(made)
        self.create(made)
        return made

    def restart(self) -> None:
        """Forget the operator's memory."""
        self.knowledge = Knowledge(address=ADDRESS)

    def evict(self, number: int) -> bool:
        """End one of the workers that are Ready, if there is any."""
        ready = [pod for pod in self.live if pod.state is PodState.READY]
        if not ready:
            return False
        pod = ready[number % len(ready)]
        self.pods[pod.name] = replace(
            pod,
            state=PodState.ENDED,
            since=self.now,
            trouble=Trouble.DISRUPTED,
            reason="Evicted",
        )
        return True

    def pass_time(self, seconds: float = 1.0) -> None:
        """The kubelets go on."""
        self.now += seconds
        for pod in list(self.pods.values()):
            if pod.state is PodState.TERMINATING and self.now - pod.since >= ENDING_TAKES:
                del self.pods[pod.name]
            elif pod.state is PodState.NOT_READY:
                self.pods[pod.name] = replace(pod, state=PodState.READY, since=self.now)
            elif pod.live and not pod.was_ready and self.now - pod.created >= STARTING_TAKES:
                self.pods[pod.name] = self._started(pod)

    def _started(self, pod: PodView) -> PodView:
        if self.fails:
            return replace(
                pod,
                state=PodState.ENDED,
                since=self.now,
                trouble=Trouble.APPLICATION,
                reason="Error",
                exit_code=1,
                ran=1.0,
            )
        if self.completes:
            return replace(
                pod,
                state=PodState.ENDED,
                since=self.now,
                trouble=Trouble.COMPLETED,
                reason="Completed",
                exit_code=0,
                ran=12.0,
            )
        return replace(pod, state=PodState.READY, since=self.now, was_ready=True, trouble=None)

    def release_what_the_operator_may_not_take(self) -> None:
        """Release outdated and surplus idle workers, as the SDK does."""
        spec, hash_ = self.document["spec"], template_hash(self.pool)
        ready = [pod for pod in self.live if pod.was_ready]
        outdated = [pod.name for pod in ready if pod.template_hash != hash_]
        if spec["update"]["strategy"] == "OnDelete":
            outdated = []
        current = [pod.name for pod in ready if pod.name not in outdated]
        excess = len(self.live) - len(outdated) - (self.pool.status.desired_replicas or 0)
        names = outdated[:5] + current[: max(0, excess)]
        spec["scaleDown"] = {**spec["scaleDown"], "release": names[:100]}
