"""From a connected socket to a proven peer and fresh secrets.

    agent                                      master
      │  TLS 1.3, both with certificates         │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      │  32 random bytes, Hello                  │
      ├─────────────────────────────────────────►│  takes it or not
      │◄─────────────────────────────────────────┤
      │             32 random bytes, Welcome or Refusal
      │  end of TLS                              │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      ▼  the same connection, without TLS        ▼

Nothing here blocks or knows where its socket comes from: each side is a generator that yields the
event (``select.POLLIN`` or ``POLLOUT``) for which it has to wait.  TLS works on the socket itself
and not on buffers in memory, because what follows the end of TLS must stay in the socket.
"""

from __future__ import annotations

import os
import select
import socket
import ssl
import struct
from collections.abc import Callable, Generator
from typing import Any, TypeAlias, TypeVar

from fiber._transport.credentials import Credentials
from fiber._transport.sealing import SECRET_SIZE, Secrets, derive
from fiber._wire.messages import ProtocolError
from fiber.errors import AuthenticationError

_T = TypeVar("_T")
Steps: TypeAlias = Generator[int, None, _T]

LARGEST_GREETING = 1 << 16
_LENGTH = struct.Struct(">I")


class Untrusted(Exception):
    """The peer could not prove what it had to, or did not believe us, or speaks no TLS 1.3."""


class HungUp(Exception):
    """The peer ended the connection in the middle."""


class _TakenSocket(ssl.SSLSocket):
    """One that was connected.  Asked for its peer as it is made, the ssl module would leave open
    what has broken at this very moment; the handshake finds that out and closes it.
    """

    def getpeername(self) -> None:
        """Nobody asks any more."""


def context_of(credentials: Credentials, *, listens: bool) -> ssl.SSLContext:
    """What one side demands and shows; AuthenticationError if ``credentials`` cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if listens else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.sslsocket_class = _TakenSocket
    context.verify_mode = ssl.CERT_REQUIRED
    if listens:
        context.num_tickets = 0  # nobody resumes, and nothing must follow the handshake
    try:
        context.load_verify_locations(cadata=credentials.authority)
        _load_own(context, credentials)
    except (ssl.SSLError, ValueError) as error:
        raise AuthenticationError(
            f"the credentials for {credentials.server_name} cannot be used: "
            f"{_words(error)}. They are cut short or not PEM."
        ) from error
    return context


def _load_own(context: ssl.SSLContext, credentials: Credentials) -> None:
    # The ssl module takes them from a file only; this one is in memory and has no name.
    file = os.memfd_create("credentials")
    try:
        with open(file, "wb", closefd=False) as writer:
            writer.write(f"{credentials.certificate}\n{credentials.key}\n".encode())
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


class Handshake:
    """One side's part on ``sock``, which it makes non-blocking and takes over; HungUp if that is
    broken already.
    """

    def __init__(
        self, sock: socket.socket, context: ssl.SSLContext, server_name: str | None = None
    ) -> None:
        """``server_name`` is what the other side's certificate must bear; None on the master's
        side, whose agents all bear the same.
        """
        self._for_master = server_name is None
        self._ours = os.urandom(SECRET_SIZE)
        self._theirs = b""
        try:
            sock.setblocking(False)
            sock.getpeername()
            self.sock = context.wrap_socket(
                sock,
                server_side=self._for_master,
                server_hostname=server_name,
                do_handshake_on_connect=False,
                suppress_ragged_eofs=False,
            )
        except OSError as error:
            sock.close()
            raise HungUp(_words(error)) from error

    def ask(self, hello: bytes) -> Steps[bytes]:
        """The agent's part: prove each other, say ``hello``, and return the answer."""
        yield from self._when_ready(self.sock.do_handshake)
        yield from self._write(hello)
        return (yield from self._read())

    def listen(self) -> Steps[bytes]:
        """The master's part: prove each other and return the agent's hello."""
        yield from self._when_ready(self.sock.do_handshake)
        return (yield from self._read())

    def answer(self, greeting: bytes) -> Steps[None]:
        """The master's answer."""
        yield from self._write(greeting)

    def end(self) -> Steps[tuple[int, Secrets]]:
        """End TLS in order: the bare connection's descriptor, now the caller's, and the secrets."""
        yield from self._when_ready(self.sock.unwrap)
        agent, master = self._ours, self._theirs
        if self._for_master:
            agent, master = master, agent
        return self.sock.detach(), derive(agent, master, for_master=self._for_master)

    def close(self) -> None:
        """Hang up."""
        self.sock.close()

    def _write(self, greeting: bytes) -> Steps[None]:
        rest = memoryview(self._ours + _LENGTH.pack(len(greeting)) + greeting)
        while rest:
            rest = rest[(yield from self._when_ready(self.sock.send, rest)) :]

    def _read(self) -> Steps[bytes]:
        self._theirs = yield from self._read_exactly(SECRET_SIZE)
        (size,) = _LENGTH.unpack((yield from self._read_exactly(_LENGTH.size)))
        if size > LARGEST_GREETING:
            raise ProtocolError(f"its greeting of {size} bytes is too long")
        return (yield from self._read_exactly(size))

    def _read_exactly(self, size: int) -> Steps[bytes]:
        data = b""
        while len(data) < size:
            more = yield from self._when_ready(self.sock.recv, size - len(data))
            if not more:
                raise HungUp("it hung up in the middle of the handshake")
            data += more
        return data

    @staticmethod
    def _when_ready(operation: Callable[..., _T], *arguments: Any) -> Steps[_T]:
        while True:
            try:
                return operation(*arguments)
            except ssl.SSLWantReadError:
                yield select.POLLIN
            except ssl.SSLWantWriteError:
                yield select.POLLOUT
            except (ssl.SSLEOFError, ssl.SSLZeroReturnError, ssl.SSLSyscallError) as error:
                raise HungUp("it hung up in the middle of the handshake") from error
            except ssl.SSLError as error:
                raise Untrusted(f"the TLS handshake failed: {_words(error)}") from error
            except OSError as error:
                raise HungUp(_words(error)) from error


def _words(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is refused: {error.verify_message}"
    if isinstance(error, ssl.SSLError) and error.reason:
        return error.reason.lower().replace("_", " ")
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error)
