"""Events of pods on nodes, as the API shows them."""

from __future__ import annotations

from typing import Any

from fakes.store import Body, Store

CONTAINER = "worker"


class Kubelet:
    """Runs the pods of ``store``.  ``auto``: each new one is Ready at once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.auto = True
        store.created = self._created

    def _created(self, plural: str, body: Body) -> None:
        if plural == "pods" and self.auto:
            self.ready(body["metadata"]["namespace"], body["metadata"]["name"])

    def pods(self, namespace: str) -> list[str]:
        return [pod["metadata"]["name"] for pod in self._store.list("pods", namespace)]

    def ready(self, namespace: str, name: str) -> None:
        self._bind(namespace, name)
        now = self._store.now()
        self._set(
            namespace,
            name,
            {
                "phase": "Running",
                "conditions": [{"type": "Ready", "status": "True", "lastTransitionTime": now}],
                "containerStatuses": [_container({"running": {"startedAt": now}})],
            },
        )

    def waiting(self, namespace: str, name: str, reason: str, message: str = "") -> None:
        """The container cannot start."""
        self._bind(namespace, name)
        state = {"waiting": {"reason": reason, "message": message}}
        status = {"phase": "Pending", "containerStatuses": [_container(state)]}
        self._set(namespace, name, status)

    def exit(self, namespace: str, name: str, code: int, reason: str = "Error") -> None:
        """The container ends."""
        self._bind(namespace, name)
        now = self._store.now()
        state = {
            "terminated": {
                "exitCode": code,
                "reason": reason,
                "startedAt": now,
                "finishedAt": now,
                "message": "last words",
            }
        }
        phase = "Failed" if code else "Succeeded"
        status = {"phase": phase, "containerStatuses": [_container(state)]}
        self._set(namespace, name, status)

    def evict(self, namespace: str, name: str) -> None:
        self._set(
            namespace,
            name,
            {
                "phase": "Failed",
                "reason": "Evicted",
                "message": "The node was low on resource: memory.",
                "conditions": [
                    {
                        "type": "DisruptionTarget",
                        "status": "True",
                        "reason": "TerminationByKubelet",
                        "lastTransitionTime": self._store.now(),
                    }
                ],
            },
        )

    def _bind(self, namespace: str, name: str) -> None:
        pod = self._store.get("pods", namespace, name)
        if "nodeName" not in pod.get("spec", {}):
            self._store.merge("pods", namespace, name, {"spec": {"nodeName": "node-1"}})

    def _set(self, namespace: str, name: str, status: dict[str, Any]) -> None:
        self._store.set_status("pods", namespace, name, status)


def _container(state: Body) -> Body:
    return {"name": CONTAINER, "ready": "running" in state, "restartCount": 0, "state": state}
