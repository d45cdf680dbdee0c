"""A ring whose program dies or is interrupted."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

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


INTERRUPTED_AGAIN = """
    import fiber
    from fiber.process import Process
    from faults import targets

    real = Process.{step}
    interrupts = [KeyboardInterrupt]

    def interrupted(process):
        if interrupts:
            raise interrupts.pop()
        real(process)

    def wait(rank, size):
        if rank == 0:
            print("ready", flush=True)
        targets.shrug_off_signals()

    if __name__ == "__main__":
        Process.{step} = interrupted
        fiber.Ring(2, wait).run()
"""


@pytest.mark.parametrize("step", ["kill", "join"])
def test_a_second_interrupt_while_the_members_are_ended_leaves_none(
    launch: Callable[..., Program], step: str
) -> None:
    program = launch(INTERRUPTED_AGAIN.format(step=step))
    assert program.line() == "ready"
    program.signal(signal.SIGINT)
    assert program.wait() == -signal.SIGINT
    assert program.left() == []
