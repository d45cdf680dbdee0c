"""Functions of the workers of ``random_calls``: a module that no process runs as its main one."""

from __future__ import annotations

from typing import NoReturn


def square(n: int) -> int:
    return n * n


def add(x: int, y: int) -> int:
    return x + y


def fail(n: int) -> NoReturn:
    raise ValueError(n)


def nothing() -> None:
    pass
