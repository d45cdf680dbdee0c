"""Short forms of arguments, which monitors show."""

from __future__ import annotations

import collections
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fiber import reduction
from fiber._runtime.short_forms import short_form, short_form_of_call


@dataclass
class Point:
    x: int
    y: int

    def __repr__(self) -> str:
        raise AssertionError("the user's code ran")

    def __reduce__(self) -> Any:
        return (Point, (self.x, self.y))


def call(*args: Any, **kwargs: Any) -> str:
    data, buffers, _ = reduction.encode_reusable((print, args, kwargs))
    return short_form_of_call(data, buffers)


@pytest.mark.parametrize(
    ("args", "kwargs", "form"),
    [
        ((), {}, ""),
        ((1, "two", None), {}, "1, 'two', None"),
        ((5,), {"label": "a"}, "5, label='a'"),
        (([1.5, (2, 3)],), {}, "[1.5, (2, 3)]"),
        ((Point(1, 2),), {}, "<Point>"),
        (([Point(1, 2)],), {}, "[<Point>]"),
        ((Point,), {}, "Point"),
        ((call,), {}, "call"),
        ((collections.OrderedDict(a=1),), {}, "<OrderedDict>"),
        ((Path("/tmp"),), {}, "<PosixPath>"),
        ((np.zeros(3),), {}, "<numpy object>"),
        ((np.zeros(100_000),), {}, "<numpy object>"),
        (tuple(range(8)), {}, "0, 1, 2, 3, 4, 5, ..."),
        ((10**5000,), {}, "<int of 16,610 bits>"),
        (([[[[1]]]],), {}, "[[[[1]]]]"),
        (((1,),), {}, "(1,)"),
        (({"a": {1}},), {}, "{'a': {1}}"),
        (("x" * 10_000,), {}, ""),
    ],
)
def test_arguments_of_a_call(args: Any, kwargs: Any, form: str) -> None:
    assert call(*args, **kwargs) == form


def test_a_long_argument_is_shortened() -> None:
    assert call("x" * 3000) == repr("x" * 40) + "..."


def test_shared_lists_take_no_longer_than_others() -> None:
    shared: Any = list("abcdef")
    for _ in range(30):
        shared = [shared] * 6
    assert len(call(*[shared] * 6)) < 300


def test_of_a_long_list_few_items_are_looked_at() -> None:
    class Items(list[int]):
        def __iter__(self) -> Any:
            raise AssertionError("the user's code ran")

    assert short_form(list(range(10**6))) == "[0, 1, 2, 3, 4, 5, ...]"
    assert short_form(Items([1])) == "<Items>"


def test_a_class_is_shown_by_its_name() -> None:
    class Named(type):
        @property
        def __name__(cls) -> str:  # type: ignore[override]
            raise AssertionError("the user's code ran")

    made = Named("Made", (), {})
    assert short_form(made) == "Made"
    assert short_form(made()) == "<Made>"


def test_what_is_no_pickle_has_no_short_form() -> None:
    assert short_form_of_call(b"", []) == ""
    assert short_form_of_call(pickle.dumps((1, 2, 3)), []) == ""


def test_items_of_a_map() -> None:
    assert short_form((1, "two")) == "(1, 'two')"
    assert short_form(Point(1, 2)) == "<Point>"
    assert short_form(1 << 1_000_000) == "<int of 1,000,001 bits>"
