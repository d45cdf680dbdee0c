"""The cluster of the end-to-end tests: one that is given, or one that is brought up for them.

In this order:

1. the cluster that KUBECONFIG names;
2. kind, where it is installed and docker runs;
3. the project's own cluster (tests/cluster): Linux, root, Go;
4. none, and then the tests are skipped, or fail where CI=true.

A cluster that was up before stays up; one that was brought up for the tests is taken down.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NoReturn

import pytest

from cluster import (
    ability,
    build,
    control_plane,
    diagnosis,
    fake_nodes,
    faults,
    images,
    laptop,
    lifecycle,
    places,
)
from cluster.ability import Choice
from cluster.daemons import all_daemons
from cluster.filters import Allowed
from cluster.images import Image
from cluster.laptop import Laptop
from cluster.shell import ClusterError, output, wait_for
from patience import PATIENCE

NODES = 2


class NoCluster(Exception):
    """Lack of a cluster: the message gives the reason and the remedy."""


class Cluster:
    """A cluster with Fiber's images on its nodes, and the operations of tests on it.

    A test is skipped if it needs an operation that this kind of cluster does not have.
    """

    description: str
    kubeconfig: Path
    images: Mapping[str, str]
    """The reference of each of images.IMAGES, as a pod names it."""
    by_version: bool = False
    """True if its nodes have these images under the version too, as chart and manifests name
    it.
    """
    outside: str | None = None
    """Address at which pods reach a program that runs beside the tests; None if they cannot."""
    node_lost_after: float = 60
    """Seconds after which a silent node is surely NotReady."""

    def kubectl(self, *arguments: str, check: bool = True) -> str:
        """Return kubectl's output. Raises ClusterError with its error."""
        command = (find_program("kubectl"), "--kubeconfig", self.kubeconfig)
        return output(*command, *arguments, check=check, timeout=120)

    def workers(self) -> list[str]:
        """The nodes on which pods are put, by name."""
        nodes = json.loads(self.kubectl("get", "nodes", "--output", "json"))["items"]
        return sorted(node["metadata"]["name"] for node in nodes if _takes_pods(node["spec"]))

    @contextlib.contextmanager
    def cut_off(self, node: str) -> Iterator[None]:
        """No packet reaches the node or leaves it meanwhile; then it is Ready again."""
        with self._cut_off(node):
            yield
        self._wait_until_ready(node)

    def closed(self, node: str) -> AbstractContextManager[Callable[[Allowed], None]]:
        """Drop packets to the node's pods meanwhile; the pods reach only the allowed targets.

        Connections that there are go on.
        """
        self._skip(f"close the network of the pods on {node}")

    @contextlib.contextmanager
    def without_apiserver(self) -> Iterator[None]:
        """Stop the API server's answers meanwhile; then it is ready again."""
        with self._without_apiserver():
            yield
        self.kubectl("get", "--raw", "/readyz")

    def trouble(self) -> str:
        """Return what went wrong in the cluster by itself; empty if nothing did."""
        return ""

    def kill(self, pod: Mapping[str, Any], container: str) -> None:
        """SIGKILL to a container of the pod, which is a document of the API.

        A container's program may answer before the API server knows the container's id.
        """
        found: list[str] = []

        def has_id() -> bool:
            found[:] = self._container_ids(pod["metadata"], container)
            return bool(found)

        wait_for(f"the id of {container}", has_id, seconds=PATIENCE)
        self._kill(pod["spec"]["nodeName"], found[0].removeprefix("containerd://"))

    def _container_ids(self, metadata: Mapping[str, Any], container: str) -> list[str]:
        """Return the id of a pod's container; none before the API server knows it."""
        where = ("--namespace", metadata["namespace"], "--output", "json")
        pod = json.loads(self.kubectl("get", "pod", metadata["name"], *where))
        statuses = pod["status"].get("containerStatuses", [])
        ids = (each.get("containerID") for each in statuses if each["name"] == container)
        return list(filter(None, ids))

    def bring(self, image: Image) -> str:
        """Have one more image on the nodes, of those that few tests need; its reference."""
        raise NotImplementedError

    def having(self, reference: str) -> AbstractContextManager[None]:
        """Have an image of this machine's builder on the nodes meanwhile."""
        self._skip("load an image into the nodes")

    def laptop(self) -> AbstractContextManager[Laptop]:
        """Have a machine that reaches the API server, and that no pod reaches."""
        self._skip("put a laptop behind NAT")

    def fake_nodes(self, count: int) -> None:
        """Have this many nodes that only pretend to run pods."""
        self._skip(f"add {count} pretended nodes")

    def close(self) -> None:
        """Take it down, if it was brought up for the tests."""

    def _cut_off(self, node: str) -> AbstractContextManager[None]:
        self._skip(f"cut {node} off")

    def _without_apiserver(self) -> AbstractContextManager[None]:
        self._skip("stop the API server")

    def _kill(self, node: str, container_id: str) -> None:
        self._skip(f"kill a container on {node}")

    def _wait_until_ready(self, node: str) -> None:
        self.kubectl("wait", "--for=condition=Ready", f"node/{node}", "--timeout=90s")
        # Its taints go a moment later, and until then no pod is put there.
        wait_for(f"{node} without taints", lambda: node in self.workers(), seconds=30)

    def _skip(self, what: str) -> NoReturn:
        pytest.skip(f"{self.description}: cannot {what}; the cluster of tests/cluster can")


