"""The zygote by its own protocol: what it answers, and what becomes of its children."""

from __future__ import annotations

import errno
import os
import pickle
import resource
import select
import signal
import socket
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from multiprocessing import spawn
from pathlib import Path
from typing import Any

import pytest

import census
from fiber import reduction
from fiber._agent import child, zygote, zygote_process
from fiber._agent.child import StartRequest
from fiber._agent.last_words import ProgressTable
from fiber._agent.preload import Imports
from fiber._agent.service import is_expected
from fiber._transport.channels import socketpair
from fiber._wire import packet
from fiber.process import Process
from patience import PATIENCE
from unit.agent_children import run_forever

NOTHING = Imports((), dict(os.environb))


class Master:
    """The agent's end of a zygote, spoken by hand."""

    def __init__(
        self,
        progress_table: ProgressTable,
        *,
        imports: Imports | None = NOTHING,
        cleanup_directory: str | None = None,
        ancestors: tuple[int, ...] = (),
    ) -> None:
        self.process, self.sock = zygote_process.launch()
        self.sock.settimeout(PATIENCE)
        setup = (zygote.SETUP, (os.getpid(), *ancestors), imports, cleanup_directory, None)
        packet.send(self.sock, pickle.dumps(setup), fds=[progress_table.fd])

    def start(self, number: int, **options: Any) -> None:
        """Ask for a child that runs for ever, unless ``options`` say otherwise."""
        fds = [os.dup(1), os.dup(2), *options.pop("fds", ())]
        for first in range(0, len(fds), 200):
            last = first + 200 >= len(fds)
            message = (zygote.START, number, tuple(_start(**options)))
            request = message if last else (zygote.DESCRIPTORS, number)
            packet.send(self.sock, pickle.dumps(request), fds=fds[first : first + 200])
        for fd in fds:
            os.close(fd)

    def say(self, *request: Any) -> None:
        packet.send(self.sock, pickle.dumps(request))

    def hear(self) -> tuple[Any, ...]:
        answer: tuple[Any, ...] = packet.loads(packet.receive(self.sock))
        return answer

    def started(self, number: int, **options: Any) -> int:
        """Start a child and return its pid."""
        self.start(number, **options)
        kind, who, pid = self.hear()
        assert (kind, who) == (zygote.STARTED, number)
        assert isinstance(pid, int)
        return pid

    def close(self) -> None:
        self.sock.close()
        self.process.wait(PATIENCE)


def _start(target: Any = run_forever, args: Any = (), **options: Any) -> StartRequest:
    process = Process(target=target, args=args)
    preparation = spawn.get_preparation_data(process.name)
    preparation |= {"authkey": b"key", "calls": [], "same_host": True}
    for key in ("start_method", "init_main_from_name", "init_main_from_path"):
        preparation.pop(key, None)
    preparation |= options.pop("preparation", {})
    return StartRequest(
        name=process.name,
        host="here",
        method=options.pop("method", "fork"),
        preparation=pickle.dumps(preparation),
        payload=reduction.dump_process(process, same_host=True)[0],
        slot=None,
        executable=options.pop("executable", None),
        open_files=resource.getrlimit(resource.RLIMIT_NOFILE),
        hub=None,
        ancestors=(os.getpid(),),
    )


@pytest.fixture
def progress_table() -> Iterator[ProgressTable]:
    made = ProgressTable()
    yield made
    made.close()


@pytest.fixture
def master(progress_table: ProgressTable) -> Iterator[Master]:
    made = Master(progress_table)
    yield made
    made.close()


def gone(pid: int) -> bool:
    found = census.read(pid)
    return found is None or found.state == "Z"


def test_a_child_that_is_just_born_does_not_count_as_prepared_for_a_signal(master: Master) -> None:
    # A new child still has the zygote's handlers and mask.
    master.started(1)  # from here on the zygote has set its own
    status = Path(f"/proc/{master.process.pid}/status").read_text()
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigIgn"))
    assert int(mask, 16) >> (signal.SIGTERM - 1) & 1
    assert not is_expected(master.process.pid, signal.SIGTERM)


@pytest.mark.parametrize(
    ("prepare", "expected"),
    [
        ("signal.signal(signal.SIGTERM, lambda *_: None)", True),
        ("signal.signal(signal.SIGTERM, signal.SIG_IGN)", True),
        ("signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())", True),
        ("pass", False),
    ],
)
def test_is_expected_tells_whether_a_process_handles_a_signal(prepare: str, expected: bool) -> None:
    script = f"import signal, sys; {prepare}; print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"\n"
        assert is_expected(process.pid, signal.SIGTERM) is expected
        process.communicate()
    assert not is_expected(process.pid, signal.SIGTERM)


