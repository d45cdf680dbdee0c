"""``fiber image build`` with the real builder of this machine: the image runs Fiber's agent, and
programs that import its packages.
"""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path

import pytest

import fiber
from cluster import images
from cluster.buildah import BUILDAH, buildah
from cluster.builders import Buildah
from cluster.shell import ClusterError, output
from e2e.accounts import ACCOUNT, may_run_programs
from e2e.clusters import Cluster
from e2e.person import Person
from e2e.program import Programs
from e2e.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
TAG = "registry.invalid/fiber-image-build:1"
PROGRAM = (
    "import fiber, fiber.agent, os, six; print(fiber.__version__, six.__version__, os.getuid())"
)


def python_in_the_image(program: str) -> str:
    container = buildah("from", TAG).strip()
    try:
        return output(*BUILDAH, "run", "--isolation", "chroot", container, "python", "-c", program)
    finally:
        buildah("rm", container)


@pytest.mark.long
@pytest.mark.timeout(900)  # pip downloads Fiber's requirements
def test_an_image_of_a_requirements_file_has_fiber_and_the_packages(
    tmp_path: Path,
) -> None:
    builder, base = images.builder_and_base()
    if not isinstance(builder, Buildah):
        pytest.skip("this test looks into images by buildah, and docker is used here")
    (tmp_path / "pyproject.toml").write_text("[tool.fiber]\nretries = 1\n")
    (tmp_path / "requirements.txt").write_text("six==1.17.0\n")
    words = ["--tag", TAG, "--base", base, "--requirements", "requirements.txt"]
    # buildah keeps a step's cache in the last one, longer than this test keeps files.
    given = {"BUILDAH_ISOLATION": "chroot", "STORAGE_DRIVER": "overlay", "TMPDIR": "/var/tmp"}
    environment = {**os.environ, **given}
    command = [sys.executable, "-m", "fiber._cli.main", "image", "build", *words]
    try:
        output(*command, cwd=tmp_path, env=environment)
        found = python_in_the_image(PROGRAM).split()
        assert found == [fiber.__version__, "1.17.0", "65532"]
        settings = tomllib.loads((tmp_path / "pyproject.toml").read_text())["tool"]["fiber"]
        assert settings == {"retries": 1, "image": TAG}
    finally:
        buildah("rmi", TAG, check=False)


OURS = "fiber-image-of-a-venv:1"
PROJECT = """
[build-system]
requires = []
build-backend = "backend"
backend-path = ["."]

[project]
name = "mine"
version = "1.0"
"""
BACKEND = """
import os, zipfile

def build_wheel(folder, settings=None, metadata=None):
    return _wheel(folder, "mine.py", open("mine.py").read())

def build_editable(folder, settings=None, metadata=None):
    return _wheel(folder, "mine.pth", os.getcwd())

def _wheel(folder, file, content):
    with zipfile.ZipFile(f"{folder}/mine-1.0-py3-none-any.whl", "w") as wheel:
        info = "mine-1.0.dist-info"
        wheel.writestr(file, content)
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\\nName: mine\\nVersion: 1.0\\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\\nTag: py3-none-any\\n")
        wheel.writestr(f"{info}/RECORD", "")
    return os.path.basename(wheel.filename)
"""
"""Backend of the standard library alone, so that pip downloads nothing."""
MINE = "def double(number):\n    return 2 * number\n"
IMPORTS = """
import fiber
import mine
import numpy

def work(number):
    return mine.double(int(numpy.arange(number).sum()))

if __name__ == "__main__":
    with fiber.Pool(2) as pool:
        print(numpy.__version__, mine.__file__, pool.map(work, range(4)))
"""


@pytest.fixture
def base() -> str:
    """The base image of this machine's builder."""
    try:
        return images.builder_and_base()[1]
    except ClusterError as error:
        pytest.skip(str(error))


def virtual_environment(folder: Path) -> Path:
    """Return the programs of an environment with Fiber, NumPy and an editable package."""
    project = folder / "mine"
    project.mkdir()
    for name, text in (("pyproject.toml", PROJECT), ("backend.py", BACKEND), ("mine.py", MINE)):
        (project / name).write_text(text)
    output(sys.executable, "-m", "venv", "--without-pip", folder / "venv")
    pip = (sys.executable, "-m", "pip", "--python", folder / "venv")
    packages = ("pip", "numpy", "--editable", project, f"{ROOT}[kubernetes]")
    output(*pip, "install", "--quiet", "--no-compile", *packages)
    return folder / "venv" / "bin"


@pytest.mark.timeout(900, func_only=True)  # pip downloads the packages the first time
def test_a_program_imports_what_its_environment_has_on_pods(
    base: str, scene: Scene, programs: Programs, cluster: Cluster, tmp_path: Path
) -> None:
    may_run_programs(scene)
    binaries = virtual_environment(tmp_path)
    folder = tmp_path / "program"
    folder.mkdir()
    (folder / "pyproject.toml").write_text("[tool.fiber]\n")
    (folder / "main.py").write_text(IMPORTS)
    person = Person(scene, programs, folder, None, binaries / "fiber")
    build = ("image", "build", "--tag", OURS, "--base", base)
    given = {"BUILDAH_ISOLATION": "chroot", "STORAGE_DRIVER": "overlay", "TMPDIR": "/var/tmp"}
    done = person.runs(*build, seconds=600, **given)
    assert done.returncode == 0, done.stderr
    try:
        with cluster.having(OURS):  # which pyproject.toml names now
            done = person.runs("run", "--service-account", ACCOUNT, "main.py")
    finally:
        images.builder_and_base()[0].remove(OURS)
    assert done.returncode == 0, done.stderr
    version, place, *results = done.stdout.split()
    assert (
        version == output(binaries / "python", "-c", "import numpy; print(numpy.__version__)")[:-1]
    )
    assert place.startswith("/opt/program/")
    assert results == ["[0,", "0,", "2,", "6]"]
