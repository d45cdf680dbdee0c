"""Tokens that are not taken, or end while a program runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from e2e.accounts import ACCOUNT, make_token, write_kubeconfig
from e2e.leftovers import leaves_nothing
from e2e.program import Programs
from e2e.scene import Scene
from e2e.test_program import SQUARES
from e2e.test_program_faults import LOST, RUNNING

pytestmark = pytest.mark.timeout(300, func_only=True)

ENDLESS = ("--seconds", 1)
"""1,000 tasks on three workers: minutes."""
LEASE = 30
"""Seconds after which a program that does not renew its Lease counts as gone."""
LOGIN = "client.authentication.k8s.io/v1"
REVIEWS = "/apis/authentication.k8s.io/v1/tokenreviews"


class Token:
    """Token that ends with the Secret that it is bound to.

    Kubernetes grants no token of less than ten minutes.
    """

    def __init__(self, scene: Scene, secret: str) -> None:
        self._scene = scene
        self._secret = scene.path("secrets", secret)
        scene.kube.create(scene.path("secrets"), {"metadata": {"name": secret}})
        bound = ("--bound-object-kind=Secret", f"--bound-object-name={secret}")
        self.text = make_token(scene, ACCOUNT, *bound)

    def end(self) -> None:
        """Return once the API server takes it no more, which remembers for some seconds."""
        self._scene.kube.delete(self._secret)
        self._scene.wait("the token is not taken", lambda: not self._is_taken(), poll=0.5)

    def _is_taken(self) -> bool:
        review = self._scene.kube.create(REVIEWS, {"spec": {"token": self.text}})
        return bool(review["status"].get("authenticated"))


def test_a_token_that_is_not_taken(programs: Programs, scene: Scene, tmp_path: Path) -> None:
    programs.kubeconfig = write_kubeconfig(scene, tmp_path / "config", {"token": "expired"})
    program = programs.start("outside", "mapping.py")
    program.says("began")
    output = program.ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert "Unauthorized" in output


@pytest.mark.long
def test_a_token_that_ends_is_asked_for_again(
    programs: Programs, scene: Scene, tmp_path: Path
) -> None:
    """Log in by the kubeconfig's plugin, which does not say when its tokens end."""
    said = tmp_path / "credential"

    def log_in_with(token: Token) -> None:
        credential = {"apiVersion": LOGIN, "kind": "ExecCredential"}
        said.write_text(json.dumps({**credential, "status": {"token": token.text}}))

    plugin = {"apiVersion": LOGIN, "command": "cat", "args": [str(said)]}
    exec_user = {"exec": {**plugin, "interactiveMode": "Never"}}
    programs.kubeconfig = write_kubeconfig(scene, tmp_path / "config", exec_user)
    first, second = Token(scene, "first"), Token(scene, "second")
    log_in_with(first)
    program = programs.start("outside", "mapping.py", *RUNNING)
    program.says("first")
    log_in_with(second)
    first.end()
    assert program.says("done")["total"] == SQUARES
    assert "Unauthorized" not in program.ends()
    second.end()
    leaves_nothing(program)


@pytest.mark.long
def test_a_program_whose_token_ends_for_good_gets_an_error(
    programs: Programs, scene: Scene, tmp_path: Path
) -> None:
    """Programs without a login count as lost later; then the operator removes their pool."""
    token = Token(scene, "login")
    programs.kubeconfig = write_kubeconfig(scene, tmp_path / "config", {"token": token.text})
    program = programs.start("outside", "mapping.py", *ENDLESS)
    program.says("first")
    token.end()
    output = program.ends(status=1, seconds=LEASE + 30)
    words = ("FiberPoolError", "Unauthorized", "kubectl auth whoami", "kubectl delete")
    assert all(each in output for each in words), output
    leaves_nothing(program, seconds=LOST + 30)
