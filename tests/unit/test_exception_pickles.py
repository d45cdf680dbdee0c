"""Exceptions of users travel as what they are."""

from __future__ import annotations

import gc
import pickle
import sys
import weakref
from multiprocessing.pool import MaybeEncodingError, RemoteTraceback  # type: ignore[attr-defined]
from types import FrameType
from typing import Any

import pytest

from fiber._agent.exception_pickles import LINKS, encode_error
from unit import exception_kinds as kinds


def travelled(error: BaseException) -> Any:
    """The exception as it arrives that a task has raised."""
    try:
        raise error
    except BaseException as raised:
        return pickle.loads(encode_error(raised))


def count_pickles(error: BaseException, functions: tuple[str, ...]) -> int:
    """Return how often one of pickle's functions is called while ``error`` is encoded."""
    calls = 0

    def profile(frame: FrameType, event: str, called: Any) -> None:
        nonlocal calls
        calls += event == "c_call" and called.__name__ in functions

    sys.setprofile(profile)
    try:
        encode_error(error)
    finally:
        sys.setprofile(None)
    return calls


@pytest.mark.parametrize(
    ("error", "attributes"),
    [
        (kinds.Diverged(3, loss=0.5), ("step", "loss")),
        (kinds.Rewords(3), ("code",)),
        (kinds.Slotted(3, 4), ("step",)),
        (kinds.Made(step=3), ("step",)),
        (kinds.Data(3, loss=0.5), ("step", "loss")),
        (kinds.Data(step=3), ("step", "loss")),
        (kinds.Frozen(3), ("step",)),
        (kinds.FrozenSlots(3, 0.5), ("step", "loss")),
        (kinds.ReducedToList(3), ("step",)),
        (kinds.Untrue(3), ()),
        (kinds.NoDevice("gpu"), ("device", "errno", "strerror", "filename")),
        (kinds.NoText(3), ("line", "encoding", "object", "start", "end", "reason")),
        (kinds.Stop(value=3), ("value",)),
        (kinds.NoModule("module", why="none"), ("name", "path", "msg")),
        (kinds.NoSyntax(3), ("lineno", "offset", "text", "end_offset", "filename")),
        (kinds.Two("key", name="name"), ("name",)),
        (kinds.Missing(2, "none"), ("errno", "strerror")),
        (kinds.BadlyReduced(3, 0.5), ("step", "loss")),
        (kinds.Refusing(3), ()),
        (AttributeError("none", name="name"), ("name",)),
        (FileNotFoundError(2, "none", "path"), ("errno", "filename")),
        (SystemExit(3), ("code",)),
        (ValueError("plain"), ()),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_an_exception_keeps_its_class_arguments_and_attributes(
    error: BaseException, attributes: tuple[str, ...]
) -> None:
    vars(error)["__notes__"] = ["on the device"]
    found = travelled(error)
    assert type(found) is type(error)
    assert (found.args, str(found)) == (error.args, str(error))
    for name in attributes:
        assert getattr(found, name) == getattr(error, name), name
    assert found.__notes__ == ["on the device"]
    assert isinstance(found.__cause__, RemoteTraceback)
    assert "in travelled" in str(found.__cause__)


def test_an_exception_keeps_its_slots() -> None:
    found = travelled(kinds.Slotted(3, 4))
    assert found.hidden() == 4
    assert not hasattr(found, "never_set")


@pytest.mark.parametrize("kind", [kinds.Reduced, kinds.Registered])
def test_a_reduce_that_works_is_used(kind: Any) -> None:
    error = kind(3, "secret")
    error.add_note("on the device")
    found = travelled(error)
    assert (type(found), found.args, found.secret) == (kind, (3, "left out"), "left out")
    assert found.__notes__ == ["on the device"]


def test_a_setstate_is_used() -> None:
    assert travelled(kinds.WithState(3, 0.5)).step == 4


def test_setstate_gets_the_value_of_getstate() -> None:
    found = travelled(kinds.HasLock(3))
    assert (found.step, found.lock.locked()) == (3, False)
    assert not hasattr(found, "__notes__")


def test_groups_with_groups() -> None:
    inner = kinds.Several([kinds.Diverged(1, loss=0.5)], step=2)
    found = travelled(ExceptionGroup("outer", [ValueError("plain"), inner]))
    assert [type(error) for error in found.exceptions] == [ValueError, kinds.Several]
    (diverged,) = found.exceptions[1].exceptions
    assert (found.exceptions[1].step, diverged.step, diverged.loss) == (2, 1, 0.5)


def test_a_group_keeps_the_others_of_one_that_cannot_be_made_again() -> None:
    hopeless = kinds.Hopeless("no hope")
    hopeless.step = 3  # type: ignore[attr-defined]
    inner = kinds.Several([hopeless, kinds.Diverged(1, loss=0.5)], step=2)
    found = travelled(ExceptionGroup("outer", [ValueError("plain"), inner]))
    assert (found.message, hasattr(found, "__notes__")) == ("outer", False)
    plain, several = found.exceptions
    assert (type(plain), type(several), several.step) == (ValueError, kinds.Several, 2)
    lost, diverged = several.exceptions
    assert type(lost) is MaybeEncodingError
    assert "Hopeless('no hope')" in str(lost)
    assert "its state cannot be set" in str(lost)
    assert (type(diverged), diverged.step) == (kinds.Diverged, 1)
    assert several.args[1][0] is lost
    assert not hasattr(several, "__notes__")


def test_a_group_keeps_the_others_of_one_that_only_its_receiver_cannot_unpickle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inner = kinds.Several([kinds.Diverged(1, loss=0.5), kinds.BadlyReduced(3, 0.5)], step=2)
    data = encode_error(ExceptionGroup("outer", [ValueError("plain"), inner]))
    monkeypatch.delattr(kinds, "Diverged")
    found = pickle.loads(data)
    assert found.message == "outer"
    plain, several = found.exceptions
    assert (type(plain), type(several), several.step) == (ValueError, kinds.Several, 2)
    lost, reduced = several.exceptions
    assert type(lost) is MaybeEncodingError
    assert "Diverged('loss 0.5 at step 1')" in str(lost)
    assert "has no attribute" in str(lost) or "Can't get attribute" in str(lost)
    assert (type(reduced), reduced.step) == (kinds.BadlyReduced, 3)
    assert several.args[1][0] is lost


def test_a_member_whose_state_is_not_plain_is_lost_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = kinds.Diverged(1, loss=0.5)
    steps.step = [1, 2]  # type: ignore[assignment]
    data = encode_error(ExceptionGroup("outer", [steps, kinds.Data([3])]))  # type: ignore[arg-type]
    monkeypatch.delattr(kinds, "Diverged")
    lost, kept = pickle.loads(data).exceptions
    assert type(lost) is MaybeEncodingError
    assert "Diverged('loss 0.5 at step 1')" in str(lost)
    assert (type(kept), kept.step) == (kinds.Data, [3])


@pytest.mark.parametrize("make", [ValueError, kinds.Rewords])
def test_a_large_group_needs_no_pickle_for_each_member(make: Any) -> None:
    group = ExceptionGroup("large", [make(number) for number in range(300)])
    assert count_pickles(group, ("dump", "dumps")) < 10


def test_a_plain_exception_is_not_unpickled_as_a_check() -> None:
    assert count_pickles(ValueError("plain", 3), ("loads",)) == 0


def test_a_member_that_has_its_group() -> None:
    member = kinds.Diverged(1, loss=0.5)
    group = ExceptionGroup("outer", [member, member])
    member.group = group  # type: ignore[attr-defined]
    found = travelled(group)
    first, second = found.exceptions
    assert first is second
    assert first.group.exceptions == (first, first)


def test_an_exception_that_contains_another_and_itself_travels() -> None:
    found = travelled(kinds.Wraps(kinds.BadlyReduced(3, 0.5), step=2))
    assert (type(found.inner), found.inner.step, found.step) == (kinds.BadlyReduced, 3, 2)
    assert found.inner.outer is found


def test_an_exception_of_a_local_class_travels() -> None:
    found = travelled(kinds.local(3))
    assert (type(found).__name__, found.args, found.step) == ("Local", ("local",), 3)


def test_unpicklable_parts_of_an_exception_are_replaced_by_notes() -> None:
    error = kinds.Wraps(kinds.Holding(3), step=2)
    error.add_note("on the device")
    found = travelled(error)
    assert (type(found), type(found.inner), found.inner.step) == (kinds.Wraps, kinds.Holding, 3)
    assert not hasattr(found.inner, "lock")
    first, second = found.inner.args
    assert (first, "lock object" in second) == ("holds", True)
    refusal = "TypeError(\"cannot pickle '_thread.lock' object\")"
    lost, shown = found.inner.__notes__
    assert lost == f"attribute 'lock' did not come along: {refusal}"
    assert shown == f"argument 1 came as text: {refusal}"
    assert found.__notes__[0] == "on the device"


def test_each_exception_of_a_chain_is_checked_once() -> None:
    part = kinds.CountsPickles()
    error = kinds.Chained(part)
    length = 12
    for _ in range(length):
        error = kinds.Chained(error)
    found = travelled(error)
    for _ in range(length):
        found = found.replaces
    assert not hasattr(found, "replaces")
    assert part.attempts < 3 * length


def test_each_exception_of_a_cycle_is_checked_once() -> None:
    part = kinds.CountsPickles()
    first = error = kinds.Chained(part)
    for _ in range(3):
        error = kinds.Chained(error)
        error.first = first  # type: ignore[attr-defined]
    first.last = error  # type: ignore[attr-defined]
    found = travelled(error)
    assert found.first.last is found
    assert part.attempts < 12


def test_each_reduce_that_fails_is_tried_once() -> None:
    part = kinds.CountsPickles()
    error = kinds.ReducedChain(part)
    length = 8
    for _ in range(length):
        error = kinds.ReducedChain(error)
    assert type(travelled(error)) is kinds.ReducedChain
    assert part.attempts < 5 * length


def test_an_exception_that_cannot_be_rebuilt_becomes_a_maybe_encoding_error() -> None:
    error = kinds.Hopeless("no hope")
    error.step = 3  # type: ignore[attr-defined]
    found = travelled(error)
    assert type(found) is MaybeEncodingError
    assert "Hopeless('no hope')" in str(found)
    assert "its state cannot be set" in str(found)
    assert "Hopeless: no hope" in str(found.__cause__)


def test_an_exception_whose_attributes_raise_becomes_a_maybe_encoding_error() -> None:
    found = travelled(kinds.Unreadable("closed"))
    assert type(found) is MaybeEncodingError
    assert "Unreadable('closed')" in str(found)
    assert "is not to be read" in str(found)
    assert "in travelled" in str(found.__cause__)


def test_an_exception_that_the_receiver_cannot_unpickle_names_its_error_and_traceback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = encode_error(kinds.Diverged(3, loss=0.5))
    monkeypatch.delattr(kinds, "Diverged")
    found = pickle.loads(data)
    assert type(found) is MaybeEncodingError
    assert "Diverged('loss 0.5 at step 3')" in str(found)
    assert "has no attribute" in str(found) or "Can't get attribute" in str(found)
    assert "Diverged: loss 0.5 at step 3" in str(found.__cause__)


def test_causes_and_contexts_come_behind_the_traceback() -> None:
    try:
        try:
            try:
                raise kinds.BadlyReduced(1, 0.5)
            except Exception as error:
                raise kinds.Diverged(2, loss=0.5) from error
        except Exception:
            raise KeyError("first")  # noqa: B904  # its context is the point
    except KeyError as error:
        found = pickle.loads(encode_error(error))
    trace = found.__cause__
    diverged = trace.__context__
    assert trace.__suppress_context__, "it would be printed twice"
    assert (type(diverged), diverged.step) == (kinds.Diverged, 2)
    assert (type(diverged.__cause__), diverged.__cause__.step) == (kinds.BadlyReduced, 1)


def test_encoding_an_exception_frees_the_objects_of_its_frames() -> None:
    def fail(held: object) -> bytes:
        try:
            raise kinds.Holding(3)
        except Exception as error:
            return encode_error(error)

    held = kinds.Refusing()
    reference = weakref.ref(held)
    gc.disable()
    try:
        fail(held)
        del held
        assert reference() is None
    finally:
        gc.enable()


def test_a_long_chain_is_cut() -> None:
    error: BaseException = ValueError(0)
    for number in range(3000):
        later = ValueError(number)
        later.__context__ = error
        error = later
    found = pickle.loads(encode_error(error)).__cause__.__context__
    length = 0
    while found is not None:
        length, found = length + 1, found.__context__
    assert length == LINKS
