"""``fiber dashboard`` and ``fiber.init(dashboard=True)``: the process beside the program."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import census
from faults.program import Program, wait_for
from patience import PATIENCE
from unit.pool_command_rig import run

_SCRIPT = """
import os, sys, fiber

if __name__ == "__main__":
    fiber.init(dashboard="--dashboard" in sys.argv)
    with fiber.Pool(1) as pool:
        print(pool.map(abs, range(10)), flush=True)
        if "--fork" in sys.argv:
            child = os.fork()
            if not child:
                if "--use" in sys.argv:
                    with fiber.Pool(1) as pool:
                        pool.map(abs, range(10))
                print("forked", flush=True)
                os.read(0, 1)
                os._exit(0)
        sys.stdin.readline()
"""

ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")


pytestmark = pytest.mark.usefixtures("only_this_machine")


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Starts a program that waits for a line after its tasks."""
    started: list[Program] = []

    def start(*arguments: str, **options: Any) -> Program:
        started.append(Program(_SCRIPT, *arguments, stdin=subprocess.PIPE, **options))
        assert started[-1].line() == str(list(range(10)))
        return started[-1]

    yield start
    for program in started:
        stdin = program.process.stdin
        assert stdin is not None
        stdin.close()
        program.close()


def go_on(program: Program) -> None:
    stdin = program.process.stdin
    assert stdin is not None
    stdin.write(b"\n")
    stdin.flush()


def address_of(program: Program) -> str:
    wait_for(lambda: bool(ADDRESS.search(program.stderr)), what="the address of the page")
    (address,) = ADDRESS.findall(program.stderr)
    return str(address)


def dashboards(program: Program) -> list[census.Found]:
    return [found for found in program.family() if "--for-program" in found.command]


def status_of(address: str) -> int:
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE) as response:
            return int(response.status)
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def test_the_page_is_served_while_the_program_runs(start: Callable[..., Program]) -> None:
    program = start("--dashboard")
    address = address_of(program)
    assert status_of(address) == 200
    assert status_of(address.partition("?")[0]) == 403
    (served,) = dashboards(program)
    token = address.rpartition("=")[2]
    with open(f"/proc/{served.pid}/cmdline") as arguments:
        assert token not in arguments.read()
    go_on(program)
    program.finish()
    assert program.stderr.count("token=") == 1


def test_the_page_imports_nothing_from_the_working_directory(
    start: Callable[..., Program], tmp_path: Path
) -> None:
    (tmp_path / "secrets.py").write_text("raise SystemExit('imported')")
    program = start("--dashboard", cwd=tmp_path)
    assert status_of(address_of(program)) == 200
    go_on(program)
    program.finish()


def test_a_copy_of_the_program_that_uses_fiber_has_no_page(start: Callable[..., Program]) -> None:
    program = start("--dashboard", "--fork", "--use")
    assert program.line() == "forked"
    address_of(program)
    assert len(dashboards(program)) == 1
    assert program.stderr.count("token=") == 1
    program.kill()
    wait_for(lambda: not dashboards(program), what="the end of the page")


def test_a_killed_program_takes_its_page_along(start: Callable[..., Program]) -> None:
    program = start("--dashboard")
    address_of(program)
    program.kill()
    assert program.left() == []


def test_a_fork_of_the_program_does_not_keep_its_page(start: Callable[..., Program]) -> None:
    program = start("--dashboard", "--fork")
    assert program.line() == "forked"
    address_of(program)
    program.kill()
    wait_for(lambda: not dashboards(program), what="the end of the page")


def test_an_interrupt_in_the_terminal_is_not_for_the_page(start: Callable[..., Program]) -> None:
    program = start("--dashboard", process_group=0)
    address = address_of(program)
    (served,) = dashboards(program)
    assert os.getpgid(served.pid) == served.pid != os.getpgid(program.pid)
    os.killpg(program.pid, signal.SIGINT)
    assert program.wait() != 0
    assert program.left() == []
    assert address in program.stderr


def test_without_aiohttp_the_program_works_and_warns_once(
    start: Callable[..., Program], tmp_path: Path
) -> None:
    without = tmp_path / "without"
    without.mkdir()
    (without / "aiohttp.py").write_text("raise ModuleNotFoundError(\"No module named 'aiohttp'\")")
    path = os.pathsep.join([str(without), *filter(None, sys.path)])
    program = start("--dashboard", env={"PYTHONPATH": path})
    wait_for(lambda: "fiberpool[dashboard]" in program.stderr, what="the warning")
    go_on(program)
    program.finish()
    assert program.stderr.count("fiber: ") == 1
    assert program.stderr.count("\n") == 3
    assert "Traceback" not in program.stderr


def test_without_the_key_there_is_no_page(start: Callable[..., Program]) -> None:
    program = start()
    assert dashboards(program) == []
    go_on(program)
    program.finish()
    assert program.stderr == ""


# The command


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts ``fiber dashboard``."""
    started: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "fiber._cli.main", "dashboard", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def first_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)], ids=["interrupt", "end"]
)
def test_the_command_serves_a_program_until_it_is_ended(
    start: Callable[..., Program],
    command: Callable[..., subprocess.Popen[str]],
    named: bool,
    number: signal.Signals,
    status: int,
) -> None:
    program = start()
    process = command(*([str(program.pid)] if named else []))
    found = ADDRESS.search(first_line(process))
    assert found is not None
    assert status_of(found[0]) == 200
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == status
    assert "Traceback" not in errors


def test_a_browser_gets_a_file_and_not_the_address(
    start: Callable[..., Program],
    command: Callable[..., subprocess.Popen[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    browser = tmp_path / "browser"
    browser.write_text(
        f'#!/bin/sh\ncat "${{1#file://}}" >{tmp_path}/seen\necho "$1" >{tmp_path}/told\n'
    )
    browser.chmod(0o700)
    monkeypatch.setenv("BROWSER", f"{browser} %s")
    program = start()
    process = command(str(program.pid), "--open")
    found = ADDRESS.search(first_line(process))
    assert found is not None
    wait_for(lambda: (tmp_path / "told").exists() and bool((tmp_path / "told").read_text()))
    told = (tmp_path / "told").read_text().strip()
    assert "token" not in told
    assert found[0] in (tmp_path / "seen").read_text()
    process.terminate()
    process.communicate(timeout=PATIENCE)
    assert not Path(told.removeprefix("file://")).parent.exists()


def test_a_taken_port_is_named(start: Callable[..., Program]) -> None:
    program = start()
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        outcome = run("dashboard", str(program.pid), "--port", str(port))
    assert outcome.status == 1
    assert f"cannot serve the page at port {port}" in outcome.err
    assert "--port" in outcome.err


def test_an_unknown_program_is_named_with_the_nearest_one(start: Callable[..., Program]) -> None:
    program = start()
    outcome = run("dashboard", f"progam-{program.pid}")
    assert outcome.status == 3
    assert f"did you mean 'program-{program.pid}'?" in outcome.err


def test_a_program_must_be_named_if_none_runs() -> None:
    outcome = run("dashboard")
    assert outcome.status == 1
    assert "the program is not named" in outcome.err
