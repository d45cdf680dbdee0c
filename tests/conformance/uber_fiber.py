"""The tests and examples of Fiber's original, https://github.com/uber/fiber, on this Fiber:

    python tests/conformance/uber_fiber.py CHECKOUT [pytest's options]

CHECKOUT is a checkout of its repository.  Its files run unmodified; the tests in a copy of their
folder, beside which no other package is called fiber.  Where they import what only the
original has, `docker` or private modules of it, an empty stand-in takes that place, so that the
other tests of the file run.  `EXCLUSIONS` and `LEFT_OUT` have each test and example that does not
pass, with the reason.  This module is also the pytest plugin of that run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest

import fiber.config

TESTS = (
    "tests/test_managers.py",
    "tests/test_misc.py",
    "tests/test_pool.py",
    "tests/test_process.py",
    "tests/test_process_misc.py",
    "tests/test_queue.py",
)
"""Public behaviour.  test_backend, test_config, test_docker_backend and test_popen test private
modules and the docker backend alone."""

# A part of a test's id -> why it cannot pass.
EXCLUSIONS = {
    "test_interactive_shell_cloudpickle": (
        "it expects an error for a function defined within a function, which is sent by value"
    ),
    "test_pool_multiple_workers_inside_one_job": (
        "it sets the key cpu_per_job, which fiber.init(processes_per_pod=) replaces"
    ),
    "test_chunk_size": "it uses fiber.reset() and the keys log_file and cpu_per_job",
    "test_ipc_passive": "it sets the key ipc_active; agents always connect to the program",
    "test_start_timeout": "it replaces the docker backend in the private module fiber.backend",
    "test_simple_queue_read_write_from_different_proc": (
        "its process reads the private attributes SimpleQueue.reader and .writer"
    ),
}
if os.environ.get("FIBER_BACKEND", "local") != "local":
    EXCLUSIONS["test_sharing_pipe_with_fiber_and_multiprocessing"] = (
        "a process of multiprocessing's reaches only pipes of its own host"
    )
# The first would leave a process to the next test; the others would wait for a process that failed.
NOT_RUN = {
    "test_interactive_shell_cloudpickle",
    "test_simple_queue_read_write_from_different_proc",
    "test_sharing_pipe_with_fiber_and_multiprocessing",
}

EXAMPLES = (
    "basic_process.py",
    "basic_queue.py",
    "bench_queue.py",
    "line_count.py",
    "parzen_estimation.py",
    "pi_estimation.py",
    "shared_data.py",
)

# An example -> why it is not run.
LEFT_OUT = {
    "async_manager.py": "it imports gym, whose environments' step() returned four values",
    "bench_frameworks.py": "it compares with other frameworks and needs all of them",
    "ring.py": "it downloads a data set and needs torchvision",
}

SECONDS = 600
"""Limit for one example: bench_queue sends two million messages."""


STAND_INS = Path(__file__).parents[1] / "stand_ins" / "original"


def pytest_configure() -> None:
    """Say in the original's words which backend is used."""
    vars(fiber.config)["default_backend"] = "local"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A test that is excluded must fail, so that the list stays true."""
    for item in items:
        for name, reason in EXCLUSIONS.items():
            if name in item.nodeid:
                run = name not in NOT_RUN
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True, run=run))


def main(checkout: str, *options: str) -> int:
    """Run all tests, then all examples; return 0 if all passed."""
    failed = run_tests(Path(checkout), options) != 0
    for name in EXAMPLES:
        failed |= not passes(Path(checkout) / "examples" / name)
    for name, reason in LEFT_OUT.items():
        print(f"examples/{name}: not run: {reason}")
    return int(failed)


def run_tests(checkout: Path, options: Sequence[str]) -> int:
    """Run the tests in a copy of their folder; return pytest's exit status."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(checkout / "tests", Path(folder) / "tests")
        command = [sys.executable, "-m", "pytest", "-p", "conformance.uber_fiber", "-rxX"]
        command += ["-c", os.devnull, "--rootdir", folder, *TESTS, *options]
        paths = [str(Path(__file__).parents[1]), str(STAND_INS)]
        paths += filter(None, [os.environ.get("PYTHONPATH")])
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        return subprocess.run(command, cwd=folder, env=environment).returncode


def passes(example: Path) -> bool:
    """Run one example, and say how it ended."""
    done = subprocess.run([sys.executable, str(example)], cwd=example.parent, timeout=SECONDS)
    print(f"examples/{example.name}: {'passed' if done.returncode == 0 else 'FAILED'}")
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
