"""Mistakes that a user or an administrator can make, and the words by which doctor names them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from fakes.doctor_cluster import RESOURCES, DoctorCluster
from fakes.kubernetes_api import Fault
from fiber._backends.kubernetes import published
from fiber._backends.kubernetes.problems import AgentRoute, PoolName, failure, unreachable
from fiber._cli.doctor_attempt import TrialCourse, mismatch_in
from fiber._cli.doctor_trial_verdicts import Program
from fiber._transport.authentication import Identity, version_mismatch
from fiber.errors import FiberPoolError, VersionMismatch
from fiber_api import names
from fiber_api.names import Reason
from unit.kubernetes_rig import NAMESPACE, OTHER, pool_body

ANSWER = {
    "python": "3.11.2",
    "fiber": Program("", "").fiber,
    "packages": ["fiberpool", "NumPy", "ruamel.yaml"],
}
SIDES = {"ours": "3.99.1", "theirs": "3.11.7", "peer": "laptop-7"}
POOL = PoolName("doctor-trial-1", NAMESPACE)


class DoctorRig:
    """Cluster, environment and trial of a test."""

    def __init__(
        self, cluster: DoctorCluster, folder: Path, patch: pytest.MonkeyPatch, url: str
    ) -> None:
        self.cluster = cluster
        self.folder = folder
        self.patch = patch
        self.url = url
        self.course = TrialCourse({"pool": 0.5, "task": 2.0}, ANSWER)
        self.trials = 0

    def attempt(self, *_: Any) -> TrialCourse:
        self.trials += 1
        return self.course

    def unpublish(self) -> None:
        """Make this Fiber a development build."""
        self.patch.setattr(published, "REGISTRY", "")

    def setenv(self, name: str, value: object) -> None:
        self.patch.setenv(f"FIBER_{name}", str(value))

    def template(self, **container: Any) -> None:
        """Configure a pod template whose worker has these fields."""
        worker = {"name": names.WORKER_CONTAINER, **container}
        file = self.folder / "template.json"
        file.write_text(json.dumps({"spec": {"containers": [worker]}}))
        self.setenv("TEMPLATE", file)

    def warm(self, **spec: Any) -> None:
        """Configure the FiberPool warm, which exists."""
        body = pool_body("warm")
        body["spec"] |= spec
        self.cluster.add(names.PLURAL, body)
        self.setenv("POOL", "warm")

    def problem(self, reason: Reason, message: str) -> None:
        """Let the trial end with a problem of its FiberPool, as the SDK reports it."""
        problem = {"reason": reason, "message": message, "severity": "Error", "terminal": True}
        error = failure(POOL, {"problems": [problem]}, 0)
        assert error is not None
        self.fails(error)

    def fails(self, error: FiberPoolError) -> None:
        said = {"kind": "FiberPoolError", "reason": error.reason, "message": str(error)}
        self.course = TrialCourse({"pool": 0.5}, error=said)


class Mistake(NamedTuple):
    """Mistake that is forced, and the words that must name it."""

    name: str
    force: Callable[[DoctorRig], object]
    check: str
    what: str
    do: str = ""
    words: tuple[str, ...] = ()


def _no_kubeconfig(rig: DoctorRig) -> None:
    rig.patch.setenv("KUBECONFIG", str(rig.folder / "nowhere"))


def _broken_kubeconfig(rig: DoctorRig) -> None:
    (rig.folder / "kubeconfig").write_text("{")


def _in_a_pod_without_account(rig: DoctorRig) -> None:
    rig.patch.delenv("KUBECONFIG")
    rig.patch.setenv("KUBERNETES_SERVICE_HOST", "10.96.0.1")


def _no_package(rig: DoctorRig) -> None:
    rig.patch.setitem(sys.modules, "kubernetes", None)


def _no_definition(rig: DoctorRig) -> None:
    rig.cluster.api.documents[RESOURCES] = None
    rig.cluster.api.faults.append(
        Fault(plural=names.PLURAL, status=404, text="404 page not found", times=9)
    )


def _quota(**hard: str) -> Callable[[DoctorRig], None]:
    spec = {"hard": {key.replace("_", "."): value for key, value in hard.items()}}

    def force(rig: DoctorRig) -> None:
        rig.cluster.add("resourcequotas", {"metadata": {"name": "team"}, "spec": spec})

    return force


def _range(**item: Any) -> Callable[[DoctorRig], None]:
    body = {"metadata": {"name": "small"}, "spec": {"limits": [{"type": "Container", **item}]}}
    return lambda rig: rig.cluster.add("limitranges", body)


def _no_room(rig: DoctorRig) -> None:
    requests = {"containers": [{"name": "a", "resources": {"requests": {"memory": "8190Mi"}}}]}
    body = {"metadata": {"name": "big"}, "spec": {"nodeName": "node-1", **requests}}
    rig.cluster.add("pods", body, "other")


def _gpu(rig: DoctorRig) -> None:
    rig.template(resources={"limits": {"nvidia.com/gpu": "1"}})


def _taint(rig: DoctorRig) -> None:
    rig.cluster.set_node(spec={"taints": [{"key": "team", "value": "a", "effect": "NoSchedule"}]})


def _refused(**theirs: Any) -> Callable[[DoctorRig], None]:
    """Let the program refuse an agent with another version."""
    here = Identity.of_this_process("")
    error = version_mismatch(here, replace(here, name="doctor-trial-1-a", **theirs))
    line = f"[fiber] an agent was refused: 10.0.0.7: {error}"
    return lambda rig: setattr(rig, "course", TrialCourse(refusal=mismatch_in(line)))


def _cut_off(relay: str) -> Callable[[DoctorRig], None]:
    route = AgentRoute(f"the relay {relay}" if relay else "192.168.1.7:4711", relay=relay)
    status = {"replicas": 1, "pendingReplicas": 0}
    return lambda rig: rig.fails(unreachable(POOL, status, 68.0, route))


def _no_namespace_and_no_right_to_see(rig: DoctorRig) -> None:
    rig.cluster.remove("namespaces", NAMESPACE)
    rig.cluster.forbid_all("namespaces")
    rig.fails(POOL.error('namespaces "lab" not found', "NamespaceNotFound"))


def _fails(reason: Reason, message: str) -> Callable[[DoctorRig], None]:
    return lambda rig: rig.problem(reason, message)


def _ends(reason: Reason, message: str) -> Callable[[DoctorRig], None]:
    """Let the trial be ended because of a problem that does not end by waiting."""
    interrupted = {"kind": "KeyboardInterrupt", "reason": "", "message": "KeyboardInterrupt"}
    problem = {"reason": reason, "message": message}

    def force(rig: DoctorRig) -> None:
        rig.course = TrialCourse(error=interrupted, problem=problem)

    return force


MISTAKES = [
    Mistake("no kubeconfig", _no_kubeconfig, "kubeconfig", "no kubeconfig", "KUBECONFIG"),
    Mistake("broken kubeconfig", _broken_kubeconfig, "kubeconfig", "cannot be used", "config view"),
    Mistake("no account", _in_a_pod_without_account, "kubeconfig", "no account", "fiber-user"),
    Mistake("no package", _no_package, "kubeconfig", "package is missing", "pip install"),
    Mistake(
        "wrong context",
        lambda rig: None,
        "kubeconfig",
        "no context 'there'",
        "get-contexts",
        ("--context", "there"),
    ),
    Mistake(
        "wrong key",
        lambda rig: rig.setenv("IMAGES", "a"),
        "kubeconfig",
        "configuration cannot be read",
        "correct the named key",
    ),
    Mistake(
        "server is silent",
        lambda rig: setattr(rig.cluster.api, "down", True),
        "API server",
        "does not answer",
        "VPN",
    ),
    Mistake(
        "no API server there",
        lambda rig: rig.cluster.api.documents.update({"/version": None}),
        "API server",
        "no API server",
        "address",
    ),
    Mistake(
        "expired login",
        lambda rig: setattr(rig.cluster.api, "accepts", set()),
        "API server",
        "login is not accepted",
        "log in again",
    ),
    Mistake(
        "slow clock", lambda rig: rig.cluster.set_clock(900.0), "clock", "behind", "timedatectl"
    ),
    Mistake(
        "fast clock", lambda rig: rig.cluster.set_clock(-900.0), "clock", "ahead", "timedatectl"
    ),
    Mistake(
        "no namespace",
        lambda rig: rig.cluster.remove("namespaces", NAMESPACE),
        "namespace",
        "no namespace 'lab'",
        "kubectl create namespace lab",
    ),
    Mistake("no CRD", _no_definition, "FiberPools", "knows no FiberPools", "helm install"),
    Mistake(
        "old CRD",
        lambda rig: rig.cluster.drop_field("relay"),
        "FiberPools",
        "lacks spec.relay",
        "helm upgrade",
    ),
    Mistake(
        "no operator",
        lambda rig: rig.cluster.end_operator(),
        "operator",
        "no operator serves",
        "the chart's value namespaces",
    ),
    Mistake(
        "stale Lease",
        lambda rig: rig.cluster.stop_operator(),
        "operator",
        "does not run any more",
        "log of its pod",
    ),
    Mistake(
        "bad template",
        lambda rig: rig.setenv("TEMPLATE", rig.folder / "none.yaml"),
        "image",
        "template cannot be made",
        "template",
    ),
    Mistake("full quota", _quota(pods="0"), "quota", "quota refuses", "larger quota"),
    Mistake("quota of limits", _quota(limits_cpu="4"), "quota", "quota refuses", "cpu_request"),
    Mistake(
        "quota of memory", _quota(requests_memory="32Mi"), "quota", "quota refuses", "larger quota"
    ),
    Mistake("LimitRange", _range(max={"memory": "32Mi"}), "quota", "LimitRange", "memory_request"),
    Mistake("minimum", _range(min={"cpu": "500m"}), "quota", "LimitRange", "cpu_request"),
    Mistake(
        "default limit", _range(default={"memory": "32Mi"}), "quota", "LimitRange", "memory_request"
    ),
    Mistake("image not set", DoctorRig.unpublish, "image", "no image for workers", "FIBER_IMAGE"),
    Mistake("no room", _no_room, "nodes", "no node has room", "add nodes"),
    Mistake("taint", _taint, "nodes", "no node has room", "tolerations"),
    Mistake(
        "node selector",
        lambda rig: rig.setenv("NODE_SELECTOR", "disk=ssd"),
        "nodes",
        "no node has room",
        "node_selector",
    ),
    Mistake("no GPU", _gpu, "nodes", "no node has a GPU", "device plugin"),
    Mistake(
        "pool of another",
        lambda rig: rig.warm(master=OTHER.spec("warm", 3)),
        "warm pools",
        "another program uses",
        "wait",
    ),
    Mistake(
        "suspended pool", lambda rig: rig.warm(suspend=True), "warm pools", "suspended", "resume"
    ),
    Mistake(
        "no such pool",
        lambda rig: rig.setenv("POOL", "warm"),
        "warm pools",
        "no FiberPool 'warm'",
        "fiber pool warm warm",
    ),
    Mistake(
        "no image",
        _fails(Reason.IMAGE_PULL_ERROR, "doctor-trial-1-a cannot get its image: not found."),
        "trial",
        "cannot pull the image 'mine:1'",
        "registry",
        ("--image", "mine:1"),
    ),
    Mistake(
        "image without Fiber",
        _ends(
            Reason.CONTAINER_FAILED, "Its last lines:\nModuleNotFoundError: No module named 'fiber'"
        ),
        "trial",
        "'mine:1' lacks Fiber",
        "fiber image build",
        ("--image", "mine:1"),
    ),
    Mistake(
        "image without Python",
        _fails(Reason.BACKOFF_LIMIT_EXCEEDED, 'exec: "python": executable file not found in $PATH'),
        "trial",
        "lacks Fiber, or Python",
        "fiber image build",
    ),
    Mistake(
        "image that crashes",
        _ends(Reason.CONTAINER_FAILED, "exited with code 139"),
        "trial",
        "ends at once",
        "kubectl logs",
    ),
    Mistake(
        "image of root",
        _fails(Reason.CONTAINER_CONFIG_ERROR, "container has runAsNonRoot and image runs as root"),
        "trial",
        "runs as root",
        "USER",
    ),
    Mistake(
        "other Python", _refused(python="3.99.1"), "trial", "another Python", "fiber image build"
    ),
    Mistake("other Fiber", _refused(protocol=0), "trial", "another Fiber", "fiber image"),
    Mistake(
        "agent that ends because of another Python",
        _ends(Reason.CONTAINER_FAILED, f"Its last lines:\n{VersionMismatch('Python', **SIDES)}"),
        "trial",
        "another Python",
        "fiber image build",
    ),
    Mistake("NetworkPolicy", _cut_off("a-relay"), "trial", "nor its relay", "NetworkPolicy"),
    Mistake("no relay wanted", _cut_off(""), "trial", "do not reach this program", "FIBER_RELAY"),
    Mistake(
        "pod security",
        _fails(Reason.FORBIDDEN, 'violates PodSecurity "restricted:latest": runAsUser=0'),
        "trial",
        "pod security",
        "securityContext",
    ),
    Mistake(
        "policy",
        _fails(Reason.FORBIDDEN, "a webhook denied the request"),
        "trial",
        "refuses the trial",
    ),
    Mistake(
        "hidden quota",
        _fails(Reason.QUOTA_EXCEEDED, "exceeded quota: team"),
        "trial",
        "a quota of the namespace",
        "larger quota",
    ),
    Mistake(
        "no node takes it",
        _fails(Reason.UNSCHEDULABLE, "No node takes it: 0/3 nodes are available"),
        "trial",
        "no node takes",
        "add nodes",
    ),
    Mistake(
        "hidden namespace",
        _no_namespace_and_no_right_to_see,
        "trial",
        "no namespace 'lab'",
        "kubectl create namespace lab",
    ),
    Mistake(
        "pool taken meanwhile",
        lambda rig: rig.fails(POOL.error("is in use: its master is laptop-8", "InUse")),
        "trial",
        "another program uses",
        "wait for the end",
    ),
    Mistake(
        "no answer of the trial",
        lambda rig: setattr(rig, "course", TrialCourse(said=["Segmentation fault"])),
        "trial",
        "no worker ran the task",
        "kubectl describe",
    ),
]
