"""``fiber image build`` with the real builder of this machine: the image runs Fiber's agent."""

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
from cluster.shell import output

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
