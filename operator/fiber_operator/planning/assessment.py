"""Assessment of a pool, its pods and what the operator knows of both, made once for a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning import cut_off, failures, revisions
from fiber_operator.planning.attachment import idleness, judge
from fiber_operator.planning.plans import Memory
from fiber_operator.planning.pods import PodView, State, Trouble

QUOTA_WAIT = 30.0
"""The longest wait until a full quota is tried again: it is freed without a sign."""

ACCOUNT_WAIT = 1.0
"""The same for a ServiceAccount that is not there: in a new namespace it is in a moment."""

_HINDERED = (Trouble.UNSCHEDULABLE, Trouble.CANNOT_START)


class Assessment:
    """All that a plan follows from.  Worked out from its arguments alone."""

    def __init__(
        self, pool: FiberPool, pods: Sequence[PodView], memory: Memory, now: float
    ) -> None:
        """``pods`` are the pool's own, the oldest first."""
        self.pool, self.spec = pool, pool.spec
        self.memory, self.now = memory, now
        self.template_hash = revisions.template_hash(pool)
        # Whoever has taken that label away has said nothing against the pod.
        pods = [
            p if p.template_hash else replace(p, template_hash=self.template_hash) for p in pods
        ]
        self.pods = [self._fairly_judged(pod) for pod in pods]
        self.attachment = judge(pool, memory.master, now)
        if self.spec.master is None or self.attachment.alive is False:
            # Those whose master has gone before they reached it wait for the next on purpose.
            self.pods = [replace(pod, joining=False) for pod in self.pods]
        self.idleness = idleness(pool, self.attachment, now)
        lost = cut_off.find(pool, [pod for pod in self.pods if pod.live], memory)
        self.pods = cut_off.outdated(self.pods, lost, attached=self.attachment.attached)
        self.ends = pool.metadata.deletion_timestamp is not None
        self.live = [pod for pod in self.pods if pod.live]
        self.ended = [pod for pod in self.pods if pod.state is State.ENDED]
        self.late = self._not_ready_in_time()
        self.desired = self._wanted()
        self.expected = self._asked_to_end()
        """Names of pods whose end is nobody's failure."""
        self.refused_until = self._refused_until()
        self.account = self._count()
        self.may_create = self._can_make_pods()

    def _fairly_judged(self, pod: PodView) -> PodView:
        """An agent whose master is lost ends with 0, however soon that is."""
        master, brief = self.spec.master, pod.state is State.ENDED and pod.exit_code == 0
        if master is None or not brief or pod.trouble is not Trouble.APPLICATION:
            return pod
        # The cluster's times are whole seconds.
        waited = pod.ran > 0 and pod.ran >= master.lost_grace_seconds - 1
        return replace(pod, trouble=Trouble.COMPLETED) if waited else pod

    def _not_ready_in_time(self) -> list[PodView]:
        """Workers that run and do not get Ready: they failed, only that they do not end."""
        if self.ends or self.spec.suspend:
            return []
        limit = self.now - self.spec.failure_policy.startup_timeout_seconds
        return [pod for pod in self.live if pod.state is State.STARTING and pod.since <= limit]

    def _asked_to_end(self) -> frozenset[str]:
        if self.ends or self.spec.suspend:
            return frozenset(pod.name for pod in self.pods)
        return frozenset(self.spec.scale_down.release)

    def _count(self) -> failures.Account:
        return failures.account(
            self.pool.status.failures,
            self.pool.status.proven_template_hash,
            self.pods,
            expected=self.expected,
            late={pod.name for pod in self.late},
            desired=self.desired - self._hindered(),
            template_hash=self.template_hash,
            spec_hash=revisions.spec_hash(self.pool),
            policy=self.spec.failure_policy,
            seed=self.pool.metadata.uid,
            now=self.now,
        )

    def _hindered(self) -> int:
        """Workers that are wanted and not there for other reasons than that workers fail."""
        missing = max(0, self.desired - len(self.live)) if self.refused_until else 0
        return missing + sum(pod.trouble in _HINDERED for pod in self.live)

    def _wanted(self) -> int:
        attachment = self.attachment
        if self.spec.suspend or self.idleness.forgotten:
            return 0
        if self.spec.on_lost != "ScaleToMin" or not attachment.grace_is_over:
            return self.pool.wanted
        floor = self.spec.min_replicas
        # Not yet confirmed by this process: keep what there is.
        return floor if attachment.gone else min(self.pool.wanted, max(floor, len(self.live)))

    @property
    def floor(self) -> int:
        """Number of pods that minReplicas keeps and the master does not want."""
        spec, forgotten = self.spec, self.idleness.forgotten
        return spec.min_replicas if spec.replicas < spec.min_replicas and not forgotten else 0

    @property
    def accepted(self) -> bool:
        """The API server takes pods of this template, or did."""
        return self.template_hash in (self.memory.accepted, self.account.proven)

    def _refused_until(self) -> float | None:
        refused = self.memory.refusal
        if refused is None or refused.template_hash != self.template_hash:
            return None
        wait = failures.delay(self.spec.failure_policy, refused.count, self.pool.metadata.uid)
        if refused.reason == Reason.QUOTA_EXCEEDED:
            wait = min(wait, QUOTA_WAIT)
        if refused.lacks_account:
            wait = min(wait, ACCOUNT_WAIT)
        return refused.at + wait

    def _can_make_pods(self) -> bool:
        memory, policy = self.memory, self.spec.failure_policy
        return not (
            self.ends
            or memory.address is None
            or memory.obstacles
            or self._is_orphaned()
            or failures.given_up(self.account.failures, policy)
            or (self.refused_until is not None and self.now < self.refused_until)
        )

    def _is_orphaned(self) -> bool:
        """Tell whether the master is lost, and the pool does not show that yet."""
        attachment = self.attachment
        if self.spec.on_lost == "Retain":
            return False
        return attachment.alive is False and not attachment.gone
