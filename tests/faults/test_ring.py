"""A ring whose program dies."""

from __future__ import annotations

from collections.abc import Callable

from faults.program import Program
from patience import PATIENCE

PROGRAM = """
    import fiber

    def wait(rank, size):
        if rank == 0:
            print("ready", flush=True)
        fiber.ring.current().recv()

    if __name__ == "__main__":
        fiber.Ring(3, wait).run()
"""


def test_a_killed_program_leaves_no_member(launch: Callable[..., Program]) -> None:
    program = launch(PROGRAM)
    assert program.line() == "ready"
    program.kill()
    assert program.left(PATIENCE) == []
    assert "Traceback" not in program.stderr
