"""The commands of the guides, as they are printed, on a cluster without an operator."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from e2e.clusters import Cluster, Own, find_program
from e2e.kube import Kube
from e2e.release import Release

ROOT = Path(__file__).resolve().parents[2]
CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^\$ (.+?)(?: +# .*)?$", re.MULTILINE)
CLUSTER = 'eval "$(make -s cluster)"'
BRING = "export FIBER_IMAGE=$(PYTHONPATH=tests python -m cluster bring fiber-search)"
_OURS = re.compile(r"FIBER_|KUBECONFIG$|MAKE|MFLAGS$")

SHOWN = {
    "fiberpools.md": {
        "helm test fiber-operator --namespace fiber-system": r"Succeeded",
        "kubectl get fiberpools": r"(?m)^minimal\s.*\b2\b",
        "kubectl explain fiberpool.spec": r"minReplicas",
    },
    "kubernetes.md": {
        "FIBER_BACKEND=kubernetes FIBER_NAMESPACE=default "
        "python examples/02-es/main.py --workers 4": r"(?m)^  trained +-[12]?\d\d\.\d ",
        "kubectl get fiberpools": r"No resources found",
        "kubectl logs job/pi": r"Pi is roughly 3\.1[34]",
    },
    "executors.md": {
        "FIBER_BACKEND=kubernetes FIBER_NAMESPACE=default python examples/05-search/search.py": (
            r"(?m)^study of 40 trials: 9\d\.\d%"
        ),
    },
}
"""Patterns of the output of some commands, by page."""
PAGES = ["fiberpools.md", "kubernetes.md", pytest.param("executors.md", marks=pytest.mark.long)]
NOT_RUN = {
    f". .venv/bin/activate && pip install --quiet --editable '.[kubernetes,{extra}]'": (
        "the tests' own environment, whose Python the shell has"
    )
    for extra in ("rl", "search")
}


def commands(page: str) -> list[str]:
    """Return the commands after each prompt, without the comments."""
    blocks = CONSOLE.findall((ROOT / "docs" / page).read_text(encoding="utf-8"))
    return [command for block in blocks for command in COMMAND.findall(block)]


class Shell:
    """Shell of a reader: variables that one command exports are there for the next."""

    _END = "[the command has ended]"

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            ["bash", "--noprofile", "--norc"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, command: str) -> str:
        """Run a command; it must end with status 0. Return its output."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{{ {command}\n}} </dev/null; echo '{self._END}' $?\n")
        self._process.stdin.flush()
        said = "".join(self._until_end())
        said, _, status = said.partition(self._END)
        assert status.strip() == "0", f"$ {command}\n{said}"
        return said

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _until_end(self) -> Iterator[str]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            yield line
            if self._END in line:
                return


@pytest.fixture
def shell(cluster: Cluster, tmp_path: Path) -> Iterator[Shell]:
    """Shell in the repository, with these tests' Python and the variables that `make cluster`
    exports.
    """
    python = str(Path(sys.executable).parent)
    given = {name: value for name, value in os.environ.items() if not _OURS.match(name)}
    homes = {f"HELM_{kind}_HOME": str(tmp_path) for kind in ("CACHE", "CONFIG", "DATA")}
    shell = Shell({**given, **homes, "PATH": os.pathsep.join([python, given["PATH"]])})
    try:
        if isinstance(cluster, Own):
            shell.run(CLUSTER)
        else:  # a reader who has a cluster has done this
            folders = {str(Path(find_program(program)).parent) for program in ("kubectl", "helm")}
            shell.run(f"export KUBECONFIG={cluster.kubeconfig}")
            shell.run(f"export PATH={os.pathsep.join(folders)}:$PATH")
            shell.run(f"export FIBER_IMAGE={cluster.images['fiber-worker-rl']}")
        yield shell
    finally:
        shell.close()


@pytest.fixture
def after(bare_cluster: None, release: Release, kube: Kube) -> Iterator[None]:
    """Remove the objects that the pages install."""
    yield
    delete = ("delete", "--ignore-not-found", "--namespace", "default")
    kube.kubectl(*delete, "fiberpool", "minimal")
    kube.kubectl(*delete, "configmap", "pi")
    kube.kubectl(*delete, "--filename", str(ROOT / "examples" / "01-pi" / "job.yaml"))
    release.helm("uninstall", "fiber-operator", "--namespace", "fiber-system", "--ignore-not-found")
    kube.delete_namespaces("fiber-system")


@pytest.mark.timeout(600, func_only=True)  # `helm test` has a limit of five minutes
@pytest.mark.usefixtures("after")
@pytest.mark.parametrize("page", PAGES)
def test_every_command_prints_the_output_of_its_page(
    page: str, shell: Shell, cluster: Cluster
) -> None:
    if BRING in commands(page) and not isinstance(cluster, Own):
        pytest.skip(f"{cluster.description} is not that of make cluster")
    assert commands(page)[0] == CLUSTER
    said = {command: shell.run(command) for command in commands(page)[1:] if command not in NOT_RUN}
    for command, pattern in SHOWN[page].items():
        assert re.search(pattern, said[command]), said[command]


def test_skipped_commands_are_shown() -> None:
    assert set(NOT_RUN) < {command for page in SHOWN for command in commands(page)}


def test_only_shell_lines_are_printed_by_make_cluster(cluster: Cluster) -> None:
    """So that a shell may evaluate it: the rest is for people, on standard error."""
    if not isinstance(cluster, Own):
        pytest.skip(f"{cluster.description} is not made by make cluster")
    done = subprocess.run(["make", "-s", "cluster"], cwd=ROOT, capture_output=True, text=True)
    exported = re.fullmatch(
        r"export KUBECONFIG=(\S+)\nexport PATH=\S+:\$PATH\nexport FIBER_IMAGE=(\S+)\n", done.stdout
    )
    assert exported, done
    assert Path(exported[1]) == cluster.kubeconfig
    assert exported[2] == cluster.images["fiber-worker-rl"]
