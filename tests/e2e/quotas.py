"""ResourceQuotas in the namespace of a test."""

from __future__ import annotations

from e2e.scene import Scene


def make_quota(scene: Scene, name: str, **hard: str) -> None:
    """Make a ResourceQuota with these limits, and wait until it is in force."""
    path = scene.path("resourcequotas")
    scene.kube.create(path, {"metadata": {"name": name}, "spec": {"hard": hard}})

    def in_force() -> object:
        return (scene.kube.get(f"{path}/{name}") or {}).get("status", {}).get("hard")

    scene.wait("the quota is in force", in_force, poll=0.2)
