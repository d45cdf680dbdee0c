"""Hostile tasks: the rows of docs/security.md that say "does not hold" or "works".

A test that fails here may be good news: then the row is to be rewritten.
"""

from __future__ import annotations

import os
from multiprocessing import managers as originals
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults.runtime import running
from fiber import managers


class Hostile:
    """Object whose pickle runs code where it is unpickled."""

    def __reduce__(self) -> Any:
        return os.getpid, ()


@pytest.mark.usefixtures("backend")
def test_code_in_a_result_runs_in_the_program() -> None:
    with fiber.Pool(1) as pool:
        result: Any = pool.apply(Hostile)
        assert result == os.getpid()


def reaches(pid: int) -> bool:
    os.kill(pid, 0)
    return os.getpid() != pid


@pytest.mark.usefixtures("backend")
def test_a_task_reaches_other_processes_of_its_user() -> None:
    with fiber.Pool(1) as pool:
        assert pool.apply(reaches, (os.getpid(),))


@pytest.mark.usefixtures("local")
def test_a_proxy_gives_access_to_all_objects_of_its_manager() -> None:
    with managers.SyncManager() as manager:
        mine: Any = manager.list()
        others: Any = manager.dict(secret=7)
        connection: Any = mine._Client(mine._token.address, authkey=mine._authkey)
        dispatch = originals.__dict__["dispatch"]
        assert others._id in dispatch(connection, None, "debug_info")


@pytest.mark.usefixtures("local")
def test_pipes_and_queues_have_no_name() -> None:
    reader, writer = fiber.Pipe()
    with reader, writer:
        for end in (reader, writer):
            inode = os.readlink(f"/proc/self/fd/{end.fileno()}").strip("socket:[]")
            lines = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()]
            assert [line[7:] for line in lines if line[6] == inode] == [[]]


def renice_its_agent(by: int) -> tuple[int, int]:
    zygote = Path(f"/proc/{os.getppid()}/stat").read_text()
    agent = int(zygote.rpartition(")")[2].split()[1])
    before = os.getpriority(os.PRIO_PROCESS, agent)
    os.setpriority(os.PRIO_PROCESS, agent, before + by)
    return before, os.getpriority(os.PRIO_PROCESS, agent)


def test_a_task_changes_the_priority_of_its_agent() -> None:
    with running(backend="loopback"), fiber.Pool(1) as pool:
        before, after = pool.apply(renice_its_agent, (1,))
    assert after == before + 1
