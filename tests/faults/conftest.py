"""Fixtures of the fault tests: programs under control, and a runtime on either backend."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from faults.program import LOOPBACK, Program
from faults.runtime import BACKENDS, running, running_on
from faults.wire import Wire, wired


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "lost_after(seconds): of silence, for the fixture `wire`")


@pytest.fixture
def launch() -> Iterator[Callable[..., Program]]:
    """Starts a script as a ``Program``, whose processes are ended after the test."""
    programs: list[Program] = []

    def start(script: str, *arguments: str, **options: Any) -> Program:
        programs.append(Program(script, *arguments, **options))
        return programs[-1]

    yield start
    for program in programs:
        program.close()


@pytest.fixture(params=BACKENDS)
def launch_on(
    request: pytest.FixtureRequest, launch: Callable[..., Program]
) -> Callable[..., Program]:
    """``launch`` on each backend in turn."""

    def start(script: str, *arguments: str, **options: Any) -> Program:
        env = LOOPBACK if request.param == "loopback" else {}
        env = {**env, **options.pop("env", {})}
        return launch(script, *arguments, env=env, **options)

    return start


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """The runtime of this very process, on each backend in turn."""
    yield from running_on(request.param)


@pytest.fixture(scope="module")
def local() -> Iterator[None]:
    """The runtime of this very process, on the local backend."""
    with running(backend="local"):
        yield


@pytest.fixture
def wire(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wire]:
    """A link that the test can cut.  The mark ``lost_after`` says how long a cut it bears."""
    marker = request.node.get_closest_marker("lost_after")
    with wired(monkeypatch, 10 if marker is None else marker.args[0]) as wire:
        yield wire
