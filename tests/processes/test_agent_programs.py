"""Children of an agent that was sent their program's files."""

from __future__ import annotations

import runpy
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import census
from fiber._agent.agent import Agent
from fiber._agent.child import ProgramPaths
from fiber._agent.interface import Cause
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop
from fiber._wire.descriptor import contents
from fiber._wire.memory_files import Blob
from patience import PATIENCE
from processes.test_agent import begin, end, settled
from unit.shipping_site import packed, write

PATHS = ProgramPaths(("es",), (), "es", None)


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Agent]:
    loop = Loop()
    loop.start_thread("fiber-io")
    hub = Hub(loop, "here", str(tmp_path))
    made = Agent(loop, "here", hub)
    yield made
    made.close()
    hub.close()
    settled(loop)
    loop.stop()
    assert not list(tmp_path.glob("fiber-*")), "no program is left"


def program(folder: Path, status: int) -> Blob:
    """A program that exits with ``status``, from its working directory."""
    main = "import os; os._exit(int(open('status.txt').read()))"
    return Blob(packed(write(folder / "es", main_py=main, status_txt=str(status))))


def run(agent: Agent, archive: Blob, method: str = "fork") -> int:
    """The exit status of a child that runs it."""
    options = {"program": archive, "preparation": {"program": PATHS}, "method": method}
    _, observer = begin(agent, runpy.run_path, "main.py", **options)
    status: int = observer.wait_for_exit().exitcode
    return status


def zygotes(agent: Agent) -> int:
    return len(agent._zygotes)


def folders(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in tmp_path.glob("fiber-*/program-*"))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_children_of_one_program_share_its_folder(
    agent: Agent, tmp_path: Path, method: str
) -> None:
    archive = program(tmp_path, 3)
    assert [run(agent, archive, method) for _ in range(2)] == [3, 3]
    assert folders(tmp_path) == ["program-1"]
    again = Blob(contents(archive.fileno())[:])
    assert run(agent, again, method) == 3
    assert folders(tmp_path) == ["program-1"]


def test_each_program_has_a_zygote_as_long_as_it_has_children(agent: Agent, tmp_path: Path) -> None:
    first, second = program(tmp_path, 1), program(tmp_path, 2)
    options = {"program": first, "preparation": {"program": PATHS}}
    child, observer = begin(agent, signal.pause, **options)
    observer.wait_for_start()
    assert run(agent, second) == 2
    assert folders(tmp_path) == ["program-1", "program-2"], "the first still runs"
    end(child, observer)
    assert census.wait_until(lambda: folders(tmp_path) == ["program-2"], PATIENCE)
    assert census.wait_until(lambda: zygotes(agent) == 1, PATIENCE)
    assert run(agent, first) == 1, "it is unpacked anew"


def test_a_folder_that_cannot_be_made_is_tried_again_for_the_next_child(
    agent: Agent, tmp_path: Path
) -> None:
    archive = program(tmp_path, 3)
    directory = Path(agent._hub.address.path).parent  # type: ignore[union-attr]
    (directory / "program-1").write_text("in its way")
    options = {"program": archive, "preparation": {"program": PATHS}}
    _, observer = begin(agent, signal.pause, **options)
    report = observer.wait_for_exit()
    assert report.cause == Cause.REFUSED
    assert "the program's files could not be unpacked: [Errno 17] File exists" in report.reason
    (directory / "program-1").unlink()
    assert run(agent, archive) == 3


def test_a_child_without_a_directory_for_its_program_does_not_start() -> None:
    loop = Loop()
    loop.start_thread("fiber-io")
    agent = Agent(loop, "here")
    with pytest.raises(OSError, match="no directory for the program's files"):
        begin(agent, signal.pause, program=Blob(b""), preparation={"program": PATHS})
    agent.close()
    loop.stop()
