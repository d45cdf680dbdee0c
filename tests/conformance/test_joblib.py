"""Fiber's backend passes joblib's own tests of one, but for those that `exclusions` explains."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from conformance.runner import TESTS

COMMAND = (
    *(sys.executable, "-m", "pytest", "--pyargs", "joblib.test.test_parallel"),
    *("-p", "conformance.joblib_plugin", "-p", "no:cacheprovider", "-c", "pytest.ini", "-q", "-rX"),
)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_joblibs_tests(tmp_path: Path) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # else it would be this project's
    done = subprocess.run(
        [*COMMAND, "--timeout", "120"],
        cwd=tmp_path,
        env={**os.environ, "FIBER_BACKEND": "local", "PYTHONPATH": str(TESTS)},
        capture_output=True,
        text=True,
        timeout=580,
    )
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout
