"""Tasks that write to the channel of their worker: they reach no results but their own."""

from __future__ import annotations

import os
import pickle
import threading
from pathlib import Path
from typing import Any

import pytest

import fiber
from fiber._agent import child
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


def victim(begun: Path, go: Path) -> str:
    begun.touch()
    while not go.exists():
        threading.Event().wait(0.01)
    return "the true result"


def _words(lie: str, own: int) -> Any:
    if lie == "another's batch":
        return [(seq, 0, None, 0.0, ["forged"], []) for seq in range(1, own + 20) if seq != own]
    return {
        "no such batch": [(own + 10**6, 0, None, 0.0, ["forged"], [])],
        "a wrong offset": [(own, 1, None, 0.0, ["forged"], [])],
        "too many results": [(own, 0, None, 0.0, ["forged", "forged"], [])],
        "an impossible value": [(own, 0, None, 0.0, ["forged"], [(5, 0, b"", 0)])],
        "another's message is unreadable": [("unreadable", own - 1, b"")],
        "no such kind": [("nonsense",)],
    }[lie]


def attack(lie: str, begun: Path) -> None:
    """Send a wrong answer in the name of this worker, and wait for the result."""
    while not begun.exists():
        threading.Event().wait(0.01)
    channel = child.task_channel()
    if lie == "no pickle":
        channel.send(b"garbage")
    else:
        for words in _words(lie, child.progress()[0]):
            channel.send(pickle.dumps(words))
    threading.Event().wait()


@pytest.mark.parametrize(
    "lie",
    [
        "another's batch",
        "no such batch",
        "a wrong offset",
        "too many results",
        "an impossible value",
        "another's message is unreadable",
        "no such kind",
        "no pickle",
    ],
)
def test_a_wrong_answer_ends_its_worker(lie: str, tmp_path: Path) -> None:
    begun, go = tmp_path / "begun", tmp_path / "go"
    with fiber.Pool(2, retries=1) as pool:
        others = pool.apply_async(victim, (begun, go))
        wrong = pool.apply_async(attack, (lie, begun))
        with pytest.raises(fiber.WorkerDied, match=r"attack.*\n.*WrongAnswer: it ") as caught:
            wrong.get(PATIENCE)
        assert caught.value.attempts == 2
        go.touch()
        assert others.get(PATIENCE) == "the true result"
        assert pool.map(abs, range(-20, 0)) == list(range(20, 0, -1))


def test_a_wrong_answer_to_a_caller_that_waits_for_its_worker(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    begun.touch()
    with fiber.Pool(1, retries=1) as pool:
        assert pool.apply(os.getpid)  # the next call goes to the worker without the loop
        with pytest.raises(fiber.WorkerDied, match="WrongAnswer: it sent a malformed message"):
            pool.apply(attack, ("no pickle", begun))
        assert pool.apply(abs, (-1,)) == 1
