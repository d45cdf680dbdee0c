"""Log records of children: they come to the program's loggers, on each backend."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from faults.program import LOOPBACK, Program
from faults.runtime import BACKENDS, running
from fiber._agent import records as sending
from fiber._runtime import records as reading
from patience import PATIENCE

NAME = "records.test"
FLOOD = 20_000
LOGGER = logging.getLogger(NAME)


class Collector(logging.Handler):
    """Handler that keeps records, and that can be made to wait."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []
        self.open = threading.Event()
        self.open.set()

    def emit(self, record: logging.LogRecord) -> None:
        self.open.wait(PATIENCE)
        self.records.append(record)

    def messages(self) -> list[str]:
        return [record.getMessage() for record in self.records]

    def wait_for(self, message: str) -> list[str]:
        assert wait_until(lambda: message in self.messages(), PATIENCE), self.messages()[-5:]
        return self.messages()


@pytest.fixture
def collector() -> Iterator[Collector]:
    collector = Collector()
    root, level = logging.getLogger(), logging.getLogger().level
    root.addHandler(collector)
    root.setLevel("INFO")
    yield collector
    root.removeHandler(collector)
    root.setLevel(level)


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest, collector: Collector) -> Iterator[str]:
    with running(backend=request.param, log_records="INFO"):
        yield request.param


def log(*messages: str) -> None:
    for message in messages:
        LOGGER.info("%s", message)


def warn(message: str) -> None:
    LOGGER.warning("%s", message)


def said(pool: Any, message: str) -> bool:
    """Have a worker log a message."""
    pool.apply(log, (message,))
    return True


def log_error() -> None:
    LOGGER.debug("too little")
    try:
        raise ValueError("on purpose")
    except ValueError:
        LOGGER.exception("it failed: %d", 7, extra={"trial": 3, "unsent": object()})


def log_and_die(count: int) -> None:
    for number in range(count):
        LOGGER.info("%d", number)
    os.kill(os.getpid(), signal.SIGKILL)


def log_from_a_child() -> None:
    child = fiber.Process(target=log, args=("from a grandchild",))
    child.start()
    child.join()


def log_badly() -> int:
    LOGGER.info("%d %d", 1)  # noqa: PLE1206 - a mistake, on purpose
    LOGGER.info("x" * 100_000)
    LOGGER.info("\udc00")
    return 1


def run(target: Callable[..., object], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, name="logging one")
    process.start()
    process.join()
    return process


def test_records_of_a_process_come_in_order(backend: str, collector: Collector) -> None:
    wanted = [str(number) for number in range(300)]
    process = run(log, *wanted)
    collector.wait_for("299")
    ours = [record for record in collector.records if record.name == NAME]
    assert [record.getMessage() for record in ours] == wanted
    assert {record.processName for record in ours} == {process.name}
    assert {record.process for record in ours} != {os.getpid()}
    (host,) = {vars(record)["host"] for record in ours}
    assert (host == "local") == (backend == "local")
    assert ours[0].funcName == "log"
    assert ours[0].created <= ours[-1].created


def test_errors_come_as_text(backend: str, collector: Collector) -> None:
    with fiber.Pool(1) as pool:
        pool.apply(log_error)
        collector.wait_for("it failed: 7")
    (record,) = [record for record in collector.records if record.name == NAME]
    assert record.levelno == logging.ERROR
    assert vars(record)["trial"] == 3
    assert not hasattr(record, "unsent")
    text = logging.Formatter().format(record)
    assert "Traceback (most recent call last):" in text
    assert text.endswith("ValueError: on purpose")


def test_the_levels_of_the_program_count(backend: str, collector: Collector) -> None:
    LOGGER.setLevel("WARNING")
    try:
        run(log, "too little")
        run(warn, "a mark")  # comes after the record before, which is dropped silently
        collector.wait_for("a mark")
        LOGGER.setLevel("NOTSET")
        run(log, "enough")
        assert "too little" not in collector.wait_for("enough")
    finally:
        LOGGER.setLevel("NOTSET")


def test_what_was_logged_before_a_crash_is_there(backend: str, collector: Collector) -> None:
    assert run(log_and_die, 20).exitcode == -signal.SIGKILL
    count = 20 if backend == "local" else 19  # one may be on its way to the agent
    assert wait_until(lambda: len(collector.records) >= count, PATIENCE)


