"""The operator as people install it: a release of the chart."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from e2e.clusters import find_program
from e2e.kube import Body, Failed, Kube, Refused, path_of, run
from e2e.pools import is_ready
from e2e.scene import Scene
from fiber_api import names

CHART = Path(__file__).resolve().parents[2] / "charts" / "fiber-operator"
LEASE_SECONDS = 6
"""Shortest possible Lease: the successor of a killed operator waits for it."""

Values = Mapping[str, Any]
_CALLS = "fiber_operator_api_requests_total"
_SAMPLE = re.compile(r"^(\w+)(?:\{(.*)\})? (\S+)$", re.MULTILINE)
_LABEL = re.compile(r'(\w+)="([^"]*)"')


class Release:
    """Release of the chart."""

    def __init__(
        self, kube: Kube, name: str, namespace: str, images: Mapping[str, str], home: Path
    ) -> None:
        self.name = name
        self.namespace = namespace
        self._kube = kube
        self._home = home
        self.refused: set[tuple[str, str]] = set()
        """Verb and resource of calls that were forbidden to the operators so far."""
        self._helm = find_program("helm")
        self._values = {
            "image": _image(images["fiber-operator"]),
            "workerImage": _image(images["fiber-worker"]),
            "operator": {"leaseSeconds": LEASE_SECONDS},
        }

    # Helm

    def install(self, values: Values | None = None) -> None:
        """Install it, or upgrade it to these values, and wait until the operator is ready."""
        self.note_refusals()
        self._with_values("upgrade", "--install", "--create-namespace", values=values or {})
        self.wait_until_ready()

    def render(self, values: Values) -> str:
        """The manifests that it would install, without those that `helm test` makes for itself."""
        version = self._kube.call("GET", "/version")["gitVersion"]
        return self._with_values(
            "template", "--skip-tests", "--kube-version", version, values=values
        )

    def _with_values(self, *command: str, values: Values) -> str:
        with tempfile.NamedTemporaryFile("w", suffix=".json", dir=self._home) as file:
            json.dump(_merged(self._values, values), file)
            file.flush()
            arguments = ("--namespace", self.namespace, "--values", file.name)
            return self.helm(*command, self.name, CHART, *arguments)

    def uninstall(self) -> str:
        """Remove the release and wait until its pod is gone, so no operator acts.

        Return Helm's output.
        """
        self.note_refusals()
        said = self.helm(
            "uninstall", self.name, "--namespace", self.namespace, "--ignore-not-found"
        )
        self.wait("no operator", lambda: not self.pods())
        return said

    def helm(self, *arguments: str | Path, seconds: float = 120) -> str:
        """Return Helm's output."""
        folders = [f"HELM_{kind}_HOME={self._home}" for kind in ("CACHE", "CONFIG", "DATA")]
        login = ("--kubeconfig", self._kube.kubeconfig)
        return run("env", *folders, self._helm, *arguments, *login, seconds=seconds)

    def kubectl(self, *arguments: str) -> str:
        """Return kubectl's output in the release's namespace."""
        return self._kube.kubectl("--namespace", self.namespace, *arguments)

    # The operator

    @property
    def deployment(self) -> str:
        """Name of the release, which the operator's Lease has too."""
        return f"{self.name}-fiber-operator"

    @property
    def selector(self) -> str:
        """Label selector of the release's objects."""
        return f"app.kubernetes.io/instance={self.name}"

    def may(self, verb: str, resource: str, namespace: str) -> bool:
        """Return whether the operator's account has this right there."""
        return self._may(verb, resource, "--namespace", namespace)

    def _may(self, *what: str) -> bool:
        account = f"system:serviceaccount:{self.namespace}:{self.deployment}"
        try:
            self._kube.kubectl("auth", "can-i", *what, "--as", account)
        except Failed:
            return False
        return True

    def stop(self) -> None:
        """Scale the operator to 0 and wait until it has ended."""
        self.note_refusals()
        self.scale(0)
        self.wait("no operator", lambda: not self.pods())

    def start(self) -> None:
        """Scale it to one again and wait until it is ready."""
        self.scale(1)
        self.wait_until_ready()

    def wait_until_ready(self) -> None:
        """Wait until the newest operator, and no other, is ready."""
        self.wait("the operator is ready", self._settled)

    def pod(self) -> Body:
        """The operator's one pod."""
        (pod,) = self.pods()
        return pod

    def pods(self) -> list[Body]:
        """The pods of all operators."""
        selector = f"{self.selector},app.kubernetes.io/component=operator"
        return self._kube.items(path_of("pods", self.namespace), labelSelector=selector)

    def log(self, lines: int = 40) -> str:
        """The end of the operator's log."""
        try:
            return "\n".join(self._log(pod, lines) for pod in self.pods())
        except Refused as refused:
            return f"there is no log: {refused}"

    def metrics(self) -> Iterator[tuple[str, dict[str, str], float]]:
        """Every sample of /metrics: name, labels, value."""
        for sample in _SAMPLE.finditer(self.page("metrics", self.pod())):
            yield sample[1], dict(_LABEL.findall(sample[2] or "")), float(sample[3])

    def note_refusals(self) -> None:
        """Ask the operator, before it ends, which calls were forbidden to it and still are.

        An API server that starts refuses all until it has read the roles. Creation is left out: a
        quota, a policy, or a namespace that goes may have refused it.
        """
        if any(is_ready(pod) for pod in self.pods()):
            calls = [labels for name, labels, _ in self.metrics() if name == _CALLS]
            found = {(call["verb"], call["resource"]) for call in calls if call["code"] == "403"}
            self.refused |= {
                call for call in found if call[0] != "create" and not self._may_everywhere(*call)
            }

    def _may_everywhere(self, verb: str, resource: str) -> bool:
        resource, _, part = resource.partition("/")
        if (verb, resource) == ("patch", "leases"):  # it may patch only this one
            lease = f"leases/{names.SERVING_LEASE}"
            return self.may(verb, lease, names.SERVING_NAMESPACE)
        if (verb, resource) == ("update", "leases"):
            lease = f"leases/{names.operator_lease_name(self.deployment)}"
            return self.may(verb, lease, self.namespace)
        return self._may(verb, resource, "--subresource", part, "--all-namespaces")

    def page(self, name: str, pod: Body) -> str:
        """Return the document that an operator's pod serves."""
        (port,) = pod["spec"]["containers"][0]["ports"]
        place = f"{pod['metadata']['name']}:{port['containerPort']}"
        return self._kube.text(path_of("pods", self.namespace, place, f"proxy/{name}"))

    def _settled(self) -> bool:
        deployment = self._kube.get(path_of("deployments", self.namespace, self.deployment)) or {}
        status = deployment.get("status", {})
        seen = status.get("observedGeneration") == deployment["metadata"]["generation"]
        updated = status.get("updatedReplicas") == status.get("replicas") == 1
        return seen and updated and [is_ready(pod) for pod in self.pods()] == [True]

    def scale(self, replicas: int) -> None:
        """Run this many operators, of which one acts."""
        path = path_of("deployments", self.namespace, self.deployment, "scale")
        self._kube.patch(path, {"spec": {"replicas": replicas}})

    def wait(self, what: str, condition: Any) -> None:
        """Wait until the condition holds for the operator's pods or their answers."""
        scene = Scene(self._kube, self.namespace, ("pods", "deployments"))
        try:
            scene.wait(what, condition, 60.0, poll=0.5)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self._account()}\n{self.log()}") from None
        finally:
            scene.close()

    def _account(self) -> str:
        """Return why the operators are not ready, in their own words."""
        lines = [self.kubectl("get", "deployments,pods", "--output", "wide")]
        for pod in self.pods():
            try:
                said = self.page("readyz", pod)
            except Refused as refused:
                said = str(refused)
            lines.append(f"/readyz of {pod['metadata']['name']}: {said}")
        return "\n".join(lines)

    def _log(self, pod: Body, lines: int) -> str:
        path = path_of("pods", self.namespace, pod["metadata"]["name"], "log")
        return self._kube.text(path, tailLines=str(lines))


def crd_owner(kube: Kube) -> str | None:
    """``namespace/name`` of the release that has the resource type; None where it is not there."""
    crd = kube.get(path_of("customresourcedefinitions", name=names.CRD_NAME))
    if crd is None:
        return None
    notes = crd["metadata"].get("annotations", {})
    return "/".join(notes.get(f"meta.helm.sh/release-{key}", "?") for key in ("namespace", "name"))


def _image(reference: str) -> dict[str, str]:
    repository, _, digest = reference.partition("@")
    if digest:
        return {"repository": repository, "digest": digest}
    repository, _, tag = reference.rpartition(":")
    return {"repository": repository, "tag": tag}


def _merged(values: Values, more: Values) -> dict[str, Any]:
    return {**values, **{key: _joined(values.get(key), value) for key, value in more.items()}}


def _joined(old: Any, new: Any) -> Any:
    both = isinstance(old, Mapping) and isinstance(new, Mapping)
    return _merged(old, new) if both else new
