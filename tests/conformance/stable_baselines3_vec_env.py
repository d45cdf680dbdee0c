"""stable-baselines3's own tests of vector environments, with ``fiber.vector.VecEnv`` in the place
of ``SubprocVecEnv``:

    python tests/conformance/stable_baselines3_vec_env.py CHECKOUT [pytest's options]

where CHECKOUT is its repository, at the version that is installed: its package comes without these
tests.  Where torch is not installed, what stands in for it has its names; tests that learn are left
out then.  This module is the plugin, too, that has pytest do so.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = (
    "tests/test_vec_check_nan.py",
    "tests/test_vec_envs.py",
    "tests/test_vec_extract_dict_obs.py",
    "tests/test_vec_monitor.py",
    "tests/test_vec_normalize.py",
    "tests/test_vec_stacked_obs.py",
)

STAND_INS = Path(__file__).parents[1] / "stand_ins"

# Parts of the ids of tests that learn.
LEARNING = (
    "test_her_normalization",
    "test_offpolicy_normalization",
    "test_vec_monitor_ppo",
    "test_vec_with_ppo",
    "test_video_recorder",
)


def pytest_configure() -> None:
    """Before any test is imported."""
    import stable_baselines3.common.vec_env as theirs

    from fiber.vector import VecEnv

    for module in (theirs, theirs.subproc_vec_env):
        vars(module)["SubprocVecEnv"] = VecEnv


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip learning: it needs torch."""
    torch = importlib.util.find_spec("torch")
    if torch is not None and torch.origin is not None and STAND_INS in Path(torch.origin).parents:
        for item in items:
            if any(name in item.nodeid for name in LEARNING):
                item.add_marker(pytest.mark.skip(reason="torch is not installed"))


def main(checkout: str, *options: str) -> int:
    """Run them; the exit status is pytest's."""
    folders = [Path(checkout).resolve(), Path(__file__).parents[1]]
    if importlib.util.find_spec("torch") is None:
        folders.append(STAND_INS)
    path = [*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]
    plugin = "conformance.stable_baselines3_vec_env"
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", plugin, "-rxX", *TESTS, *options],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path)},
    ).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
