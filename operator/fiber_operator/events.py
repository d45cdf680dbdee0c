"""Kubernetes events: those that the operator posts on pools, and those that it reads of pods.

Posted events are what ``kubectl describe`` shows; a lost one does no harm.  An event that repeats
within ``WINDOW`` raises the count of the existing one, at most every ``PAUSE`` seconds, so that a
pool in trouble does not flood the API server.  For that the text of an event holds nothing that
differs each time, such as a number of pods.

Events are posted beside the reconciles, which do not wait for them.  Namespaces take turns, and
each has a limit of waiting and of remembered events, so that the events of one namespace neither
delay nor displace those of another.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
import secrets
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from fiber_api import names
from fiber_api.rest import EVENTS, ApiError, Body
from fiber_operator.cluster import Cluster
from fiber_operator.logs import about
from fiber_operator.operator_leases import NotLeader
from fiber_operator.planning.documents import mapping, seconds, text
from fiber_operator.planning.plans import PoolEvent
from fiber_operator.planning.pods import PodView
from fiber_operator.workqueue import Key

log = logging.getLogger(__name__)


WINDOW = 600.0
PAUSE = 30.0
REMEMBERED = 200
"""Most events of a namespace whose repetitions are counted."""
WAITING = 50
"""Most events of a namespace that wait to be posted; beyond that the oldest are dropped."""
AT_ONCE = 4
"""Most events that are posted at the same time, each of another namespace."""
MESSAGE_LIMIT = 1024
"""Longest message that the API server accepts."""


@dataclass
class _Posted:
    name: str
    first: float
    updated: float
    count: int = 1


_Place = tuple[str, str, str]
"""Key by which events are counted: the pool's uid, the reason and the message."""


@dataclass
class _Namespace:
    """Events of one namespace."""

    waiting: deque[tuple[Key, str, PoolEvent]] = field(
        default_factory=lambda: deque(maxlen=WAITING)
    )
    posted: OrderedDict[_Place, _Posted] = field(default_factory=OrderedDict)
    posting: bool = False

    def forget(self, now: float) -> None:
        """Forget events that are too old to be repeated, and the oldest of too many."""
        while self.posted:
            oldest = next(iter(self.posted.values()))
            if len(self.posted) <= REMEMBERED and now - oldest.first <= WINDOW:
                return
            self.posted.popitem(last=False)


class EventRecorder:
    """Posts events on pools.  ``now`` returns unix seconds."""

    def __init__(self, cluster: Cluster, now: Callable[[], float], identity: str) -> None:
        self._cluster = cluster
        self._now = now
        self._identity = identity
        self._bell = asyncio.Event()
        self._namespaces: dict[str, _Namespace] = {}
        """Namespaces in the order of their turns."""

    def tell(self, key: Key, uid: str, event: PoolEvent) -> None:
        """Log ``event``, and queue it to be posted on the pool."""
        level = logging.WARNING if event.type == "Warning" else logging.INFO
        log.log(level, "%s", event.message, extra=about(*key, uid=uid, reason=event.reason))
        self._events_of(key).waiting.append((key, uid, event))
        self._bell.set()

    async def run(self) -> None:
        """Post queued events until cancelled."""
        async with asyncio.TaskGroup() as posters:
            for _ in range(AT_ONCE):
                posters.create_task(self._post_in_turn())

    async def _post_in_turn(self) -> None:
        while True:
            name = self._next()
            if name is None:
                self._bell.clear()
                await self._bell.wait()
                continue
            # The namespace goes to the end of the queue.
            events = self._namespaces[name] = self._namespaces.pop(name)
            events.posting = True
            try:
                await self.record(*events.waiting.popleft())
            finally:
                events.posting = False
            self._bell.set()
            self._forget(name)

    def _next(self) -> str | None:
        """Return the namespace whose turn it is; None if no event waits."""
        free = (
            name
            for name, events in self._namespaces.items()
            if events.waiting and not events.posting
        )
        return next(free, None)

    def _events_of(self, key: Key) -> _Namespace:
        return self._namespaces.setdefault(key.namespace, _Namespace())

    def _forget(self, name: str) -> None:
        """Forget old events of this namespace and of the one that waits longest for its turn."""
        for known in (name, next(iter(self._namespaces))):
            events = self._namespaces[known]
            events.forget(self._now())
            if not (events.posted or events.waiting or events.posting):
                del self._namespaces[known]
                return

    async def record(self, key: Key, uid: str, event: PoolEvent) -> None:
        """Post ``event`` on the pool.  A failure is only logged."""
        now, place = self._now(), (uid, event.reason, event.message[:MESSAGE_LIMIT])
        posted = self._events_of(key).posted.get(place)
        try:
            async with asyncio.timeout(5):
                if posted is None or now - posted.first > WINDOW:
                    await self._post(place, key, event, now)
                else:
                    await self._repeat(posted, key, now)
        except (ApiError, TimeoutError, NotLeader) as error:
            log.warning("an event could not be posted: %s", error, extra=about(*key, uid=uid))

    async def _post(self, place: _Place, key: Key, event: PoolEvent, now: float) -> None:
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
        events = self._events_of(key)
        events.posted[place] = _Posted(name, now, now)
        events.posted.move_to_end(place)
        events.forget(now)

    async def _repeat(self, posted: _Posted, key: Key, now: float) -> None:
        posted.count += 1
        if now - posted.updated >= PAUSE:
            posted.updated = now
            patch = {"count": posted.count, "lastTimestamp": _stamp(now)}
            await self._cluster.patch(EVENTS, key.namespace, posted.name, patch)


