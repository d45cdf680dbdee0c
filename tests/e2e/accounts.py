"""Accounts with the rights of people who use pools, and kubeconfigs that log in as one."""

from __future__ import annotations

import json
from pathlib import Path

from e2e.kube import Body
from e2e.scene import Scene

ACCOUNT = "master"


def may_use_pools(scene: Scene) -> None:
    """Give the namespace an account with the role fiber-user, and no other right."""
    group = "rbac.authorization.k8s.io"
    make_account(scene, ACCOUNT)
    binding = {
        "metadata": {"name": ACCOUNT},
        "roleRef": {"apiGroup": group, "kind": "ClusterRole", "name": "fiber-user"},
        "subjects": [{"kind": "ServiceAccount", "name": ACCOUNT, "namespace": scene.namespace}],
    }
    scene.kube.create(scene.path("rolebindings"), binding)


def may_run_programs(scene: Scene) -> None:
    """Give the namespace's account the role fiber-runner, too."""
    binding = scene.kube.call("GET", scene.path("rolebindings", ACCOUNT))
    other = {
        "metadata": {"name": f"{ACCOUNT}-runs-programs"},
        "roleRef": {**binding["roleRef"], "name": "fiber-runner"},
        "subjects": binding["subjects"],
    }
    scene.kube.create(scene.path("rolebindings"), other)


def may_not(scene: Scene, resource: str) -> None:
    """Take the rights to a resource from the namespace's account."""
    group = "rbac.authorization.k8s.io"
    role = scene.kube.call("GET", f"/apis/{group}/v1/clusterroles/fiber-user")
    rules = [rule for rule in role["rules"] if resource not in rule["resources"]]
    scene.kube.create(scene.path("roles"), {"metadata": {"name": ACCOUNT}, "rules": rules})
    binding = scene.kube.call("GET", scene.path("rolebindings", ACCOUNT))
    scene.kube.delete(scene.path("rolebindings", ACCOUNT))
    other = {
        "metadata": {"name": f"{ACCOUNT}-with-less"},
        "roleRef": {"apiGroup": group, "kind": "Role", "name": ACCOUNT},
        "subjects": binding["subjects"],
    }
    scene.kube.create(scene.path("rolebindings"), other)


def make_account(scene: Scene, name: str) -> None:
    """An account without rights."""
    scene.kube.create(scene.path("serviceaccounts"), {"metadata": {"name": name}})


def kubeconfig_of(scene: Scene, folder: Path, account: str = ACCOUNT) -> Path:
    """A kubeconfig whose user is an account of the scene's namespace."""
    return write_kubeconfig(scene, folder / account, {"token": make_token(scene, account)})


def make_token(scene: Scene, account: str, *options: str) -> str:
    """A new login as the account; the options are those of ``kubectl create token``."""
    create = ("--namespace", scene.namespace, "create", "token", account, *options)
    return scene.kube.kubectl(*create).strip()


def write_kubeconfig(scene: Scene, path: Path, user: Body) -> Path:
    """The same cluster, and a user who logs in so."""
    view = ("config", "view", "--raw", "--minify", "--flatten", "--output", "json")
    config: Body = json.loads(scene.kube.kubectl(*view))
    (context,) = config["contexts"]
    context["context"] = {"cluster": context["context"]["cluster"], "user": "user"}
    config["users"] = [{"name": "user", "user": user}]
    path.touch(mode=0o600)
    path.write_text(json.dumps(config), encoding="utf-8")
    return path
