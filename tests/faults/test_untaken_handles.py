"""Connections in messages that no process receives."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from faults.program import Program

UNTAKEN = """
    import {library} as library
    if __name__ == "__main__":
        process = library.Process(target=int)
        process.start()
        process.join()
        outer, outer_theirs = library.Pipe()
        ours, theirs = library.Pipe()
        outer.send(theirs)  # never received
        for end in theirs, outer_theirs, outer:
            end.close()
        print(ours.poll(0.3), flush=True)
"""


@pytest.mark.parametrize("library", ["multiprocessing", "fiber"])
def test_an_untaken_handle_holds_its_end_as_long_as_multiprocessings(
    launch_on: Callable[..., Program], library: str
) -> None:
    """Kernels throw a message away together with its pipe, and notify no process.

    So a process that has sent an end keeps it for a later taker, until the program ends.
    """
    program = launch_on(UNTAKEN.format(library=library))
    assert program.line() == "False"
    assert program.wait() == 0
    assert program.left() == []
