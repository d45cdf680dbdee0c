"""Records: what is shown on stderr, of the program and of its children, and who can have it."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from fiber import _logs
from patience import PATIENCE

PROGRAM = """
import logging
import fiber

def double(number):
    logging.getLogger("fiber").debug("doubling %d", number)
    return 2 * number

if __name__ == "__main__":
    {before}
    with fiber.Pool(1) as pool:
        print(pool.map(double, [1]))
"""


def run(tmp_path: Path, before: str = "pass", **environment: str) -> list[str]:
    """The lines that a program writes to stderr."""
    script = tmp_path / "program.py"
    script.write_text(PROGRAM.format(before=before))
    environ = {name: value for name, value in os.environ.items() if name != "FIBER_LOG_LEVEL"}
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout == "[2]\n", done.stderr
    return done.stderr.splitlines()


def found(pattern: str, lines: list[str]) -> int:
    return sum(re.search(pattern, line) is not None for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_the_level_of_the_configuration(backend: str, tmp_path: Path) -> None:
    # One agent: the program would not wait for a second one, which its worker does not need.
    lines = run(tmp_path, FIBER_BACKEND=backend, FIBER_LOG_LEVEL="DEBUG", FIBER_AGENTS="1")
    worker = "ForkServerPoolWorker-1"
    for pattern in (
        rf"^\[DEBUG/MainProcess\] {backend.title()}Backend on host",
        rf"^\[DEBUG/MainProcess\] starting worker {worker}$",
        rf"^\[DEBUG/MainProcess\] worker {worker} is ready$",
        rf"^\[DEBUG/MainProcess\] worker {worker} ended: killed by SIGTERM",
        r"^\[DEBUG/MainProcess\] opened a pool of 1 to 1 workers$",
        rf"\[DEBUG/{worker}\] doubling 1$",
    ):
        assert found(pattern, lines) == 1, (pattern, lines)
    if backend == "loopback":
        assert found(r"^\[DEBUG/MainProcess\] agent loopback-\d has joined$", lines) == 1
        assert found(r"^\[DEBUG/loopback-\d\] agent with pid \d+$", lines) == 1


@pytest.mark.slow
def test_no_record_is_shown_by_default(tmp_path: Path) -> None:
    assert run(tmp_path) == []
    assert run(tmp_path, FIBER_LOG_LEVEL="ERROR") == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "before",
    [
        'fiber.init(log_level="DEBUG")',
        'fiber.log_to_stderr("DEBUG")',
        'fiber.log_to_stderr(); fiber.init(log_level="DEBUG")',
        'fiber.log_to_stderr(); fiber.get_logger().setLevel("DEBUG")',
    ],
)
def test_each_record_is_shown_once(before: str, tmp_path: Path) -> None:
    lines = run(tmp_path, before)
    assert found(r"\[DEBUG/MainProcess\] closing pool|terminating pool", lines) == 1
    assert found(r"\[DEBUG/ForkServerPoolWorker-1\] doubling 1", lines) == 1


@pytest.mark.slow
def test_the_root_logger_has_the_records_of_a_program_without_multiprocessings(
    tmp_path: Path,
) -> None:
    lines = run(tmp_path, 'logging.basicConfig(level="DEBUG")')
    assert found("^DEBUG:fiber:terminating pool$", lines) == 1


@pytest.fixture
def records() -> Iterator[list[str]]:
    """Messages that the handlers of the logger ``fiber`` get."""
    got: list[str] = []

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            got.append(record.getMessage())

    logger, handler = logging.getLogger("fiber"), Handler()
    logger.addHandler(handler)
    logger.setLevel("DEBUG")
    yield got
    logger.removeHandler(handler)
    logger.setLevel("NOTSET")


def test_the_logger_has_handlers_of_its_users(records: list[str]) -> None:
    _logs.debug("agent %s has joined", "a")
    logging.getLogger("fiber").setLevel("INFO")
    _logs.debug("agent %s has joined", "b")
    assert records == ["agent a has joined"]


def test_a_handler_that_raises_is_shown_and_harms_no_caller(
    records: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Faulty(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise RuntimeError("no room")

    monkeypatch.setattr(logging.getLogger("fiber"), "handlers", [Faulty()])
    _logs.debug("agent %s has joined", "a")
    assert "RuntimeError: no room" in capsys.readouterr().err


def test_a_module_that_is_being_imported_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "logging", ModuleType("logging"))
    _logs.debug("agent %s has joined", "a")


def test_a_program_without_logging_imports_none() -> None:
    statement = "import sys, fiber._logs as logs; logs.debug('x'); logs.show('WARNING')"
    command = [sys.executable, "-c", f"{statement}; print('logging' in sys.modules)"]
    assert subprocess.run(command, capture_output=True, text=True).stdout == "False\n"


def test_a_lock_that_an_interrupt_left_locked_stops_no_thread_of_fiber() -> None:
    """A Ctrl-C between two lines of ``logging.getLogger`` does that."""
    program = (
        "import logging, threading\n"
        "from fiber import _logs\n"
        "_logs.debug('first')\n"
        "logging._lock.acquire()\n"
        "thread = threading.Thread(target=_logs.debug, args=('next',), daemon=True)\n"
        "thread.start()\n"
        "thread.join()\n"
        "print(thread.is_alive(), flush=True)\n"
        "import os; os._exit(0)\n"
    )
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert ran.stdout == "False\n", ran.stderr
