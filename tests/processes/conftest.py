"""Fixture of several modules: the runtime of this very process on each backend."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from faults.runtime import BACKENDS, running_on


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """The runtime of this very process, on each backend in turn."""
    yield from running_on(request.param)