@pytest.mark.slow
def test_a_child_is_started_signalled_and_reaped(master: Master) -> None:
    pid = master.started(7)
    master.say(zygote.SIGNAL, 7, signal.SIGTERM)
    assert master.hear() == (zygote.EXITED, 7, -signal.SIGTERM)
    assert census.read(pid) is None, "no zombie is left"
    master.say(zygote.SIGNAL, 7, signal.SIGTERM)  # gone: the call does nothing
    assert master.started(8) > 0


def test_a_signal_right_after_the_birth_is_not_lost(master: Master) -> None:
    for number in range(20):
        master.start(number)
        master.say(zygote.SIGNAL, number, signal.SIGTERM)
    answers = [master.hear() for _ in range(40)]
    assert [a[2] for a in answers if a[0] == zygote.EXITED] == [-signal.SIGTERM] * 20


def test_many_simultaneous_deaths_are_all_reported(master: Master) -> None:
    pids = [master.started(number) for number in range(10)]
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    answers = {master.hear() for _ in pids}
    assert answers == {(zygote.EXITED, number, -signal.SIGKILL) for number in range(10)}


def test_quit_kills_and_reports_the_children(master: Master) -> None:
    pids = [master.started(number) for number in range(3)]
    master.say(zygote.QUIT)
    answers = {master.hear() for _ in pids}
    assert answers == {(zygote.EXITED, number, -signal.SIGKILL) for number in range(3)}
    with pytest.raises(EOFError):
        master.hear()
    assert all(gone(pid) for pid in pids)


@pytest.mark.slow
def test_no_signal_of_the_terminal_ends_it(master: Master) -> None:
    first = master.started(1)
    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        master.process.send_signal(signum)
    assert master.started(2) > 0
    assert not gone(first)


def test_children_end_with_a_zygote_that_is_killed(master: Master) -> None:
    pids = [
        master.started(number, method=method) for number, method in enumerate(("fork", "spawn"))
    ]
    master.process.kill()
    assert census.wait_until(lambda: all(gone(pid) for pid in pids), PATIENCE)


@pytest.mark.slow
def test_a_hang_up_ends_it(progress_table: ProgressTable) -> None:
    master = Master(progress_table)
    pid = master.started(1)
    master.close()
    assert gone(pid)


@pytest.mark.slow
def test_a_zygote_ends_with_its_agent_although_another_process_holds_its_socket() -> None:
    script = """
        import os, signal, subprocess
        from processes.test_zygote import ProgressTable, Master
        master = Master(ProgressTable())
        child, socket = master.started(1), master.sock.fileno()
        holder = subprocess.Popen(["sleep", "60"], stdout=subprocess.DEVNULL, pass_fds=[socket])
        print(holder.pid, master.process.pid, child, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    holder, *ours = map(int, _run(script, expect=-signal.SIGKILL).split())
    try:
        assert census.wait_until(lambda: all(map(gone, ours)), PATIENCE)
        assert not gone(holder)
    finally:
        os.kill(holder, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["at once", "later"])
def test_a_zygote_removes_the_directory_of_a_killed_agent(moment: str, tmp_path: Path) -> None:
    directory = tmp_path / "cleanup_directory"
    directory.mkdir()
    script = f"""
        import os, signal
        from processes.test_zygote import ProgressTable, Master
        master = Master(ProgressTable(), cleanup_directory={str(directory)!r})
        if {moment!r} == "later":
            master.started(1)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    _run(script, expect=-signal.SIGKILL)
    assert census.wait_until(lambda: not directory.exists(), PATIENCE)


def test_quit_leaves_the_directory_to_the_agent(
    progress_table: ProgressTable, tmp_path: Path
) -> None:
    master = Master(progress_table, cleanup_directory=str(tmp_path))
    master.started(1)
    master.say(zygote.QUIT)
    master.close()
    assert tmp_path.exists()


@pytest.mark.parametrize("parent", ["os.getppid()", "os.getppid() + 1"])
def test_a_child_whose_zygote_died_first_does_not_live_on(parent: str) -> None:
    script = f"""
        import os
        from fiber._agent.child import die_with_parent
        die_with_parent({parent})
        print("alive")
    """
    alive = parent == "os.getppid()"
    assert _run(script, expect=0 if alive else 1) == ("alive\n" if alive else "")


