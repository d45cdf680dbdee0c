"""Cache of the workers' pods, filled by a list and kept current by a watch.

::

    API server ──list, watch──► PodInformer ──changed(pool)──► queue
                                  ▲     │
           created, deleted ──────┘     └──pods(pool)────────► controller

The watch may be behind the operator's own changes.  So the controller reports its changes to the
informer.  A pod that it created is in the cache from then on.  A pod that it deleted counts as
terminating, even if the watch shows it otherwise.  Kubernetes' controllers call this expectations.

A watch that breaks off is continued from its last version.  If the API server no longer has that
version (410 Gone), or after two failures in a row, the pods are listed again, and the list replaces
the cache.
"""

from __future__ import annotations

import asyncio
import copy
import dataclasses
import logging
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple

from fiber_api import names
from fiber_api.rest import PODS, ApiError, Body, Expired, Forbidden, ServerUnreachable
from fiber_operator.cluster import Cluster
from fiber_operator.planning.documents import mapping, text
from fiber_operator.planning.pods import PodState, PodView, observe, worker_container
from fiber_operator.responses import Answered
from fiber_operator.workqueue import Key

PAUSES = (0.5, 1.0, 2.0, 5.0, 15.0)
"""Seconds until the next attempt, after one, two … attempts that failed."""
SYNC_TIMEOUT = 30.0
"""Seconds for which a reconcile waits for the first list."""
CONFIRMED_WITHIN = 30.0
"""Seconds within which the watch shows a created pod.  After that the pods are listed again."""
SHORT = 1.0
"""Seconds: a watch that ends earlier, and without an event, has failed."""
REMEMBERED = 1000
"""Number of deleted pods whose uids are kept: the answer to a creation may come after the end."""

_SELECTOR = names.LABEL_POOL_UID

log = logging.getLogger(__name__)


class PodInformer:
    """Cache of the pods of ``namespaces`` (empty: all) that belong to pools.

    ``changed`` is called with the pool of each pod that has changed, ``answered`` with the result
    of each watch.  Everything runs in one event loop.
    """

    def __init__(
        self,
        cluster: Cluster,
        *,
        namespaces: Sequence[str],
        changed: Callable[[Key], None],
        answered: Answered = lambda what, error: None,
    ) -> None:
        self._reflectors: dict[str | None, _Reflector] = {
            namespace: _Reflector(cluster, namespace, changed, answered)
            for namespace in namespaces or (None,)
        }

    async def run(self) -> None:
        """Keep the cache until cancelled."""
        async with asyncio.TaskGroup() as group:
            for reflector in self._reflectors.values():
                group.create_task(reflector.run())

    def refresh(self) -> None:
        """List the pods again before any are returned: another operator may have acted."""
        for reflector in self._reflectors.values():
            reflector.refresh()

    async def pods(self, key: Key, uid: str) -> list[PodView]:
        """Return the pods of the pool with that uid; raise ApiError if they are not known."""
        return await self._reflector(key.namespace).pods(key.namespace, uid)

    def created(self, namespace: str, document: Body) -> None:
        """Expect a pod that this operator has created."""
        self._reflector(namespace).created(document)

    def deleted(self, namespace: str, uid: str, *, gone: bool) -> None:
        """Expect the end of a pod that this operator has deleted.  ``gone``: it has ended."""
        self._reflector(namespace).deleted(uid, gone=gone)

    def _reflector(self, namespace: str) -> _Reflector:
        return self._reflectors.get(namespace) or self._reflectors[None]


class _Known(NamedTuple):
    """Pod in the cache."""

    key: Key
    pool: tuple[str, str]
    """The namespace of the pod, and the uid of the pool."""
    view: PodView


