"""examples/01-pi"""

from __future__ import annotations

import pytest

from examples.run_example import BACKENDS, run


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_example_prints_pi(backend: str) -> None:
    done = run("01-pi/pi.py", "1e5", backend=backend)
    text, _, number = done.stdout.strip().rpartition(" ")
    assert text == "Pi is roughly"
    assert float(number) == pytest.approx(3.1416, abs=0.05)  # ten standard deviations
    assert not done.stderr
