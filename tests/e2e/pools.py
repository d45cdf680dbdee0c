"""FiberPools as a test handles them: made, changed, waited for, and read as a person reads them."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from typing import Any

from e2e.kube import APPLY, Body
from e2e.scene import Scene
from fiber_api import names


def template(image: str, *command: str, **container: Any) -> Body:
    """A pod template; without a command it runs the image's agent."""
    worker: Body = {
        "name": names.WORKER_CONTAINER,
        "image": image,
        "resources": {"requests": {"cpu": "5m", "memory": "16Mi"}},
        **container,
    }
    if command:
        worker["command"] = list(command)
    # Process 1 without a signal handler ignores SIGTERM, and the test would wait for it.
    return {"spec": {"terminationGracePeriodSeconds": 2, "containers": [worker]}}


class Pool:
    """FiberPool of a test. All reads come from the scene's watches."""

    def __init__(self, scene: Scene, name: str) -> None:
        self.scene = scene
        self.name = name
        self._path = scene.path("fiberpools", name)

    # Actions of a person and of the SDK

    def apply(self, pod_template: Body, **spec: Any) -> Pool:
        """``kubectl apply`` of a manifest."""
        applied = self.scene.kube.apply(self.manifest(pod_template, **spec), "--output=json")
        self._wait_until_seen(json.loads(applied))
        return self

    def manifest(self, pod_template: Body, **spec: Any) -> Body:
        return {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "metadata": {"name": self.name, "namespace": self.scene.namespace},
            "spec": {"template": copy.deepcopy(pod_template), **spec},
        }

    def scale(self, replicas: int) -> None:
        """``kubectl scale``."""
        self.kubectl("scale", "fiberpool", self.name, f"--replicas={replicas}")
        self._wait_until_seen(self.scene.kube.call("GET", self._path))

    def patch(self, **spec: Any) -> None:
        """``kubectl patch``."""
        self._wait_until_seen(self.scene.kube.patch(self._path, {"spec": spec}))

    def attach(self, **spec: Any) -> None:
        """Write the SDK's fields as the SDK does: all of them, by server-side apply."""
        body = {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "metadata": {"name": self.name},
            "spec": spec,
        }
        query = {"fieldManager": names.SDK_MANAGER, "force": "true"}
        self._wait_until_seen(self.scene.kube.patch(self._path, body, APPLY, **query))

    def delete(self) -> None:
        """``kubectl delete``, without waiting."""
        self.kubectl("delete", "fiberpool", self.name, "--wait=false")

    def kubectl(self, *arguments: str) -> str:
        return self.scene.kube.kubectl("--namespace", self.scene.namespace, *arguments)

    # Reading the cluster

    @property
    def body(self) -> Body:
        return self.scene.now["fiberpools"].get(self.name, {})

    @property
    def status(self) -> Body:
        found: Body = self.body.get("status", {})
        return found

    def problem(self, reason: str) -> Body | None:
        return problem_in(self.body, reason)

    def condition(self, kind: str) -> Body:
        return condition_in(self.body, kind)

    @property
    def pods(self) -> list[Body]:
        """All of its pods, the oldest first."""
        mine = [pod for pod in self.scene.now["pods"].values() if self.owns(pod)]
        return sorted(mine, key=lambda pod: pod["metadata"]["creationTimestamp"])

    @property
    def live(self) -> list[Body]:
        return [pod for pod in self.pods if is_live(pod)]

    @property
    def names(self) -> set[str]:
        """Return the names of its live pods."""
        return {pod["metadata"]["name"] for pod in self.live}

    @property
    def ever(self) -> set[str]:
        """The names of all pods that it ever had."""
        moments = [moment for moment in list(self.scene.moments) if moment.resource == "pods"]
        return {moment.name for moment in moments if self.owns(moment.object)}

    @property
    def conditions(self) -> list[str]:
        """The types of the conditions that it has."""
        return [condition["type"] for condition in self.status.get("conditions", [])]

    def owns(self, pod: Body) -> bool:
        return bool(pod["metadata"].get("labels", {}).get(names.LABEL_POOL) == self.name)

    @property
    def seen_generation(self) -> bool:
        """Return whether the status is about the current spec."""
        generation = self.body.get("metadata", {}).get("generation")
        return generation is not None and self.status.get("observedGeneration") == generation

    # Waiting

    def _wait_until_seen(self, written: Body) -> None:
        """Wait until the watch shows what was written: until then, all reads are about before."""

        def is_seen() -> bool:
            seen = self.body.get("metadata", {})
            made = written["metadata"]
            if seen.get("uid") != made["uid"]:
                return False
            return int(seen["generation"]) >= int(made["generation"])

        # After an outage of the API server the watch first has to connect again.
        self.wait("the watch shows what was written", is_seen, seconds=60)

    def wait(self, what: str, condition: Callable[[], Any], seconds: float = 30.0) -> Any:
        return self.scene.wait(f"{self.name}: {what}", condition, seconds)

    def ready(self, replicas: int, seconds: float = 30.0) -> Sequence[str]:
        """Wait until the status shows this many ready workers and no other change under way."""

        def settled() -> bool:
            status = self.status
            counts = [status.get(f"{kind}eplicas") for kind in ("r", "readyR", "desiredR")]
            return (
                self.seen_generation
                and counts == [replicas] * 3
                and status.get("phase") == "Ready"
                and len(self.live) == replicas
            )

        self.wait(f"{replicas} ready", settled, seconds)
        return sorted(self.names)

    def has_problem(self, reason: str, seconds: float = 30.0, **fields: Any) -> Body:
        """Wait until the status has this problem, with these fields."""

        def found() -> Body | None:
            problem = self.problem(reason)
            if problem is None or any(problem.get(key) != value for key, value in fields.items()):
                return None
            return problem

        problem: Body = self.wait(f"problem {reason} {fields or ''}", found, seconds)
        return problem

    def told_after(self, reported: Callable[[Body], object], reason: str, **fields: Any) -> float:
        """Seconds from when one of its pods was first so to when the status first said so."""
        event = self.scene.first("pods", lambda pod: self.owns(pod) and reported(pod))
        told = self.scene.first("fiberpools", lambda pool: self._tells(pool, reason, fields))
        return told - event

    def _tells(self, pool: Body, reason: str, fields: Body) -> bool:
        problem = problem_in(pool, reason) if pool["metadata"]["name"] == self.name else None
        return problem is not None and all(problem.get(key) == fields[key] for key in fields)


