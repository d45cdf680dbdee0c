"""Files with the output of children, on each backend: ``log_to``."""

from __future__ import annotations

import errno
import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from census import wait_until
from faults.program import LOOPBACK, Program
from faults.runtime import BACKENDS, running
from fiber._agent.output_tee import TeeFile, TeeStream
from fiber._output_files import (
    OutputFile,
    OutputKeeper,
    program_name,
    stem_of,
    usable,
    with_time,
)
from patience import PATIENCE

TIME = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}"


@pytest.fixture(params=BACKENDS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    """Folder with the files, which does not exist before."""
    folder = tmp_path / "new" / "logs"
    with running(backend=request.param, log_to=str(folder)):
        yield folder


def say(*texts: str) -> None:
    for text in texts:
        print(text)
    print("an error", file=sys.stderr)
    print("without an end", end="")


def say_and_die() -> None:
    print("the last words")
    os.kill(os.getpid(), signal.SIGKILL)


def say_without_an_end() -> None:
    print("the last words", end="", flush=True)
    os.kill(os.getpid(), signal.SIGKILL)


def say_in_a_child() -> None:
    child = fiber.Process(target=print, args=("from a grandchild",), name="grandchild")
    child.start()
    child.join()


def look_at_streams() -> list[Any]:
    streams = (sys.stdout, sys.stderr)
    names = [stream.name for stream in streams]
    return [*names, *(stream.fileno() for stream in streams), sys.stdout is sys.__stdout__]


def run(target: Callable[..., object], *args: Any, name: str = "one") -> fiber.Process:
    process = fiber.Process(target=target, args=args, name=name)
    process.start()
    process.join()
    return process


def contents(folder: Path, child: str) -> str:
    path = folder / f"{program_name()}.{child}.log"
    return path.read_text() if path.exists() else ""


def raw(folder: Path, child: str) -> str:
    """Return the contents of a child's file with its ends of lines."""
    path = folder / f"{program_name()}.{child}.log"
    return path.read_bytes().decode() if path.exists() else ""


def wait_for(folder: Path, child: str, text: str) -> None:
    assert wait_until(lambda: contents(folder, child) == text, PATIENCE), contents(folder, child)


def test_each_process_has_a_file(folder: Path) -> None:
    run(say, "first", "second")
    run(say, "third", name="two")
    wait_for(folder, "one", "first\nsecond\nan error\nwithout an end\n")
    wait_for(folder, "two", "third\nan error\nwithout an end\n")


def test_each_worker_has_a_file_from_its_first_line_on(folder: Path) -> None:
    with fiber.Pool(2) as pool:
        pool.map(abs, range(10))
        assert os.listdir(folder) == []
        pool.apply(print, ("begun",))
        assert wait_until(lambda: len(os.listdir(folder)) == 1, PATIENCE)
        (name,) = os.listdir(folder)
        assert wait_until(lambda: (folder / name).read_text() == "begun\n", PATIENCE)
        assert name in {f"{stem_of(program_name(), worker.name)}.log" for worker in pool.workers()}


def test_the_lines_of_a_killed_child_are_there(folder: Path) -> None:
    assert run(say_and_die).exitcode == -signal.SIGKILL
    wait_for(folder, "one", "the last words\n")


def test_the_last_line_of_a_killed_child_is_there_without_its_end(folder: Path) -> None:
    assert run(say_without_an_end).exitcode == -signal.SIGKILL
    assert wait_until(lambda: raw(folder, "one").rstrip() == "the last words", PATIENCE)


def test_children_of_one_name_have_separate_files(folder: Path) -> None:
    run(say, "first")
    wait_for(folder, "one", "first\nan error\nwithout an end\n")
    run(say, "second")
    wait_for(folder, "one.2", "second\nan error\nwithout an end\n")


@pytest.mark.parametrize("backend", BACKENDS)
def test_each_line_of_a_file_has_its_time_if_that_is_wanted(backend: str, tmp_path: Path) -> None:
    with running(backend=backend, log_to=str(tmp_path), log_times=True):
        run(say, "first\rsecond", "")
        lines = [f"{TIME} {text}\n" for text in ("first\rsecond", "", "an error", "without an end")]
        pattern = re.compile("".join(lines))
        assert wait_until(lambda: pattern.fullmatch(raw(tmp_path, "one")) is not None, PATIENCE)


def test_a_time_is_local_and_has_milliseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC-2")
    time.tzset()
    try:
        timed = with_time("one\n\n", 1_700_000_000.0625)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert timed == "2023-11-15 00:13:20.062 one\n2023-11-15 00:13:20.062 \n"


def test_no_name_leads_out_of_the_folder(folder: Path) -> None:
    run(say, name="../../out of\nthe folder/é")
    assert wait_until(lambda: len(os.listdir(folder)) == 1, PATIENCE)
    assert os.listdir(folder) == [f"{program_name()}._out_of_the_folder_.log"]
    assert os.listdir(folder.parent) == ["logs"]


def test_the_output_of_children_of_children_is_kept(folder: Path) -> None:
    run(say_in_a_child)
    text = "from a grandchild\n"
    assert wait_until(
        lambda: text in (contents(folder, "one"), contents(folder, "grandchild")), PATIENCE
    )


def test_the_streams_of_a_child_stay_what_they_are(folder: Path) -> None:
    with fiber.Pool(1) as pool:
        assert pool.apply(look_at_streams) == ["<stdout>", "<stderr>", 1, 2, True]


def test_a_folder_that_goes_away_harms_no_child(folder: Path) -> None:
    run(say, "first")
    wait_for(folder, "one", "first\nan error\nwithout an end\n")
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    assert run(say, "second", name="two").exitcode == 0


def test_a_folder_that_cannot_be_made_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    path = str(tmp_path / "file" / "logs")
    with pytest.warns(RuntimeWarning, match="is not kept in '.*/file/logs': Not a directory"):
        assert work_on(log_to=path) == 1


def work_on(**settings: Any) -> object:
    with running(backend="local", **settings), fiber.Pool(1) as pool:
        return pool.apply(abs, (-1,))


PROGRAM = """
    import fiber, sys
    def work(number):
        print("out", number)
        print("err", number, file=sys.stderr)
    if __name__ == "__main__":
        fiber.set_start_method(sys.argv[1])
        fiber.init(log_to="logs")
        child = fiber.Process(target=work, args=(5,), name="child")
        child.start()
        child.join()
"""


@pytest.mark.parametrize("env", [{}, LOOPBACK], ids=BACKENDS)
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_the_terminal_shows_everything(env: dict[str, str], method: str) -> None:
    program = Program(PROGRAM, method, env=env)
    try:
        shown = program.finish() + program.stderr.replace("[child@loopback-0] ", "")
        assert shown == "out 5\nerr 5\n"
        (path,) = (program.folder / "logs").iterdir()
        assert path.name == f"program-{program.pid}.child.log"
        assert path.read_text() == "out 5\nerr 5\n"
        assert program.left() == []
    finally:
        program.close()


# ---- the files ------------------------------------------------------------------------------


class Full(OutputFile):
    """File on a full disk."""

    def append(self, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def pipe_ends() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def test_a_full_disk_costs_only_the_lines_of_the_file(
    pipe_ends: tuple[int, int], tmp_path: Path
) -> None:
    reader, writer = pipe_ends
    tee = TeeStream(writer, "<stdout>", TeeFile(Full(str(tmp_path), "p", "c")))
    with io.TextIOWrapper(io.BufferedWriter(tee)) as stream:
        print("seen", file=stream, flush=True)
    assert os.read(reader, 100) == b"seen\n"


def test_a_file_has_at_once_what_is_written(pipe_ends: tuple[int, int], tmp_path: Path) -> None:
    _, writer = pipe_ends
    tee = TeeStream(writer, "<stdout>", TeeFile(OutputFile(str(tmp_path), "p", "c")))
    tee.write(b"a beginning")
    assert (tmp_path / "p.c.log").read_bytes() == b"a beginning"
    tee.write(b", an end\nand")
    tee.finish(io.StringIO())
    assert (tmp_path / "p.c.log").read_bytes() == b"a beginning, an end\nand\n"


def test_two_streams_share_no_line(pipe_ends: tuple[int, int], tmp_path: Path) -> None:
    _, writer = pipe_ends
    file = TeeFile(OutputFile(str(tmp_path), "p", "c"), times=True)
    output, errors = (TeeStream(writer, name, file) for name in ("<stdout>", "<stderr>"))
    output.write(b"one, ")
    output.write(b"two")
    errors.write(b"an error\n")
    output.write(b"\xff three\nfour\n")
    lines = (tmp_path / "p.c.log").read_bytes().splitlines()
    assert [line[24:] for line in lines] == [b"one, two", b"an error", b"\xff three", b"four"]
    assert all(re.fullmatch(TIME, line[:23].decode()) for line in lines)


def test_the_first_error_of_the_keeper_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    keeper = OutputKeeper(str(tmp_path), told.append)
    full = Full(str(tmp_path), "p", "c")
    keeper.write(full, "lost")
    keeper.write(full, "lost, too")
    good = keeper.file("c")
    keeper.write(good, "kept")
    keeper.close()
    assert len(told) == 1
    assert "No space left on device" in told[0]
    assert contents(tmp_path, "c") == "kept\n"


def test_lines_are_written_at_the_end_if_no_thread_can_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    keeper = OutputKeeper(str(tmp_path), print)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        keeper.write(keeper.file("c"), "kept")
    keeper.close()
    assert contents(tmp_path, "c") == "kept\n"


def test_lines_for_which_the_disk_is_too_slow_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fiber._output_files._ROOM", 10)
    monkeypatch.setattr(OutputKeeper, "_run", lambda self: None)
    keeper = OutputKeeper(str(tmp_path), print)
    file = keeper.file("c")
    keeper.write(file, "more than ten characters")
    keeper.write(file, "one\ntwo")
    assert file.left_out == 2
    keeper._waiting = 0
    keeper.write(file, "three")
    assert keeper._queue.qsize() == 2
    assert keeper._queue.get()
    entry = keeper._queue.get()
    assert entry is not None
    assert entry[1] == "[fiber] 2 lines are left out here: the disk was too slow\nthree"
    keeper.close()


def test_a_link_in_the_place_of_a_file_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "p.c.log").symlink_to(tmp_path / "secret")
    OutputFile(str(tmp_path), "p", "c").append(b"line\n")
    assert not (tmp_path / "secret").exists()
    assert (tmp_path / "p.c.2.log").read_bytes() == b"line\n"


def test_nothing_is_made_without_the_key() -> None:
    assert usable(None) is None
