"""Creation of pods in batches of 1, 2, 4 and so on, each pod once.

Creation runs while the controller plans and writes the status.  The informer expects each pod from
the moment in which its creation is answered.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field

from fiber_api import names
from fiber_api.rest import (
    PODS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    Invalid,
    TooManyRequests,
    Transient,
)
from fiber_operator.cluster import Cluster
from fiber_operator.planning.pods import PodView
from fiber_operator.workqueue import Key

Draw = Callable[[], str]


def draw_suffix() -> str:
    """Return a suffix that makes a pod's name unique."""
    return secrets.token_hex(names.POD_SUFFIX_LENGTH // 2)


@dataclass
class CreationPace:
    """Pace of a pool's creations, which its next creation continues."""

    batch: int = 1
    """Number of pods in the next batch."""
    unsure: list[str] = field(default_factory=list)
    """Names of pods that may or may not have been created.

    They are used first: a pod that exists is refused as a duplicate, so none is created twice."""


@dataclass(frozen=True)
class Order:
    """Order of pods to create."""

    template_hash: str
    body: Callable[[str], Body]
    """Function that returns the body of the pod of that name."""
    limit: int
    """Most pods in a batch."""


@dataclass
class Created:
    """Outcome of an order."""

    names: list[str] = field(default_factory=list)
    refusal: ApiError | None = None
    """First error with status 403 or 422."""
    failure: ApiError | None = None
    """First other error."""
    wait: float = 0.0
    """Seconds that the API server asked to wait."""


class Creation:
    """The pods of one pool that are being created, in batches of 1, 2, 4 ... up to a limit.

    A batch in which anything fails is the last, and the next time begins with one pod.
    ``created`` is called with each pod that was created.
    """

    def __init__(
        self,
        cluster: Cluster,
        key: Key,
        pace: CreationPace,
        draw: Draw = draw_suffix,
        created: Callable[[Body], object] = lambda document: None,
    ) -> None:
        self._cluster = cluster
        self._key = key
        self._created = created
        self._pace = pace
        self._draw = draw
        self.order: Order
        self._left = 0
        """Number of pods whose creation has not begun."""
        self._under_way: set[str] = set()
        self._unknown = 0
        """Number of pods whose creation has begun and that the last ``see`` did not show."""
        self._task: asyncio.Task[None] | None = None
        self._done = Created()

    def see(self, pods: list[PodView]) -> None:
        """Note the pods that the informer shows, before the plan that is based on them."""
        there = {pod.name for pod in pods}
        self._pace.unsure = [name for name in self._pace.unsure if name not in there]
        self._unknown = len(self._under_way - there)

    def aim(self, count: int, order: Order) -> None:
        """Create ``count`` pods, including those under way that the last ``see`` did not show."""
        self.order = order
        self._left = max(0, count - self._unknown)
        if self._left and (self._task is None or self._task.done()):
            self._task = asyncio.create_task(self._run(), name=f"creation for {self._key}")

    def stop(self) -> None:
        """Start no further batch."""
        self._left = 0

    async def wait(self, seconds: float | None = None) -> bool:
        """Wait until the creation has ended, at most for ``seconds``; return True if it has."""
        if self._task is None:
            return True
        done, _ = await asyncio.wait([self._task], timeout=seconds)
        for task in done:
            self._task = None
            task.result()
        return bool(done)

    def take(self) -> Created:
        """Return the outcome since the last call."""
        done, self._done = self._done, Created()
        return done

    async def cancel(self) -> None:
        """Stop at once.  Pods under way may or may not be created."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        while self._left and not (self._done.refusal or self._done.failure):
            size = min(self._pace.batch, self.order.limit, self._left)
            self._left -= size
            self._unknown += size
            batch = [self._name() for _ in range(size)]
            self._under_way.update(batch)
            results = await asyncio.gather(*map(self._create, batch), return_exceptions=True)
            for result in results:
                if result is not None:
                    raise result
            more = self._left and not (self._done.refusal or self._done.failure)
            self._pace.batch = min(2 * size, self.order.limit) if more else 1

    def _name(self) -> str:
        unsure = self._pace.unsure
        return unsure.pop(0) if unsure else names.pod_name(self._key.name, self._draw())

    async def _create(self, name: str) -> None:
        try:
            document = await self._have(name)
        except (Forbidden, Invalid) as error:
            self._done.refusal = self._done.refusal or error
        except ApiError as error:
            if isinstance(error, TooManyRequests):
                self._done.wait = max(self._done.wait, error.retry_after)
            elif isinstance(error, Transient):
                self._pace.unsure.append(name)
            self._done.failure = self._done.failure or error
        except asyncio.CancelledError:
            self._pace.unsure.append(name)
            raise
        else:
            self._done.names.append(name)
            self._created(document)
        finally:
            self._under_way.discard(name)

    async def _have(self, name: str) -> Body:
        namespace = self._key.namespace
        try:
            return await self._cluster.create(PODS, namespace, self.order.body(name))
        except Conflict as error:
            if error.reason != "AlreadyExists":
                raise
        # An earlier request created the pod, and its response was lost.
        return await self._cluster.read(PODS, namespace, name)
