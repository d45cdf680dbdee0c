"""Claims of namespaces: of several releases that watch a namespace, one acts there.

Each namespace that is served has a Lease of one name, whatever the releases are called and whatever
else they watch.  A release holds it, not a process: which process acts for a release is decided by
the release's own Lease (leader_election.py).  So the one of the namespace may last long, a thousand
of them cost a few requests a second, and a restart of the operator goes on at once.  Why a warning
would not do is in docs/decisions/0012.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fiber_api import names
from fiber_operator.cluster import Cluster
from fiber_operator.leader_election import LeaderElector, NotLeader
from fiber_operator.logs import about

NAME = names.CRD_NAME
"""Name of the Lease.  No release's own Lease has it, nor one of the SDK, which has no dot."""
SECONDS = 900
"""Seconds that other releases wait for one that ended without a word."""
LINGER = 60
"""Seconds that they wait for one that stopped: less, but longer than an upgrade takes."""
AT_ONCE = 4
"""Leases that are asked for at the same time."""
SHOWN = 3

log = logging.getLogger(__name__)


@dataclass
class _Claim:
    namespace: str
    elector: LeaderElector
    due: float
    held: bool = False
    """Last state that was reported."""
    complaint: str = ""
    """Why the namespace is not served by this operator, as it was told."""


class Claims:
    """The namespaces that this release serves, while this process acts for it.

    ``release`` is the same for all processes of one release.  ``namespaces`` are claimed for good;
    if there are none, each for which ``holds`` is asked, for as long as it is ``used``.
    ``on_change`` is called with the namespace and whether this operator acts there now, also when
    it turns out that it must not begin to: its pools may have gone while that was not known.
    """

    def __init__(
        self,
        cluster: Cluster,
        *,
        release: str,
        namespaces: tuple[str, ...],
        used: Callable[[], Iterable[str]],
        on_change: Callable[[str, bool], None],
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._cluster = cluster
        self._release = release
        self._namespaces = namespaces
        self._used = used
        self._on_change = on_change
        self._wall_clock = wall_clock
        self._claims: dict[str, _Claim] = {}
        self._wake = asyncio.Event()

    def begin(self) -> None:
        """Begin to act for the release."""
        for namespace in self._namespaces:
            self.holds(namespace)

    def end(self) -> None:
        """Stop acting for the release.  Another process may begin."""
        self._claims.clear()

    def holds(self, namespace: str) -> bool:
        """Tell whether this operator may act in the namespace; find it out if it is not known."""
        claim = self._claims.get(namespace)
        if claim is None:
            self._claims[namespace] = _Claim(namespace, self._elector(namespace), self._now())
            self._wake.set()
            return False
        return claim.elector.is_leader

    def require(self, namespace: str) -> float:
        """The seconds that a write there may last which begins now; NotLeader if none may."""
        claim = self._claims.get(namespace)
        if claim is None:
            raise NotLeader(f"this operator has not claimed the namespace {namespace}")
        return claim.elector.require()

    def refused(self, namespace: str) -> bool:
        """Tell whether it is known that this operator may not act there now."""
        claim = self._claims.get(namespace)
        return claim is not None and bool(claim.complaint)

    def wrong(self) -> list[str]:
        """Return a sentence for each namespace that is not served as it should be.

        Where all namespaces are watched it is right that some are served by others.
        """
        claims, used = list(self._claims.values()), {*self._namespaces, *self._used()}
        tolerant = not self._namespaces and any(claim.elector.is_leader for claim in claims)
        wrong = [
            claim.complaint
            for claim in claims
            if claim.complaint
            and claim.namespace in used  # else it is given up when its next step is due
            and not (tolerant and claim.elector.holder)
        ]
        more = [f"so are {len(wrong) - SHOWN} more namespaces"] if len(wrong) > SHOWN else []
        return wrong[:SHOWN] + more

    async def run(self) -> None:
        """Claim what is asked for, and keep it, until cancelled."""
        while True:
            self._wake.clear()
            due = [claim for claim in self._claims.values() if claim.due <= self._now()]
            used = {*self._namespaces, *self._used()} if due else set()
            for start in range(0, len(due), AT_ONCE):
                await asyncio.gather(
                    *(self._step(claim, used) for claim in due[start : start + AT_ONCE])
                )
            soonest = min((claim.due for claim in self._claims.values()), default=None)
            try:
                async with asyncio.timeout_at(soonest):
                    await self._wake.wait()
            except TimeoutError:
                pass  # one is due

    async def release(self) -> None:
        """Let other releases begin soon; this one's next process goes on at once."""
        claims = list(self._claims.values())
        self._claims.clear()
        await self._give_up(claims)

    async def _step(self, claim: _Claim, used: set[str]) -> None:
        if self._claims.get(claim.namespace) is not claim:
            return  # it was given up since
        if claim.namespace not in used:
            del self._claims[claim.namespace]
            await self._give_up([claim])
            return
        claim.due = self._now() + await claim.elector.step()
        if self._claims.get(claim.namespace) is claim:
            self._tell(claim)

    async def _give_up(self, claims: list[_Claim]) -> None:
        held = [claim.elector for claim in claims if claim.elector.is_leader]
        for elector in held:
            elector.resign()
        for start in range(0, len(held), AT_ONCE):
            await asyncio.gather(
                *(elector.linger(LINGER) for elector in held[start : start + AT_ONCE])
            )

    def _tell(self, claim: _Claim) -> None:
        held, complaint = claim.elector.is_leader, self._complaint(claim)
        if complaint and complaint != claim.complaint:
            reason = "ServedByAnother" if claim.elector.holder else "NotClaimed"
            log.warning("%s", complaint, extra=about(claim.namespace, reason=reason))
        elif claim.complaint and not complaint:
            log.info("this operator serves the namespace %s now", claim.namespace)
        refused = bool(complaint) and not claim.complaint
        claim.complaint = complaint
        if held != claim.held or refused:
            claim.held = held
            self._on_change(claim.namespace, held)

    def _complaint(self, claim: _Claim) -> str:
        if claim.elector.is_leader:
            return ""
        if not claim.elector.holder:
            return f"the namespace {claim.namespace} is not served: {claim.elector.why}"
        return (
            f"the namespace {claim.namespace} is served by another operator, release "
            f"{claim.elector.holder}, which holds the Lease {NAME} there: this one, release "
            f"{self._release}, does nothing in it. Uninstall one of the two, or let them watch "
            "different namespaces"
        )

    def _elector(self, namespace: str) -> LeaderElector:
        return LeaderElector(
            self._cluster,
            namespace=namespace,
            name=NAME,
            identity=self._release,
            seconds=SECONDS,
            wall_clock=self._wall_clock,
        )

    def _now(self) -> float:
        return asyncio.get_running_loop().time()
