"""Out of file descriptors: a clear error that says the limit, and a program that goes on."""

from __future__ import annotations

import resource
from collections.abc import Callable

import pytest

from faults.program import Program

PRELUDE = """
    import fiber, os, resource, sys
    from faults import targets
    from fiber.errors import TooManyOpenFiles

    def held():
        return len(os.listdir("/proc/self/fd"))

    def limit(soft):
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))

    def exhaust(make):
        made = []
        try:
            while True:
                made.append(make())
        except TooManyOpenFiles as error:
            print(type(error).__name__, error.limit, error.errno)
            assert "ulimit -n" in str(error) and "resource.setrlimit()" in str(error), error
        return made

    def fill():
        made = []
        try:
            while True:
                made.append(os.dup(1))
        except OSError:
            return made
"""

PIPES = (
    PRELUDE
    + """
    if __name__ == "__main__":
        limit(100)
        pipes = exhaust(fiber.Pipe)
        print(40 < len(pipes) < 50)
        for ends in pipes:
            for end in ends:
                end.close()
        ours, theirs = fiber.Pipe()
        ours.send(1)
        print(theirs.recv())
"""
)


def test_too_many_pipes(launch: Callable[..., Program]) -> None:
    assert launch(PIPES).finish() == "TooManyOpenFiles 100 24\nTrue\n1\n"


BARE = """
    import fiber, os
    from fiber.errors import TooManyOpenFiles
    fiber.Pipe()  # what it takes is imported
    try:
        while True:
            os.dup(1)
    except OSError:
        pass
    try:
        fiber.Pipe()
    except TooManyOpenFiles as error:
        print(error.limit)
"""


def test_the_error_itself_needs_no_descriptor(launch: Callable[..., Program]) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))

    assert launch(BARE, preexec_fn=limit).finish() == "64\n"


QUEUES = (
    PRELUDE
    + """
    if __name__ == "__main__":
        limit(100)
        exhaust(lambda: fiber.{what}()).clear()
        before = held()  # with segments of shared memory, which are used again
        queues = exhaust(lambda: fiber.{what}())
        print(len(queues) > 5)
        del queues
        print(held() == before)
"""
)


@pytest.mark.parametrize("what", ["Queue", "SimpleQueue", "JoinableQueue", "Event"])
def test_exceeding_any_limit_leaks_no_descriptor(launch: Callable[..., Program], what: str) -> None:
    output = launch(QUEUES.format(what=what)).finish()
    assert output == "TooManyOpenFiles 100 24\n" * 2 + "True\nTrue\n"


PROCESSES = (
    PRELUDE
    + """
    def start():
        child = fiber.Process(target=targets.block)
        child.start()
        return child

    if __name__ == "__main__":
        limit({limit})
        children = exhaust(start)
        print(len(children) > {atleast})
        for child in children:
            child.kill()
            child.join()
            child.close()
        again = start()
        again.kill()
        again.join()
        print(again.exitcode)
"""
)


def test_too_many_processes(launch: Callable[..., Program]) -> None:
    script = PROCESSES.format(limit=64, atleast=10)
    assert launch(script).finish() == "TooManyOpenFiles 64 24\nTrue\n-9\n"


@pytest.mark.parametrize("limit", range(4, 22, 3))
def test_a_limit_below_the_need_of_a_start_is_an_error(
    launch: Callable[..., Program], limit: int
) -> None:
    program = launch(PROCESSES.format(limit=limit, atleast=-1))
    program.wait()
    assert "TooManyOpenFiles" in program.rest() + program.stderr
    assert program.left() == []


POOL = (
    PRELUDE
    + """
    if __name__ == "__main__":
        limit(48)
        try:
            pool = fiber.Pool(64)
            print(pool.map(abs, range(-100, 0)) == list(range(100, 0, -1)))
            pool.terminate()
        except TooManyOpenFiles:
            print("refused")
        except fiber.StartError as error:
            print("refused" if "too many open files" in str(error) else error)
        limit(512)
        with fiber.Pool(2) as pool:
            print(pool.map(abs, [-1, -2]))
"""
)


def test_a_pool_larger_than_the_limit_works_with_fewer_or_says_why(
    launch: Callable[..., Program],
) -> None:
    first, second = launch(POOL).finish().splitlines()
    assert first in ("True", "refused")
    assert second == "[1, 2]"