def test_children_of_children_send_to_the_program(backend: str, collector: Collector) -> None:
    run(log_from_a_child)
    collector.wait_for("from a grandchild")


def test_bad_and_long_records_are_no_fault(
    backend: str, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without pytest's handler: its reports cannot carry all characters between processes.
    monkeypatch.setattr(logging.getLogger(), "handlers", [collector])
    with fiber.Pool(1) as pool:
        assert pool.apply(log_badly) == 1
        collector.wait_for("\udc00")
    (long,) = [record for record in collector.records if "characters" in record.msg]
    assert len(long.msg) < 11_000


def test_a_flood_does_not_stop_the_child(backend: str, collector: Collector) -> None:
    collector.open.clear()
    with fiber.Pool(1) as pool:
        try:
            pool.apply(log, map(str, range(FLOOD)))
            assert not collector.records
        finally:
            collector.open.set()
        end = "the program takes records again"
        assert wait_until(lambda: said(pool, end) and end in collector.messages(), PATIENCE)
    ours = [record.msg for record in collector.records if record.name == NAME]
    notes = [record.msg for record in collector.records if record.name == "fiber"]
    numbers = [int(message) for message in ours if message != end]
    assert numbers == sorted(numbers)
    # On a busy machine the program may fall behind more than once.
    counts = [re.match(r"(\d+) log records are left out here", note) for note in notes]
    left_out = sum(int(count[1]) for count in counts if count is not None)
    assert left_out > 0
    assert len(numbers) + left_out + ours.count(end) >= FLOOD


def test_a_stuck_handler_does_not_stop_the_end_of_the_program(
    collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "_AT_EXIT", 0.1)
    with running(backend="local", log_records="INFO"):
        collector.open.clear()
        run(log, "first", "second")
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "fiber-records")
    collector.open.set()
    thread.join(PATIENCE)
    assert not thread.is_alive()


def test_without_the_key_no_record_comes(collector: Collector) -> None:
    with running(backend="local"):
        run(log, "kept")
        assert "fiber-records" not in {thread.name for thread in threading.enumerate()}
    assert not collector.records


@pytest.mark.parametrize(
    "data",
    [b"", b"[]", b"{}", b'{"name": 3}', b'{"name": "a", "levelno": "x"}', b"\xff", b"[" * 100_000],
)
def test_nonsense_of_a_child_harms_nothing(
    data: bytes, monkeypatch: pytest.MonkeyPatch, collector: Collector
) -> None:
    reported: list[int] = []
    monkeypatch.setattr(reading, "report_uncaught", lambda: reported.append(1))
    reading.hand_over(data)
    assert reported or not collector.records or data == b"{}"


def test_no_child_replaces_a_method_of_a_record(collector: Collector) -> None:
    fields = {"name": NAME, "levelno": 20, "msg": "text", "getMessage": "no function"}
    reading.hand_over(json.dumps(fields).encode())
    assert collector.messages() == ["text"]


def test_a_record_that_sends_itself_is_left_out() -> None:
    sender = sending.RecordSender("INFO", b"no pickle")
    sender._busy = True
    sender.handle(logging.makeLogRecord({"levelno": 20}))
    assert sender._channel is None


PROGRAM = """
    import fiber, logging, sys
    def work(number):
        logging.getLogger("w").info("task %d", number)
    if __name__ == "__main__" or CONFIGURES_AT_IMPORT:
        form = "%(levelname)s %(processName)s %(message)s"
        logging.basicConfig(level="INFO", format=form, stream=sys.stdout)
    if __name__ == "__main__":
        fiber.set_start_method("METHOD")
        fiber.init(log_records="INFO")
        child = fiber.Process(target=work, args=(5,), name="child")
        child.start()
        child.join()
"""


@pytest.mark.parametrize("env", [{}, LOOPBACK], ids=BACKENDS)
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("at_import", [False, True])
def test_the_last_records_are_there_once_at_the_end_of_the_program(
    env: dict[str, str], method: str, at_import: bool
) -> None:
    script = PROGRAM.replace("METHOD", method).replace("CONFIGURES_AT_IMPORT", str(at_import))
    program = Program(script, env=env)
    try:
        assert program.finish() == "INFO child task 5\n"
        assert program.stderr == ""
        assert program.left() == []
    finally:
        program.close()
