"""Functions that travel by value are pickled once for as long as what they read is the same."""

from __future__ import annotations

import functools
import pickle
import sys
from collections.abc import Callable, Iterable
from types import FunctionType, ModuleType
from typing import Any, ClassVar, TypeVar

import cloudpickle
import pytest

from fiber import reduction
from fiber._agent.by_value import FunctionByValue
from fiber._runtime.by_value import FunctionPickles

SESSION = """
import collections

scale = 2
pair = (1, "two")

def helper(x, by=1):
    return by * x

def scaled(x: int, shift=0, *, sign=1) -> int:
    return sign * scale * helper(x) + shift

def countdown(x):
    return x and countdown(x - 1)

def length(items):
    return len(items)

def reading_names(kind):
    return collections.OrderedDict(kind), pair

def adding(term):
    def inner(x):
        return x + term
    return inner

plus = adding(10)
"""


class Session:
    """Names of a ``__main__`` that other processes cannot import."""

    def __init__(self) -> None:
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self.pickles = FunctionPickles()
        self.run(SESSION)

    def run(self, code: str) -> None:
        exec(code, self.names)

    def light(self, name: str = "scaled") -> Any:
        return self.pickles.light(self.names[name])

    def sent(self, name: str = "scaled") -> Any:
        """Return the function as a worker has it."""
        return pickle.loads(pickle.dumps(self.light(name)))


@pytest.fixture
def session() -> Any:
    reduction.readers_lack_main(True)
    try:
        yield Session()
    finally:
        reduction.readers_lack_main(False)


@pytest.mark.parametrize("name", ["scaled", "countdown", "length", "reading_names", "plus"])
def test_an_unchanged_function_is_pickled_and_unpickled_once(session: Session, name: str) -> None:
    assert isinstance(session.light(name), FunctionByValue)
    assert session.light(name) is session.light(name)
    assert session.sent(name) is session.sent(name)
    assert session.sent(name) is not session.names[name]


CHANGES: dict[str, tuple[str, int]] = {
    "a global": ("scale = 3", 33),
    "a global of another type": ("scale = 2.0", 22),
    "a global is deleted, and a builtin stands for it": (
        "del scale; __builtins__ = {**vars(__import__('builtins')), 'scale': 5}",
        22,
    ),
    "a new function of the same name": ("helper = lambda x: -x", -22),
    "the code of a function that it calls": ("helper.__code__ = (lambda x, by: 7).__code__", 14),
    "the defaults of a function that it calls": ("helper.__defaults__ = (4,)", 88),
    "its defaults": ("scaled.__defaults__ = (1,)", 23),
    "a default in its dictionary": ("scaled.__kwdefaults__['sign'] = -1", -22),
}


@pytest.mark.parametrize(("change", "result"), CHANGES.values(), ids=CHANGES.keys())
def test_a_change_of_what_a_function_reads_reaches_workers(
    session: Session, change: str, result: int
) -> None:
    before = session.light()
    assert session.sent()(11) == 22
    session.run(change)
    assert session.light() is not before
    if not change.startswith("del"):
        assert session.sent()(11) == result


def test_two_functions_with_equal_pickles_share_no_values(session: Session) -> None:
    session.run(
        "def counting():\n"
        "    count = 0\n"
        "    def inner():\n"
        "        nonlocal count\n"
        "        count += 1\n"
        "        return count\n"
        "    return inner\n"
        "one, other = counting(), counting()\n"
    )
    assert [session.sent("one")(), session.sent("one")()] == [1, 2]
    assert session.sent("other")() == 1


def test_a_value_that_was_changed_back_reaches_workers(session: Session) -> None:
    session.run("def grow(): global scale; scale += 1; return scale")
    assert session.sent("grow")() == 3
    session.run("scale = 9")
    assert session.sent("grow")() == 10
    session.run("scale = 2")
    assert session.sent("grow")() == 3


def test_a_change_of_a_closure_reaches_workers(session: Session) -> None:
    before = session.light("plus")
    session.names["plus"].__closure__[0].cell_contents = 20
    assert session.light("plus") is not before
    assert session.sent("plus")(1) == 21


def test_an_attribute_of_a_function_reaches_workers(session: Session) -> None:
    before = session.light("length")
    session.names["length"].unit = "items"
    assert session.light("length") is not before
    assert session.sent("length").unit == "items"


def test_a_name_that_hides_a_builtin_reaches_workers(session: Session) -> None:
    assert session.sent("length")([1]) == 1
    session.run("def len(items): return 99")
    assert session.sent("length")([1]) == 99


def test_a_submodule_that_is_imported_later_reaches_workers(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = session.light("reading_names")
    monkeypatch.setitem(sys.modules, "collections.later", ModuleType("collections.later"))
    assert session.light("reading_names") is not before


UNSTABLE = {
    "a list": "scale = [2]",
    "a list in a tuple": "pair = scale = ([2], 1)",
    "a large text": "scale = 'x' * (1 << 20)",
    "a class of the session": "class scale: pass",
    "a bound method": "scale = [].append",
    "a module that cannot be imported": "scale = type(collections)('made_up')",
    "a mutable default": "scaled.__defaults__ = ([],)",
    "an object as an attribute": "scaled.cache = {}",
    "a list beside a type": "import typing; scale = typing.Annotated[int, []]",
    "a type variable with a class of the session": (
        "import typing\nclass Own: pass\nscale = typing.TypeVar('T', bound=Own)"
    ),
    "a type variable between classes of the session": (
        "import typing\nclass Own: pass\nscale = typing.TypeVar('T', Own, int)"
    ),
}


@pytest.mark.parametrize("change", UNSTABLE.values(), ids=UNSTABLE.keys())
def test_a_function_that_reads_what_can_change_is_pickled_for_each_call(
    session: Session, change: str
) -> None:
    session.run(change)
    assert session.light() is session.names["scaled"]


def test_other_callables_are_pickled_as_before(session: Session) -> None:
    functions: list[Callable[..., Any]] = [
        cloudpickle.dumps,
        len,
        functools.partial(session.names["scaled"], 1),
        session.names["adding"].__call__,
        Session,
    ]
    for function in functions:
        assert session.pickles.light(function) is function


def test_functions_of_a_main_module_that_workers_import_go_by_reference(session: Session) -> None:
    reduction.readers_lack_main(False)
    if not reduction.main_is_out_of_reach():
        assert session.light() is session.names["scaled"]
    assert isinstance(session.light("plus"), FunctionByValue)


def test_a_function_is_pickled_anew_beside_modules_that_travel_by_value(session: Session) -> None:
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    try:
        assert session.light() is session.names["scaled"]
    finally:
        cloudpickle.unregister_pickle_by_value(sys.modules[__name__])


@pytest.mark.parametrize(
    "annotation",
    [int, int | None, list[tuple[int, Any]], Iterable[str], ClassVar[int], TypeVar("T")],
    ids=repr,
)
def test_annotations_of_importable_types_do_not_matter(session: Session, annotation: Any) -> None:
    session.names["scaled"].__annotations__["x"] = annotation
    assert isinstance(session.light(), FunctionByValue)


def test_a_function_that_does_not_pickle_is_left_to_the_call(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction, "dumps_by_value", pickle.dumps)
    assert session.light() is session.names["scaled"]


def test_many_functions_are_not_kept(session: Session) -> None:
    for _ in range(300):
        function = session.names["adding"](1)
        assert type(function) is FunctionType
        session.pickles.light(function)
    assert len(session.pickles._known) <= 128