def _stamp(now: float) -> str:
    moment = datetime.datetime.fromtimestamp(now, datetime.UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


# -- Events about pods

_NO_NEWS = frozenset(
    {
        # From before the pod had a node.
        "FailedScheduling",
        "NotTriggerScaleUp",
        "Scheduled",
        "TriggeredScaleUp",
        # Normal events that accompany a problem and do not end it.
        "BackOff",
        "Killing",
        "SandboxChanged",
        # A notice of the kubelet, which starts the pod anyway.
        "MissingClusterDNS",
    }
)
"""Reasons of events that do not say what a pod with a node waits for."""


class _Occurrence(NamedTuple):
    """Event about a pod.  The greatest is the newest."""

    second: int
    """Second of the event: most times in Kubernetes are no more precise."""
    written: int
    warning: str


async def pod_warnings(
    cluster: Cluster, key: Key, pods: Sequence[str], there: Sequence[PodView]
) -> dict[str, str]:
    """Return the newest event of each pod as ``Reason: message`` if it is a Warning, else "".

    A Warning that a newer event follows is over: the volume is mounted, or the image is pulled.
    """
    uids = {pod.name: pod.uid for pod in there}
    found = {}
    for name in pods:
        try:
            events = await cluster.list(
                EVENTS, key.namespace, _occurrence, fields=f"involvedObject.uid={uids.get(name)}"
            )
        except ApiError:
            events = []  # the explanation is optional
        newest = max((event for event in events if event is not None), default=None)
        found[name] = newest.warning if newest else ""
    return found


def _occurrence(event: Body) -> _Occurrence | None:
    reason = text(event.get("reason"))
    if reason in _NO_NEWS:
        return None
    warning = f"{reason}: {text(event.get('message'))}" if event.get("type") == "Warning" else ""
    return _Occurrence(int(_last_time(event)), _version(event), warning)


def _version(event: Body) -> int:
    """Return a number that is greater for the later of two events in one second."""
    try:
        return int(text(mapping(event, "metadata").get("resourceVersion")))
    except ValueError:
        return 0


def _last_time(event: Body) -> float:
    """Return the time of the event's last repetition."""
    stamps = (
        mapping(event, "series").get("lastObservedTime"),
        event.get("lastTimestamp"),
        event.get("eventTime"),
        mapping(event, "metadata").get("creationTimestamp"),
    )
    return next(filter(None, map(seconds, stamps)), 0.0)
