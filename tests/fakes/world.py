"""A cluster with an operator in it, within this process.

The operator is the whole program but for kopf, whose place a direct feed of the store's changes
takes: in virtual time, an hour of a pool's life takes milliseconds.  It can be ended between any
two calls and started again.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from typing import Any

from fakes import virtual_time
from fakes.certificates import make_certificates
from fakes.kubelet import Kubelet
from fakes.kubernetes_api import Fault, KubernetesApi
from fakes.memory_connector import MemoryConnector
from fakes.store import Body, Failure, Store
from fiber_api import names
from fiber_operator.cluster import Configuration
from fiber_operator.lease_monitor import connected_in
from fiber_operator.process import OperatorProcess
from fiber_operator.settings import OperatorSettings
from fiber_operator.workqueue import Key

NAMESPACE = "team"
OWN_LEASE = names.operator_lease_name(OperatorSettings.lease)
POLL = 0.5
TEMPLATE = {"spec": {"containers": [{"name": "worker", "image": "registry/worker:1"}]}}


@functools.cache
def _any_authority() -> str:
    # Loading the system's authorities takes longer than a test.
    return make_certificates("any", "any").authority


def configuration(api: KubernetesApi) -> Configuration:
    """Return the address and credentials of the API."""
    return Configuration(host=api.url, ca_cert_data=_any_authority())


class Feed:
    """Feed in kopf's place: it reports every change to the program, as watches do."""

    def __init__(self, world: World, notice: Callable[..., None], **options: Any) -> None:
        self._world = world
        self._notice = notice
        self._renewed = options["renewed"]
        self._gate = options["gate"]
        self._on_start = options["on_start"]
        self._answered = options["answered"]
        self._namespaces = options["namespaces"]

    async def run(self) -> None:
        await self._gate()
        self._on_start(True)
        for where in [f" in {namespace}" for namespace in self._namespaces] or [""]:
            for plural in ("fiberpools", "leases"):
                self._answered(f"watch {plural}{where}", None)
        seen = 0
        while True:
            changes = self._world.store.changes
            for change in changes[seen:]:
                plural, namespace, name = change.place
                if self._world.deaf or namespace not in (self._namespaces or [namespace]):
                    continue
                metadata = change.object["metadata"]
                if plural == "fiberpools":
                    generation = -1 if change.type == "DELETED" else metadata["generation"]
                    self._notice(Key(namespace, name), metadata["uid"], generation)
                elif "fiber.dev/pool-uid" not in metadata.get("labels", {}):
                    continue
                elif plural == "leases":
                    gone = change.type == "DELETED"
                    version = "" if gone else metadata["resourceVersion"]
                    self._renewed(namespace, name, version, connected_in(change.object))
            seen = len(changes)
            await self._world.store.changed()


class _InMemory(Configuration):
    """Client configuration of the operator that needs no socket."""

    def __init__(self, connector: MemoryConnector) -> None:
        super().__init__(host="http://in.memory", ca_cert_data=_any_authority())
        self._connector = connector

    @property
    def client_session_kwargs(self) -> dict[str, Any]:
        return {"connector": self._connector, "trust_env": False}

    @client_session_kwargs.setter
    def client_session_kwargs(self, _: dict[str, Any]) -> None:
        """The operator's own leave the connector to the client."""


