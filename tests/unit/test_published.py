"""The harness of the published programs: bad input, comparing, and the table."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import published.__main__ as published
from published import checks, table
from published.__main__ import Ended, verdict
from published.comparing import difference
from published.records import Package, Program, Version, programs
from published.runs import Run, RunFailed, Value, added_lines, outcomes

REPORT = """<testsuites><testsuite>
<testcase classname="a" name="one"/>
<testcase classname="a" name="two"><failure message="no"/></testcase>
<testcase classname="a" name="three"><skipped message="no"/></testcase>
</testsuite></testsuites>"""


def nothing(_run: Run) -> dict[str, Value]:
    """Run nothing, for records whose checks are tested."""
    return {}


def record(
    files: tuple[str, ...] = (),
    packages: tuple[Package, ...] = (),
    roms: tuple[str, ...] = (),
    version: Version | None = None,
) -> Program:
    """Return the record of a program that needs these."""
    return Program(
        name="walker",
        upstream="https://example.org/walker",
        clone="walker",
        way="one changed line",
        ran="all of it",
        run=nothing,
        files=files,
        packages=packages,
        roms=roms,
        version=version,
    )


@pytest.fixture
def clones(tmp_path: Path) -> Path:
    """Return a folder with one clone, whose version is 1.2."""
    (tmp_path / "walker").mkdir()
    (tmp_path / "walker" / "version.py").write_text('__version__ = "1.2"\n')
    return tmp_path


def test_a_missing_clone_is_one_line_that_says_how_to_get_it(tmp_path: Path) -> None:
    line = checks.missing(record(), tmp_path)
    assert line is not None
    assert line.startswith(f"walker: {tmp_path / 'walker'} is not there: git clone https://")
    assert "\n" not in line


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (record(files=("main.py",)), "has no main.py, so its version does not fit"),
        (record(version=Version("version.py", ">=2.0")), "has version 1.2, which does not fit"),
        (record(version=Version("absent.py", ">=2.0")), "says no version"),
        (
            record(packages=(Package("no_such_box", "no-such>=2"),)),
            "pip install 'no-such>=2'",
        ),
        (
            record(packages=(Package("no_such_box.lid", "no-such>=2"),)),
            "pip install 'no-such>=2'",
        ),
        (record(packages=(Package("pytest", "pytest>=9999"),)), "pip install 'pytest>=9999'"),
        (record(packages=(Package("pytest", "no-such-box"),)), "pip install 'no-such-box'"),
        (record(roms=("no_such_game",)), "ROM of no_such_game is not installed: pip install"),
    ],
    ids=["file", "version", "no version", "package", "module", "old", "other", "rom"],
)
def test_other_bad_input_is_one_line_that_says_what_to_do(
    program: Program, said: str, clones: Path
) -> None:
    line = checks.missing(program, clones)
    assert line is not None
    assert line.startswith("walker: ")
    assert said in line
    assert "\n" not in line


def test_a_program_that_has_all_it_needs_may_run(clones: Path) -> None:
    fits = Version("version.py", ">=1.0,<2")
    installed = (Package("pytest", "pytest>=1"),)
    assert checks.missing(record(("version.py",), installed, version=fits), clones) is None


def test_a_missing_program_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"{table.BEGIN}\n{table.END}\n")
    monkeypatch.setattr(published, "PAGE", page)
    monkeypatch.setattr(published, "RESULTS", tmp_path / "results.json")
    assert published.main([str(tmp_path), "--only", "poet", "DEAP"]) == 1
    first, second, last = capsys.readouterr().err.splitlines()
    assert first.startswith("poet: ")
    assert second.startswith("DEAP: ")
    assert last == "published: not run, or not the same: poet, DEAP"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([""], "name the folder with the clones: make published CLONES=folder"),
        (["no-such-folder"], "no-such-folder is no folder"),
        ([".", "--only", "nobody"], "there is no program nobody"),
        ([".", "--backends", "moon"], "invalid choice: 'moon'"),
        ([".", "--backends", "kubernetes"], "kubernetes needs a cluster and an image"),
    ],
)
def test_wrong_arguments_are_refused(
    arguments: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("FIBER_IMAGE", raising=False)
    with pytest.raises(SystemExit) as ended:
        published.main(arguments)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_another_commit_than_that_of_the_table_is_named(
    clones: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = clones / "results.json"
    table.write(results, {"walker": {"commit": "0123456789"}})
    monkeypatch.setattr(published, "RESULTS", results)
    monkeypatch.setattr(published, "_run", lambda *_: Ended(None, "status 1"))
    assert not published.compare(record(), clones, ["local"])
    said = capsys.readouterr().err
    assert f"git -C {clones / 'walker'} checkout 0123456789" in said


def test_pods_need_a_cluster_and_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("KUBECONFIG", "FIBER_IMAGE"):
        monkeypatch.delenv(name, raising=False)
    assert published.available() == ["local", "loopback"]
    monkeypatch.setenv("KUBECONFIG", "file")
    monkeypatch.setenv("FIBER_IMAGE", "image")
    assert published.available() == ["local", "loopback", "kubernetes"]


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"a": [1.0, float("nan")], "b": "x"}, None),
        ({"a": [1.0, 2.0], "b": "x"}, "a[1] is 2.0, with multiprocessing nan"),
        ({"a": [1.0 + 2**-52, float("nan")], "b": "x"}, "a[0] is 1.0000000000000002"),
        ({"a": [1.0], "b": "x"}, "a[1] is missing"),
        ({"a": [1.0, float("nan"), 3], "b": "x"}, "a[2] is 3, and multiprocessing has none"),
        ({"a": [True, float("nan")], "b": "x"}, "a[0] is True"),
    ],
    ids=["same", "nan", "last bit", "fewer", "more", "type"],
)
def test_values_are_compared_to_the_last_bit(found: dict[str, Value], said: str | None) -> None:
    reported = difference({"a": [1.0, float("nan")], "b": "x"}, found)
    assert reported is None if said is None else str(reported).startswith(said)


def test_a_verdict_says_what_happened() -> None:
    expected = {"values": {"a": [1, 2]}}
    assert verdict(expected, Ended({"values": {"a": [1, 2]}})) == "same (2 values)"
    failed = {"values": {"test": "failure", "other": "passed"}}
    assert verdict(failed, Ended(failed)) == "same (2 values, 1 of them failures)"
    assert verdict(expected, Ended({"values": {"a": [1, 3]}})).startswith("differs: a[1] is 3")
    nothing = Ended({"values": {"a": []}})
    assert verdict({"values": {}}, nothing) == "failed: it gave no values to compare"
    assert verdict(expected, Ended(None, "status 1")) == "failed: status 1"
    assert verdict(None, Ended(None)) == "not run: it failed with multiprocessing"


def test_a_run_leaves_no_process_of_any_group() -> None:
    program = (
        "import subprocess, sys\n"
        "print(subprocess.Popen(['sleep', '600'], process_group=0).pid, flush=True)\n"
        "sys.stdin.read()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    with process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        assert pid in published._living(process.pid)
        published._end(process)
        assert published._living(process.pid) == []


def test_changed_lines_are_counted_in_a_copy(clones: Path, tmp_path: Path) -> None:
    (clones / "walker" / "main.py").write_text("import multiprocessing\nrun()\n")
    run = Run("local", clones / "walker", tmp_path)
    program = run.copy() / "main.py"
    run.replace(program, "import multiprocessing\n", "import fiber as multiprocessing\n")
    assert run.changed == ["import fiber as multiprocessing"]
    assert program.read_text() == "import fiber as multiprocessing\nrun()\n"
    assert (clones / "walker" / "main.py").read_text() == "import multiprocessing\nrun()\n"
    with pytest.raises(RunFailed, match=r"0 times 'absent'.* does not fit"):
        run.replace(program, "absent", "present")
    assert added_lines("a\nb\n", "a\nc\nd\n") == ["c", "d"]


def test_outcomes_of_tests_come_from_the_report(tmp_path: Path) -> None:
    report = tmp_path / "report.xml"
    report.write_text(REPORT)
    expected = {"a::one": "passed", "a::two": "failure", "a::three": "skipped"}
    assert outcomes(report) == expected
    report.write_text("<testsuite/>")
    with pytest.raises(RunFailed, match="none of the tests passed"):
        outcomes(report)
    with pytest.raises(RunFailed, match="wrote no report"):
        outcomes(tmp_path / "absent.xml")


def test_the_table_has_what_ran_and_keeps_what_ran_earlier() -> None:
    every = {"walker": record(), "other": record()}
    results: table.Results = {}
    table.add(results, "walker", "abc", ["import fiber"], {"local": "same (2 values)"})
    table.add(results, "walker", "abc", ["import fiber"], {"loopback": "differs: a is 1"})
    *_, row = table.rows(every, results)
    assert row == (
        "| [walker](https://example.org/walker) `abc` | one changed line | 1 | all of it "
        "| nothing | same (2 values) | differs: a is 1 | not run |"
    )
    table.add(results, "walker", "def", [], {"local": "same (2 values)"})
    assert results["walker"]["outcome"] == {"local": "same (2 values)"}


def test_the_table_replaces_what_is_between_the_markers() -> None:
    page = f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n"
    assert table.put_into(page, ["new"]) == f"before\n{table.BEGIN}\n\nnew\n\n{table.END}\nafter\n"
    with pytest.raises(ValueError, match="the page needs the lines"):
        table.put_into("no markers", ["new"])


def test_the_page_shows_the_results_of_the_file() -> None:
    page = published.PAGE.read_text(encoding="utf-8")
    lines = table.rows(programs(), table.read(published.RESULTS))
    assert table.put_into(page, lines) == page


def test_the_records_name_requirements_that_are_in_the_list() -> None:
    listed = Path(published.__file__).with_name("requirements.txt").read_text(encoding="utf-8")
    names = {line.split(">")[0].split("=")[0].lower() for line in listed.splitlines()}
    for program in programs().values():
        for package in program.packages:
            name = package.requirement.split(">")[0].split("=")[0].lower()
            assert name in names, f"{program.name} needs {name}"


def test_a_commit_is_that_of_the_clone(tmp_path: Path) -> None:
    assert checks.commit(tmp_path) == "unknown"
    for command in (
        ["git", "init", "-q"],
        ["git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "a", "--allow-empty"],
    ):
        subprocess.run(command, cwd=tmp_path, check=True)
    assert len(checks.commit(tmp_path)) == 10
