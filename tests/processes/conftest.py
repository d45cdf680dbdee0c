"""Fixtures of several modules: the runtime of this process, and a machine without a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults.runtime import BACKENDS, running_on
from fiber._hub import one_way
from processes.one_way_ends import Ends


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """The runtime of this very process, on each backend in turn."""
    yield from running_on(request.param)


@pytest.fixture
def only_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No cluster is configured, and no other test's programs are seen."""
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    monkeypatch.setenv("FIBER_RUNTIME_DIRECTORY", str(tmp_path))


@pytest.fixture
def ends() -> Iterator[Ends]:
    """The receiving and the sending end of a new one-way channel."""
    receiver, sender = one_way.pair()
    yield receiver, sender
    receiver.close()
    sender.close()


@pytest.fixture
def manager() -> Iterator[Any]:
    with fiber.Manager() as manager:
        yield manager
    manager._process.close()  # pytest holds the manager
