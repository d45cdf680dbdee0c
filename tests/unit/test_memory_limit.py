"""Memory kills of children, as the kernel's files report them."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

from fiber._agent.agent import Agent
from fiber._agent.last_words import MemoryLimit


@pytest.fixture
def group(tmp_path: Path) -> Path:
    (tmp_path / "membership").write_text("1:cpu:/old\n0::/pod/worker\n")
    folder = tmp_path / "pod" / "worker"
    folder.mkdir(parents=True)
    return folder


def limit_of(group: Path) -> MemoryLimit:
    root = group.parents[1]
    return MemoryLimit(str(root), str(root / "membership"))


def kills(group: Path, count: int) -> None:
    (group / "memory.events").write_text(f"low 0\noom 9\noom_kill {count}\noom_group_kill 0\n")


def test_each_kill_is_reported_once(group: Path) -> None:
    kills(group, 3)
    limit = limit_of(group)
    assert not limit.was_exceeded()
    kills(group, 4)
    assert limit.was_exceeded()
    assert not limit.was_exceeded()


@pytest.mark.parametrize(
    ("maximum", "words"),
    [
        ("167772160\n", "its memory limit is 160Mi"),
        ("2147483648\n", "its memory limit is 2Gi"),
        ("1001\n", "its memory limit is 1001 bytes"),
        ("max\n", "its container has no memory limit"),
    ],
)
def test_the_limit_is_written_as_kubernetes_does(group: Path, maximum: str, words: str) -> None:
    (group / "memory.max").write_text(maximum)
    assert limit_of(group).describe() == words


def test_the_first_version_of_control_groups_counts_too(tmp_path: Path) -> None:
    (tmp_path / "membership").write_text("4:memory:/node/pod\n0::/node/pod\n")
    (tmp_path / "memory").mkdir()  # a container sees its own group as the root
    control = tmp_path / "memory" / "memory.oom_control"
    control.write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 0\n")
    (tmp_path / "memory" / "memory.limit_in_bytes").write_text("167772160\n")
    limit = MemoryLimit(str(tmp_path), str(tmp_path / "membership"))
    assert not limit.was_exceeded()
    control.write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 1\n")
    assert limit.was_exceeded()
    assert limit.describe() == "its memory limit is 160Mi"


def test_without_counters_no_kill_is_reported(tmp_path: Path) -> None:
    limit = MemoryLimit(str(tmp_path), str(tmp_path / "nothing"))
    assert not limit.was_exceeded()
    assert limit.describe() == "its container has no memory limit"


def test_a_child_that_was_killed_for_it_says_so(group: Path, loop: Any) -> None:
    kills(group, 0)
    (group / "memory.max").write_text("167772160\n")
    agent = Agent(loop, "here")
    agent.memory_limit = limit_of(group)
    assert agent.describe_end(-signal.SIGKILL) == "killed by SIGKILL"
    kills(group, 1)
    assert agent.describe_end(-signal.SIGTERM) == "killed by SIGTERM"
    assert agent.describe_end(-signal.SIGKILL) == "OOMKilled: its memory limit is 160Mi"
    agent.close()