class Own(Cluster):
    """The project's own cluster."""

    by_version = True
    outside = places.HOST_IP
    node_lost_after = control_plane.NODE_LOST_AFTER + 10.0

    def __init__(self) -> None:
        self.description = "the cluster of tests/cluster"
        self.kubeconfig = places.KUBECONFIG
        self._was_up = lifecycle.find() is not None
        try:
            lifecycle.up(NODES)
            self.images = images.bring_images()
        except BaseException:
            self.close()
            raise

    def closed(self, node: str) -> AbstractContextManager[Callable[[Allowed], None]]:
        return faults.closed(node)

    def _cut_off(self, node: str) -> AbstractContextManager[None]:
        return faults.cut_off(node)

    def _kill(self, node: str, container_id: str) -> None:
        faults.kill_container(node, container_id)

    def _without_apiserver(self) -> AbstractContextManager[None]:
        return faults.stopped(faults.APISERVER)

    def trouble(self) -> str:
        return diagnosis.ends_meanwhile(all_daemons())

    def bring(self, image: Image) -> str:
        return images.bring(image)

    @contextlib.contextmanager
    def having(self, reference: str) -> Iterator[None]:
        with images.saved(reference) as archive:
            images.load(archive, reference)
        yield
        images.unload(reference)

    def laptop(self) -> AbstractContextManager[Laptop]:
        return laptop.plugged_in()

    def fake_nodes(self, count: int) -> None:
        fake_nodes.set_count(count)

    def close(self) -> None:
        if not self._was_up:
            lifecycle.down()


class Kind(Cluster):
    """Nodes in docker containers."""

    by_version = True

    def __init__(self, name: str, kubeconfig: Path, *, made: bool) -> None:
        self.description = f"the kind cluster {name}"
        self.kubeconfig = kubeconfig
        self._name = name
        self._made = made
        try:
            self.outside = _gateway()
            self.images = images.build_images()
            for image in images.IMAGES:
                self._load(image.archive)
                self._tag(self.images[image.name], image.released(places.CHECKOUT))
        except BaseException:
            self.close()
            raise

    def bring(self, image: Image) -> str:
        reference = images.build(image)
        self._load(image.archive)
        return reference

    @contextlib.contextmanager
    def having(self, reference: str) -> Iterator[None]:
        with images.saved(reference) as archive:
            self._load(archive)
        yield
        for node in self._nodes():
            remove = ("images", "rm", "--sync", images.full_name(reference))
            self._inside(node, "ctr", "--namespace", "k8s.io", *remove)

    @classmethod
    def make(cls, name: str = "fiber-e2e") -> Kind:
        """Use the kind cluster of this name; make it where there is none."""
        kubeconfig = images.FOLDER.parent / f"{name}.kubeconfig"
        kubeconfig.parent.mkdir(parents=True, exist_ok=True)
        named = ("--name", name, "--kubeconfig", kubeconfig)  # not the user's own kubeconfig
        made = name not in output("kind", "get", "clusters").split()
        if made:
            config = Path(__file__).with_name("kind.yaml")
            output("kind", "create", "cluster", *named, "--config", config, "--wait", "180s")
        else:
            output("kind", "export", "kubeconfig", *named)
        return cls(name, kubeconfig, made=made)

    @contextlib.contextmanager
    def _cut_off(self, node: str) -> Iterator[None]:
        # Rules and not `docker network disconnect`, after which the node has another address.
        rules = [("INPUT", "-i"), ("OUTPUT", "-o"), ("FORWARD", "-i"), ("FORWARD", "-o")]
        with contextlib.ExitStack() as undo:
            for chain, direction in rules:
                rule = (chain, direction, "eth0", "-j", "DROP")
                self._inside(node, "iptables", "--wait", "-I", *rule)
                undo.callback(self._inside, node, "iptables", "--wait", "-D", *rule)
            yield

    @contextlib.contextmanager
    def _without_apiserver(self) -> Iterator[None]:
        node = f"{self._name}-control-plane"
        output("docker", "pause", node)
        try:
            yield
        finally:
            output("docker", "unpause", node)

    def close(self) -> None:
        if self._made:
            output("kind", "delete", "cluster", "--name", self._name)

    def _kill(self, node: str, container_id: str) -> None:
        kill = ("tasks", "kill", "--signal", "SIGKILL", container_id)
        self._inside(node, "ctr", "--namespace", "k8s.io", *kill)

    def _load(self, archive: Path) -> None:
        output("kind", "load", "image-archive", archive, "--name", self._name)

    def _tag(self, reference: str, other: str) -> None:
        names = map(images.full_name, (reference, other))
        tag = ("ctr", "--namespace", "k8s.io", "images", "tag", "--force", *names)
        for node in self._nodes():
            self._inside(node, *tag)

    def _nodes(self) -> list[str]:
        return output("kind", "get", "nodes", "--name", self._name).split()

    @staticmethod
    def _inside(node: str, *command: str) -> None:
        output("docker", "exec", node, *command)


