"""Fiber beside other ways to have processes and threads: neither disturbs the other."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from faults.program import LOOPBACK, Program

FORKS = """
    import fiber, os, sys, warnings
    from faults import targets

    # From Python 3.12 on os.fork() warns of any thread, and the loop is one.
    warnings.simplefilter("ignore", DeprecationWarning)

    def use(name):
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        theirs.close()
        ours.send(name)
        assert ours.recv() == name
        ours.close()
        child.join()
        with fiber.Pool(1) as pool:
            assert pool.map(abs, [-1, -2]) == [1, 2]
        return child.exitcode

    if __name__ == "__main__":
        {before}
        pid = os.fork()
        code = use("child" if pid == 0 else "parent")
        if pid == 0:
            {end}
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        print(status, code, use("parent again"))
        {after}
"""

DAEMON = "daemon = fiber.Process(target=targets.block, daemon=True); daemon.start()"


@pytest.mark.parametrize("before", ["pass", "use('before the fork')", DAEMON])
@pytest.mark.parametrize("end", ["sys.exit(code)", "os._exit(code)"])
def test_a_program_that_forks_itself_uses_fiber_in_both(
    launch: Callable[..., Program], before: str, end: str
) -> None:
    after = "print(daemon.is_alive())" if before == DAEMON else "pass"
    program = launch(FORKS.format(before=before, end=end, after=after))
    expected = "0 0 0\n" + ("True\n" if before == DAEMON else "")
    assert program.finish() == expected
    assert program.stderr == ""


def test_a_program_with_agents_that_forks_itself_uses_fiber_in_both(
    launch: Callable[..., Program],
) -> None:
    script = FORKS.format(before=DAEMON, end="sys.exit(code)", after="print(daemon.is_alive())")
    program = launch(script, env=LOOPBACK)
    assert program.finish() == "0 0 0\nTrue\n"
    assert program.stderr == ""


BESIDE_MULTIPROCESSING = """
    import fiber, multiprocessing, sys
    from faults import targets

    def fiber_within(connection):
        child = fiber.Process(target=targets.exit_by, args=("os._exit",))
        child.start()
        child.join()
        connection.send(child.exitcode)

    if __name__ == "__main__":
        context = multiprocessing.get_context("{method}")
        ours, theirs = context.Pipe()
        theirs_first = context.Process(target=fiber_within, args=(theirs,))
        mine = fiber.Process(target=targets.block)
        mine.start()
        theirs_first.start()
        print(ours.recv())
        theirs_first.join()
        print(theirs_first.exitcode, mine.is_alive())
        with context.Pool(2) as other, fiber.Pool(2) as pool:
            print(other.map(abs, [-1]), pool.map(abs, [-2]))
        print(sorted(type(child).__name__ for child in fiber.active_children()))
        mine.terminate()
        mine.join()
        print(mine.exitcode, fiber.active_children())
"""


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_multiprocessing_works_in_the_same_program(
    launch: Callable[..., Program], method: str
) -> None:
    env = LOOPBACK if method == "fork" else {}
    program = launch(BESIDE_MULTIPROCESSING.format(method=method), env=env)
    assert program.finish() == "9\n0 True\n[1] [2]\n['Process']\n-15 []\n"
    assert program.stderr == ""


MULTIPROCESSING_INSIDE = """
    import fiber, multiprocessing
    def inside(connection):
        with multiprocessing.get_context("fork").Pool(2) as pool:
            connection.send(pool.map(abs, [-1, -2]))
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=inside, args=(theirs,))
        child.start()
        print(ours.recv())
        child.join()
        print(child.exitcode)
"""


def test_multiprocessing_inside_it(launch: Callable[..., Program]) -> None:
    assert launch(MULTIPROCESSING_INSIDE).finish() == "[1, 2]\n0\n"


SUBPROCESS = """
    import fiber, subprocess, sys
    def shell(connection):
        done = subprocess.run("echo inside; exit 3", shell=True, capture_output=True, text=True)
        connection.send((done.returncode, done.stdout))
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=shell, args=(theirs,))
        child.start()
        print(ours.recv())
        child.join()
        print(subprocess.run(["true"]).returncode)
