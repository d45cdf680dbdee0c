"""Bars of maps in a notebook: a real kernel, and functions that its cells define."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from conformance.notebook import LIMIT, bar, outputs_of

pytest.importorskip("tqdm", reason="tqdm is optional, as for users")

pytestmark = pytest.mark.timeout(LIMIT)

BEGIN = """
import time, threading
import fiber

def square(number):
    return number * number

def linger(number):
    time.sleep(0.7)  # longer than a short map, of which the configuration shows nothing
    return number
"""
END = """
pool.terminate()
pool.join()
while "fiber-progress" in [thread.name for thread in threading.enumerate()]:
    time.sleep(0.01)
print("over")
"""


def shown(folder: Path, backend: str, *cells: str) -> list[Any]:
    """Run cells in a kernel, and return the output of each."""
    return outputs_of(folder, {"FIBER_BACKEND": backend}, *cells)


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_a_notebook_shows_the_bars_of_its_cells(tmp_path: Path, backend: str) -> None:
    outputs = shown(
        tmp_path,
        backend,
        f"{BEGIN}pool = fiber.Pool(2)",
        "print(sum(pool.map(square, range(50), progress=True)))",
        "print(sum(pool.imap(square, iter(range(50)), progress='lazy')))",
        "pool.map(square, range(50));",
        END,
    )
    assert "50/50" in bar(outputs[1], "square")
    assert "50/50" in bar(outputs[2], "lazy")
    assert [output["stdout"] for output in outputs[1:]] == ["40425\n", "40425\n", "", "over\n"]
    assert (outputs[3]["stderr"], outputs[3]["displays"]) == ("", 0)


def test_the_configuration_shows_long_maps_of_a_notebook(tmp_path: Path) -> None:
    outputs = shown(
        tmp_path,
        "local",
        f"{BEGIN}fiber.init(progress='auto')\npool = fiber.Pool(2)",
        "pool.map(linger, range(2));",
        "pool.map(linger, range(2), progress=False);",
        END,
    )
    assert "2/2" in bar(outputs[1], "linger")
    assert (outputs[2]["stderr"], outputs[2]["displays"]) == ("", 0)


def test_an_interrupted_map_ends_its_bar(tmp_path: Path) -> None:
    outputs = shown(
        tmp_path,
        "local",
        f"{BEGIN}import signal\npool = fiber.Pool(1)",
        """
def interrupt(number):
    import os
    os.kill(parent, signal.SIGINT)
    while True:
        time.sleep(1)

import os
parent = os.getpid()
try:
    pool.map(interrupt, [1], progress=True)
except KeyboardInterrupt:
    print("interrupted")
""",
        END,
    )
    assert "0/1" in bar(outputs[1], "interrupt:")
    assert [output["stdout"] for output in outputs[1:]] == ["interrupted\n", "over\n"]