MESSAGES = (
    PRELUDE
    + """
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        limit(held() + 3)
        fillers = fill()
        ours.send("small ones need none")
        print(ours.recv())
        try:
            ours.send(bytes(200_000))
        except TooManyOpenFiles as error:
            print("refused:", error.doing)
        for fd in fillers:
            os.close(fd)
        ours.send(bytes(200_000))
        print(len(ours.recv()))
        ours.close()
        theirs.close()
        child.join()
"""
)


def test_a_large_message_needs_one_and_says_so(launch: Callable[..., Program]) -> None:
    expected = "small ones need none\nrefused: sending a message\n200000\n"
    assert launch(MESSAGES).finish() == expected


RECEIVES = (
    PRELUDE
    + """
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        theirs.send(bytes(200_000))
        limit(held() + 3)
        fillers = fill()
        try:
            print(len(ours.recv()))
        except TooManyOpenFiles as error:
            print("refused:", error.doing)
        for fd in fillers:
            os.close(fd)
        theirs.send("the next one arrives")
        print(ours.recv())
"""
)


def test_receiving_one_without_is_an_error_and_not_a_broken_pipe(
    launch: Callable[..., Program],
) -> None:
    output = launch(RECEIVES).finish()
    assert output == "refused: receiving a descriptor\nthe next one arrives\n"


LOOPBACK = (
    PRELUDE
    + """
    if __name__ == "__main__":
        limit(64)
        children = exhaust(lambda: fiber.Pipe())
        try:
            fiber.Process(target=targets.nothing).start()
        except TooManyOpenFiles as error:
            print("refused")
        children.clear()
        child = fiber.Process(target=targets.nothing)
        child.start()
        child.join()
        print(child.exitcode)
"""
)


def test_a_loopback_program_with_few_descriptors_refuses_and_ends(
    launch: Callable[..., Program],
) -> None:
    program = launch(LOOPBACK, env={"FIBER_BACKEND": "loopback", "FIBER_AGENTS": "1"})
    assert program.finish() == "TooManyOpenFiles 64 24\nrefused\n0\n"


ANSWER = (
    PRELUDE
    + """
    def fill():
        fillers = []
        try:
            while True:
                fillers.append(os.dup(1))
        except OSError:
            return fillers

    if __name__ == "__main__":
        pool = fiber.Pool(2, retries=0)
        pool.map(abs, range(10))
        limit(held() + 3)
        fillers = fill()
        try:
            getattr(pool, sys.argv[1])(bytes, (1 << 20,)).get()
        except fiber.WorkerDied as error:
            print("too many open files" in str(error), flush=True)
        for fd in fillers:
            os.close(fd)
        limit(1000)
        print(pool.apply(abs, (-1,)))
        pool.terminate()
"""
)


def test_an_answer_that_cannot_be_received_is_an_error(launch: Callable[..., Program]) -> None:
    assert launch(ANSWER, "apply_async").finish() == "True\n1\n"


AGENT_WITHOUT = (
    PRELUDE
    + """
    import subprocess
    from fiber._engine import start_failures

    def agent():
        found = subprocess.run(
            ["pgrep", "-f", "-P", str(os.getpid()), "fiber.agent"], capture_output=True, text=True
        )
        return int(found.stdout)

    if __name__ == "__main__":
        start_failures.KILLED_PATIENCE = 1.0  # the real one is half of what the test may take
        pool = fiber.Pool(2, retries=0)
        pool.map(abs, range(10))
        pid = agent()
        before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (8, before[1]))
        try:
            print(pool.apply_async(len, (bytes(1 << 20),)).get())
        except fiber.WorkerDied as error:
            print("too many open files" in str(error).lower())
        workers = pool._pool
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.join()
        try:
            pool.apply(abs, (-1,))
        except (fiber.WorkerDied, fiber.StartError) as error:
            print("told")
        pool.terminate()
        print("over")
"""
)


def test_an_agent_that_has_none_left_says_so(launch: Callable[..., Program]) -> None:
    program = launch(AGENT_WITHOUT, env={"FIBER_BACKEND": "loopback", "FIBER_AGENTS": "1"})
    assert program.finish() == "True\ntold\nover\n"
