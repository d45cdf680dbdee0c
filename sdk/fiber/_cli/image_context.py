"""Context of a build: the Dockerfile, the requirements and the wheels."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from fiber._cli.failures import CommandError
from fiber._cli.image_packages import Contents
from fiber._cli.image_wheels import make_wheels

PYTHON = f"{sys.version_info[0]}.{sys.version_info[1]}"
"""Minor version that workers need: the program's."""

BASE = f"docker.io/library/python:{PYTHON}-slim"
"""Image to begin with.  podman and buildah need its whole name."""

MARK = "fiber-image:"
"""Beginning of a line by which a step of the Dockerfile says why it fails."""

_FIRST = "# Image for Fiber's workers, made by `fiber image build`."

_BUILD = """\
ARG BASE_IMAGE={base}

FROM ${{BASE_IMAGE}} AS build
USER 0
# A worker needs the program's minor version of Python.
RUN python3 -c 'import sys; found = "%d.%d" % sys.version_info[:2]; found == "{python}" \
or sys.exit("{mark} the base image has Python " + found + ", and the program {python}")'
RUN python3 -m venv /opt/program
# The secrets are optional: pip's settings and certificates, which only these steps see.
COPY {files} /src/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=certificates \\
    --mount=type=cache,target=/root/.cache/pip \\
    /opt/program/bin/{install} -r /src/requirements.txt
"""

_WHEELS = """\
COPY wheels /src/wheels
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=certificates \\
    --mount=type=cache,target=/root/.cache/pip \\
    /opt/program/bin/{install} /src/wheels/*.whl
"""

_WORKER = """\

FROM ${BASE_IMAGE}
USER 0
# Libraries that ask for the user's name or home get an answer.
RUN getent passwd 65532 > /dev/null \\
    || useradd --uid 65532 --user-group --no-create-home --home-dir /tmp fiber
COPY --from=build /opt/program /opt/program
# Nothing is written at run time, so that the root file system can be read-only.
ENV PATH=/opt/program/bin:$PATH \\
    PYTHONDONTWRITEBYTECODE=1 \\
    PYTHONUNBUFFERED=1
WORKDIR /app
USER 65532:65532
# The agent is process 1, which is not told of a SIGTERM that it has no handler for yet.
ENTRYPOINT ["env", "--block-signal=TERM", "python", "-m", "fiber.agent"]
"""


def dockerfile(contents: Contents, base: str) -> str:
    """Return the Dockerfile for these contents."""
    files = ["requirements.txt"]
    install = "pip install --quiet"
    if contents.complete:
        install += " --no-deps"
    if contents.constraints:
        files.append("constraints.txt")
        install += " -c /src/constraints.txt"
    words = {"install": install, "files": " ".join(files)}
    build = _BUILD.format(base=base, python=PYTHON, mark=MARK, **words)
    wheels = _WHEELS.format(**words) if contents.built else ""
    return f"{_FIRST}\n{build}{wheels}{_WORKER}"


def write_context(folder: Path, contents: Contents, base: str) -> None:
    """Write the context to an empty folder."""
    folder.mkdir(parents=True, exist_ok=True)
    # First: by this file a later call knows a folder that was not finished.
    (folder / "Dockerfile").write_text(dockerfile(contents, base), encoding="utf-8")
    if contents.built:
        make_wheels(contents.built, folder / "wheels")
    _write(folder / "requirements.txt", contents.requirements)
    if contents.constraints:
        _write(folder / "constraints.txt", contents.constraints)


def emptied(folder: Path) -> Path:
    """Return ``folder`` without what an earlier call wrote; other files are an error."""
    if folder.exists() and not _is_own(folder):
        raise CommandError(
            f"cannot write the context to {folder}",
            "it exists, and has other files than those of `fiber image build`",
            "name another folder: --file-only FOLDER",
        )
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _is_own(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    if not any(folder.iterdir()):
        return True
    try:
        return (folder / "Dockerfile").read_text(encoding="utf-8").startswith(_FIRST)
    except (OSError, UnicodeDecodeError):
        return False


def _write(file: Path, lines: tuple[str, ...]) -> None:
    file.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
