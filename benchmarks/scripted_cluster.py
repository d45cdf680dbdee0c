"""Scripted cluster: an API server, pods that come at once, and fake agents in them.

    python -m benchmarks.scripted_cluster AGENTS       (PYTHONPATH=tests)

It prints the URL of the API server. Each FiberPool gets the pods that it wants, in as many steps as
on a real cluster, and loses those that it names. The agents, which are those of `agent_host`, dial
once so many pods run. For each line on standard input it prints, as JSON, the requests of clients
until then. It ends at the end of standard input.
"""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from aiohttp import web
from benchmarks.agent_host import Order
from benchmarks.fake_cluster import Host, agent_hosts

from fakes.kubernetes_api import KubernetesApi
from fakes.store import Store
from fiber._transport.credentials import Credentials
from fiber_api import identity, names

Body = dict[str, Any]

_BATCH, _PAUSE = 50, 0.02
"""Number of pods that take a step together, and seconds until the next so many do."""

_STATUS = 0.2
"""Seconds from one status of a pool to the next, while its pods change."""

_DIALS = 120.0

_MANAGED: Body = {"f:metadata": {f"f:field-{n}": {f"k:{n}": {}} for n in range(60)}}
"""Bytes that an API server's managedFields and defaults add to a pod."""


class CountingApi(KubernetesApi):
    """Counter of calls, and of the bytes of patches and lists."""

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self.requests: Counter[str] = Counter()
        self.largest: Counter[str] = Counter()
        """Bytes of the largest body, by kind of request."""

    async def _serve(self, request: web.Request) -> web.StreamResponse:
        response = await super()._serve(request)
        call = self.calls[-1] if self.calls else None
        what = f"{request.method} {request.path.split('/')[-2]}"
        if call is not None:
            self.requests[what] += 1
            self.largest[what] = max(self.largest[what], request.content_length or 0)
        return response


