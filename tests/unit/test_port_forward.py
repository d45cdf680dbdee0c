"""Port-forward: the messages of its WebSocket, and how it is opened."""

from __future__ import annotations

import contextlib
import itertools
import socket
import ssl
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fakes.certificates import make_certificates
from fakes.kubernetes_api import Fault
from fakes.port_forward import (
    BINARY,
    CLOSE,
    CONTINUATION,
    DATA,
    ERROR,
    PING,
    PONG,
    TEXT,
    frame,
    greetings,
    message,
)
from fakes.served import Served, served
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.port_forward import PortForward, proxy_options
from fiber_api.rest import (
    PODS,
    ApiError,
    Forbidden,
    NotFound,
    ServerError,
    ServerUnreachable,
    Unauthorized,
)
from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE, kubeconfig

MEGABYTE = 1 << 20
POD = PODS.path(NAMESPACE, "relay")


class Wire:
    """A port-forward, and the API server's end of its connection, which the test plays."""

    def __init__(self) -> None:
        near, self.server = socket.socketpair()
        self.server.setblocking(False)
        client: Any = SimpleNamespace(sock=near)
        self.forward = PortForward(client)

    def send(self, *frames: bytes) -> None:
        assert self.server.send(b"".join(frames)) == len(b"".join(frames))

    def sent(self) -> list[tuple[int, bytes]]:
        """Return opcode and payload of the frames that the client has sent."""
        data = bytearray()
        with contextlib.suppress(BlockingIOError):
            while more := self.server.recv(MEGABYTE):
                data += more
        found = []
        while data:
            found.append(_unmask(data))
        return found

    def close(self) -> None:
        self.forward.close()
        self.server.close()


def _unmask(data: bytearray) -> tuple[int, bytes]:
    """Take the first frame of a client off ``data``."""
    assert data[1] & 0x80
    size, start = data[1] & 0x7F, 2
    if size >= 126:
        form = ">H" if size == 126 else ">Q"
        (size,) = struct.unpack_from(form, data, 2)
        start += struct.calcsize(form)
    mask, end = data[start : start + 4], start + 4 + size
    payload = bytes(byte ^ mask[i % 4] for i, byte in enumerate(data[start + 4 : end]))
    opcode = data[0] & 0x0F
    del data[:end]
    return opcode, payload


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    wire.close()


@pytest.fixture
def begun(wire: Wire) -> Wire:
    """Both channels have had their first message."""
    wire.send(greetings(7071))
    assert wire.forward.receive() is None
    return wire


# -- Messages


def test_the_first_message_of_each_channel_is_no_part_of_the_bytes(wire: Wire) -> None:
    wire.send(message(DATA, b"\x9f\x1b"), message(DATA, b"one"), message(ERROR, b"\x9f\x1b"))
    wire.send(message(DATA, b"two"))
    assert wire.forward.receive() == b"onetwo"
    assert wire.forward.receive() is None


@given(
    st.lists(st.tuples(st.binary(max_size=200), st.lists(st.integers(0, 200), max_size=3))),
    st.lists(st.integers(0, 4000), max_size=10),
)
def test_messages_in_parts_and_pieces_of_any_size_arrive_whole(
    messages: list[tuple[bytes, list[int]]], cuts: list[int]
) -> None:
    sent = greetings(7071) + b"".join(_in_parts(data, at) for data, at in messages)
    wire = Wire()
    got = b""
    try:
        places = sorted({0, len(sent), *(cut for cut in cuts if cut < len(sent))})
        for start, end in itertools.pairwise(places):
            wire.send(sent[start:end])
            while (piece := wire.forward.receive()) is not None:
                got += piece
    finally:
        wire.close()
    assert got == b"".join(data for data, _ in messages)


def _in_parts(data: bytes, cuts: list[int]) -> bytes:
    whole = bytes([DATA]) + data
    places = [0, *sorted(min(cut, len(whole)) for cut in cuts), len(whole)]
    parts = [whole[start:end] for start, end in itertools.pairwise(places)]
    if not parts[0]:  # an API server always begins with the channel
        parts = [whole]
    frames = [frame(parts[0], BINARY, last=len(parts) == 1)]
    frames += [frame(part, CONTINUATION, last=False) for part in parts[1:-1]]
    frames += [frame(parts[-1], CONTINUATION)] if len(parts) > 1 else []
    return frame(b"beat", PONG).join(frames)


