"""Vector environments whose observations are in shared memory: Gymnasium's own, adopted, and one in
the manner of OpenAI Baselines.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run

HERE = Path(__file__).parent


@pytest.mark.parametrize("backend", BACKENDS)
def test_gymnasium_sees_the_same_with_and_without_shared_memory(backend: str) -> None:
    done = run(str(HERE / "gymnasium_spaces.py"), backend=backend)
    assert done.stdout == "shared_memory=True: the same\nshared_memory=False: the same\n"
    assert not done.stderr


@pytest.mark.parametrize("backend", BACKENDS)
def test_shmem_vec_env(backend: str) -> None:
    done = run(str(HERE / "shmem_vec_env.py"), backend=backend)
    assert done.stdout == "observations: the same\n"
    assert not done.stderr
