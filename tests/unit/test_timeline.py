"""Files with timelines: forms, errors, and pictures with a bounded number of artists."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import fiber
from fiber._engine.activity import Activity, WorkReport
from fiber._runtime import timeline_picture
from fiber._runtime.timeline import TimelineAtEnd, write_timeline

PROGRAM = {"name": "train-7", "pid": 7, "python": "3.11.0", "fiber": "0.1"}

DRAWING = """
import fiber, sys
for form in sys.argv[1:]:
    fiber.timeline(f"run.{form}")
"""
"""Program that draws pictures: matplotlib never closes the fonts that it opens."""


def record_of(workers: int, answers: int, hosts: int = 3) -> dict[str, Any]:
    """Return a snapshot of workers with several functions, the first of which died."""
    activity = Activity(0.0)
    children = [activity.add_child(f"worker-{number}", 0.0) for number in range(workers)]
    for number, child in enumerate(children):
        activity.started(child, 1.0, f"host-{number % hosts}", "", number)
        activity.ready(child, 1.5, 1)
    for number in range(answers):
        begin = 2 + number / workers
        report = WorkReport(f"f{number % 20}", begin, begin + 0.9, 0.9, 3, number % 2)
        activity.worked(children[number % workers], report)
    activity.ended(children[0], 3 + answers / workers, "killed by SIGKILL")
    return {"start": 1.7e9, "busy": [[2, 5.0]], **activity.snapshot(4 + answers / workers)}


def test_a_trace_may_be_compressed(tmp_path: Path) -> None:
    fiber.timeline(tmp_path / "run.json")
    fiber.timeline(str(tmp_path / "run.json.gz"))
    plain = json.loads((tmp_path / "run.json").read_bytes())
    assert plain["otherData"]["tasks"] == 0
    packed = json.loads(gzip.decompress((tmp_path / "run.json.gz").read_bytes()))
    assert packed.keys() == plain.keys()
    assert sorted(os.listdir(tmp_path)) == ["run.json", "run.json.gz"]


def test_pictures_are_written(tmp_path: Path) -> None:
    command = [sys.executable, "-c", DRAWING, "png", "svg", "pdf"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    begins = {path.suffix: path.read_bytes()[:5] for path in tmp_path.iterdir()}
    assert begins == {".png": b"\x89PNG\r", ".svg": b"<?xml", ".pdf": b"%PDF-"}


@pytest.mark.parametrize("workers", [1, 4, 40, 2000])
def test_a_picture_has_few_artists(workers: int) -> None:
    figure = timeline_picture.draw(record_of(workers, 10_000), "train-7")
    assert len(figure.findobj()) < 700


def test_bars_that_are_too_close_to_tell_apart_become_one() -> None:
    bars = [timeline_picture.Bar(at % 2, at * 1e-6, (at + 1) * 1e-6) for at in range(0, 1000, 2)]
    bars += [timeline_picture.Bar(1, 0.5, 0.6)]
    joined = list(timeline_picture._joined(bars, 0.01))
    assert joined == [timeline_picture.Bar(0, 0.0, 999 * 1e-6), timeline_picture.Bar(1, 0.5, 0.6)]


# Errors


@pytest.mark.parametrize("name", ["run", "run.txt", ".json", "run.json.bz2", ""])
def test_another_suffix_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no suffix that Fiber knows.* Use \.json"):
        fiber.timeline(tmp_path / name)


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*/none .*Make it"):
        fiber.timeline(tmp_path / "none" / "run.json")


def test_a_path_that_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").mkdir()
    with pytest.raises(IsADirectoryError, match="which is a folder"):
        fiber.timeline(tmp_path / "run.json")
    os.mkfifo(tmp_path / "fifo.json")
    with pytest.raises(OSError, match="which is no ordinary file"):
        fiber.timeline(tmp_path / "fifo.json")


def test_a_failed_write_leaves_the_earlier_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.json"
    path.write_text("earlier")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(
        OSError, match=r"cannot be written: No space left .*Choose a path"
    ) as raised:
        fiber.timeline(path)
    assert raised.value.errno == 28
    assert path.read_text() == "earlier"
    assert os.listdir(tmp_path) == ["run.json"]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link.json").symlink_to("run.json")
    fiber.timeline(tmp_path / "link.json")
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "run.json").read_bytes())


def test_a_picture_without_matplotlib(tmp_path: Path) -> None:
    program = f"import sys; sys.modules['matplotlib'] = None\n{DRAWING}"
    command = [sys.executable, "-c", program, "json", "png"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == (
        "ModuleNotFoundError: a timeline in the form .png needs the package matplotlib, which is "
        "not installed: pip install matplotlib"
    )
    assert os.listdir(tmp_path) == ["run.json"]


# At the end of a program


def end(timeline: TimelineAtEnd) -> None:
    with timeline.writing(lambda: record_of(2, 10)):
        pass


def test_the_process_id_may_be_in_the_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    end(TimelineAtEnd(str(tmp_path / "run-%p.json")))
    assert os.listdir(tmp_path) == [f"run-{os.getpid()}.json"]
    assert capsys.readouterr().err == ""


def test_an_earlier_run_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("earlier")
    end(TimelineAtEnd(str(tmp_path / "run.json")))
    assert json.loads((tmp_path / "run.json").read_bytes())["otherData"]["tasks"] == 30


def test_the_file_of_a_program_beside_this_one_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.json.gz"
    timeline = TimelineAtEnd(str(path))
    path.write_text("of another program")
    end(timeline)
    assert path.read_text() == "of another program"
    mine = tmp_path / f"run-{os.getpid()}.json.gz"
    assert json.loads(gzip.decompress(mine.read_bytes()))
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"fiber: another program has written {path}. See {mine}."


def test_a_timeline_that_the_program_wrote_itself_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.json"
    timeline = TimelineAtEnd(str(path))
    write_timeline(str(path), record_of(1, 1), PROGRAM)
    end(timeline)
    assert json.loads(path.read_bytes())["otherData"]["tasks"] == 30
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "problem"), [("run.txt", "no suffix"), ("none/run.json", "there is no folder")]
)
def test_a_problem_is_printed_once_and_at_the_beginning(
    name: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timeline = TimelineAtEnd(str(tmp_path / name))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"fiber: no timeline {tmp_path / name}: ")
    assert problem in line
    end(timeline)
    assert capsys.readouterr().err == ""
    assert os.listdir(tmp_path) == []


def test_a_record_that_cannot_be_read_does_not_reach_the_program(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> dict[str, Any]:
        raise fiber.FiberError("the loop does not answer")

    with TimelineAtEnd(str(tmp_path / "run.json")).writing(fail):
        pass
    assert "the loop does not answer" in capsys.readouterr().err


def test_an_error_of_the_end_is_raised_after_the_timeline(tmp_path: Path) -> None:
    timeline = TimelineAtEnd(str(tmp_path / "run.json"))
    with pytest.raises(KeyboardInterrupt), timeline.writing(lambda: record_of(1, 1)):
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == ["run.json"]


def test_a_picture_that_cannot_be_drawn_becomes_a_trace(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(timeline_picture, "draw", fail)
    end(TimelineAtEnd(str(tmp_path / "run.png")))
    assert os.listdir(tmp_path) == ["run.png.json"]
    assert "cannot be drawn: RuntimeError('no fonts')" in capsys.readouterr().err
