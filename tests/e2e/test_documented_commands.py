"""The commands of docs/fiberpools.md, as they are printed, on a cluster without an operator."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from e2e.clusters import Cluster, find_program
from e2e.kube import Kube, environment, path_of
from e2e.release import Release
from fiber_api import names

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "fiberpools.md"
CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^\$ (.+?)(?: +# .*)?$", re.MULTILINE)
NOT_RUN = {
    'eval "$(make --silent cluster)"': "the tests' cluster is up, with what this brings to it",
}


def commands() -> list[str]:
    """What a reader types after each prompt, without the comments."""
    blocks = CONSOLE.findall(PAGE.read_text(encoding="utf-8"))
    return [command for block in blocks for command in COMMAND.findall(block)]


@pytest.fixture
def without_operator(cluster: Cluster, release: Release, kube: Kube) -> Iterator[None]:
    """A cluster that has the images and nothing else of Fiber; then the operator of all tests."""
    if not cluster.by_version:
        pytest.skip(f"{cluster.description}: its nodes have no images under the chart's version")
    release.uninstall()
    _remove_type(kube)
    yield
    kube.kubectl("delete", "--ignore-not-found", "fiberpool", "minimal", "--namespace", "default")
    release.helm("uninstall", "fiber", "--namespace", "fiber-system", "--ignore-not-found")
    _remove_type(kube)
    kube.delete(path_of("namespaces", name="fiber-system"))
    release.install()


def _remove_type(kube: Kube) -> None:
    kube.kubectl("delete", "--ignore-not-found", "customresourcedefinition", names.CRD_NAME)


@pytest.mark.timeout(600, func_only=True)  # `helm test` has five minutes of its own
@pytest.mark.usefixtures("without_operator")
def test_every_command_does_what_its_page_says(cluster: Cluster, tmp_path: Path) -> None:
    said = {command: _run(command, cluster, tmp_path) for command in commands() if _is_run(command)}
    assert "Succeeded" in said["helm test fiber --namespace fiber-system"]
    assert re.search(r"^minimal\s.*\b2\b", said["kubectl get fiberpools"], re.MULTILINE)
    assert "minReplicas" in said["kubectl explain fiberpool.spec"]


def test_only_what_is_shown_is_left_out() -> None:
    assert set(NOT_RUN) < set(commands())


def _is_run(command: str) -> bool:
    return command not in NOT_RUN


def _run(command: str, cluster: Cluster, home: Path) -> str:
    """What a shell prints that has this cluster and these programs."""
    folders = {str(Path(find_program(program)).parent) for program in ("kubectl", "helm")}
    done = subprocess.run(
        command,
        shell=True,
        cwd=ROOT,
        env=environment(
            KUBECONFIG=str(cluster.kubeconfig),
            PATH=os.pathsep.join([*folders, os.environ["PATH"]]),
            HELM_CACHE_HOME=str(home),
            HELM_CONFIG_HOME=str(home),
            HELM_DATA_HOME=str(home),
        ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, f"$ {command}\n{done.stdout}"
    return done.stdout
