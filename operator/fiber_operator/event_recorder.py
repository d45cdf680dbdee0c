"""Kubernetes events on the pools: what ``kubectl describe`` shows.  Lost ones do no harm.

An event that repeats within ``WINDOW`` raises the count of the one that is there, and not more
often than every ``PAUSE`` seconds, so that a pool in trouble does not flood the API server.
What would differ each time, such as a number of pods, is therefore not in the words of an event.

They are posted one after the other beside the looks at pools, which wait for none.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
import secrets
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass

from fiber_api import names
from fiber_operator.cluster import EVENTS, ApiError, Body, Cluster
from fiber_operator.leader_election import NotLeader
from fiber_operator.logs import about
from fiber_operator.planning.plans import Event
from fiber_operator.workqueue import Key

WINDOW = 600.0
PAUSE = 30.0
REMEMBERED = 1000
WAITING = 200
"""Events that wait to be posted; beyond that the oldest are given up."""
MESSAGE_LIMIT = 1024
"""The API server refuses longer ones."""

log = logging.getLogger(__name__)


@dataclass
class _Posted:
    name: str
    first: float
    told: float
    count: int = 1


class EventRecorder:
    """Posts events.  ``now`` gives unix seconds."""

    def __init__(self, cluster: Cluster, now: Callable[[], float], identity: str) -> None:
        self._cluster = cluster
        self._now = now
        self._identity = identity
        self._waiting: deque[tuple[Key, str, Event]] = deque(maxlen=WAITING)
        self._bell = asyncio.Event()
        self._posted: OrderedDict[tuple[str, str, str], _Posted] = OrderedDict()

    def tell(self, key: Key, uid: str, event: Event) -> None:
        """Log ``event`` and have it posted on the pool when its turn comes."""
        level = logging.WARNING if event.type == "Warning" else logging.INFO
        log.log(level, "%s", event.message, extra=about(*key, uid=uid, reason=event.reason))
        self._waiting.append((key, uid, event))
        self._bell.set()

    async def run(self) -> None:
        """Post what was told, until cancelled."""
        while True:
            await self._bell.wait()
            self._bell.clear()
            while self._waiting:
                await self.record(*self._waiting.popleft())

    async def record(self, key: Key, uid: str, event: Event) -> None:
        """Post ``event`` on the pool; it never fails, it only may not be posted."""
        now, place = self._now(), (uid, event.reason, event.message)
        posted = self._posted.get(place)
        try:
            async with asyncio.timeout(5):
                if posted is None or now - posted.first > WINDOW:
                    await self._post(place, key, event, now)
                else:
                    await self._repeat(posted, key, now)
        except (ApiError, TimeoutError, NotLeader) as error:
            log.warning("an event could not be posted: %s", error, extra=about(*key, uid=uid))

    async def _post(self, place: tuple[str, str, str], key: Key, event: Event, now: float) -> None:
        name = f"{key.name}.{secrets.token_hex(8)}"
        body: Body = {
            "apiVersion": "v1",
            "kind": "Event",
            "metadata": {"name": name, "namespace": key.namespace},
            "involvedObject": {
                "apiVersion": names.API_VERSION,
                "kind": names.KIND,
                "namespace": key.namespace,
                "name": key.name,
                "uid": place[0],
            },
            "type": event.type,
            "reason": event.reason,
            "message": event.message[:MESSAGE_LIMIT],
            "source": {"component": names.OPERATOR_MANAGER},
            "reportingComponent": names.OPERATOR_MANAGER,
            "reportingInstance": self._identity,
            "firstTimestamp": _stamp(now),
            "lastTimestamp": _stamp(now),
            "count": 1,
        }
        await self._cluster.create(EVENTS, key.namespace, body)
        self._posted[place] = _Posted(name, now, now)
        self._posted.move_to_end(place)
        while len(self._posted) > REMEMBERED:
            self._posted.popitem(last=False)

    async def _repeat(self, posted: _Posted, key: Key, now: float) -> None:
        posted.count += 1
        if now - posted.told >= PAUSE:
            posted.told = now
            patch = {"count": posted.count, "lastTimestamp": _stamp(now)}
            await self._cluster.patch(EVENTS, key.namespace, posted.name, patch)


def _stamp(now: float) -> str:
    moment = datetime.datetime.fromtimestamp(now, datetime.UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
