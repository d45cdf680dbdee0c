"""Copies of stored exceptions, and the rule that stored exceptions are raised as copies."""

from __future__ import annotations

import ast
import itertools
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

import fiber
from fiber._exceptions import advice_on_main, fresh
from fiber._runtime.threads import BackgroundThread
from fiber._transport.loop import Loop
from fiber.errors import ConnectionClosed, WorkerDied
from patience import PATIENCE

SDK = Path(fiber.__file__).parent


class Demanding(Exception):
    def __init__(self, loss: float, *, step: int) -> None:
        super().__init__(f"diverged at {step}")
        self.loss = loss
        self.step = step


class Slotted(ValueError):
    __slots__ = ("place", "unset")

    def __init__(self, place: str | None) -> None:
        self.place = place


@dataclass(frozen=True)
class Frozen(Exception):
    code: int


class Missing(KeyError, OSError):
    """Instances have the fields of the second base."""


class OwnGroup(ExceptionGroup[Exception]):
    def __new__(cls, errors: list[Exception]) -> OwnGroup:
        return super().__new__(cls, "several", errors)


class Guarded(Exception):
    """An exception whose class does not like to be looked at."""

    def __new__(cls, *args: object) -> Guarded:
        made = super().__new__(cls, *args)
        object.__setattr__(made, "made_in", threading.get_ident())
        return made

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AssertionError("code of the user's")


KINDS = [
    ValueError("wrong", 1),
    KeyError("missing"),
    OSError(2, "no such file", "from", None, "to"),
    ConnectionError("no number"),
    OSError(),
    ImportError("no module", name="module", path="/path"),
    SyntaxError("invalid", ("file.py", 1, 2, "text")),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    StopIteration(7),
    SystemExit(3),
    AttributeError("no attribute", name="name", obj=3),
    Demanding(0.5, step=3),
    Slotted("here"),
    Slotted(None),
    Frozen(4),
    Guarded("guarded"),
    Missing(2, "no such file"),
    ConnectionClosed("worker 1", "killed"),
    WorkerDied(task="f", worker="w", host="h", pid=1, exitcode=-9, reason="killed", log=["line"]),
]


def attributes(error: BaseException) -> dict[str, Any]:
    names = (name for name in dir(error) if not name.startswith("__"))
    found = {name: getattr(error, name, None) for name in names}
    return {name: value for name, value in found.items() if not callable(value)}


@pytest.mark.parametrize("error", KINDS, ids=lambda error: type(error).__name__)
def test_a_copy_differs_only_in_its_identity(error: BaseException) -> None:
    copy = fresh(error)
    assert copy is not error
    assert type(copy) is type(error)
    assert copy.args == error.args
    assert str(copy) == str(error)
    assert attributes(copy) == attributes(error)


GROUPS = [
    ExceptionGroup("several", [ValueError(1), ExceptionGroup("inner", [KeyError(2)])]),
    OwnGroup([ValueError(1)]),
]


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: type(group).__name__)
def test_a_group_is_copied_with_its_exceptions(group: ExceptionGroup[Exception]) -> None:
    before = repr(group)
    copy = fresh(group)
    assert type(copy) is type(group)
    assert repr(copy) == before
    pairs = list(zip(_leaves(copy), _leaves(group), strict=True))
    for leaf, original in pairs:
        assert leaf is not original
        assert (type(leaf), leaf.args) == (type(original), original.args)
        with pytest.raises(type(original)):
            raise leaf
        assert original.__traceback__ is None
        assert original.__context__ is None


def _leaves(group: ExceptionGroup[Exception]) -> list[Exception]:
    nested = [
        _leaves(error) if isinstance(error, ExceptionGroup) else [error]
        for error in group.exceptions
    ]
    return list(itertools.chain.from_iterable(nested))


def test_an_exception_that_is_twice_in_a_group_is_copied_once() -> None:
    first, second = ValueError("first"), KeyError("second")
    first.__context__ = second
    group = ExceptionGroup("outer", [first, ExceptionGroup("inner", [first]), second])
    copy = fresh(group)
    leaf, inner, other = copy.exceptions
    assert isinstance(inner, ExceptionGroup)
    assert inner.exceptions == (leaf,)
    assert leaf.__context__ is other is not second
    assert copy.args == ("outer", [leaf, inner, other])


def test_a_copy_has_the_cause_the_notes_and_the_traceback() -> None:
    def fail() -> NoReturn:
        try:
            raise KeyError("first")
        except KeyError as cause:
            error = ValueError("second")
            error.add_note("a note")
            raise error from cause

    with pytest.raises(ValueError, match="second") as caught:
        fail()
    error = caught.value
    copy = fresh(error)
    assert copy.__cause__ is error.__cause__ is not None
    assert copy.__context__ is error.__context__
    assert copy.__suppress_context__
    assert copy.__traceback__ is error.__traceback__ is not None
    copy.add_note("another")
    assert error.__notes__ == ["a note"]


def test_raising_a_copy_leaves_the_original_as_it_was() -> None:
    error = ValueError("stored")
    for _ in range(2):
        with pytest.raises(ValueError, match="stored"):
            raise fresh(error)
    assert error.__traceback__ is None
    assert error.__context__ is None


def test_an_exception_that_cannot_be_copied_is_raised_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error = Demanding(0.5, step=3)
    monkeypatch.setattr(Demanding, "__new__", len, raising=False)  # native, and refuses
    assert fresh(error) is error
    not_an_exception: Any = "text"
    assert fresh(not_an_exception) == "text"


# Exceptions that no caller catches


@pytest.mark.parametrize("leaves_by", [SystemExit(1), KeyboardInterrupt(), RuntimeError("hook")])
def test_a_hook_that_raises_ends_no_thread(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    loop: Loop,
    leaves_by: BaseException,
) -> None:
    thread, events = BackgroundThread("test-background"), [threading.Event() for _ in range(2)]

    def hook(*_: object) -> NoReturn:
        raise leaves_by

    def fail() -> NoReturn:
        raise ValueError("the callback")

    monkeypatch.setattr(sys, "excepthook", hook)
    for submit, event in zip((thread.submit, loop.call_soon), events, strict=True):
        submit(fail)
        submit(event.set)
        assert event.wait(PATIENCE)
    thread.stop()
    thread.join()
    shown = capsys.readouterr().err
    assert ("ValueError: the callback" in shown) == (not isinstance(leaves_by, SystemExit))


# The rule


def raised_as_stored(source: str) -> list[int]:
    """Lines that raise an object which was made elsewhere, other than by ``raise fresh(...)``.

    Allowed are a call, which makes the exception, a class, and what the ``except`` clause around
    the statement has caught.
    """
    return sorted(_raised_as_stored(ast.parse(source), frozenset()))


def _raised_as_stored(node: ast.AST, caught: frozenset[str]) -> Iterator[int]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        caught = frozenset()
    if isinstance(node, ast.ExceptHandler) and node.name is not None:
        caught |= {node.name}
    if isinstance(node, ast.Raise) and node.exc is not None and not _is_new(node.exc, caught):
        yield node.lineno
    for child in ast.iter_child_nodes(node):
        yield from _raised_as_stored(child, caught)


def _is_new(raised: ast.expr, caught: frozenset[str]) -> bool:
    match raised:
        case ast.Call(func=ast.Attribute(attr="convert_to_error")):  # returns what it is given
            return False
        case ast.Call():
            return True
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name in caught or name.strip("_")[0].isupper()
    return False


@pytest.mark.parametrize(
    "statement",
    [
        "raise self._failure",
        "raise self.failures[0]",
        "raise outcome.error",
        "raise error",
        "raise self.error or ValueError()",
        "raise convert.convert_to_error(kind, result)",
    ],
)
def test_the_rule_finds_stored_exceptions(statement: str) -> None:
    assert raised_as_stored(statement) == [1]


@pytest.mark.parametrize(
    "text",
    [
        "raise ValueError('new')",
        "raise StopIteration",
        "raise queue.Empty",
        "raise fresh(self.error)",
        "try:\n    f()\nexcept OSError as error:\n    raise error from None",
        "try:\n    f()\nexcept OSError:\n    raise",
    ],
)
def test_the_rule_allows_new_and_caught_exceptions(text: str) -> None:
    assert raised_as_stored(text) == []


def test_stored_exceptions_are_raised_as_copies() -> None:
    found = {
        str(path.relative_to(SDK)): lines
        for path in sorted(SDK.rglob("*.py"))
        if (lines := raised_as_stored(path.read_text(encoding="utf-8")))
    }
    assert found == {}


@pytest.mark.parametrize("module", ["__main__", "__mp_main__"])
def test_a_name_that_the_main_module_lacks_gets_advice(module: str) -> None:
    text = f"Can't get attribute 'f' on <module {module!r} from 'program.py'>"
    assert "move it above that line" in advice_on_main(AttributeError(text))
    assert not advice_on_main(ValueError(text))


def test_other_attribute_errors_get_no_advice_on_main() -> None:
    for text in ("Can't get attribute 'f' on <module 'my__main__' from 'it.py'>", "f", ""):
        assert not advice_on_main(AttributeError(text))