"""


def test_subprocesses_of_both_sides_are_reaped_by_their_parents(
    launch: Callable[..., Program],
) -> None:
    assert launch(SUBPROCESS).finish() == "(3, 'inside\\n')\n0\n"


ORPHANS = """
    import fiber, os
    def leave_one(connection):
        pid = os.fork()
        if pid == 0:
            os.fork() or os._exit(0)
            import time
            time.sleep(0.2)
            os._exit(7)
        os.waitpid(pid, 0)
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        for _ in range(3):
            child = fiber.Process(target=leave_one, args=(theirs,))
            child.start()
            child.join()
            print(child.exitcode)
"""


def test_orphans_of_children_disturb_no_process(launch_on: Callable[..., Program]) -> None:
    assert launch_on(ORPHANS).finish() == "0\n0\n0\n"


SIGCHLD = """
    import fiber, signal, sys
    from faults import targets
    if __name__ == "__main__":
        {handling}
        child = fiber.Process(target=targets.exit_by, args=("os._exit",))
        child.start()
        child.join()
        print(child.exitcode)
        with fiber.Pool(2) as pool:
            print(pool.map(abs, [-1, -2]))
"""


@pytest.mark.parametrize(
    "handling",
    [
        "signal.signal(signal.SIGCHLD, signal.SIG_IGN)",
        "signal.signal(signal.SIGCHLD, lambda *_: None)",
        "signal.signal(signal.SIGPIPE, signal.SIG_DFL)",
        "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM, signal.SIGCHLD])",
        "signal.set_wakeup_fd(-1); signal.alarm(100)",
    ],
)
def test_a_program_with_its_own_idea_of_signals(
    launch: Callable[..., Program], handling: str
) -> None:
    env = LOOPBACK if "mask" in handling else {}
    assert launch(SIGCHLD.format(handling=handling), env=env).finish() == "9\n[1, 2]\n"


THREADS = """
    import fiber, threading
    from faults import targets
    results = []
    def work(number):
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        theirs.close()
        for value in range(20):
            ours.send((number, value))
            results.append(ours.recv())
        ours.close()
        child.join()
        with fiber.Pool(1) as pool:
            results.extend(pool.map(abs, [number]))
    if __name__ == "__main__":
        threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        print(len(results), len(set(results)))
"""


def test_threads_that_start_processes_at_once(launch_on: Callable[..., Program]) -> None:
    assert launch_on(THREADS).finish() == "126 126\n"


DEFAULT_TIMEOUT = """
    import fiber, socket, time
    from faults import targets
    if __name__ == "__main__":
        socket.setdefaulttimeout(0.05)
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        with fiber.Pool(1) as pool:
            pool.apply(time.sleep, (0.2,))
        ours.send(1)
        print(ours.recv())
        child.kill()
"""


def test_a_default_timeout_for_sockets_is_for_the_users_own(
    launch_on: Callable[..., Program],
) -> None:
    assert launch_on(DEFAULT_TIMEOUT).finish() == "1\n"


THREADED_MAIN = """
    import fiber, threading, time
    from faults import targets
    threading.Thread(target=time.sleep, args=(0.2,), name="from the import").start()
    if __name__ == "__main__":
        for method in ("spawn", "forkserver", "forkserver", "spawn"):
            child = fiber.get_context(method).Process(target=targets.exit_by, args=("os._exit",))
            child.start()
            child.join()
            print(child.exitcode)
        with fiber.Pool(2) as pool:
            print(pool.map(abs, [-1, -2]))
"""


def test_a_main_module_whose_import_starts_threads(launch: Callable[..., Program]) -> None:
    assert launch(THREADED_MAIN).finish() == "9\n9\n9\n9\n[1, 2]\n"
