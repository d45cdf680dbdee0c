"""Program that defines functions and classes in its ``__main__`` and uses them in children."""

from __future__ import annotations

from functools import partial
from typing import Any

import fiber

PATIENCE = 15

DEFINITIONS = """\
import os
from conformance import main_checks

print("top level of", __name__, flush=True)

class Point:
    def __init__(self, x): self.x = x
    def plus(self, y): return self.x + y

class Trouble(Exception): pass

def double(x): return 2 * x

def move(point): return Point(point.x + 1)

def fail(x): raise Trouble(x)

def send(connection): connection.send(os.getpid())

triple = lambda x: 3 * x

def adding(y): return lambda x: triple(x) + y

"""
"""Program without blank lines within a block and with one after it, so that it can be typed."""

CALL = "main_checks.check(globals())\n"

PROGRAM = f'{DEFINITIONS}if __name__ == "__main__": {CALL}\n'

METHODS = ("forkserver", "spawn", "fork")

RESULT = "".join(f"works with {method}\n" for method in METHODS)


def check(main: dict[str, Any]) -> None:
    """Use ``main``, which holds ``DEFINITIONS``, in a pool and in processes."""
    for method in METHODS:
        context = fiber.get_context(method)
        with context.Pool(1) as pool:
            _check_pool(main, pool)
        ours, theirs = context.Pipe()
        process = context.Process(target=main["send"], args=(theirs,))
        process.start()
        assert ours.recv() == process.pid
        process.join(PATIENCE)
        assert process.exitcode == 0
        print("works with", method, flush=True)


def _check_pool(main: dict[str, Any], pool: Any) -> None:
    point = main["Point"]
    assert pool.map(main["double"], range(3)) == [0, 2, 4]
    assert pool.apply(main["triple"], (1,)) == 3
    assert pool.apply(main["adding"](1), (1,)) == 4
    assert pool.apply(partial(main["double"], 4)) == 8
    assert pool.apply(point(1).plus, (2,)) == 3
    moved = list(pool.imap(main["move"], [point(1), point(2)]))
    assert all(isinstance(each, point) for each in moved)
    assert [each.x for each in moved] == [2, 3]
    caught: Any = None
    try:
        pool.map(main["fail"], [5])
    except main["Trouble"] as error:
        caught = error.args
    assert caught == (5,)
