"""Mistakes of a person are answered at once, with the mistake and the remedy."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any, cast

import pytest

import fiber
from faults.program import Program
from fiber import config
from fiber.connection import Connection

UNGUARDED_PROCESS = """
    import fiber, sys
    from faults import targets
    print("main is imported", file=sys.stderr)
    fiber.set_start_method("{method}", force=True)
    child = fiber.Process(target=targets.nothing)
    child.start()
    child.join()
    print(child.exitcode, flush=True)
"""

UNGUARDED_POOL = """
    import fiber, sys
    print("main is imported", file=sys.stderr)
    pool = fiber.Pool(4)
    pool.map(abs, range(10))
"""

UNGUARDED_QUEUE_THEN_PROCESS = """
    import fiber, sys
    from faults import targets
    print("main is imported", file=sys.stderr)
    queue = fiber.Queue()
    child = fiber.Process(target=targets.get_for_ever, args=(queue,))
    child.start()
    child.join()
    print(child.exitcode, flush=True)
"""


@pytest.mark.parametrize("method", ["forkserver", "spawn"])
@pytest.mark.parametrize("script", [UNGUARDED_PROCESS, UNGUARDED_QUEUE_THEN_PROCESS])
def test_an_unguarded_main_gets_an_error_and_starts_no_avalanche(
    launch: Callable[..., Program], script: str, method: str
) -> None:
    program = launch(script.replace("{method}", method))
    assert program.rest() == "1\n"
    assert program.wait() == 0
    assert program.stderr.count('if __name__ == "__main__"') == 1
    assert f"did not start: {program.script}, line " in program.stderr
    assert "Traceback" not in program.stderr
    assert "threads" not in program.stderr
    assert program.stderr.count("main is imported") <= 3  # itself, its zygote, the child
    assert program.left() == []


def test_an_unguarded_main_with_a_pool_is_an_error_after_a_few_tries(
    launch: Callable[..., Program],
) -> None:
    program = launch(UNGUARDED_POOL)
    assert program.wait() == 1
    assert program.stderr.count('if __name__ == "__main__"') == 1
    assert program.stderr.count("Traceback") == 1, "the program's own"
    assert f"{program.script}, line 4, starts a process" in program.stderr
    assert "StartError" in program.stderr
    assert program.stderr.count("main is imported") <= 20
    assert program.left() == []


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: Connection(cast("Any", 0)), TypeError, "multiprocessing.connection.Connection"),
        (lambda: fiber.Process(group=cast("Any", 1)), AssertionError, "group"),
        (lambda: fiber.Semaphore(-1), OSError, "value"),
        (lambda: fiber.get_context("typo"), ValueError, "typo"),
        (lambda: fiber.set_start_method("typo", force=True), ValueError, "typo"),
        (lambda: fiber.init(bakend="local"), fiber.ConfigError, "'bakend'.*'backend'"),  # type: ignore[call-arg]
        (lambda: fiber.init(backend="typo"), fiber.ConfigError, "'typo'.*'local'"),  # type: ignore[arg-type]
        (lambda: fiber.Barrier(0), ValueError, "one party.*0"),
    ],
)
def test_bad_arguments_are_named(make: Callable[[], Any], error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make()


NO_NUMBER = """
    import fiber, os
    if __name__ == "__main__":
        try:
            fiber.Pool({processes!r})
        except (TypeError, ValueError) as error:
            print("processes" in str(error), flush=True)
        os._exit(0)
"""


@pytest.mark.parametrize("processes", [2.5, "4", True])
def test_an_invalid_number_of_processes_is_refused_as_in_multiprocessing(
    launch: Callable[..., Program], processes: object
) -> None:
    assert launch(NO_NUMBER.format(processes=processes)).rest() == "True\n"


def test_a_misspelt_option_of_a_pool_is_the_only_thing_on_stderr(
    launch: Callable[..., Program],
) -> None:
    program = launch("import fiber\nfiber.Pool(2, initialiser=print)\n")
    assert program.wait() == 1
    assert "'initialiser'" in program.stderr
    assert "Exception ignored" not in program.stderr


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("FIBER_BACKEND", "typo", "'typo' for 'backend'"),
        ("FIBER_BAKEND", "local", "FIBER_BAKEND"),
        ("FIBER_AGENTS", "0", "'0' for 'agents'"),
        ("FIBER_LOST_AFTER", "never", "'never' for 'lost_after'"),
        ("FIBER_LISTEN_PORT", "80000", "'80000' for 'listen_port'"),
        ("FIBER_RUNTIME_DIRECTORY", "/no/such", "'/no/such' for 'runtime_directory'"),
    ],
)
def test_bad_environment_is_named_at_the_first_use(
    launch: Callable[..., Program], variable: str, value: str, words: str
) -> None:
    script = "import fiber\nprint('imported', flush=True)\nfiber.Process(target=print).start()\n"
    program = launch(script, env={variable: value})
    assert program.rest() == "imported\n"
    assert program.wait() == 1
    assert words in program.stderr
    assert program.left() == []


@pytest.mark.parametrize(
    "statement",
    [
        "Pipe()",
        "Queue()",
        "JoinableQueue()",
        "SimpleQueue()",
        "Event()",
        "Semaphore()",
        "get_context('spawn').BoundedSemaphore()",
    ],
)
def test_bad_environment_is_named_where_no_process_is_made(
    monkeypatch: pytest.MonkeyPatch, statement: str
) -> None:
    monkeypatch.setattr(config, "_current", {})
    monkeypatch.setenv("FIBER_BACKEND", "typo")
    with pytest.raises(fiber.ConfigError, match="'typo' for 'backend'"):
        eval(f"fiber.{statement}")


def test_a_port_in_use(launch: Callable[..., Program]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        env = {"FIBER_BACKEND": "loopback", "FIBER_LISTEN_PORT": port}
        program = launch("import fiber\nfiber.Process(target=print).start()\n", env=env)
        assert program.wait() == 1
        assert f"127.0.0.1:{port}" in program.stderr
        assert "port 0 takes a free one" in program.stderr
        assert program.left() == []


def test_targets_that_exist_here_only_are_explained(launch: Callable[..., Program]) -> None:
    script = """
        import fiber, threading
        if __name__ == "__main__":
            fiber.Process(target=print, args=(threading.Lock(),), name="mine").start()
    """
    program = launch(script)
    assert program.wait() == 1
    assert "argument 0 of process 'mine' cannot be pickled" in program.stderr
