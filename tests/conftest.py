"""Every test has a time limit and leaves nothing behind."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from leaks import Snapshot, Watch, shut_down_runtime
from patience import PATIENCE

if TYPE_CHECKING:
    from fiber._transport.loop import Loop
    from fiber.connection import Connection
    from hosts import Far, Hosts, Wire

# Seconds for one test; a test with its own timeout marker keeps that. The limit ends a hang that no
# deadline of the test ends, so it is longer than two of them.
LIMIT = 3 * PATIENCE
CONFORMANCE_LIMIT = 900  # one test of this folder runs a whole test suite of someone else's

_CALL = pytest.StashKey[pytest.CallInfo[None]]()
_WATCH = pytest.StashKey[Watch]()
_BEFORE = pytest.StashKey[Snapshot]()


def pytest_configure() -> None:
    # A shell without job control starts what it puts in the background with interrupts ignored,
    # and every program that a test starts would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup has it ignored
    # The same examples in every run; how long one takes says more about the machine.
    settings.register_profile("tests", derandomize=True, deadline=None)
    settings.load_profile("tests")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    root = Path(__file__).parent
    for item in items:
        if item.get_closest_marker("timeout") is None:
            conformance = item.path.is_relative_to(root / "conformance")
            item.add_marker(pytest.mark.timeout(CONFORMANCE_LIMIT if conformance else LIMIT))


def pytest_collection_finish() -> None:
    # What was imported stays. A collection of garbage, of which the checks below make many, does
    # not go through it again.
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    if call.when == "call":
        item.stash[_CALL] = call
    return (yield)


@pytest.fixture
def pipe() -> Iterator[tuple[Connection, Connection]]:
    """Both ends of a pipe, closed after the test."""
    import fiber  # not for the operator's tests

    one, other = fiber.Pipe()
    with one, other:
        yield one, other


@pytest.fixture
def all_caught(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """After the test: no loop or other thread of Fiber has reported an exception.

    They go on after it, so the test might not notice.
    """
    uncaught: list[BaseException] = []
    monkeypatch.setattr(sys, "excepthook", lambda _kind, error, _trace: uncaught.append(error))
    yield
    for error in uncaught:
        raise error


def _running_loop() -> Iterator[Loop]:
    from fiber._transport.loop import Loop

    running = Loop()
    running.start_thread("loop under test")
    yield running
    running.stop()


loop = pytest.fixture(_running_loop, name="loop")
module_loop = pytest.fixture(_running_loop, scope="module", name="module_loop")


@pytest.fixture
def hosts(all_caught: None) -> Iterator[Hosts]:
    from hosts import Hosts

    hosts = Hosts()
    yield hosts
    hosts.close()


@pytest.fixture
def wires(hosts: Hosts) -> tuple[Wire, Wire]:
    return hosts.link("b", "a")


@pytest.fixture
def far(hosts: Hosts, wires: tuple[Wire, Wire]) -> Iterator[Far]:
    with hosts.at("b"):
        from hosts import Far

        yield Far(hosts)


_INTERRUPTED = pytest.ExitCode.INTERRUPTED


@pytest.fixture(scope="session", autouse=True)
def _nothing_left_at_the_end(
    request: pytest.FixtureRequest, pytestconfig: pytest.Config
) -> Iterator[None]:
    """Gives the session its own folder for temporary files and takes stock at its end."""
    outside = tempfile.gettempdir()
    # Short, because paths of unix sockets are.
    folder = Path(tempfile.mkdtemp(prefix="ft-"))
    marker = uuid.uuid4().hex
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", outside)  # pytest keeps its own files there
    os.environ.update(TMPDIR=str(folder), LEAK_CHECK_SESSION=marker)
    tempfile.tempdir = None
    watch = Watch(f"LEAK_CHECK_SESSION={marker}", folder)
    before = watch.look()
    pytestconfig.stash[_WATCH] = watch
    pytestconfig.stash[_BEFORE] = before
    yield
    shut_down_runtime()
    left = watch.left_since(before, excuse_runtime=False)
    watch.kill_processes_since(before)
    os.environ["TMPDIR"] = outside
    tempfile.tempdir = None
    shutil.rmtree(folder)
    ended_early = request.session.shouldfail or request.session.exitstatus == _INTERRUPTED
    if left and not ended_early:  # then a failure here would hide the test's own failure
        pytest.fail("left at the end of the session: " + "; ".join(left), pytrace=False)


@pytest.fixture(autouse=True)
def _nothing_left(request: pytest.FixtureRequest, _nothing_left_at_the_end: None) -> Iterator[None]:
    """After each test: no process, thread, open file or temporary file more than before."""
    watch = request.config.stash[_WATCH]
    before = watch.look()
    yield
    call = request.node.stash.get(_CALL, None)
    failed = call is None or call.excinfo is not None
    marker = request.node.get_closest_marker("may_leak")
    left = [] if failed or marker else watch.left_since(before)
    if failed or marker or left:
        watch.kill_processes_since(before)
    if left:
        pytest.fail("this test left behind: " + "; ".join(left), pytrace=False)
