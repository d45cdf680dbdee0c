"""Strangers at the sockets cannot stop, read or run anything."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import LOOPBACK, Program, wait_for
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend
from fiber._transport import authentication
from fiber._transport.authentication import AgentHello, Identity
from fiber._transport.credentials import make_credentials
from patience import PATIENCE
from unit.link_site import say

GARBAGE = [
    b"",
    b"\x00",
    b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
    b"\xff" * 5000,
    os.urandom(1 << 16),
    pickle.dumps("let me in"),
    b"\x00SP\x00\x00\x11\x00\x00" + bytes(8) + b"\xff" * 64,  # as nng greets, then nonsense
]


class Bomb:
    """Unpickled anywhere, it leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self._trace),)


@pytest.fixture(scope="module")
def backend() -> Iterator[LoopbackBackend]:
    with running(backend="loopback", agents=1) as runtime:
        assert isinstance(runtime.backend, LoopbackBackend)
        runtime.backend._output.write("test", "begins")
        child = fiber.Process(target=targets.nothing)
        child.start()
        child.join()
        yield runtime.backend


def works() -> None:
    child = fiber.Process(target=targets.exit_by, args=("os._exit",))
    child.start()
    child.join(PATIENCE)
    assert child.exitcode == 9


def address(backend: LoopbackBackend) -> tuple[str, int]:
    host, _, port = backend._listener.address.rpartition(":")
    return host, int(port)


@pytest.mark.parametrize("data", GARBAGE, ids=range(len(GARBAGE)))
def test_garbage_on_the_masters_port(backend: LoopbackBackend, data: bytes) -> None:
    strangers = [socket.create_connection(address(backend), PATIENCE) for _ in range(3)]
    for stranger in strangers:
        stranger.sendall(data)
    works()
    for stranger in strangers:
        stranger.close()
    works()


def test_silent_strangers_delay_no_agent(backend: LoopbackBackend) -> None:
    strangers = [socket.create_connection(address(backend), PATIENCE) for _ in range(50)]
    works()
    backend._slots[0].process.kill()
    wait_for(lambda: backend._slots[0].name != "loopback-0")
    works()  # by an agent that had to come in past them
    for stranger in strangers:
        stranger.close()


CROWDED = """
    import resource, fiber
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
    from fiber._runtime import state

    if __name__ == "__main__":
        with fiber.Pool(1) as pool:
            assert pool.map(abs, range(3)) == [0, 1, 2]
            print(state.runtime().backend._listener.address, flush=True)
            while input() == "go on":
                assert pool.apply(abs, (-1,)) == 1
                with open("/dev/null"), fiber.Pool(1) as another:  # there are descriptors left
                    print(another.apply(abs, (-2,)), flush=True)
"""


def test_a_crowd_of_strangers_does_not_take_the_masters_descriptors(
    launch: Callable[..., Program],
) -> None:
    program = launch(CROWDED, env=LOOPBACK, stdin=subprocess.PIPE)
    host, _, port = program.line().rpartition(":")
    with contextlib.ExitStack() as crowd:
        for _ in range(300):
            crowd.enter_context(socket.create_connection((host, int(port)), PATIENCE))
        assert program.process.stdin is not None
        program.process.stdin.write(b"go on\n")
        program.process.stdin.flush()
        assert program.line() == "2"
        descriptors = len(os.listdir(f"/proc/{program.pid}/fd"))
        assert descriptors < 150
    program.process.stdin.write(b"end\n")
    program.process.stdin.close()
    program.finish()
    assert program.stderr.count("too many connections come at the same time") <= 1


def test_tls_without_a_proof_gets_no_word(backend: LoopbackBackend) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with socket.create_connection(address(backend), PATIENCE) as plain:
        plain.settimeout(PATIENCE)
        try:
            with context.wrap_socket(plain, server_hostname="x") as stranger:
                stranger.sendall(b"hello?")
                stranger.recv(32)  # the random bytes that any client gets
                heard = stranger.recv(100)
        except (ssl.SSLError, ConnectionError):
            heard = b""
    assert heard == b""
    works()


@pytest.mark.parametrize("pool", ["this one", "another"])
def test_nonsense_over_tls_is_not_unpickled(
    backend: LoopbackBackend, pool: str, tmp_path: Path
) -> None:
    trace = tmp_path / "unpickled"
    made = backend._credentials if pool == "this one" else make_credentials()
    credentials = replace(made.agent("loopback-0", "uid"), master="")
    with pytest.raises(authentication.PeerClosed):
        say(backend._listener.address, credentials, pickle.dumps(Bomb(trace)))
    works()
    assert not trace.exists()


def test_a_stranger_that_claims_to_be_an_agent_is_refused(backend: LoopbackBackend) -> None:
    slot = backend._slots[0]
    hello = AgentHello(Identity.of_this_process(slot.name, slot.uid), "0" * 32, 0, False)
    forged = replace(make_credentials().agent(slot.name, slot.uid), master="")
    with pytest.raises(authentication.Untrusted, match="does not believe"):
        say(backend._listener.address, forged, hello.encode())
    works()


# The hub's socket, a unix socket in a private directory


@pytest.fixture(scope="module")
def door() -> Iterator[str]:
    with running(backend="local") as runtime:
        queue: fiber.Queue[Any] = fiber.Queue()
        queue.put(1)
        assert runtime.hub is not None
        yield runtime.hub.address.path


def test_the_hubs_socket_is_in_a_directory_that_only_this_user_can_enter(door: str) -> None:
    assert os.stat(os.path.dirname(door)).st_mode & 0o077 == 0


KNOCK = """
import os, socket, sys
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
try:
    stranger.connect(sys.argv[1])
    stranger.send(bytes(100))
    print("heard", stranger.recv(100))
except OSError as error:
    print(type(error).__name__)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_another_user_cannot_connect_to_the_hubs_socket(door: str) -> None:
    def knock() -> str:
        # Isolated, and without site: the other user may not read this one's packages.
        command = [sys.executable, "-I", "-S", "-c", KNOCK, door]
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE).stdout

    folder = os.path.dirname(door)
    assert knock() == "PermissionError\n"
    for opened in (
        os.path.dirname(folder),
        folder,
        door,
    ):  # as if another process had changed the permissions
        os.chmod(opened, os.stat(opened).st_mode | 0o007)
    assert knock() in ("heard b''\n", "ConnectionResetError\n", "BrokenPipeError\n")
    works()


@pytest.mark.usefixtures("door")
def test_named_shared_memory_is_this_users_alone() -> None:
    memory = fiber.shared_memory.SharedMemory(create=True, size=1)
    try:
        assert os.stat(f"/dev/shm/{memory.name}").st_mode & 0o077 == 0
    finally:
        memory.close()
        memory.unlink()


@pytest.mark.parametrize("data", [data for data in GARBAGE if data], ids=range(len(GARBAGE) - 1))
def test_garbage_at_the_hubs_socket_harms_no_process(door: str, data: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.settimeout(PATIENCE)
        stranger.connect(door)
        try:
            stranger.send(data)
            heard = stranger.recv(1 << 16)
        except OSError:
            heard = b""
    assert b"key" not in heard.replace(b"wrong key", b"")
    assert bytes(fiber.current_process().authkey) not in heard
    works()


def test_bytes_of_a_stranger_are_never_unpickled(door: str, tmp_path: Path) -> None:
    trace = tmp_path / "unpickled"
    payload = pickle.dumps(Bomb(trace))
    for prefix in (b"", b"\x00", b"\x01", b"\x02"):
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
            stranger.settimeout(PATIENCE)
            stranger.connect(door)
            try:
                stranger.send(prefix + payload)
                stranger.recv(1 << 16)
            except OSError:
                pass
    works()
    assert not trace.exists()


def test_many_silent_connections_delay_no_agent(door: str) -> None:
    strangers = []
    for _ in range(64):
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(door)
        strangers.append(stranger)
    outer, outer_theirs = fiber.Pipe()
    child = fiber.Process(target=targets.make_and_send_a_pipe, args=(outer_theirs,))
    child.start()
    inner = outer.recv()
    assert inner.recv() == "through the inner pipe"
    child.kill()
    child.join()
    child.close()
    for end in (outer, outer_theirs, inner, *strangers):
        end.close()