def _run(script: str, expect: int, env: Mapping[str, str] = os.environ) -> str:
    path = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        env={**env, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == expect
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_once_its_imports_made_forking_unsafe_it_forks_no_more(
    progress_table: ProgressTable, method: str
) -> None:
    master = Master(progress_table, imports=None)
    threads = {"preload": ["processes.threads_at_import"]}
    master.started(1, method="spawn")
    for number in (2, 3):
        master.start(number, preparation=threads)
        kind, who, safe = master.hear()
        assert (kind, who) == (zygote.FORK_UNSAFE, number)
        assert safe.modules == ()
    assert master.started(4, method="spawn") > 0, "a new interpreter is safe all the same"
    master.close()


@pytest.mark.slow
def test_the_main_module_is_imported_once_for_all(
    progress_table: ProgressTable, tmp_path: Path
) -> None:
    main, log = tmp_path / "main_module.py", tmp_path / "log"
    main.write_text(f"import os\nwith open({str(log)!r}, 'a') as f:\n    f.write('imported\\n')\n")
    master = Master(progress_table, imports=None)
    for number in range(3):
        preparation = {"preload": [], "sys_path": [str(tmp_path), *sys.path]}
        master.started(number, preparation={**preparation, "preload": ["main_module"]})
    master.close()
    assert log.read_text() == "imported\n"


@pytest.mark.slow
@pytest.mark.parametrize("code", ["raise SystemExit(3)", "raise KeyboardInterrupt", "1 / 0"])
def test_an_import_that_fails_does_not_end_it(
    progress_table: ProgressTable, tmp_path: Path, code: str
) -> None:
    (tmp_path / "broken_module.py").write_text(code)
    master = Master(progress_table, imports=None)
    preparation = {"preload": ["broken_module"], "sys_path": [str(tmp_path), *sys.path]}
    assert master.started(1, preparation=preparation) > 0
    master.close()


def test_an_executable_that_is_not_there_is_named(
    progress_table: ProgressTable, capfd: pytest.CaptureFixture[str]
) -> None:
    master = Master(progress_table)
    master.started(1, method="spawn", executable="/no/such/python")
    assert master.hear() == (zygote.EXITED, 1, 1)
    master.close()
    assert "No such file or directory: '/no/such/python'" in capfd.readouterr().err


def test_more_descriptors_than_it_was_born_to_hold(progress_table: ProgressTable) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        master = Master(progress_table)
        first = master.started(1)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    # The program raised its limit, as the error message says one can.
    fds = [os.dup(1) for _ in range(400)]
    second = master.started(2, fds=fds)
    assert not gone(first)
    assert not gone(second)

    def limits() -> list[tuple[int, int]]:
        return [resource.prlimit(pid, resource.RLIMIT_NOFILE) for pid in (first, second)]

    # Each child has its program's limit of the moment, as one of the first things it sets.
    assert census.wait_until(lambda: limits() == [(256, hard), (soft, hard)], PATIENCE), limits()
    for pid in (first, second):
        os.kill(pid, signal.SIGKILL)
    master.close()


# What cannot be forced from outside: the zygote object itself, in this process


@pytest.fixture
def inside(progress_table: ProgressTable) -> Iterator[tuple[zygote.Zygote, socket.socket]]:
    ours, theirs = socketpair("a test")
    ours.settimeout(PATIENCE)
    watched = os.pidfd_open(os.getpid())
    made = zygote.Zygote(theirs, progress_table, [watched], imports=NOTHING)
    yield made, ours
    for fd in (watched, made._sigchld, made._sigchld_in):
        os.close(fd)
    ours.close()
    theirs.close()


def test_a_refused_fork_is_reported_and_leaks_no_descriptor(
    inside: tuple[zygote.Zygote, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> int:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    made, ours = inside
    before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(os, "fork", refuse)
    for number in (1, 2):
        request = (zygote.START, number, tuple(_start()))
        packet.send(ours, pickle.dumps(request), fds=[1, 2, 1, 2])
        assert made._serve()
        kind, who, text = packet.loads(packet.receive(ours))
        assert (kind, who) == (zygote.FAILED, number)
        assert text == "the system refused a new process: Resource temporarily unavailable"
    assert len(os.listdir("/proc/self/fd")) == before
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()


def test_a_zygote_without_free_descriptors_reports_the_request_as_failed_and_lives(
    inside: tuple[zygote.Zygote, socket.socket],
) -> None:
    made, ours = inside
    request = (zygote.START, 1, tuple(_start()))
    packet.send(ours, pickle.dumps(request), fds=[1, 2, 1, 2])
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
    try:
        assert made._serve()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    kind, who, text = packet.loads(packet.receive(ours))
    assert (kind, who) == (zygote.FAILED, None)
    assert "descriptor" in text


def test_a_child_out_of_reach_does_not_end_the_others(
    inside: tuple[zygote.Zygote, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, ours = inside
    child = subprocess.Popen(["sleep", "0"])
    made._pids, made._children = {1: child.pid}, {child.pid: 1}

    def refuse(pid: int, signum: int) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "kill", refuse)
    packet.send(ours, pickle.dumps((zygote.SIGNAL, 1, signal.SIGTERM)))
    assert made._serve()
    made._kill_children(0)
    assert packet.loads(packet.receive(ours)) == (zygote.EXITED, 1, 0)
    child.returncode = 0


def test_descriptors_of_a_start_that_never_came_are_closed(master: Master) -> None:
    reader, writer = os.pipe()
    packet.send(master.sock, pickle.dumps((zygote.DESCRIPTORS, 1)), fds=[writer])
    os.close(writer)
    master.started(2)
    assert select.select([reader], [], [], PATIENCE)[0]
    assert os.read(reader, 1) == b""
    os.close(reader)
    master.say(zygote.SIGNAL, 2, signal.SIGKILL)


def test_untaken_descriptors_are_closed_in_the_child(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reader, writer = os.pipe()
    monkeypatch.setattr(child, "_descriptors", [writer])
    start = _start(target=os.getpid)
    monkeypatch.setattr(child, "_prepare_environment", lambda _data: None)
    monkeypatch.setattr(child, "prepare_paths", lambda _data: None)
    monkeypatch.setattr(child, "prepare_main", lambda _data: None)
    child._load(start)
    assert os.read(reader, 1) == b""
    os.close(reader)


def test_the_socket_of_a_zygote_blocks_in_spite_of_a_default_timeout(
    monkeypatch: pytest.MonkeyPatch, progress_table: ProgressTable
) -> None:
    blocking = []

    def run(control: int) -> subprocess.Popen[bytes]:
        blocking.append(os.get_blocking(control))
        return start(control)

    start = zygote_process._run
    monkeypatch.setattr(zygote_process, "_run", run)
    socket.setdefaulttimeout(PATIENCE)
    try:
        master = Master(progress_table)
    finally:
        socket.setdefaulttimeout(None)
    assert blocking == [True]
    master.close()


# Started before anything needs it


@pytest.mark.slow
def test_a_zygote_that_was_started_early_is_used_next(progress_table: ProgressTable) -> None:
    zygote_process.start_early()
    early = zygote_process._early
    assert early is not None
    zygote_process.start_early()
    assert zygote_process._early is early, "one is enough"
    master = Master(progress_table)
    assert master.process is early.process
    master.started(1)
    master.close()


def test_an_unused_early_zygote_is_ended() -> None:
    zygote_process.start_early()
    assert zygote_process._early is not None
    pid = zygote_process._early.process.pid
    zygote_process.discard_early()
    assert census.read(pid) is None


def test_an_early_zygote_ends_with_the_program() -> None:
    script = """
        import os
        from fiber._agent import zygote_process
        zygote_process.start_early()
        print(zygote_process._early.process.pid, flush=True)
        os._exit(0)
    """
    pid = int(_run(script, expect=0))
    assert census.wait_until(lambda: gone(pid), PATIENCE)


def test_a_forked_process_leaves_it_to_its_parent() -> None:
    script = """
        import os
        from fiber._agent import zygote_process
        zygote_process.start_early()
        forked = os.fork()
        if forked:
            assert os.waitpid(forked, 0)[1] == 0
            process, sock = zygote_process.launch()
            assert process.poll() is None, "it goes on"
            sock.close()
            process.wait()
        else:
            assert zygote_process._early is None
    """
    assert _run(script, expect=0) == ""


@pytest.mark.parametrize(("backend", "zygotes"), [("local", 1), ("auto", 1), ("loopback", 0)])
def test_the_first_pool_starts_it_before_it_imports_the_rest(backend: str, zygotes: int) -> None:
    script = """
        import fiber, sys
        from fiber._agent import zygote_process
        class Stop(BaseException): pass
        class Importer:
            def find_spec(self, name, path, target=None):
                if name == "fiber.pool":
                    raise Stop
        sys.meta_path.insert(0, Importer())
        try:
            fiber.Pool(1)
        except Stop:
            print(int(zygote_process._early is not None))
    """
    environ = {**os.environ, "FIBER_BACKEND": backend}
    assert int(_run(script, expect=0, env=environ)) == zygotes


def test_a_worker_imports_no_unneeded_module() -> None:
    script = """
        import fiber
        heavy = {"cloudpickle", "dataclasses", "fiber.config", "fiber._runtime.state", "traceback"}
        with fiber.Pool(1) as pool:
            print(pool.apply(eval, (f"{heavy} & __import__('sys').modules.keys()",)))
    """
    assert _run(script, expect=0) == "set()\n"