def test_a_long_message_arrives_whole(begun: Wire) -> None:
    begun.server.setblocking(True)
    sent = threading.Thread(
        target=begun.server.sendall, args=(message(DATA, b"x" * (3 * MEGABYTE)),)
    )
    sent.start()
    got = 0
    while got < 3 * MEGABYTE:
        got += len(begun.forward.receive() or b"")
    sent.join()
    begun.server.setblocking(False)


def test_messages_that_mean_nothing_are_ignored(begun: Wire) -> None:
    begun.send(frame(b""), message(7, b"another channel"), frame(b"", PONG), message(ERROR, b""))
    begun.send(message(DATA, b"bytes"))
    assert begun.forward.receive() == b"bytes"


def test_the_error_channel_ends_it_with_the_clusters_words(begun: Wire) -> None:
    begun.send(message(ERROR, b" error forwarding port 7071: refused\n"))
    with pytest.raises(OSError, match=r"^error forwarding port 7071: refused$"):
        begun.forward.receive()


def test_a_ping_is_answered(begun: Wire) -> None:
    begun.send(frame(b"are you there", PING))
    assert begun.forward.receive() is None
    assert begun.sent() == [(PONG, b"are you there")]


def test_a_close_is_the_end_also_if_the_connection_stays_open(begun: Wire) -> None:
    begun.send(message(DATA, b"last"), frame(struct.pack(">H", 1000), CLOSE))
    assert begun.forward.receive() == b"last"
    assert begun.forward.receive() == b""
    assert begun.forward.receive() == b""


def test_an_end_without_a_close_is_an_error(begun: Wire) -> None:
    begun.server.close()
    with pytest.raises(ConnectionResetError, match="the API server closed the port-forward"):
        begun.forward.receive()


@pytest.mark.parametrize(
    "wrong",
    [
        frame(b"\0text", TEXT),
        frame(b"x", CONTINUATION),
        frame(b"\0begin", last=False) + message(DATA, b"another"),
        frame(b"", 5),
        frame(b"x", BINARY, reserved=4),
        frame(b"x", CLOSE),
        b"\xff" * 20,
    ],
)
def test_a_wrong_frame_is_an_error_of_the_connection(begun: Wire, wrong: bytes) -> None:
    begun.send(wrong)
    with pytest.raises(ConnectionResetError, match="the API server sent a"):
        begun.forward.receive()


def test_bytes_that_cannot_be_sent_now_are_kept_in_order(begun: Wire) -> None:
    pieces = [bytes([number]) * 100_000 for number in range(20)]
    for piece in pieces:
        begun.forward.write(piece)
    assert begun.forward.backlog > MEGABYTE
    data = bytearray()
    while begun.forward.backlog or not data:
        with contextlib.suppress(BlockingIOError):
            while more := begun.server.recv(MEGABYTE):
                data += more
        begun.forward.flush()
    with contextlib.suppress(BlockingIOError):
        while more := begun.server.recv(MEGABYTE):
            data += more
    assert begun.forward.backlog == 0
    assert [len(data), data[:2]] == [20 * (100_000 + 15), b"\x82\xff"]
    for piece in pieces:
        assert data[14] ^ data[10] == DATA
        assert data[15] ^ data[11] == piece[0]
        del data[: len(piece) + 15]


def test_a_closed_one_has_no_descriptor(wire: Wire) -> None:
    wire.forward.close()
    assert wire.forward.fileno() < 0
    with pytest.raises(OSError, match="descriptor"):
        wire.forward.receive()


# -- Opening


@pytest.fixture
def server() -> Iterator[Served]:
    with served() as server:
        yield server


@pytest.fixture
def api(server: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Api]:
    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
    pod(server)
    with contextlib.closing(Api.connect()) as api:
        yield api


def pod(server: Served) -> None:
    server.do(server.store.create, "pods", NAMESPACE, {"metadata": {"name": "relay"}, "spec": {}})


@contextlib.contextmanager
def echo() -> Iterator[int]:
    """A server that sends back what it gets, for one connection."""

    def serve() -> None:
        sock, _ = listener.accept()
        with sock:
            while data := sock.recv(MEGABYTE):
                sock.sendall(data)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join()


def back_and_forth(forward: PortForward, data: bytes) -> bytes:
    """Send ``data`` and return as many bytes that come."""
    forward.write(data)
    got = b""
    while len(got) < len(data):
        forward.flush()
        got += forward.receive() or b""
    return got


