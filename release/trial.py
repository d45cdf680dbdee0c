"""Trial of a wheel: installed in a new environment, its command and a small pool run."""

from __future__ import annotations

import json
import sys
import venv
from pathlib import Path

from release import ReleaseError, output

_PROGRAM = """
import json
import fiber
from fiber._backends.kubernetes.published import install_command, worker_image


def square(number):
    return number * number


if __name__ == "__main__":
    with fiber.Pool(2) as pool:
        squares = pool.map(square, range(5))
    print(json.dumps([fiber.__version__, fiber.__file__, squares, worker_image("3.11")]))
"""


def run(wheel: Path, version: str, folder: Path) -> str:
    """Install the wheel below ``folder`` and try it; return its default image of workers."""
    environment = folder / "environment"
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet")
    output(*pip, f"{wheel}[kubernetes]", cwd=folder)
    _check_command(environment / "bin" / "fiber", version, folder)
    program = folder / "program.py"
    program.write_text(_PROGRAM, encoding="utf-8")
    lines = output(python, "-I", program, cwd=folder).splitlines()
    found, file, squares, image = json.loads(lines[-1])
    if found != version or not Path(file).is_relative_to(environment) or squares != SQUARES:
        raise ReleaseError(
            f"the wheel {wheel.name} does not work: Fiber {found} of {file} computed {squares}, "
            f"and not Fiber {version} of {environment} {SQUARES}. Run the program {program}"
        )
    return str(image)


SQUARES = [0, 1, 4, 9, 16]


def _check_command(command: Path, version: str, folder: Path) -> None:
    said = output(command, "--version", cwd=folder)
    if said.split() != ["fiber", version]:
        raise ReleaseError(
            f"`fiber --version` of the wheel printed {said.strip()!r}, and not version {version}. "
            "Build it from the sources of this release"
        )
    if "Usage: fiber" not in (said := output(command, "--help", cwd=folder)):
        raise ReleaseError(
            f"`fiber --help` of the wheel printed no help, but {said!r}. Try the command"
        )
