"""Contexts and start methods, as far as multiprocessing's own tests leave them open."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from fiber import context
from fiber._runtime import start_methods
from patience import PATIENCE


@pytest.fixture(autouse=True)
def _as_at_the_start() -> Iterator[None]:
    chosen, preload = start_methods.chosen, list(start_methods.preload)
    start_methods.choose(None)
    yield
    start_methods.inherit(chosen, preload)


@pytest.fixture
def fresh() -> context.DefaultContext:
    return context.DefaultContext()


def run(script: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_methods_are_multiprocessings_and_the_default_comes_first() -> None:
    assert sorted(fiber.get_all_start_methods()) == sorted(multiprocessing.get_all_start_methods())
    assert fiber.get_all_start_methods()[0] == context.DefaultContext().get_start_method()


def test_a_method_is_set_once(fresh: context.DefaultContext) -> None:
    assert fresh.get_start_method(allow_none=True) is None
    fresh.set_start_method("spawn")
    assert fresh.get_start_method() == "spawn"
    with pytest.raises(RuntimeError, match="context has already been set"):
        fresh.set_start_method("fork")
    fresh.set_start_method("fork", force=True)
    assert fresh.get_context().Process is context.ForkProcess
    fresh.set_start_method(None, force=True)
    assert fresh.get_start_method(allow_none=True) is None


def test_asking_for_the_method_settles_it(fresh: context.DefaultContext) -> None:
    assert fresh.get_start_method() == "forkserver"
    with pytest.raises(RuntimeError, match="context has already been set"):
        fresh.set_start_method("spawn")


@pytest.mark.parametrize("method", ["typo", None, 7])
def test_an_unknown_method_is_named(fresh: context.DefaultContext, method: Any) -> None:
    with pytest.raises(ValueError, match=f"cannot find context for {method!r}"):
        fresh.set_start_method(method)
    assert fresh.get_start_method(allow_none=True) is None


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_a_concrete_context_keeps_its_method(method: str) -> None:
    concrete = fiber.get_context(method)
    assert concrete.get_start_method() == method
    assert concrete.get_context() is concrete
    assert concrete.Process._start_method == method
    assert issubclass(concrete.Process, fiber.Process)
    with pytest.raises(ValueError, match="concrete context"):
        concrete.set_start_method("spawn")
    with pytest.raises(ValueError, match="cannot find context for 'typo'"):
        concrete.get_context("typo")


def test_the_default_process_follows_the_default_method(fresh: context.DefaultContext) -> None:
    for method, asked in (("spawn", "spawn"), ("fork", "fork"), ("forkserver", "fork")):
        fresh.set_start_method(method, force=True)
        assert start_methods.zygote_method(None) == asked
        assert start_methods.zygote_method("spawn") == "spawn"


def test_preload_takes_names_only() -> None:
    with pytest.raises(TypeError, match="must be a list of strings"):
        fiber.set_forkserver_preload([1])  # type: ignore[list-item]
    fiber.set_forkserver_preload(["json"])
    assert start_methods.preload == ["json"]


def test_a_child_inherits_method_and_preload() -> None:
    script = """
        import fiber
        from fiber._runtime import start_methods
        def report():
            print(fiber.get_start_method(), start_methods.preload)
        fiber.set_start_method("spawn")
        fiber.set_forkserver_preload(["json"])
        child = fiber.Process(target=report)
        child.start()
        child.join()
    """
    assert run(script) == "spawn ['json']\n"


def test_preloaded_modules_are_there_in_a_forked_child() -> None:
    script = """
        import sys, fiber
        def report():
            print("sqlite3" in sys.modules)
        fiber.set_forkserver_preload(["sqlite3", "no_such_module"])
        child = fiber.Process(target=report)
        child.start()
        child.join()
    """
    assert run(script) == "True\n"


def test_every_name_of_multiprocessings_context_is_there() -> None:
    theirs = {name for name in dir(multiprocessing.get_context()) if not name.startswith("_")}
    assert theirs <= set(dir(fiber.get_context()))


def test_cpu_count_and_loggers_are_reached_through_a_context() -> None:
    spawn = fiber.get_context("spawn")
    assert spawn.cpu_count() >= 1
    assert spawn.get_logger() is multiprocessing.get_logger()
    freeze_support: Callable[[], object] = spawn.freeze_support
    assert freeze_support() is None
    assert spawn.reducer.ForkingPickler is multiprocessing.reduction.ForkingPickler


def test_a_contexts_pool_has_the_options_of_the_class() -> None:
    options = dict(inspect.signature(fiber.pool.Pool).parameters)
    del options["context"]
    assert dict(inspect.signature(fiber.Pool).parameters) == options
