"""Output of children, and the case that it cannot be written."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from faults.program import LOOPBACK, Program

UNCAUGHT = """
    import fiber, sys
    from faults import targets
    if __name__ == "__main__":
        child = fiber.Process(target=targets.exit_by, args=(sys.argv[1],), name="unlucky")
        child.start()
        child.join()
        print(child.exitcode)
"""


@pytest.mark.parametrize(
    ("way", "words"),
    [("raise", ["Process unlucky:", "ValueError: on purpose"]), ("sys.exit text", ["a last word"])],
)
def test_the_error_of_a_child_is_on_stderr(
    launch_on: Callable[..., Program], way: str, words: list[str]
) -> None:
    program = launch_on(UNCAUGHT, way)
    assert program.finish() == "1\n"
    for word in words:
        assert word in program.stderr
    assert sys.executable not in program.stderr


NOISY = """
    import fiber, sys
    def shout(number):
        print("out", number)
        print("err", number, file=sys.stderr)
    if __name__ == "__main__":
        children = [fiber.Process(target=shout, args=(n,)) for n in range(3)]
        for child in children:
            child.start()
        for child in children:
            child.join()
        with open("answer", "w") as file:
            print({child.exitcode for child in children}, file=file)
"""


@pytest.mark.parametrize("full", [{"stdout"}, {"stderr"}, {"stdout", "stderr"}])
def test_a_full_disk_under_the_output_only_loses_the_lines(
    launch_on: Callable[..., Program], full: set[str], request: pytest.FixtureRequest
) -> None:
    with open("/dev/full", "wb") as device:
        streams = {"stdout": subprocess.DEVNULL, **dict.fromkeys(full, device)}
        program = launch_on(NOISY, **streams)
    assert program.wait() == 0
    # A child that writes to the full disk itself fails as any process would; what an agent
    # passes on, it has got rid of.
    codes = {"{0}\n"} if "loopback" in request.node.name else {"{0}\n", "{1}\n"}
    assert program.answer in codes
    assert program.left() == []


ANSWER = """
    import fiber, os, sys
    def work(value):
        print("into the void", file=sys.stderr)
        print("into the void")
        sys.exit(value)
    if __name__ == "__main__":
        for method in ("fork", "spawn"):
            child = fiber.get_context(method).Process(target=work, args=(5,))
            child.start()
            child.join()
            with open("answer", "a") as file:
                print(child.exitcode, file=file)
"""


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1, 2)], ids=str)
def test_a_program_whose_standard_streams_are_closed(
    launch: Callable[..., Program], closed: tuple[int, ...]
) -> None:
    def close() -> None:
        for fd in closed:
            os.close(fd)

    env = LOOPBACK if len(closed) > 1 else {}
    program = launch(ANSWER, stdout=subprocess.DEVNULL, preexec_fn=close, env=env)
    assert program.wait() == 0
    assert program.answer == "5\n5\n"
    assert program.left() == []


CLOSES_LATE = """
    import fiber, os, sys
    def work(value):
        sys.exit(value)
    if __name__ == "__main__":
        os.close(0), os.close(1), os.close(2)
        for value in (3, 4):
            child = fiber.Process(target=work, args=(value,))
            child.start()
            child.join()
            with open("answer", "a") as file:
                print(child.exitcode, file=file)
        os._exit(0)
"""


def test_a_program_that_closes_its_standard_streams_itself(
    launch_on: Callable[..., Program],
) -> None:
    program = launch_on(CLOSES_LATE, stdout=subprocess.DEVNULL)
    assert program.wait() == 0
    assert program.answer == "3\n4\n"
    assert program.left() == []


def test_development_mode_warns_of_no_fault_of_fiber(
    launch_on: Callable[..., Program],
) -> None:
    program = launch_on(
        """
        import fiber
        if __name__ == "__main__":
            with fiber.Pool(1) as pool:
                print(pool.apply(abs, (-3,)))
            queue = fiber.SimpleQueue()
            child = fiber.Process(target=queue.put, args=(4,))
            child.start()
            print(queue.get())
            child.join()
            queue.close()
        """,
        env={"PYTHONDEVMODE": "1"},
    )
    assert program.finish() == "3\n4\n"
    assert program.stderr == ""


LINES = """
    import fiber, sys
    def talk(number):
        for turn in range(300):
            print("worker", number, "turn", turn, "." * 60, "end")
            print("worker", number, "turn", turn, "." * 3000, "end", file=sys.stderr)
    if __name__ == "__main__":
        with fiber.Pool(3) as pool:
            result = pool.map_async(talk, range(3), chunksize=1)
            while not result.ready():
                print("master", "." * 60, "end")
                result.wait(0.0001)
            result.get()
"""
LINE = re.compile(r"(\[[^]]+\] )?worker \d turn \d+ \.+ end|master \.+ end|\[fiber\] .*")


@pytest.mark.parametrize("unbuffered", ["", "1"], ids=["buffered", "unbuffered"])
def test_no_two_processes_share_a_line(
    launch_on: Callable[..., Program], unbuffered: str, tmp_path: Path
) -> None:
    with (tmp_path / "output").open("w+") as output:
        env = {"PYTHONUNBUFFERED": unbuffered}
        assert launch_on(LINES, stdout=output, stderr=output, env=env).wait() == 0
        output.seek(0)
        lines = output.read().splitlines()
    assert [line for line in lines if not LINE.fullmatch(line)] == []
    said = [line.partition("worker ")[2] for line in lines if "worker " in line]
    assert len(said) == 2 * 3 * 300


PARTS = """
    import fiber
    def count():
        for number in range(3):
            print(number, end=" ", flush=number == 1)
    if __name__ == "__main__":
        child = fiber.Process(target=count)
        child.start()
        child.join()
"""


def test_an_incomplete_line_arrives_when_its_process_ends(
    launch: Callable[..., Program],
) -> None:
    assert launch(PARTS).finish() == "0 1 2 "


WRITES_A_LOT = """
    import fiber, sys
    def shout():
        for number in range(20_000):
            print("line", number)
        sys.stdout.flush()
    if __name__ == "__main__":
        child = fiber.Process(target=shout, name="loud")
        child.start()
        child.join()
        print(child.exitcode)
"""


def test_much_output_arrives_whole_and_in_order(launch: Callable[..., Program]) -> None:
    program = launch(WRITES_A_LOT, env=LOOPBACK)
    assert program.finish() == "0\n"
    lines = [line for line in program.stderr.splitlines() if line.startswith("[loud@")]
    assert [int(line.split()[-1]) for line in lines] == list(range(20_000))


def test_an_output_pipe_without_a_reader_harms_no_task(launch_on: Callable[..., Program]) -> None:
    reader, writer = os.pipe()
    program = launch_on(NOISY, stdout=writer)
    os.close(writer)
    os.close(reader)
    program.wait()
    assert program.left() == []