class Pool:
    """Script for one FiberPool: what an operator, a scheduler and kubelets would do."""

    def __init__(self, store: Store, body: Body, hosts: Sequence[Host], agents: int) -> None:
        self._store = store
        self._agents = agents
        self._metadata = body["metadata"]
        self._hosts = hosts
        self._numbers = itertools.count()
        self._running: list[str] = []
        self._told = 0.0

    async def follow(self) -> None:
        """Run until the pool is gone."""
        while (body := self._body()) is not None:
            spec, pods = body["spec"], self._pods()
            release = set(spec.get("scaleDown", {}).get("release", ())) & pods.keys()
            for name in sorted(release):
                self._store.remove("pods", self._metadata["namespace"], name)
            lacking = spec.get("replicas", 0) - len(pods) + len(release)
            self._say_status(body)
            if "master" in spec and lacking > 0 and self._secret(spec) is not None:
                await self._grow(body, lacking)
            else:
                await self._store.changed()

    async def _grow(self, body: Body, lacking: int) -> None:
        made = [f"{self._metadata['name']}-{next(self._numbers)}" for _ in range(lacking)]
        await self._step(made, lambda name: self._store.create("pods", *self._new_pod(body, name)))
        await self._step(made, lambda name: self._set(name, "Pending", node="node-1"))
        await self._step(made, lambda name: self._set(name, "Pending", ip="10.1.2.3"))
        await self._step(made, lambda name: self._set(name, "Running", ready=True))
        if len(self._running) == self._agents:
            self._dial(body)

    async def _step(self, made: list[str], take: Any) -> None:
        for start in range(0, len(made), _BATCH):
            for name in made[start : start + _BATCH]:
                take(name)
            body = self._body()
            if body is None:
                return
            self._say_status(body)
            await asyncio.sleep(_PAUSE)

    def _dial(self, body: Body) -> None:
        """Start the agents of all pods."""
        secret, master = self._secret(body["spec"]), body["spec"]["master"]
        assert secret is not None
        key = identity.key_in(secret["data"])
        pin = base64.b64decode(secret["data"][names.KEY_MASTER]).decode()
        address = names.address_of(master["host"], master["port"])
        for number, host in enumerate(self._hosts):
            mine = self._running[number :: len(self._hosts)]
            share = [asdict(agent) for agent in self._agents_of(key, pin, mine)]
            assert host.stdin is not None
            host.stdin.write(Order(address, share, _DIALS).to_line())
            host.stdin.flush()

    def _agents_of(self, key: str, pin: str, pods: list[str]) -> list[Credentials]:
        """Return what the init container of each pod writes."""
        uids = {name: pod["metadata"]["uid"] for name, pod in self._pods().items()}
        return [
            Credentials(name, uids[name], identity.agent_key(key, name, uids[name]), pin)
            for name in pods
        ]

    def _new_pod(self, body: Body, name: str) -> tuple[str, Body]:
        labels = {
            names.LABEL_POOL: self._metadata["name"],
            names.LABEL_POOL_UID: self._metadata["uid"],
        }
        owner = {"kind": names.KIND, "name": self._metadata["name"], "uid": self._metadata["uid"]}
        metadata = {
            "name": name,
            "labels": labels,
            "ownerReferences": [owner],
            "managedFields": [_MANAGED],
        }
        spec = json.loads(json.dumps(body["spec"]["template"]["spec"]))
        return self._metadata["namespace"], {"metadata": metadata, "spec": spec}

    def _set(
        self, name: str, phase: str, node: str = "", ip: str = "", ready: bool = False
    ) -> None:
        namespace = self._metadata["namespace"]
        if node:
            self._store.merge("pods", namespace, name, {"spec": {"nodeName": node}})
        container = {"name": names.WORKER_CONTAINER, "ready": ready, "restartCount": 0}
        status = {"phase": phase, "podIP": ip, "containerStatuses": [container]}
        self._store.set_status("pods", namespace, name, status)
        if ready:
            self._running.append(name)

    def _say_status(self, body: Body) -> None:
        now, generation = time.monotonic(), body["metadata"]["generation"]
        seen = body.get("status", {}).get("observedGeneration")
        if seen == generation and now < self._told + _STATUS:
            return
        self._told = now
        there = len(self._pods())
        status = {
            "observedGeneration": generation,
            "masterEpoch": body["spec"].get("master", {}).get("epoch", 0),
            "desiredReplicas": body["spec"].get("replicas", 0),
            "replicas": there,
            "readyReplicas": min(len(self._running), there),
            "pendingReplicas": max(there - len(self._running), 0),
        }
        self._store.set_status(
            names.PLURAL, self._metadata["namespace"], self._metadata["name"], status
        )

    def _body(self) -> Body | None:
        found = self._store.list(names.PLURAL, self._metadata["namespace"])
        return next((b for b in found if b["metadata"]["uid"] == self._metadata["uid"]), None)

    def _pods(self) -> dict[str, Body]:
        selector = f"{names.LABEL_POOL_UID}={self._metadata['uid']}"
        pods = self._store.list("pods", self._metadata["namespace"], selector)
        return {pod["metadata"]["name"]: pod for pod in pods}

    def _secret(self, spec: Body) -> Body | None:
        wanted = spec.get("credentialsSecretName")
        found = self._store.list("secrets", self._metadata["namespace"])
        return next((s for s in found if s["metadata"]["name"] == wanted), None)


async def _watch_over(host: Host) -> None:
    """Say why a process of agents has ended, if one does."""
    assert host.stdout is not None
    words = await asyncio.to_thread(host.stdout.read)
    print(f"agents ended: {words.strip() or 'without a word'}", file=sys.stderr, flush=True)


async def main(agents: int) -> None:
    """Play the cluster."""
    store = Store(time.monotonic)
    api = CountingApi(store)
    tasks = []
    with agent_hosts() as hosts:

        def created(plural: str, body: Body) -> None:
            if plural == names.PLURAL:
                tasks.append(asyncio.ensure_future(Pool(store, body, hosts, agents).follow()))

        store.created = created
        tasks += [asyncio.ensure_future(_watch_over(host)) for host in hosts]
        async with api.serving():
            print(api.url, flush=True)
            while await asyncio.to_thread(sys.stdin.readline):
                told = {
                    "pods": len(store.list("pods")),
                    "requests": dict(api.requests),
                    "largest": dict(api.largest),
                }
                print(json.dumps(told), flush=True)
            for task in tasks:
                task.cancel()


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1])))
