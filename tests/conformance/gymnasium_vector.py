"""Gymnasium's own tests of vector environments, with ``fiber.vector.VectorEnv`` in the place of
``AsyncVectorEnv``:

    python tests/conformance/gymnasium_vector.py CHECKOUT [--adopted] [pytest's options]

With ``--adopted`` it is Gymnasium's own ``AsyncVectorEnv`` that they test, with Fiber's processes,
pipes and shared memory (``fiber.adopt``).  CHECKOUT is Gymnasium's repository, at the version that
is installed: its package comes without these tests.  They need what Gymnasium's extra `testing`
installs.  This module is the plugin, too, that has pytest do so.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium.vector
import pytest
from gymnasium.vector import async_vector_env

import fiber.vector

TESTS = (
    "tests/vector/test_async_vector_env.py",
    "tests/vector/test_autoreset_mode.py",
    "tests/vector/test_observation_mode.py",
    "tests/vector/test_vector_env.py",
    "tests/vector/test_vector_env_info.py",
    "tests/vector/test_vector_wrapper.py",
    "tests/wrappers/vector",
    "tests/envs/registration/test_make_vec.py",
    # Opens windows, and makes MuJoCo draw in them.
    "--ignore=tests/wrappers/vector/test_human_rendering.py",
)

TESTS_OF_ASYNC_VECTOR_ENV = ("tests/vector/test_async_vector_env.py",)
ADOPTED = "--adopted"

# A part of a test's id -> why it cannot pass.
EXCLUSIONS = {
    "test_custom_space_async_vector_env_shared_memory": (
        "custom spaces are no error with shared memory: what does not fit into it travels"
    ),
    "test_async_vector_subenv_error": (
        "a worker goes on when an environment raises, so no log tells that it is shut down; "
        "the error has a note that names the environment"
    ),
}


class AsyncVectorEnv(fiber.vector.VectorEnv):
    """Vector environment with the arguments of Gymnasium's, in its order."""

    def __init__(
        self,
        env_fns: Any,
        shared_memory: bool = True,
        copy: bool = True,
        context: str | None = None,
        daemon: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(
            env_fns, shared_memory=shared_memory, copy=copy, context=context, **options
        )


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that ``main`` passes on."""
    parser.addoption(ADOPTED, action="store_true")


def pytest_configure(config: pytest.Config) -> None:
    """Before any test is imported."""
    if config.getoption(ADOPTED):
        fiber.adopt(async_vector_env.__name__)
        return
    for module in (gymnasium.vector, async_vector_env):
        vars(module)["AsyncVectorEnv"] = AsyncVectorEnv


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Expect listed tests to fail: a listed test that passes is an error."""
    if config.getoption(ADOPTED):
        return
    for item in items:
        for name, reason in EXCLUSIONS.items():
            if name in item.nodeid:
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


def main(checkout: str, *options: str) -> int:
    """Run them; the exit status is pytest's."""
    folders = [str(Path(checkout).resolve()), str(Path(__file__).parents[1])]
    folders += filter(None, [os.environ.get("PYTHONPATH")])
    command = [sys.executable, "-m", "pytest", "-p", "conformance.gymnasium_vector", "-rxX"]
    command += TESTS_OF_ASYNC_VECTOR_ENV if ADOPTED in options else TESTS
    return subprocess.run(
        [*command, *options],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
    ).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
