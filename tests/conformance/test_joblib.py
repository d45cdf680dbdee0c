"""Run joblib's own backend tests on Fiber's backend, except those that `exclusions` explains."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from conformance.runner import TESTS

COMMAND = (
    *(sys.executable, "-m", "pytest", "--pyargs", "joblib.test.test_parallel"),
    *("-p", "conformance.joblib_plugin", "-p", "no:cacheprovider", "-c", "pytest.ini", "-q", "-rX"),
)


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("backend", ["local", "kubernetes"])
def test_joblibs_tests(backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # else it would be this project's
    variables = {**os.environ, "FIBER_BACKEND": backend, "PYTHONPATH": str(TESTS)}
    with ExitStack() as stack:
        if backend == "kubernetes":
            from conformance.warm_pools import warm_pools  # needs the operator's work

            # Played: pods of a real one need an image with joblib and pytest.
            monkeypatch.delenv("KUBECONFIG", raising=False)
            pools = stack.enter_context(warm_pools(1, variables))
            variables |= stack.enter_context(pools.lend())
        done = subprocess.run(
            [*COMMAND, "--timeout", "120"],
            cwd=tmp_path,
            env=variables,
            capture_output=True,
            text=True,
            timeout=580,
        )
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout
