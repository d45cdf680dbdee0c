"""The launcher of a program's pod: what it passes on, and how it ends."""

from __future__ import annotations

import contextlib
import ctypes
import gzip
import io
import json
import os
import signal
import socket
import subprocess
import sys
import tarfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from faults.program import wait_for
from fiber.launcher import (
    ALIVE,
    DROPPED,
    EXIT,
    FAILURE,
    FOLLOWS,
    LAYOUT,
    NUMBER,
    RECORD,
    STATUS,
    STDERR,
    STDOUT,
    Output,
)
from patience import PATIENCE
from unit.launcher_rig import Records, Site, archive, status_in, text


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    made = Site(tmp_path)
    yield made
    made.close()


# ---- output


def test_output_and_errors_are_apart_and_the_log_has_both(site: Site) -> None:
    pod = site.shell("echo out; echo err >&2; exit 7")
    found = pod.read()
    assert (text(found), text(found, STDERR), status_in(found)) == (b"out\n", b"err\n", 7)
    assert pod.end() == 7
    assert sorted(pod.log().splitlines()) == ["err", "out"]


def test_a_follower_gets_all_of_much_output(site: Site) -> None:
    """More than is kept: the program waits for its reader."""
    pod = site.python("import os\nfor n in range(40): os.write(1, bytes([65 + n]) * (1 << 20))")
    found = pod.read()
    assert not text(found, DROPPED)
    assert text(found) == b"".join(bytes([65 + n]) * (1 << 20) for n in range(40))
    assert status_in(found) == pod.end() == 0


def test_output_without_a_newline_is_there_at_once(site: Site) -> None:
    pod = site.python(
        "import signal, sys\nsys.stdout.write('abc'); sys.stdout.flush(); signal.pause()"
    )
    assert pod.read(until=b"abc")
    answers: list[int] = []
    found = pod.read(begun=lambda: answers.append(pod.signal(signal.SIGTERM)))
    assert (answers, status_in(found)) == ([200], 143)


def test_a_program_may_close_its_output(site: Site) -> None:
    pod = site.shell("echo out; exec >&-; echo err >&2; exit 5")
    found = pod.read()
    assert (text(found), text(found, STDERR), status_in(found)) == (b"out\n", b"err\n", 5)


def test_a_process_that_is_left_behind_does_not_keep_the_pod(site: Site) -> None:
    pod = site.shell("sleep 1000 & echo $!; exit 3")
    found = pod.read()
    left = int(text(found))
    os.kill(left, signal.SIGKILL)
    assert status_in(found) == pod.end() == 3


def test_two_readers_get_everything(site: Site) -> None:
    pod = site.python("import os, time\nos.write(1, b'one\\n')\nwhile True: time.sleep(0.1)")
    both: list[Records] = []
    told = threading.Semaphore(0)

    def read() -> None:
        both.append(pod.read(told=told.release))

    threads = [threading.Thread(target=read) for _ in range(2)]
    for thread in threads:
        thread.start()
        assert told.acquire(timeout=PATIENCE)
    pod.signal(signal.SIGINT)
    for thread in threads:
        thread.join()
    for found in both:
        assert text(found) == b"one\n"
        assert b"KeyboardInterrupt" in text(found, STDERR)
        assert status_in(found) == 130


def test_a_reader_goes_on_where_another_broke_off(site: Site) -> None:
    pod = site.python(
        "import os, signal, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: (os.write(1, b'two'), os._exit(9)))\n"
        "os.write(1, b'one')\n"
        "while True: time.sleep(0.1)"
    )
    assert text(pod.read(until=b"one")) == b"one"
    rest = pod.read(3, begun=lambda: pod.signal(signal.SIGTERM))
    assert (text(rest), status_in(rest)) == (b"two", 9)


# ---- start


def test_files_and_search_path_are_those_of_the_layout(site: Site, tmp_path: Path) -> None:
    pod = site.pod(sys.executable, "-c", "import here; print(here.__file__)")
    files = archive(**{"lib/here.py": "", "work/a": ""})
    # The folders of an archive come before their files.
    buffer = io.BytesIO()
    with (
        tarfile.open(fileobj=buffer, mode="w:gz") as made,
        tarfile.open(fileobj=io.BytesIO(files)) as plain,
    ):
        for name in ("lib", "work"):
            folder = tarfile.TarInfo(name)
            folder.type = tarfile.DIRTYPE
            made.addfile(folder)
        for member in plain:
            made.addfile(member, plain.extractfile(member))
    pod.start(buffer.getvalue(), json.dumps({"directory": "work", "path": ["lib"]}))
    assert text(pod.read()).decode() == f"{tmp_path}/pod/program/lib/here.py\n"


def test_a_large_archive(site: Site) -> None:
    content = os.urandom(8 << 20).hex()
    pod = site.pod(sys.executable, "-c", "import os; print(os.path.getsize('large'))")
    pod.start(archive(large=content))
    assert text(pod.read()) == b"%d\n" % (16 << 20)


def test_output_that_is_no_text_arrives_unchanged(site: Site) -> None:
    """An archive of results can be the output of a program."""
    program = "import sys; sys.stdout.buffer.write(bytes(range(256)) * 4096)"
    pod = site.pod(sys.executable, "-c", program)
    pod.start()
    assert text(pod.read()) == bytes(range(256)) * 4096


@pytest.mark.parametrize(
    ("command", "status", "words"),
    [
        ("no-such-command", 127, "cannot run 'no-such-command': there is no such command"),
        ("./no/such", 127, "there is no such command"),
        ("/etc/passwd", 126, "cannot run '/etc/passwd': "),
    ],
)
def test_a_command_that_cannot_be_run(site: Site, command: str, status: int, words: str) -> None:
    pod = site.pod(command)
    failure = pod.start()
    assert failure is not None
    assert words in failure
    found = pod.read()
    assert words in text(found, STDERR).decode()
    assert status_in(found) == pod.end() == status
    assert words in pod.log()


@pytest.mark.parametrize(
    "files",
    [b"", b"no archive", gzip.compress(b"no archive"), archive(**{"../out": ""})],
    ids=["empty", "no archive", "no tar", "a file outside"],
)
def test_a_bad_archive_ends_the_pod(site: Site, files: bytes) -> None:
    pod = site.pod("true")
    with pod.ask("PUT", "/program", files, **{FOLLOWS: "yes"}) as response:
        assert "cannot be unpacked" in (response.getheader(FAILURE) or "")
    assert status_in(pod.read()) == pod.end() == 125


def test_a_broken_upload_is_repeated(site: Site) -> None:
    pod = site.pod("cat", "name")
    files = archive(name="content")
    broken = pod.connect()
    broken.putrequest("PUT", "/program")
    broken.putheader("Content-Length", str(len(files)))
    broken.endheaders(files[:-10])
    broken.close()
    assert pod.start(files) is None
    assert pod.start(files) is None
    found = pod.read()
    assert (text(found), status_in(found)) == (b"content", 0)
    assert pod.log() == "content"


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", "/output/x", {}, 404),
        ("GET", "/output/-1", {}, 404),
        ("POST", "/signal/999", {}, 400),
        ("POST", "/signal/x", {}, 400),
        ("PUT", "/program", {"Content-Length": "x"}, 400),
        ("PUT", "/program", {LAYOUT: "{"}, 400),
        ("PATCH", "/", {}, 501),
    ],
)
def test_a_bad_request_is_refused(
    site: Site, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    pod = site.pod("true")
    with pod.ask(method, path, b"" if method == "PUT" else None, **headers) as response:
        assert response.status == status
    assert pod.start() is None
    assert status_in(pod.read()) == pod.end() == 0
    assert pod.log() == ""


def test_files_that_do_not_arrive(site: Site) -> None:
    pod = site.pod("true", wait=0)
    assert pod.end() == 125
    assert "did not arrive in time" in pod.log()


def test_without_its_settings_it_says_what_it_is_for() -> None:
    command = [sys.executable, "-m", "fiber.launcher"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 125
    assert done.stderr.startswith("fiber.launcher is for the pods of `fiber run`")
    assert len(done.stderr.splitlines()) == 1


def test_a_port_that_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        settings = {
            "FIBER_LAUNCHER_COMMAND": "[]",
            "FIBER_LAUNCHER_FOLDER": str(tmp_path),
            "FIBER_LAUNCHER_PORT": str(taken.getsockname()[1]),
            "FIBER_LAUNCHER_WAIT": "0",
        }
        done = subprocess.run(
            [sys.executable, "-m", "fiber.launcher"],
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    assert done.returncode == 125
    assert done.stderr.startswith("fiber run: cannot listen at port")


def test_the_port_may_be_left_to_the_system(site: Site) -> None:
    pod = site.shell("echo out")
    assert (text(pod.read()), pod.log()) == (b"out\n", "out\n")
    assert pod.launched.port


# ---- signals and processes


def send_to_another_thread(process: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal that does not interrupt what the main thread waits for.

    A signal that comes just before the main thread waits does not interrupt it, either.
    """
    threads = map(int, os.listdir(f"/proc/{process.pid}/task"))
    other = next(thread for thread in threads if thread != process.pid)
    assert ctypes.CDLL(None).tgkill(process.pid, other, number) == 0


def test_a_signal_just_before_the_wait_for_files_ends_the_pod(site: Site) -> None:
    pod = site.pod("true")
    assert pod.signal(999) == 400  # by now the main thread waits
    send_to_another_thread(pod.launched.process, signal.SIGTERM)
    assert pod.end() == 143


def test_a_signal_just_before_the_wait_for_the_program_is_passed_on(site: Site) -> None:
    pod = site.python("import signal\nprint(1, flush=True)\nsignal.pause()")
    pod.read(until=b"1")
    found = pod.read(begun=lambda: send_to_another_thread(pod.launched.process, signal.SIGTERM))
    assert status_in(found) == pod.end() == 143


def test_an_interrupt_reaches_the_group(site: Site) -> None:
    waits = "print(1, flush=True)\nwhile True: time.sleep(0.1)"
    child = f"{sys.executable} -c 'import time\n{waits}'"
    pod = site.shell(f"trap 'echo shell' INT; {child}; exit 4")
    pod.read(until=b"1\n")
    found = pod.read(begun=lambda: pod.signal(signal.SIGINT))
    assert text(found) == b"1\nshell\n"
    assert b"KeyboardInterrupt" in text(found, STDERR)
    assert status_in(found) == 4


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_the_status_of_a_program_that_a_signal_ends(site: Site, number: int) -> None:
    pod = site.shell(f"kill -{number} $$")
    assert status_in(pod.read()) == 128 + number
    assert pod.end() == 128 + number


def test_the_end_of_the_pod_is_passed_on(site: Site) -> None:
    pod = site.python("import signal\nprint(1, flush=True)\nsignal.pause()")
    pod.read(until=b"1")
    found = pod.read(begun=lambda: pod.launched.process.send_signal(signal.SIGTERM))
    assert status_in(found) == pod.end() == 143


def test_a_pod_without_a_program_ends_at_once(site: Site) -> None:
    pod = site.pod("true")
    pod.connect().close()
    pod.launched.process.send_signal(signal.SIGTERM)
    assert pod.end() == 143


def test_a_program_may_be_ended_before_its_files_are_there(site: Site) -> None:
    pod = site.pod("true")
    assert pod.signal(signal.SIGTERM) == 200
    assert pod.end() == 143


def test_orphans_are_reaped(site: Site) -> None:
    pod = site.python(
        "import os, time\n"
        "read, write = os.pipe()\n"
        "if os.fork() == 0:\n"
        "    orphan = os.fork()\n"
        "    if orphan: os.write(write, str(orphan).encode())\n"
        "    os._exit(9)\n"
        "os.wait()\n"
        "orphan = int(os.read(read, 20))\n"
        f"deadline = time.monotonic() + {PATIENCE}\n"
        "while os.path.exists(f'/proc/{orphan}') and time.monotonic() < deadline:\n"
        "    time.sleep(0.01)\n"
        "print(os.path.exists(f'/proc/{orphan}'))\n"
        "raise SystemExit(6)\n"
    )
    found = pod.read()
    assert (text(found), status_in(found)) == (b"False\n", 6)


# ---- readers


def records_of(output: Output, position: int = 0, heartbeat: float = PATIENCE) -> Records:
    with output.reading(position, heartbeat) as records:
        return split(b"".join(records))


def split(data: bytes) -> Records:
    found = []
    while data:
        kind, length = RECORD.unpack(data[: RECORD.size])
        found.append((kind, data[RECORD.size : RECORD.size + length]))
        data = data[RECORD.size + length :]
    return found


def test_small_pieces_become_one() -> None:
    output = Output()
    for _ in range(3):
        output.add(STDOUT, b"a")
    output.add(STDERR, b"b")
    output.end(0)
    end = (EXIT, STATUS.pack(0))
    assert records_of(output) == [(STDOUT, b"aaa"), (STDERR, b"b"), end]
    assert records_of(output, 2) == [(STDOUT, b"a"), (STDERR, b"b"), end]
    assert records_of(output, 4) == records_of(output, 99) == [end]


def test_without_readers_old_output_is_dropped() -> None:
    output = Output(kept=1500, linger=3600)
    for number in range(10):
        output.add((STDOUT, STDERR)[number % 2], bytes([65 + number]) * 100)
    output.end(0)
    first, *rest = records_of(output)
    assert first[0] == DROPPED
    dropped = NUMBER.unpack(first[1])[0]
    assert dropped + sum(len(data) for kind, data in rest if kind != EXIT) == 1000
    assert rest[-2] == (STDERR, b"J" * 100)


@pytest.mark.parametrize("reader", ["there", "expected", "broken off"])
def test_the_program_waits_for_a_reader_that_takes_its_output(reader: str) -> None:
    output = Output(kept=1500, linger=3600)
    if reader == "expected":
        output.expect_reader()
    elif reader == "broken off":
        with pytest.raises(ConnectionError), output.reading(0):
            raise ConnectionError

    def write() -> None:
        for number in range(100):
            output.add((STDOUT, STDERR)[number % 2], b"x" * 100)
        output.end(0)

    writer = threading.Thread(target=write)
    with contextlib.ExitStack() as stack:
        if reader == "there":
            records = stack.enter_context(output.reading(0))
        writer.start()
        if reader != "there":
            wait_for(lambda: output._end >= 500)  # and that is too much to keep
            records = stack.enter_context(output.reading(0))
        found = split(b"".join(records))
    writer.join()
    assert not text(found, DROPPED)
    assert len(text(found) + text(found, STDERR)) == 10_000


def test_a_reader_that_takes_nothing_is_left_behind() -> None:
    output = Output(kept=1500, linger=0)
    with output.reading(0) as records:
        for number in range(10):
            output.add((STDOUT, STDERR)[number % 2], b"x" * 100)
        output.end(0)
        found = split(b"".join(records))
    assert found[0][0] == DROPPED
    assert found[-1][0] == EXIT


def test_a_silent_program_is_known_to_be_alive() -> None:
    output = Output()
    with output.reading(0, heartbeat=0) as records:
        assert next(records) == RECORD.pack(ALIVE, 0)


def test_the_end_waits_only_for_readers_that_there_are() -> None:
    output = Output(linger=3600)
    output.end(0)
    output.wait_for_readers()  # nobody follows
    output.expect_reader()
    with output.reading(0) as records:
        list(records)
    output.wait_for_readers()  # everybody has everything


def test_the_end_waits_for_an_answer() -> None:
    output = Output()
    output.end(0)
    ended = threading.Event()

    def wait() -> None:
        output.wait_for_readers()
        ended.set()

    waiter = threading.Thread(target=wait)
    with output.answering():
        waiter.start()
        assert not ended.is_set()
    waiter.join()


def test_the_end_waits_for_a_reader_that_broke_off_to_come_again() -> None:
    output = Output(linger=3600)
    output.add(STDOUT, b"out")
    with pytest.raises(ConnectionError), output.reading(0):
        raise ConnectionError
    output.end(0)
    waiter = threading.Thread(target=output.wait_for_readers)
    waiter.start()
    assert text(records_of(output)) == b"out"
    waiter.join()


# ---- monitors


WATCHED = """
import os
from fiber._monitor.server import MonitorServer
from fiber._transport.loop import Loop

parent = os.environ.get("FIBER_RUNTIME_DIRECTORY") or os.environ["TMPDIR"]
folder = parent + "/fiber-watched"
os.mkdir(folder, 0o700)
loop = Loop()
server = MonitorServer(loop, folder, "watched", lambda request: [{"answer": request}])
print("listens", flush=True)
loop.run()
"""


@pytest.mark.parametrize("variable", ["TMPDIR", "FIBER_RUNTIME_DIRECTORY"])
def test_a_question_is_passed_on_to_the_programs_monitor(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, str(tmp_path))
    pod = site.python(WATCHED)
    pod.read(until=b"listens")
    question = {"Content_Length": "16"}
    with pod.ask("POST", "/monitor", b'{"ask": "stack"}', **question) as response:
        answers = [json.loads(line) for line in response]
    assert {"answer": {"ask": "stack"}} in answers


@pytest.mark.parametrize("size", ["70000", "-1", "many"])
def test_a_question_that_cannot_be_is_refused(site: Site, size: str) -> None:
    pod = site.pod("true")
    with pod.ask("POST", "/monitor", b"nonsense", Content_Length=size) as response:
        assert response.status == 400
