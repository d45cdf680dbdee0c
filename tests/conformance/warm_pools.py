"""The pods of a run with the backend kubernetes: FiberPools that are there before the tests.

A pool has one master at a time, so there is one for each interpreter that runs at a time.  They are
made in the cluster that KUBECONFIG names, with FIBER_IMAGE in FIBER_NAMESPACE; without KUBECONFIG
in a cluster that is played in this process, whose nodes run real agents as processes of this
machine.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import queue
import secrets
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fakes.cluster import FakeCluster, fake_cluster
from fiber import config
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.template import PodShape, fiber_pool_body, pod_template
from fiber_api import names
from fiber_api.rest import POOLS, NotFound
from unit.kubernetes_rig import kubeconfig

PODS = 4  # agents of each pool
PROCESSES = 16  # processes of each pod: no test waits for room
READY = 180.0  # seconds until all pods of a pool are there: an image may have to be pulled
_LOOK = 0.05  # seconds between two looks at a pool
_SUPPORT = ("__init__.py", "_test_multiprocessing.py", "support", "test_concurrent_futures*")


@contextmanager
def warm_pools(count: int, variables: Mapping[str, str]) -> Iterator[WarmPools]:
    """So many, for interpreters with these `variables`; they go at the end."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="conformance-")))
        path = os.pathsep.join([variables["PYTHONPATH"], str(_cpython_tests(folder / "testsuite"))])
        given = {"PYTHONPATH": path}
        cluster = None
        if not os.environ.get("KUBECONFIG"):
            cluster = stack.enter_context(fake_cluster())
            given["KUBECONFIG"] = str(kubeconfig(folder, cluster.url))
        with _environment(given):
            api = Api.connect(config.load({}).context)
        stack.callback(api.close)
        told = {key: value for key, value in variables.items() if key.startswith("MP_")}
        pools = WarmPools(api, given, told, cluster)
        stack.callback(pools.close)
        pools.fill(count)
        yield pools


@dataclass(frozen=True)
class _Pool:
    name: str
    port: socket.socket | None
    """Port where its masters listen, one after the other, if no Service leads to them."""

    @property
    def address(self) -> str:
        assert self.port is not None
        return names.address_of("127.0.0.1", self.port.getsockname()[1])


class WarmPools:
    """Pools of one run."""

    def __init__(
        self,
        api: Api,
        given: Mapping[str, str],
        told: Mapping[str, str],
        played: FakeCluster | None,
    ) -> None:
        """`given` is for interpreters that run tests, `told` for their children."""
        self._api = api
        self._given = given
        self._told = told
        self._played = played
        self._config = config.load({"processes_per_pod": PROCESSES})
        self._namespace = self._config.namespace or api.namespace
        self._names = (f"conformance-{secrets.token_hex(4)}-{n}" for n in itertools.count())
        self._free: queue.SimpleQueue[_Pool] = queue.SimpleQueue()
        self._made: list[_Pool] = []

    def fill(self, count: int) -> None:
        """Have so many to lend."""
        for pool in [self._make() for _ in range(count)]:
            self._wait_for_pods(pool)
            self._free.put(pool)

    @contextmanager
    def lend(self) -> Iterator[Mapping[str, str]]:
        """Yield the environment that gives an interpreter one of the pools."""
        pool = self._free.get()
        given = {**self._given, "FIBER_POOL": pool.name, "FIBER_NAMESPACE": self._namespace}
        if pool.port is not None:
            given["FIBER_LISTEN_HOST"] = "0.0.0.0"
            given["FIBER_LISTEN_PORT"] = str(pool.port.getsockname()[1])
        try:
            yield given
        finally:
            if self._read(pool)["spec"].get("master"):
                # The interpreter was killed: until its Lease ends, no other one gets the pool.
                self._delete(pool)
                self.fill(1)
            else:
                self._free.put(pool)

    def close(self) -> None:
        """Delete them all."""
        for pool in list(self._made):
            self._delete(pool)

    def _make(self) -> _Pool:
        template = pod_template(PodShape.of(self._config), None, "")
        worker = next(
            container
            for container in template["spec"]["containers"]
            if container["name"] == names.WORKER_CONTAINER
        )
        worker.setdefault("env", []).extend(
            {"name": name, "value": value} for name, value in self._told.items()
        )
        pool = _Pool(next(self._names), None if self._played is None else _reserved_port())
        if self._played is not None:
            self._played.do(self._played.nodes.services.__setitem__, pool.name, pool.address)
        body = fiber_pool_body(pool.name, template, self._config)
        body["spec"] |= {"replicas": PODS, "minReplicas": PODS, "maxReplicas": PODS}
        self._made.append(pool)
        self._api.create(POOLS.path(self._namespace), body, strict=True)
        return pool

    def _read(self, pool: _Pool) -> dict[str, Any]:
        return self._api.get(POOLS.path(self._namespace, pool.name))

    def _wait_for_pods(self, pool: _Pool) -> None:
        deadline = time.monotonic() + READY
        while (status := self._read(pool).get("status", {})).get("readyReplicas", 0) < PODS:
            if time.monotonic() > deadline:
                raise TimeoutError(
                    f"the {PODS} pods of the FiberPool {pool.name} are not there after {READY:g} "
                    f"s: {status}"
                )
            time.sleep(_LOOK)

    def _delete(self, pool: _Pool) -> None:
        self._made.remove(pool)
        try:
            self._api.delete(POOLS.path(self._namespace, pool.name))
        except NotFound:
            pass  # another process deleted it
        if pool.port is not None:
            pool.port.close()


def _reserved_port() -> socket.socket:
    """A port that the kernel gives to no process, but on which one that names it can listen."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind(("", 0))
    return sock


def _cpython_tests(folder: Path) -> Path:
    """A folder with what children import of CPython's tests: images are mostly without them, so
    they travel with the program.
    """
    spec = importlib.util.find_spec("test")
    assert spec is not None
    assert spec.origin is not None
    (folder / "test").mkdir(parents=True)
    tests = Path(spec.origin).parent
    for source in itertools.chain.from_iterable(map(tests.glob, _SUPPORT)):
        copy = folder / "test" / source.name
        if source.is_dir():
            shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, copy)
    return folder


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