def test_bytes_go_to_the_port_and_come_back(server: Served, api: Api) -> None:
    data = bytes(range(256)) * 8192
    with echo() as server.api.forwards.target:
        with contextlib.closing(api.port_forward(POD, 7071)) as forward:
            assert back_and_forth(forward, data) == data
        assert server.api.tokens == ["Bearer one"]


def test_bytes_go_through_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_certificates("localhost", "nobody")
    (tmp_path / "server.pem").write_text(f"{made.master.certificate}\n{made.master.key}\n")
    (tmp_path / "ca.crt").write_text(made.authority)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "server.pem")
    data = bytes(range(256)) * 8192
    with served(context) as server:
        pod(server)
        authority = {"certificate-authority": str(tmp_path / "ca.crt")}
        url = f"https://127.0.0.1:{server.api.port}"
        name = {"tls-server-name": "localhost"}
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, url, **authority, **name)))
        with (
            contextlib.closing(Api.connect()) as api,
            echo() as server.api.forwards.target,
            contextlib.closing(api.port_forward(POD, 7071)) as forward,
        ):
            assert back_and_forth(forward, data) == data
            forward.close()
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, url, **authority)))
        with (
            contextlib.closing(Api.connect()) as api,
            pytest.raises(ServerUnreachable, match=r"(?i)certificate verify failed"),
        ):
            api.port_forward(POD, 7071)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault(status=403, reason="Forbidden"), Forbidden),
        (Fault(status=404, reason="NotFound"), NotFound),
        (Fault(status=500), ServerError),
        (Fault(text="a proxy's page"), ServerUnreachable),
        (Fault(status=403, text="a proxy's page"), ServerUnreachable),
        (Fault(), ServerUnreachable),
    ],
)
def test_an_answer_that_is_no_port_forward_is_the_error_of_other_calls(
    server: Served, api: Api, fault: Fault, error: type[ApiError]
) -> None:
    server.api.faults = [fault]
    with pytest.raises(error):
        api.port_forward(POD, 7071)


def test_a_pod_that_is_gone(api: Api) -> None:
    with pytest.raises(NotFound):
        api.port_forward(PODS.path(NAMESPACE, "gone"), 7071)


def test_a_login_that_has_expired_is_renewed_once(server: Served, api: Api, tmp_path: Path) -> None:
    server.api.accepts = {"Bearer two"}
    with pytest.raises(Unauthorized):
        api.port_forward(POD, 7071)
    kubeconfig(tmp_path, server.api.url, {"token": "two"})
    with echo() as server.api.forwards.target:
        api.port_forward(POD, 7071).close()
    assert server.api.tokens == ["Bearer one", "Bearer one", "Bearer one", "Bearer two"]


def test_a_redirect_does_not_get_the_login(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as elsewhere, _redirects_to(elsewhere) as port:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, f"http://127.0.0.1:{port}")))
        with contextlib.closing(Api.connect()) as api, pytest.raises(ServerUnreachable):
            api.port_forward(POD, 7071)
        elsewhere.setblocking(False)
        with pytest.raises(BlockingIOError):
            elsewhere.accept()


@contextlib.contextmanager
def _redirects_to(elsewhere: socket.socket) -> Iterator[int]:
    url = f"ws://127.0.0.1:{elsewhere.getsockname()[1]}/"

    def serve() -> None:
        sock, _ = listener.accept()
        with sock:
            sock.recv(MEGABYTE)
            sock.sendall(f"HTTP/1.1 302 Found\r\nLocation: {url}\r\n\r\n".encode())

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join(PATIENCE)


@pytest.mark.parametrize(
    ("proxy", "no_proxy", "options"),
    [
        (None, "10.0.0.1", {}),
        (
            "http://proxy:3128",
            None,
            {"http_proxy_host": "proxy", "http_proxy_port": 3128, "proxy_type": "http"},
        ),
        (
            "http://me:p%40ss@proxy",
            "10.0.0.1, .lab",
            {
                "http_proxy_host": "proxy",
                "http_proxy_port": 80,
                "http_proxy_auth": ("me", "p@ss"),
                "http_no_proxy": ["10.0.0.1", ".lab"],
            },
        ),
        ("socks5h://proxy", "", {"http_proxy_port": 1080, "proxy_type": "socks5h"}),
    ],
)
def test_a_proxy_of_the_configuration_is_used(
    proxy: str | None, no_proxy: str | None, options: dict[str, object]
) -> None:
    assert proxy_options(proxy, no_proxy).items() >= options.items()