class _Reflector:
    """Cache of the pods of one namespace (None: of all), as the API server shows them."""

    def __init__(
        self,
        cluster: Cluster,
        namespace: str | None,
        changed: Callable[[Key], None],
        answered: Answered,
    ) -> None:
        self._cluster = cluster
        self._namespace = namespace
        self._changed = changed
        self._answered = answered
        self._pods: dict[str, _Known] = {}
        """Pods by uid."""
        self._pools: dict[tuple[str, str], dict[str, PodView]] = {}
        """The same pods: namespace and uid of the pool -> uid of the pod -> view.  The uid alone
        is not enough: a pod of another namespace may have the label."""
        self._expected: dict[str, float] = {}
        """Pods that were created and that the watch has not shown: uid -> time of the event loop.
        The oldest is the first."""
        self._ending: set[str] = set()
        """The uids of pods that this operator has deleted and that the watch has not ended."""
        self._gone: OrderedDict[str, float] = OrderedDict()
        """Pods that have left the cache: uid -> time of the event loop."""
        self._stale = True
        """True if the pods must be listed.  Only a completed list changes it to False."""
        self._version = ""
        """Version that the watch goes on from."""
        self._refreshes = 0
        self._settled = asyncio.Event()
        """Set once the pods are known, or ``_failure`` says why they are not."""
        self._failure: ApiError | None = None
        self._failures = 0
        """Attempts that failed since a watch brought an event or lasted for a while."""
        self._watching: asyncio.Timeout | None = None
        self._trial: asyncio.TimerHandle | None = None
        """Timer after which a watch that follows a failure counts as working."""

    async def pods(self, namespace: str, uid: str) -> list[PodView]:
        try:
            async with asyncio.timeout(SYNC_TIMEOUT):
                await self._settled.wait()
        except TimeoutError:
            raise ServerUnreachable("the pods were not listed in time", what="list pods") from None
        if self._failure is not None:
            raise copy.copy(self._failure)  # raised twice, it would keep what raised it alive
        return list(self._pools.get((namespace, uid), {}).values())

    def refresh(self) -> None:
        self._stale = True
        self._refreshes += 1
        self._settled.clear()
        if self._watching is not None:
            self._watching.reschedule(_now())
            self._watching = None  # it cannot be rescheduled again once it has expired

    # Changes by the operator

    def created(self, document: Body) -> None:
        uid = text(mapping(document, "metadata").get("uid"))
        if uid not in self._pods and uid not in self._gone:
            self._expected[uid] = _now()
            self._keep(uid, document)

    def deleted(self, uid: str, *, gone: bool) -> None:
        if gone:
            self._drop(uid)
        elif known := self._pods.get(uid):
            self._ending.add(uid)
            self._put(uid, known._replace(view=_as_ending(known.view)))

    # Changes that the API server reports

    async def run(self) -> None:
        while True:
            try:
                await self._follow()
            except ApiError as error:
                await self._recover(error)

    async def _recover(self, error: ApiError) -> None:
        """Report a failure if it is the second in a row, and pause before the next attempt."""
        again, expired = self._failures > 0, isinstance(error, Expired)
        self._failures += 1
        # A watch that breaks off once is begun again, and the pods are known meanwhile.
        if again or isinstance(error, Forbidden):
            self._failure = error
            self._settled.set()
            self._answered(self._request_name("watch"), error)
        self._stale = self._stale or self._failure is not None or expired
        if again or not expired:
            await asyncio.sleep(PAUSES[min(self._failures, len(PAUSES)) - 1])

    async def _follow(self) -> None:
        """List if need be, and watch until the watch ends."""
        while self._stale:
            await self._list()
        began, version = _now(), self._version
        refreshed = await self._watch()
        if not refreshed and self._version == version and _now() - began < SHORT:
            raise ServerUnreachable("the watch ended at once", what=self._request_name("watch"))

    async def _watch(self) -> bool:
        """Watch until the watch ends; return True if a refresh ended it."""
        deadline = asyncio.timeout(None)
        try:
            async with deadline as self._watching:
                await self._cluster.watch(
                    PODS,
                    self._namespace,
                    self._take,
                    selector=_SELECTOR,
                    version=self._version,
                    opened=self._opened,
                )
        except TimeoutError:
            if not deadline.expired():
                raise
            return True
        finally:
            self._watching = None
            if self._trial is not None:
                self._trial.cancel()
        return False

    def _opened(self) -> None:
        if self._failures:
            # The last watch failed.  This one works if it lasts, or brings an event.
            self._trial = asyncio.get_running_loop().call_later(SHORT, self._works)
        else:
            self._works()

    def _works(self) -> None:
        self._failure, self._failures = None, 0
        self._answered(self._request_name("watch"), None)

    def _request_name(self, verb: str) -> str:
        return f"{verb} {PODS.plural}" + (f" in {self._namespace}" if self._namespace else "")

    async def _list(self) -> None:
        began, refreshes = _now(), self._refreshes
        listed: set[str] = set()

        def keep(document: Body) -> None:
            uid = self._uid(document)
            listed.add(uid)
            # A pod that has left the cache since then may still be in the list.
            if self._gone.get(uid, -1.0) < began:
                self._show(uid, document)

        version = await self._cluster.list_all(PODS, self._namespace, keep, selector=_SELECTOR)
        for uid in [uid for uid in self._pods if uid not in listed]:
            # A pod that was created since then may be missing from the list.
            if self._expected.get(uid, -1.0) < began:
                self._drop(uid)
        if refreshes == self._refreshes:
            self._stale, self._version, self._failure = False, version, None
            self._settled.set()

    def _take(self, kind: str, document: Body) -> None:
        """Apply one event of the watch to the cache."""
        if self._stale:
            return  # the list that comes next is newer
        metadata = mapping(document, "metadata")
        if kind == "DELETED":
            self._drop(self._uid(document))
        elif kind in ("ADDED", "MODIFIED"):
            self._show(self._uid(document), document)
        self._version = text(metadata.get("resourceVersion")) or self._version
        if self._failures:
            self._works()
        oldest = next(iter(self._expected.values()), None)
        if oldest is not None and _now() - oldest > CONFIRMED_WITHIN:
            self.refresh()

    def _uid(self, document: Body) -> str:
        uid = text(mapping(document, "metadata").get("uid"))
        if not uid:
            raise ServerUnreachable("a pod has no uid", what=self._request_name("watch"))
        return uid

    def _show(self, uid: str, document: Body) -> None:
        """Put a pod of a list or watch into the cache."""
        self._expected.pop(uid, None)
        self._keep(uid, document)

    # The cache

    def _keep(self, uid: str, document: Body) -> None:
        metadata = mapping(document, "metadata")
        version = text(metadata.get("resourceVersion"))
        before = self._pods.get(uid)
        if before is not None and version and before.view.resource_version == version:
            return  # the answer to a creation, and the event of the same creation
        labels = mapping(metadata, "labels")
        view = observe(document, worker_container(document))
        if uid in self._ending:
            view = _as_ending(view)
        key = Key(text(metadata.get("namespace")), text(labels.get(names.LABEL_POOL)))
        pool = key.namespace, text(labels.get(names.LABEL_POOL_UID))
        known = _Known(key, pool, view)
        if before is not None and (before.key, before.pool) != (key, pool):
            self._drop(uid)
            before = None
        self._gone.pop(uid, None)
        self._put(uid, known)
        if before is None or not _same(before.view, view):
            self._changed(key)

    def _put(self, uid: str, known: _Known) -> None:
        self._pods[uid] = known
        self._pools.setdefault(known.pool, {})[uid] = known.view

    def _drop(self, uid: str) -> None:
        self._expected.pop(uid, None)
        self._ending.discard(uid)
        self._gone[uid] = _now()
        if len(self._gone) > REMEMBERED:
            self._gone.popitem(last=False)
        known = self._pods.pop(uid, None)
        if known is not None:
            pods = self._pools[known.pool]
            del pods[uid]
            if not pods:
                del self._pools[known.pool]
            self._changed(known.key)


def _now() -> float:
    return asyncio.get_running_loop().time()


def _as_ending(view: PodView) -> PodView:
    if not view.live:
        return view
    return dataclasses.replace(
        view, state=PodState.TERMINATING, trouble=None, reason="", message=""
    )


def _same(one: PodView, other: PodView) -> bool:
    """Return True if the views are equal except for their version."""
    return dataclasses.replace(one, resource_version=other.resource_version) == other
