"""Directories that are missing, full or forbidden, and the program's needs of them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from faults.program import Program
from patience import PATIENCE

WORK = """
    import fiber, os, sys
    from faults import targets
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        theirs.close()
        ours.send(1)
        print(ours.recv())
        ours.close()
        child.join()
        with fiber.Pool(2) as pool:
            print(pool.map(abs, [-1, -2]))
"""


SHARE = """
    import fiber, tempfile
    def share():
        carrier, _ = fiber.Pipe()
        end, _ = fiber.Pipe()
        carrier.send(end)
    def try_to_share():
        try:
            share()
        except OSError as error:
            return str(error)
    if __name__ == "__main__":
        {before}
        with fiber.Pool(1) as pool:
            print(pool.apply(try_to_share))
        share()
"""


@pytest.fixture
def folder() -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="d-"))
    yield made
    shutil.rmtree(made, ignore_errors=True)


def test_no_temporary_directory_at_all(launch_on: Callable[..., Program]) -> None:
    """Python falls back to other directories; where TMPDIR does not exist no file is lost."""
    program = launch_on(WORK, env={"TMPDIR": "/no/such/directory"})
    assert program.finish() == "1\n[1, 2]\n"


def test_a_temporary_directory_that_goes_away_while_it_runs(
    launch_on: Callable[..., Program], folder: Path
) -> None:
    gone = folder / "gone"
    gone.mkdir()
    script = WORK.replace(
        "with fiber.Pool(2)",
        f"import shutil; shutil.rmtree({str(gone)!r})\n        with fiber.Pool(2)",
    )
    program = launch_on(script, env={"TMPDIR": str(gone)})
    assert program.finish() == "1\n[1, 2]\n"


NOWHERE = "import tempfile; tempfile.tempdir = '/no/such/directory'"


def test_nowhere_to_write_is_no_matter_until_something_is_shared(
    launch: Callable[..., Program],
) -> None:
    script = WORK.replace("ours, theirs", NOWHERE + "\n        ours, theirs", 1)
    program = launch(script)
    assert program.finish() == "1\n[1, 2]\n"
    assert program.left() == []


def test_nowhere_to_write_is_said_when_something_is_shared(
    launch: Callable[..., Program],
) -> None:
    program = launch(SHARE.format(before=NOWHERE))
    in_a_worker = program.line()
    assert program.wait() == 1
    for said in (in_a_worker, program.stderr):
        assert "no pipe, queue, lock or value can be shared" in said
        assert "/no/such/directory" in said
        assert "Set FIBER_RUNTIME_DIRECTORY" in said
    assert program.left() == []


def test_a_runtime_directory_that_is_a_file_is_named(
    launch: Callable[..., Program], folder: Path
) -> None:
    file = folder / "file"
    file.touch()
    program = launch(WORK, env={"FIBER_RUNTIME_DIRECTORY": str(file)})
    assert program.wait() == 1
    assert str(file) in program.stderr
    assert "ConfigError" in program.stderr


def test_a_path_too_long_for_a_socket_names_the_setting(
    launch_on: Callable[..., Program], folder: Path
) -> None:
    deep = folder / ("d" * 100)
    deep.mkdir()
    program = launch_on(SHARE.format(before="pass"), env={"FIBER_RUNTIME_DIRECTORY": str(deep)})
    assert program.wait() == 1
    assert "FIBER_RUNTIME_DIRECTORY" in program.stderr
    assert program.left() == []
    assert list(deep.iterdir()) == []


def test_a_working_directory_that_is_gone(launch_on: Callable[..., Program], folder: Path) -> None:
    gone = folder / "gone"
    gone.mkdir()
    script = WORK.replace(
        "ours, theirs = fiber.Pipe()", "os.rmdir(os.getcwd())\n        ours, theirs = fiber.Pipe()"
    )
    program = launch_on(script, cwd=gone)
    assert program.wait() == 1
    assert "this program's working directory was deleted" in program.stderr
    assert program.left() == []


def test_a_home_that_does_not_exist(launch: Callable[..., Program]) -> None:
    program = launch(WORK, env={"HOME": "/no/such/home"})
    assert program.finish() == "1\n[1, 2]\n"


def test_an_almost_empty_environment(launch_on: Callable[..., Program]) -> None:
    script = WORK.replace(
        "ours, theirs = fiber.Pipe()",
        "keep = ('FIBER_BACKEND', 'FIBER_AGENTS', 'TMPDIR', 'FAULTS_PROGRAM')\n"
        "        kept = {key: os.environ[key] for key in keep if key in os.environ}\n"
        "        os.environ.clear(); os.environ.update(kept)\n"
        "        ours, theirs = fiber.Pipe()",
    )
    program = launch_on(script)
    assert program.finish() == "1\n[1, 2]\n"


FIRST_PROCESS = """
    import census, fiber, os, subprocess
    from faults.program import wait_for

    def leave_orphans():
        for _ in range(5):
            subprocess.Popen(["sh", "-c", "sleep 0.1 &"]).wait()

    def is_orphan(found):
        return "sleep" in found.command or found.command == "[sh]"

    if __name__ == "__main__":
        print(os.getpid())
        child = fiber.Process(target=leave_orphans)
        child.start()
        child.join()
        wait_for(lambda: not any(map(is_orphan, census.everything())))
        print([found.command for found in census.everything() if found.state == "Z"])
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may make a process namespace")
def test_process_1_of_a_container_leaves_no_zombies(tmp_path: Path) -> None:
    """Run as in a pod, where no other process reaps orphans."""
    script = tmp_path / "program.py"
    script.write_text(textwrap.dedent(FIRST_PROCESS))
    done = subprocess.run(
        ["unshare", "--pid", "--fork", "--mount-proc", sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.stdout, done.stderr) == ("1\n[]\n", "")


def test_a_command_that_goes_elsewhere_before_its_first_pool_has_its_modules(
    tmp_path: Path,
) -> None:
    (tmp_path / "beside.py").write_text("def double(number):\n    return 2 * number\n")
    command = """
        import fiber as mp, os
        import beside
        os.chdir("/")
        with mp.Pool(1) as pool:
            print(pool.apply(beside.double, (2,)))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(command)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.stdout, done.stderr) == ("4\n", "")
