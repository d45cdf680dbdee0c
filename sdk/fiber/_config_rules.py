"""Rules for the values of configuration keys."""

from __future__ import annotations

import copy
import math
import os
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from fiber import resources


class KeyRule(NamedTuple):
    """Rule for the values of a key.  `check` returns the value to keep, or raises ValueError."""

    expects: str
    check: Callable[[object], object]
    from_text: Callable[[str], object] = str
    is_path: bool = False
    """True if a text is a path, relative to the folder of the file that has it."""


def choice(*choices: str) -> KeyRule:
    """Return the rule for one of some words."""

    def check(value: object) -> str:
        for choice in choices:
            if isinstance(value, str) and value.lower() == choice.lower():
                return choice
        raise ValueError

    return KeyRule(f"one of {', '.join(map(repr, choices))}", check)


def whole(low: int, high: int | None = None) -> KeyRule:
    """Return the rule for a whole number from ``low`` to ``high``."""

    def check(value: object) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            raise ValueError
        if high is not None and value > high:
            raise ValueError
        return value

    reach = f"of at least {low}" if high is None else f"from {low} to {high}"
    return KeyRule(f"a whole number {reach}", check, from_text=int)


def ports() -> KeyRule:
    """Return the rule for a port or a range of ports."""

    def check(value: object) -> int | str:
        numbers = re.fullmatch(r"(\d{1,5})(?:-(\d{1,5}))?", str(value).strip())
        if numbers is None or isinstance(value, bool):
            raise ValueError
        first, last = int(numbers[1]), int(numbers[2] or numbers[1])
        if not (min(1, last) <= first <= last <= 65535):
            raise ValueError
        return first if first == last else f"{first}-{last}"

    return KeyRule("a whole number from 0 to 65535, or a range of ports such as '9000-9009'", check)


def seconds() -> KeyRule:
    """Return the rule for a number of seconds."""

    def check(value: object) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise ValueError
        if not math.isfinite(value) or value <= 0:
            raise ValueError
        return float(value)

    return KeyRule("a number of seconds above 0", check, from_text=float)


def word(expects: str, pattern: str = r"\S+") -> KeyRule:
    """Return the rule for a text of one pattern."""

    def check(value: object) -> str:
        if not isinstance(value, str) or not re.fullmatch(pattern, value.strip()):
            raise ValueError
        return value.strip()

    return KeyRule(expects, check)


def pool() -> KeyRule:
    """Return the rule for the name of a FiberPool."""

    def check(value: object) -> str:
        from fiber_api import names  # only programs on Kubernetes need it

        if not isinstance(value, str):
            raise ValueError
        return names.check_pool_name(value.strip())

    return KeyRule("the name of a FiberPool: lower-case letters, digits and '-', at most 50", check)


def template() -> KeyRule:
    """Return the rule for a pod template, or the path of one."""

    def check(value: object) -> str | dict[str, Any]:
        if isinstance(value, Mapping):
            return copy.deepcopy(dict(value))
        if not isinstance(value, str | os.PathLike) or not os.fspath(value):
            raise ValueError
        # The file is read later: only programs on Kubernetes need it.
        return os.path.abspath(os.fsdecode(value))

    expects = "the path of a YAML or JSON file with a pod template, or a dict of one"
    return KeyRule(expects, check, is_path=True)


def amount(expects: str, read: Callable[[object], object], *, or_none: bool) -> KeyRule:
    """Return the rule for an amount that ``read`` understands."""

    def check(value: object) -> object:
        nothing = or_none and not isinstance(value, bool) and value in (0, "0")
        return 0 if nothing else read(value)

    def from_text(text: str) -> object:
        return int(text) if text.strip().isdecimal() else text.strip()

    return KeyRule(expects, check, from_text=from_text)


def node_selector() -> KeyRule:
    """Return the rule for labels of nodes."""

    def check(value: object) -> dict[str, str]:
        return dict(resources.read_node_selector(value))

    return KeyRule("a dict of the labels of nodes, or a text as 'disk=ssd,zone=a'", check)


def tolerations() -> KeyRule:
    """Return the rule for taints that nodes may have."""

    def check(value: object) -> tuple[dict[str, Any], ...]:
        return tuple(dict(one) for one in resources.read_tolerations(value))

    return KeyRule("a list of tolerations, or a text as 'spot,team=a:NoSchedule'", check)


def switch() -> KeyRule:
    """Return the rule for true or false."""

    def check(value: object) -> bool:
        if not isinstance(value, bool):
            raise ValueError
        return value

    def from_text(text: str) -> bool:
        word = text.strip().lower()
        if word not in ("0", "1", "false", "true"):
            raise ValueError
        return word in ("1", "true")

    return KeyRule("True or False", check, from_text=from_text)


def path() -> KeyRule:
    """Return the rule for a path."""

    def check(value: object) -> str:
        if not isinstance(value, str | os.PathLike) or not os.fspath(value):
            raise ValueError
        return os.path.abspath(os.fsdecode(value))

    return KeyRule("a path", check, is_path=True)


def directory() -> KeyRule:
    """Return the rule for a directory that exists."""

    def check(value: object) -> str:
        if not isinstance(value, str | os.PathLike):
            raise ValueError
        path = os.fsdecode(value)
        if not os.path.isabs(path) or not os.path.isdir(path):
            raise ValueError
        if not os.access(path, os.W_OK | os.X_OK):
            raise ValueError
        return path

    return KeyRule("the absolute path of a directory that exists and can be written to", check)
