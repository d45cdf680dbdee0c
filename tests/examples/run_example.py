"""Run an example as its README says: as a script, with a separate Python."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from patience import PATIENCE

EXAMPLES = Path(__file__).parents[2] / "examples"
BACKENDS = ("local", "loopback")


def command(script: str, *arguments: object) -> list[str]:
    """The command line for `script`, a path below examples/."""
    return [sys.executable, str(EXAMPLES / script), *map(str, arguments)]


def environment(backend: str) -> dict[str, str]:
    """The environment of a run on `backend`."""
    return {**os.environ, "FIBER_BACKEND": backend}


def run(
    script: str, *arguments: object, backend: str = "local", status: int = 0
) -> subprocess.CompletedProcess[str]:
    """Run to the end, which must be with this exit status."""
    done = subprocess.run(
        command(script, *arguments),
        env=environment(backend),
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert done.returncode == status, f"{done.args}\n{done.stdout}{done.stderr}"
    return done