class Given(Cluster):
    """Cluster of the user, from which the tests remove everything that they installed."""

    def __init__(self, kubeconfig: Path, environment: Mapping[str, str]) -> None:
        self.description = f"the cluster of {kubeconfig}"
        self.kubeconfig = kubeconfig
        self.outside = environment.get("FIBER_E2E_OUTSIDE_ADDRESS")
        self.images = _given_images(environment)
        self._environment = environment

    def bring(self, image: Image) -> str:
        variable = _variable(image.name)
        return self._environment.get(variable) or self._skip(
            f"have {image.dockerfile} built unless {variable} names the image"
        )


def choose(environment: Mapping[str, str] = os.environ) -> Cluster:
    """The cluster to test on. Raises NoCluster where there is none."""
    choice, reasons = ability.choose(environment)
    match choice:
        case Choice.GIVEN:
            return _given(Path(environment["KUBECONFIG"]), environment)
        case Choice.KIND:
            return Kind.make()
        case Choice.OWN:
            return Own()
    raise NoCluster(
        f"there is no Kubernetes cluster to test on. {'. '.join(reasons)}. Set KUBECONFIG to a "
        "cluster that may be used, or run this where docker and kind are, or as root on Linux "
        "with Go"
    )


def _given(kubeconfig: Path, environment: Mapping[str, str]) -> Cluster:
    if not kubeconfig.is_file():
        raise ClusterError(
            f"KUBECONFIG is {kubeconfig}, and there is no such file: unset or mend it"
        )
    if kubeconfig == places.KUBECONFIG:
        return Own()
    command = (find_program("kubectl"), "--kubeconfig", kubeconfig)
    output(*command, "get", "--raw", "/readyz", timeout=30)
    context = output(*command, "config", "current-context").strip()
    if context.startswith("kind-") and not ability.kind_lacks():
        return Kind(context.removeprefix("kind-"), kubeconfig, made=False)
    return Given(kubeconfig, environment)


def _given_images(environment: Mapping[str, str]) -> dict[str, str]:
    names = {image.name: _variable(image.name) for image in images.IMAGES}
    missing = [variable for variable in names.values() if not environment.get(variable)]
    if missing:
        raise ClusterError(
            f"{' and '.join(missing)} must name images that the cluster of KUBECONFIG can pull, "
            "since tests cannot bring them to its nodes: build them (make images), push them to a "
            "registry, and set the variables"
        )
    return {name: environment[variable] for name, variable in names.items()}


def _variable(image: str) -> str:
    """fiber-worker-rl: FIBER_E2E_WORKER_RL_IMAGE."""
    return f"FIBER_E2E_{image.removeprefix('fiber-').replace('-', '_').upper()}_IMAGE"


def _takes_pods(node: Mapping[str, Any]) -> bool:
    """Return whether pods may be put on a node; the taint of a cordoned one comes and goes late."""
    taints = {taint["key"] for taint in node.get("taints", [])}
    return not node.get("unschedulable") and taints <= {"node.kubernetes.io/unschedulable"}


def _gateway() -> str:
    """The host's address in the network of kind's nodes."""
    template = "{{range .IPAM.Config}}{{.Gateway}} {{end}}"
    addresses = output("docker", "network", "inspect", "kind", "--format", template).split()
    return next(address for address in addresses if "." in address)


def find_program(name: str) -> str:
    """kubectl or helm: the one on the PATH, else the one that was built for the test cluster."""
    if found := shutil.which(name) or shutil.which(name, path=places.programs()):
        return found
    build.build(["helm" if name == "helm" else "kubernetes"])
    return places.program(name)
