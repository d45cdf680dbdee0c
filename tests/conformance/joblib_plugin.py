"""A plugin of pytest: joblib's own tests that take a backend, with Fiber's in the place of loky's.

python -m pytest --pyargs joblib.test.test_parallel -p conformance.joblib_plugin
"""

from __future__ import annotations

from typing import Any

import pytest

import fiber.joblib  # noqa: F401  # registers the backend
from conformance.exclusions import JOBLIB

BACKEND = "fiber"


@pytest.hookimpl(tryfirst=True)
def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Each test that runs with the backend loky runs with Fiber's, and with no other."""
    for mark in metafunc.definition.iter_markers("parametrize"):
        names, values = mark.args[:2]
        if names == "backend" and "loky" in list(values):
            metafunc.definition.own_markers.remove(mark)
            metafunc.definition.add_marker(pytest.mark.parametrize("backend", [BACKEND]))
            return


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests without a backend.  Listed tests must fail."""
    mine = [item for item in items if _backend(item) == BACKEND]
    config.hook.pytest_deselected(items=[item for item in items if item not in mine])
    items[:] = mine
    for item in items:
        reason = JOBLIB.get(getattr(item, "originalname", item.name))
        if reason is not None:
            item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


def _backend(item: Any) -> object:
    call = getattr(item, "callspec", None)
    return None if call is None else call.params.get("backend")
