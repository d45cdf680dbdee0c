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
        ((10**5000,), {}, ""),
        (("x" * 10_000,), {}, ""),
    ],
)
def test_arguments_of_a_call(args: Any, kwargs: Any, form: str) -> None:
    assert call(*args, **kwargs) == form


def test_a_long_argument_is_shortened() -> None:
    assert len(call("x" * 3000)) < 40


def test_what_is_no_pickle_has_no_short_form() -> None:
    assert short_form_of_call(b"", []) == ""
    assert short_form_of_call(pickle.dumps((1, 2, 3)), []) == ""


def test_items_of_a_map() -> None:
    assert short_form((1, "two")) == "(1, 'two')"
    assert short_form(Point(1, 2)) == ""
    assert short_form(10**5000) == ""
