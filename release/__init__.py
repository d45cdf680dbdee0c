"""Release of Fiber: its packages, its images, its chart and its notes.

``python -m release prepare VERSION`` writes the version and the changelog into the checkout.
``build`` makes and checks all files of a release.  ``push-image`` builds and pushes one image.
``.github/workflows/release.yml`` runs the last two; ``make release-dry-run`` runs ``build`` here.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

PATIENCE = 600
"""Seconds that a command may take, at most."""


class ReleaseError(Exception):
    """Error that ends the release: what happened, why, and what to do."""


def output(*command: str | Path, env: Mapping[str, str] | None = None, cwd: Path = ROOT) -> str:
    """Run a command and return its output; ReleaseError with all of its output if it fails."""
    done = subprocess.run(
        command,
        check=False,
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
    )
    if done.returncode:
        words = " ".join(map(str, command))
        raise ReleaseError(f"`{words}` ended with status {done.returncode}:\n{done.stdout}")
    return done.stdout