class World:
    """The cluster, and the operator that is in it now, if any."""

    def __init__(self, past: Store | None = None) -> None:
        clock = asyncio.get_running_loop().time
        self.store = Store(clock) if past is None else past.copy(clock)
        self.api = KubernetesApi(self.store)
        self.connector = MemoryConnector(self.api)
        self.kubelet = Kubelet(self.store)
        self.deaf = False
        """No event reaches the operator."""
        self.program: OperatorProcess
        self._task: asyncio.Task[None] | None = None
        self._nodes: asyncio.Task[None] | None = None
        self._stop = asyncio.Event()
        self._suffixes = iter(range(len(self.store.changes), 10**6))

    # -- The operator

    def start(self, **settings: Any) -> None:
        """Start an operator; the identity is that of a pod, so that a restart goes on at once."""
        defaults: dict[str, Any] = {
            "host": "127.0.0.1",
            "port": 0,
            "identity": "operator-1",
            "namespace": "fiber-system",
        }
        self._stop = asyncio.Event()
        self.program = self.another(**{**defaults, **settings})
        self._task = asyncio.ensure_future(self.program.run(self._stop))

    def another(self, **settings: Any) -> OperatorProcess:
        async def configure() -> Configuration:
            return _InMemory(self.connector)

        return OperatorProcess(
            OperatorSettings(**settings),
            configure=configure,
            watches=functools.partial(Feed, self),
            now=self.store.unix_now,
            draw=lambda: f"{next(self._suffixes):010x}",
        )

    async def stop(self) -> None:
        """End as with SIGTERM."""
        assert self._task is not None
        self._stop.set()
        await self._task
        self._task = None

    async def kill(self) -> None:
        """End as with SIGKILL: no call after this one."""
        assert self._task is not None
        self._task.cancel()
        await asyncio.wait([self._task])
        if not self._task.cancelled():
            self._task.result()
        self._task = None

    def crash(self) -> None:
        """Begin to end as with SIGKILL; ``kill`` waits for the end."""
        assert self._task is not None
        self._task.cancel()

    @property
    def live_at_most(self) -> int:
        """The largest number of pods that there ever were at one time, less those that end."""
        most = 0
        live: set[tuple[str, str, str]] = set()
        for change in self.store.changes:
            if change.place[0] == "pods":
                phase = change.object.get("status", {}).get("phase")
                ending = "deletionTimestamp" in change.object["metadata"]
                gone = change.type == "DELETED" or ending or phase in ("Failed", "Succeeded")
                (live.discard if gone else live.add)(change.place)
                most = max(most, len(live))
        return most

    @property
    def dead(self) -> bool:
        return self._task is None or self._task.done()

    # -- What nodes do

    def let_pods_linger(self, seconds: float) -> None:
        """From now on a deleted pod is there, terminating, for so long."""

        async def end() -> None:
            while True:
                for pod in self.store.list("pods"):
                    if "deletionTimestamp" in pod["metadata"]:
                        loop.call_later(seconds, self._remove, pod)
                await self.store.changed()

        loop = asyncio.get_running_loop()
        self.store.pods_linger = True
        self._nodes = asyncio.ensure_future(end())

    def _remove(self, pod: Body) -> None:
        metadata = pod["metadata"]
        with contextlib.suppress(Failure):
            there = self.store.get("pods", metadata["namespace"], metadata["name"])
            if there["metadata"]["uid"] == metadata["uid"]:
                self.store.remove("pods", metadata["namespace"], metadata["name"])

    # -- What users do

    def make_pool(self, name: str = "es", namespace: str = NAMESPACE, **spec: Any) -> Body:
        body = {"metadata": {"name": name}, "spec": {"template": TEMPLATE, **spec}}
        return self.store.create("fiberpools", namespace, body)

    def edit(self, name: str = "es", namespace: str = NAMESPACE, **spec: Any) -> Body:
        return self.store.merge("fiberpools", namespace, name, {"spec": spec})

    def status(self, name: str = "es", namespace: str = NAMESPACE) -> Body:
        body: Body = self.store.get("fiberpools", namespace, name).get("status", {})
        return body

    def reasons(self, name: str = "es") -> list[str]:
        return [problem["reason"] for problem in self.status(name).get("problems", [])]

    def pods(self, namespace: str = NAMESPACE) -> list[Body]:
        return self.store.list("pods", namespace)

    def names(self, namespace: str = NAMESPACE) -> list[str]:
        return [pod["metadata"]["name"] for pod in self.pods(namespace)]

    def created(self) -> list[str]:
        """Every pod that was ever created."""
        return self._changed("ADDED")

    def deleted(self) -> list[str]:
        """Every pod that was ever deleted."""
        return self._changed("DELETED")

    def _changed(self, how: str) -> list[str]:
        changes = (change for change in self.store.changes if change.type == how)
        return [change.place[2] for change in changes if change.place[0] == "pods"]

    def slow(self, verb: str, plural: str, seconds: float) -> Fault:
        """From now on such calls take so long."""
        fault = Fault(verb, plural, late=seconds, times=float("inf"))
        self.api.faults.append(fault)
        return fault

    # -- Waiting

    async def until(self, condition: Callable[[], bool], within: float = 300.0) -> float:
        """Wait until it holds; the seconds that took."""
        loop = asyncio.get_running_loop()
        started = loop.time()
        while not condition():
            if loop.time() - started > within:
                raise AssertionError(f"not so after {within} s: {self.api.calls[-10:]}")
            if self.dead and self._task is not None and not self._task.cancelled():
                self._task.result()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(POLL):
                    await self.store.changed()
        return loop.time() - started

    async def ready(self, pods: int, name: str = "es", within: float = 300.0) -> float:
        """Wait until the status says that so many are Ready and no other is there."""

        def settled() -> bool:
            status = self.status(name)
            return status.get("readyReplicas") == status.get("replicas") == pods

        return await self.until(settled, within)

    async def run_out_or(
        self, condition: Callable[[], bool], otherwise: Callable[[World], Awaitable[None]]
    ) -> None:
        """Wait until ``otherwise`` ends well, or the condition holds, whichever is first."""
        task = asyncio.ensure_future(otherwise(self))
        while not task.done() and not condition():
            await asyncio.wait([task], timeout=POLL)
        if condition():
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        else:
            await task

    async def until_settled(self, pods: int, name: str = "es") -> None:
        """``ready``, whichever operator is at work."""
        task, self._task = self._task, None
        try:
            await self.ready(pods, name)
        finally:
            self._task = task

    async def settled(self, seconds: float = 5.0) -> None:
        """Let that much time pass."""
        await asyncio.sleep(seconds)


@contextlib.asynccontextmanager
async def a_world(
    *, operator: bool = True, past: Store | None = None, **settings: Any
) -> AsyncIterator[World]:
    """``past``: the store that it begins with; else an empty one."""
    world = World(past)
    async with world.api.serving():
        if operator:
            world.start(**settings)
        try:
            yield world
        finally:
            if not world.dead:
                await world.kill()
            if world._nodes is not None:
                world._nodes.cancel()
            await world.connector.close()


Test = Callable[[World], Coroutine[Any, Any, None]]


def played(test: Test) -> Callable[[], None]:
    """Wrap the test for pytest: it gets a new world and virtual time."""

    async def main() -> None:
        async with a_world() as world:
            await test(world)

    return lambda: virtual_time.run(main())
