"""Adoption of modules by adopt(): all names or none, and back again."""

from __future__ import annotations

import importlib
import multiprocessing
import multiprocessing.connection
import multiprocessing.dummy
import multiprocessing.pool
import multiprocessing.queues
import multiprocessing.sharedctypes
import multiprocessing.synchronize
import sys
import threading
import types
from collections.abc import Callable
from multiprocessing.context import BaseContext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from fiber import adoption
from fiber.adoption import Adoption, adopt
from fiber.errors import AdoptionError
from patience import PATIENCE


class Process(multiprocessing.process.BaseProcess):
    pass


class Queue:
    pass


class Connection:
    pass


class SynchronizedArray:
    pass


class OtherQueue:
    pass


def pipe() -> None:
    pass


def wait() -> None:
    pass


class Context(BaseContext):
    """A context of a kind that is multiprocessing's, but was not taken from it."""

    def __init__(self, method: str) -> None:
        self.method = method

    def get_start_method(self, allow_none: bool = False) -> str:
        return self.method

    def Queue(self, maxsize: int = 0) -> Any:
        return Queue()


CONTEXTS = {method: Context(method) for method in ("spawn", "fork")}


def get_context(method: str) -> Context:
    if method not in CONTEXTS:
        raise ValueError(f"cannot find context for {method!r}")
    return CONTEXTS[method]


