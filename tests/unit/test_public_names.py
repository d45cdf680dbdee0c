"""Names, where multiprocessing's users look for them."""

from __future__ import annotations

import importlib
import multiprocessing
import subprocess
import sys
from types import ModuleType

import pytest

import fiber
from fiber import errors

SUBMODULES = [
    "connection",
    "context",
    "dummy",
    "managers",
    "pool",
    "process",
    "queues",
    "reduction",
    "resource_tracker",
    "shared_memory",
    "sharedctypes",
    "spawn",
    "synchronize",
    "util",
]


def test_dir_shows_exactly_the_existing_names() -> None:
    assert dir(fiber) == sorted({*fiber.__all__, *fiber._SUBMODULES, "__version__"})
    assert {*multiprocessing.__all__, "SUBDEBUG", "SUBWARNING"} <= set(dir(fiber))
    for name in dir(fiber):
        assert getattr(fiber, name) is not None


@pytest.mark.parametrize("name", sorted(fiber._SUBMODULES))
def test_submodules_are_attributes_before_their_first_import(name: str) -> None:
    statement = f"import fiber; print(fiber.{name}.__name__)"
    done = subprocess.run([sys.executable, "-c", statement], capture_output=True, text=True)
    assert done.stdout == f"fiber.{name}\n", done.stderr


def public_names(module: ModuleType) -> set[str]:
    """Return the names that a submodule of multiprocessing offers: in __all__, or defined there."""
    if said := getattr(module, "__all__", None):
        return {name for name in said if not name.startswith("_")}
    return {
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
    }


@pytest.mark.parametrize("name", SUBMODULES)
def test_submodules_have_multiprocessings_names(name: str) -> None:
    theirs = importlib.import_module(f"multiprocessing.{name}")
    ours = importlib.import_module(f"fiber.{name}")
    assert {other for other in public_names(theirs) if not hasattr(ours, other)} == set()


def test_private_names_that_libraries_import_are_those_of_multiprocessing() -> None:
    from multiprocessing import connection, reduction, util

    for ours, theirs, name in (
        (fiber.util, util, "_exit_function"),
        (fiber.util, util, "spawnv_passfds"),
        (fiber.connection, connection, "BUFSIZE"),
    ):
        assert getattr(ours, name) is vars(theirs)[name]
    assert fiber.connection.AuthenticationError is fiber.AuthenticationError
    assert fiber.reduction.HAVE_SEND_HANDLE is vars(reduction)["HAVE_SEND_HANDLE"]
    for module in (fiber.util, fiber.connection):
        with pytest.raises(AttributeError, match=f"{module.__name__}.*'no_such_name'"):
            getattr(module, "no_such_name")  # noqa: B009  # mypy


@pytest.mark.parametrize("name", errors.__all__)
def test_every_error_but_the_pools_is_at_the_top(name: str) -> None:
    if name != "MaybeEncodingError":  # multiprocessing has that one in its pool alone
        assert getattr(fiber, name) is getattr(errors, name)
    assert f" {name} " in str(errors.__doc__)


@pytest.mark.parametrize(
    "name",
    [
        "context.ForkContext",
        "context.ForkServerContext",
        "context.SpawnContext",
        "managers.DictProxy",
        "managers.SyncManager",
        "shared_memory.ShareableList",
        "shared_memory.SharedMemory",
        "synchronize.Barrier",
        "synchronize.BoundedSemaphore",
        "synchronize.Condition",
        "synchronize.Event",
        "synchronize.Lock",
        "synchronize.RLock",
        "synchronize.Semaphore",
    ],
)
def test_classes_serve_in_annotations_and_isinstance(name: str) -> None:
    module, _, attribute = name.partition(".")
    cls = getattr(getattr(fiber, module), attribute)
    assert isinstance(cls | None, type(int | None))
    assert not isinstance(3, cls)


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_contexts_are_of_a_class_by_the_name_that_multiprocessing_has(method: str) -> None:
    ours, theirs = fiber.get_context(method), multiprocessing.get_context(method)
    assert type(ours).__name__ == type(theirs).__name__
    assert ours.Process.__name__ == vars(type(theirs))["Process"].__name__