def problem_in(pool: Body, reason: str) -> Body | None:
    """The problem of this kind that a pool's status has."""
    problems = pool.get("status", {}).get("problems", [])
    return next((problem for problem in problems if problem["reason"] == reason), None)


def condition_in(pool: Body, kind: str) -> Body:
    """A condition of a pool; empty while there is none."""
    conditions = pool.get("status", {}).get("conditions", [])
    return next((condition for condition in conditions if condition["type"] == kind), {})


def says(text: str, *words: str) -> bool:
    """Return whether the text contains all the words, in this order."""
    place = 0
    for word in words:
        place = text.find(word, place)
        assert place >= 0, f"{word!r} is missed in: {text}"
        place += len(word)
    return True


def is_live(pod: Body) -> bool:
    """Return whether the pod counts as a replica."""
    ended = pod.get("status", {}).get("phase") in ("Failed", "Succeeded")
    return not ended and "deletionTimestamp" not in pod["metadata"]


def is_ready(pod: Body) -> bool:
    conditions = pod.get("status", {}).get("conditions", [])
    return any(c["type"] == "Ready" and c["status"] == "True" for c in conditions)


def state_of(pod: Body) -> Body:
    """The state of its worker container: waiting, running or terminated."""
    statuses = pod.get("status", {}).get("containerStatuses", [])
    found: Body = next((s["state"] for s in statuses if s["name"] == names.WORKER_CONTAINER), {})
    return found


def waits_for(*reasons: str) -> Callable[[Body], bool]:
    """Return whether a container of a pod waits, and the kubelet gives one of these reasons."""
    return lambda pod: any(
        state.get("waiting", {}).get("reason") in reasons for state in _states(pod)
    )


def _states(pod: Body) -> list[Body]:
    # The init container has the worker's image and environment, and starts first.
    status = pod.get("status", {})
    kinds = ("initContainerStatuses", "containerStatuses")
    return [found["state"] for kind in kinds for found in status.get(kind, [])]


def has_ended(pod: Body) -> bool:
    """Return whether its worker has ended."""
    return "terminated" in state_of(pod)