@pytest.fixture
def fiber() -> ModuleType:
    """Return the names that `import fiber` gives, as far as these tests need them."""
    package = ModuleType("fiber")
    vars(package).update(
        Process=Process,
        Queue=Queue,
        Pipe=pipe,
        get_context=get_context,
        TimeoutError=multiprocessing.TimeoutError,
        connection=SimpleNamespace(Connection=Connection, wait=wait),
        process=multiprocessing.process,
        queues=SimpleNamespace(Queue=OtherQueue),
        sharedctypes=SimpleNamespace(SynchronizedArray=SynchronizedArray),
        synchronize=SimpleNamespace(),
    )
    return package


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Makes a module from source text, as if it was imported."""

    def make(source: str, name: str = "library") -> ModuleType:
        module = ModuleType(name)
        monkeypatch.setitem(sys.modules, name, module)
        exec(source, vars(module))
        return module

    return make


Library = Callable[[str], ModuleType]


class TestWhatIsRebound:
    @pytest.mark.parametrize(
        ("statement", "path"),
        [
            ("import multiprocessing as x", ""),
            ("from multiprocessing import connection as x", "connection"),
            ("from multiprocessing import Process as x", "Process"),
            ("from multiprocessing.context import Process as x", "Process"),
            ("from multiprocessing import Queue as x", "Queue"),
            ("from multiprocessing import Pipe as x", "Pipe"),
            ("from multiprocessing import get_context as x", "get_context"),
            ("from multiprocessing.queues import Queue as x", "queues.Queue"),
            ("from multiprocessing.connection import Connection as x", "connection.Connection"),
            ("from multiprocessing.connection import wait as x", "connection.wait"),
            (
                "from multiprocessing.sharedctypes import SynchronizedArray as x",
                "sharedctypes.SynchronizedArray",
            ),
        ],
    )
    def test_an_imported_name_is_rebound(
        self, library: Library, fiber: Any, statement: str, path: str
    ) -> None:
        module = library(statement)
        Adoption(module, fiber)
        expected = fiber
        for part in path.split(".") if path else ():
            expected = getattr(expected, part)
        assert vars(module)["x"] is expected

    def test_contexts_and_their_members_are_adopted(self, library: Library, fiber: Any) -> None:
        module: Any = library(
            "import multiprocessing\n"
            "context = multiprocessing.get_context('spawn')\n"
            "Queue = context.Queue\n"
        )
        Adoption(module, fiber)
        assert module.context is CONTEXTS["spawn"]
        assert module.Queue == CONTEXTS["spawn"].Queue
        before = dict(vars(module))
        Adoption(module, fiber)
        assert dict(vars(module)) == before

    def test_functions_of_the_module_use_fiber_at_once(self, library: Library, fiber: Any) -> None:
        module: Any = library("import multiprocessing\ndef make(): return multiprocessing.Queue()")
        make = module.make
        Adoption(module, fiber)
        assert isinstance(make(), Queue)

    def test_other_names_stay(self, library: Library, fiber: Any) -> None:
        module = library(
            "import multiprocessing, threading, queue\n"
            "from multiprocessing.dummy import Pool as ThreadPool\n"
            "from multiprocessing import dummy, TimeoutError, process, current_process\n"
            "from multiprocessing.util import SUBDEBUG\n"
            "current = multiprocessing.process.current_process()\n"
            "key = current.authkey\n"
            "del current_process\n"
            "def f(x=threading.Lock, *, y=queue.Queue): pass\n"
            "class A(threading.Thread):\n"
            "    error = multiprocessing.TimeoutError\n"
            "class MyTimeout(TimeoutError): pass\n"
        )
        before = dict(vars(module))
        adopted = Adoption(module, fiber)
        after = dict(vars(module))
        assert adopted.names == ("multiprocessing",)
        assert after.pop("multiprocessing") is fiber
        del before["multiprocessing"]
        assert after == before

    def test_multiprocessing_itself_and_other_modules_stay(
        self, library: Library, fiber: Any
    ) -> None:
        before = dict(vars(multiprocessing))
        Adoption(library("from multiprocessing import Process, Queue"), fiber)
        assert dict(vars(multiprocessing)) == before


class TestWhatWasEvaluatedAtImport:
    """Default values and class attributes are rebound, too, and restored."""

    @pytest.mark.parametrize(
        ("source", "name", "path"),
        [
            ("def f(a, mp=multiprocessing, b=1): return mp", "f.mp", "f(0)"),
            ("def f(*, mp=multiprocessing): return mp", "f.mp", "f()"),
            ("class C:\n    def m(self, mp=multiprocessing): return mp", "C.m.mp", "C().m()"),
            (
                "class C:\n    @classmethod\n    def m(cls, mp=multiprocessing): return mp",
                "C.m.mp",
                "C.m()",
            ),
            ("class C:\n    mp = multiprocessing", "C.mp", "C.mp"),
            (
                "@functools.singledispatch\ndef f(a, mp=multiprocessing): return mp",
                "f.mp",
                "f(0)",
            ),
        ],
    )
    def test_a_value_from_the_import_is_rebound_and_restored(
        self, library: Library, fiber: Any, source: str, name: str, path: str
    ) -> None:
        module = library(f"import functools, multiprocessing\n{source}")
        with Adoption(module, fiber) as adopted:
            assert eval(path, vars(adopted)) is fiber
            assert Adoption(module, fiber).names == (name, "multiprocessing")
        # The second one lasts.
        assert eval(path, vars(module)) is fiber

    def test_a_static_method_stays_one(self, library: Library, fiber: Any) -> None:
        source = "import multiprocessing\nclass C:\n    make = staticmethod(multiprocessing.Queue)"
        module = library(source)
        before = vars(module.C)["make"]
        with Adoption(module, fiber):
            assert module.C().make is fiber.Queue
        assert vars(module.C)["make"] is before

    def test_a_class_that_refuses_leaves_the_module_as_it_was(
        self, library: Library, fiber: Any
    ) -> None:
        module = library(
            "import multiprocessing\n"
            "class Meta(type):\n"
            "    def __setattr__(cls, name, value): raise TypeError('it is frozen')\n"
            "class C(metaclass=Meta): mp = multiprocessing\n"
        )
        with pytest.raises(AdoptionError, match=r"'C.mp' cannot be rebound: TypeError: it is fro"):
            Adoption(module, fiber)
        assert module.multiprocessing is module.C.mp is multiprocessing

    def test_a_name_that_was_rebound_meanwhile_stays_rebound(
        self, library: Library, fiber: Any
    ) -> None:
        module = library(
            "import multiprocessing as mp\ndef f(a=mp, *, b=mp): return a, b\nclass C: mp = mp"
        )
        with Adoption(module, fiber):
            assert module.f() == (fiber, fiber)
            module.f.__defaults__ = ()
            module.f.__kwdefaults__ = None
            module.C.mp = "theirs"
        assert (module.f.__defaults__, module.f.__kwdefaults__, module.C.mp) == ((), None, "theirs")
        assert module.mp is multiprocessing


class TestRefusals:
    def test_names_without_equivalent_are_all_named_and_no_name_changes(
        self, library: Library, fiber: Any
    ) -> None:
        module = library(
            "import multiprocessing\n"
            "from multiprocessing import Array as Shared, Process, shared_memory\n"
            "from multiprocessing.synchronize import Lock\n"
        )
        before = dict(vars(module))
        with pytest.raises(AdoptionError) as caught:
            Adoption(module, fiber)
        text = str(caught.value)
        assert "'library', which was left as it is" in text
        assert "'Shared' is multiprocessing.Array, for which Fiber has no equivalent" in text
        assert "'shared_memory' is multiprocessing.shared_memory" in text
        assert "'Lock' is multiprocessing.synchronize.Lock" in text
        assert "'Process'" not in text
        assert "Replace these objects" in text
        assert dict(vars(module)) == before

    def test_a_start_method_that_fiber_lacks(self, library: Library, fiber: Any) -> None:
        module = library("import multiprocessing\nc = multiprocessing.get_context('forkserver')")
        with pytest.raises(AdoptionError, match=r"get_context\('forkserver'\)"):
            Adoption(module, fiber)

    @pytest.mark.parametrize(
        ("source", "complaint"),
        [
            (
                "class Worker(multiprocessing.Process): pass",
                "class 'Worker' has the base multiprocessing.context.Process",
            ),
            (
                "class Holder:\n    array = multiprocessing.Array",
                "'Holder.array' is multiprocessing.Array, for which Fiber has no equivalent",
            ),
            (
                "class Holder:\n    lock = multiprocessing.Lock()",
                "'Holder.lock' is an object of multiprocessing.synchronize.Lock",
            ),
            (
                "def f(number, make=multiprocessing.Array): pass",
                "'f.make' is multiprocessing.Array, for which Fiber has no equivalent",
            ),
            (
                "def f(lock=multiprocessing.Lock()): pass",
                "function 'f' has the default value an object of multiprocessing",
            ),
            (
                "lock = multiprocessing.Lock()",
                "'lock' holds an object of multiprocessing.synchronize.Lock",
            ),
        ],
    )
    def test_names_that_were_fixed_at_import_are_reported(
        self, library: Library, fiber: Any, source: str, complaint: str
    ) -> None:
        module = library(f"import multiprocessing\n{source}")
        with pytest.raises(AdoptionError) as caught:
            Adoption(module, fiber)
        assert complaint in str(caught.value)
        assert vars(module)["multiprocessing"] is multiprocessing

    def test_a_module_that_uses_no_multiprocessing_is_refused(
        self, library: Library, fiber: Any
    ) -> None:
        with pytest.raises(AdoptionError, match="none of its names comes from multiprocessing"):
            Adoption(library("import threading"), fiber)

    def test_a_package_whose_module_is_meant(
        self, library: Callable[..., ModuleType], fiber: Any
    ) -> None:
        library("import multiprocessing", "library.vector.workers")
        with pytest.raises(AdoptionError, match=r"inside of it do: library\.vector\.workers"):
            Adoption(library("", "library"), fiber)

    def test_an_adoption_of_shared_names_only_is_empty(self, library: Library, fiber: Any) -> None:
        assert Adoption(library("from multiprocessing import TimeoutError"), fiber).names == ()

    def test_a_name_that_does_not_import(self) -> None:
        with pytest.raises(AdoptionError, match=r"'no_such_module'.*ModuleNotFoundError"):
            adopt("no_such_module")

    def test_a_module_whose_import_fails(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "fiber_test_broken.py").write_text("1 / 0")
        monkeypatch.syspath_prepend(tmp_path)
        with pytest.raises(AdoptionError, match="ZeroDivisionError: division by zero"):
            adopt("fiber_test_broken")

    @pytest.mark.parametrize("name", ["multiprocessing", "multiprocessing.pool", "fiber.errors"])
    def test_multiprocessing_and_fiber_themselves(self, name: str) -> None:
        with pytest.raises(AdoptionError, match="the module that uses multiprocessing"):
            adopt(name)

    def test_something_that_is_no_module(self) -> None:
        with pytest.raises(TypeError, match="takes a module or its name, not 3"):
            adopt(3)  # type: ignore[arg-type]


class TestDuration:
    @pytest.fixture
    def module(self, library: Library) -> Any:
        return library("import multiprocessing\nfrom multiprocessing import Queue")

    def test_an_adoption_as_context_manager_ends_with_its_block(
        self, module: Any, fiber: Any
    ) -> None:
        with Adoption(module, fiber) as adopted:
            assert adopted is module
            assert module.Queue is Queue
        assert module.multiprocessing is multiprocessing
        assert vars(module)["Queue"] == multiprocessing.Queue

    def test_an_error_in_the_block_ends_it_too(self, module: Any, fiber: Any) -> None:
        with pytest.raises(KeyError), Adoption(module, fiber):
            raise KeyError
        assert module.multiprocessing is multiprocessing

    def test_twice_is_as_once(self, module: Any, fiber: Any) -> None:
        first, second = Adoption(module, fiber), Adoption(module, fiber)
        assert first.names == second.names == ("Queue", "multiprocessing")
        assert module.Queue is Queue

    def test_a_block_inside_of_a_lasting_adoption_does_not_end_it(
        self, module: Any, fiber: Any
    ) -> None:
        Adoption(module, fiber)
        with Adoption(module, fiber):
            pass
        assert module.multiprocessing is fiber

    def test_overlapping_blocks_end_with_the_last(self, module: Any, fiber: Any) -> None:
        first, second = Adoption(module, fiber), Adoption(module, fiber)
        first.__exit__(None, None, None)
        first.__exit__(None, None, None)
        assert module.multiprocessing is fiber
        second.__exit__(None, None, None)
        assert module.multiprocessing is multiprocessing

    def test_a_block_can_be_entered_again(self, module: Any, fiber: Any) -> None:
        adopted = Adoption(module, fiber)
        for _ in range(2):
            with adopted:
                assert module.multiprocessing is fiber
            assert module.multiprocessing is multiprocessing
        assert adopted.names == ()

    def test_a_name_that_was_rebound_in_the_block_stays_rebound(
        self, module: Any, fiber: Any
    ) -> None:
        with Adoption(module, fiber):
            module.Queue = "mine"
        assert module.Queue == "mine"
        assert module.multiprocessing is multiprocessing

    def test_a_reloaded_module_can_be_adopted_again(self, module: Any, fiber: Any) -> None:
        Adoption(module, fiber)
        module.multiprocessing = multiprocessing
        Adoption(module, fiber)
        assert module.multiprocessing is fiber

    def test_threads_may_adopt_one_module_at_the_same_time(self, module: Any, fiber: Any) -> None:
        wrong: list[object] = []
        together = threading.Barrier(4, timeout=PATIENCE)

        def work() -> None:
            together.wait()
            for _ in range(50):
                with Adoption(module, fiber):
                    if module.multiprocessing is not fiber:
                        wrong.append(module.multiprocessing)

        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(timeout=PATIENCE)
        assert not wrong
        assert module.multiprocessing is multiprocessing

    def test_a_dropped_module_leaves_no_reference(self, fiber: Any) -> None:
        module = ModuleType("passing")
        vars(module)["multiprocessing"] = multiprocessing
        Adoption(module, fiber)
        assert module in adoption._adopted
        before = len(adoption._adopted)
        del module
        assert len(adoption._adopted) == before - 1

    def test_repr_names_module_and_names(self, module: Any, fiber: Any) -> None:
        assert repr(Adoption(module, fiber)) == "<Adoption of 'library': Queue, multiprocessing>"


def test_gymnasiums_vector_environment(fiber: Any) -> None:
    module: Any = importlib.import_module("gymnasium.vector.async_vector_env")
    before = dict(vars(module))
    with Adoption(module, fiber) as adopted:
        assert adopted is module
        assert module.multiprocessing is fiber
        assert module.Queue is Queue
        assert module.Connection is Connection
        assert module.synchronize is fiber.synchronize
        assert module.SynchronizedArray is SynchronizedArray
        changed = {name for name in before if vars(module)[name] is not before[name]}
    assert changed == {
        "multiprocessing",
        "Queue",
        "Connection",
        "synchronize",
        "SynchronizedArray",
    }
    assert dict(vars(module)) == before


def test_adopt_takes_a_name_and_uses_the_real_fiber(
    library: Library, fiber: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fiber", fiber)
    module = library("import multiprocessing")
    assert isinstance(module, types.ModuleType)
    with adopt("library"):
        assert vars(module)["multiprocessing"] is fiber
    with adopt(module):
        assert vars(module)["multiprocessing"] is fiber
