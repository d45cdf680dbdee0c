"""From a connected socket to a proven peer and fresh secrets.

    agent                                      master
      │  TLS 1.3                                 │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      │                          32 random bytes │
      │◄─────────────────────────────────────────┤
      │  32 random bytes, Hello, proof           │
      ├─────────────────────────────────────────►│  believes it or not, takes it or not
      │◄─────────────────────────────────────────┤
      │               Welcome or Refusal, proof  │
      │  end of TLS                              │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      ▼  the same connection, without TLS        ▼

A proof is an HMAC with the agent's own key, which the master derives, over the random bytes of
both sides, the certificate that TLS has shown, and the words beside it.  So it is good for one
connection with one master: who shows another certificate, in the middle say, passes no proof on.

Nothing here blocks or knows where its socket comes from: each side is a generator that yields the
event (``select.POLLIN`` or ``POLLOUT``) for which it has to wait.  TLS works on the socket itself
and not on buffers in memory, because what follows the end of TLS must stay in the socket.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import select
import socket
import ssl
import struct
from collections.abc import Callable, Generator
from typing import Any, TypeAlias, TypeVar

from fiber._transport.credentials import Certificate, Credentials
from fiber._transport.sealing import SECRET_SIZE, Secrets, derive
from fiber._wire.messages import ProtocolError
from fiber.errors import AuthenticationError

_T = TypeVar("_T")
Steps: TypeAlias = Generator[int, None, _T]

LARGEST_GREETING = 1 << 16
_LENGTH = struct.Struct(">I")
_PROOF_SIZE = 32


class Untrusted(Exception):
    """The peer could not prove what it had to, or did not believe us, or speaks no TLS 1.3."""


class HungUp(Exception):
    """The peer ended the connection in the middle."""


class _TakenSocket(ssl.SSLSocket):
    """Socket that was connected.

    The ssl module asks a new socket for its peer.  If the connection has just broken, it would then
    leave the socket open.  The handshake finds that out itself, and closes the socket.
    """

    def getpeername(self) -> None:
        """Return nothing, so that the ssl module does not ask the kernel."""


def master_context(certificate: Certificate) -> ssl.SSLContext:
    """Return the context of a master; AuthenticationError if ``certificate`` cannot be used."""
    context = _context(ssl.PROTOCOL_TLS_SERVER)
    context.num_tickets = 0  # nobody resumes, and nothing must follow the handshake
    try:
        _load_own(context, certificate)
    except (ssl.SSLError, ValueError) as error:
        raise AuthenticationError(
            f"the master's certificate cannot be used: {_words(error)}. It is cut short or not PEM."
        ) from error
    return context


def agent_context() -> ssl.SSLContext:
    """Return the context of an agent.  TLS checks no certificate: the proofs cover it."""
    return _context(ssl.PROTOCOL_TLS_CLIENT)


def _context(protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.sslsocket_class = _TakenSocket
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def _load_own(context: ssl.SSLContext, certificate: Certificate) -> None:
    # The ssl module takes them from a file only; this one is in memory and has no name.
    file = os.memfd_create("credentials")
    try:
        with open(file, "wb", closefd=False) as writer:
            writer.write(f"{certificate.text}\n{certificate.key}\n".encode())
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


class _Handshake:
    """Handshake of one side on ``sock``, which it takes over and makes non-blocking.

    HungUp if the connection has broken already.
    """

    _for_master: bool

    def __init__(self, sock: socket.socket, context: ssl.SSLContext) -> None:
        self._ours = os.urandom(SECRET_SIZE)
        self._theirs = b""
        try:
            sock.setblocking(False)
            sock.getpeername()
            self.sock = context.wrap_socket(
                sock,
                server_side=self._for_master,
                do_handshake_on_connect=False,
                suppress_ragged_eofs=False,
            )
        except OSError as error:
            sock.close()
            raise HungUp(_words(error)) from error

    def end(self) -> Steps[tuple[int, Secrets]]:
        """End TLS in order: the bare connection's descriptor, now the caller's, and the secrets."""
        yield from self._when_ready(self.sock.unwrap)
        return self.sock.detach(), derive(*self._nonces, for_master=self._for_master)

    def close(self) -> None:
        """Hang up."""
        self.sock.close()

    @property
    def _nonces(self) -> tuple[bytes, bytes]:
        """The random bytes of the agent and of the master."""
        if self._for_master:
            return self._theirs, self._ours
        return self._ours, self._theirs

    def _proof(self, side: bytes, key: str, certificate: bytes, words: bytes) -> bytes:
        """Compute what ``side`` proves, while it says ``words``."""
        agent, master = self._nonces
        said = b"fiber " + side + agent + master + certificate + words
        return hmac.digest(bytes.fromhex(key), said, "sha256")

    def _write(self, data: bytes) -> Steps[None]:
        rest = memoryview(data)
        while rest:
            rest = rest[(yield from self._when_ready(self.sock.send, rest)) :]

    def _read(self) -> Steps[bytes]:
        """Read a greeting."""
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


class AgentHandshake(_Handshake):
    """The agent's part."""

    _for_master = False

    def ask(self, credentials: Credentials, hello: bytes) -> Steps[bytes]:
        """Prove each other, say ``hello``, and return the answer."""
        yield from self._when_ready(self.sock.do_handshake)
        seen = hashlib.sha256(self.sock.getpeercert(binary_form=True) or b"").digest()
        if credentials.master and seen.hex() != credentials.master:
            raise Untrusted("its certificate is refused: it is not that of this agent's master")
        self._theirs = yield from self._read_exactly(SECRET_SIZE)
        proof = self._proof(b"agent", credentials.key, seen, hello)
        yield from self._write(self._ours + _LENGTH.pack(len(hello)) + hello + proof)
        answer = yield from self._read()
        proof = yield from self._read_exactly(_PROOF_SIZE)
        if not answer:
            raise Untrusted("the master does not believe that this agent is the pod it says")
        if not hmac.compare_digest(proof, self._proof(b"master", credentials.key, seen, answer)):
            raise Untrusted("it cannot prove that it is this pool's master")
        return answer


class MasterHandshake(_Handshake):
    """The master's part."""

    _for_master = True

    def __init__(
        self, sock: socket.socket, context: ssl.SSLContext, certificate: Certificate
    ) -> None:
        super().__init__(sock, context)
        self._certificate = certificate.hash
        self._key = ""
        self._words = self._said = b""

    def listen(self) -> Steps[bytes]:
        """Return the agent's hello, which is not proved yet."""
        yield from self._when_ready(self.sock.do_handshake)
        yield from self._write(self._ours)
        self._theirs = yield from self._read_exactly(SECRET_SIZE)
        self._words = yield from self._read()
        self._said = yield from self._read_exactly(_PROOF_SIZE)
        return self._words

    def believes(self, key: str) -> bool:
        """Return whether the agent has ``key``; with this key the master proves itself then."""
        proof = self._proof(b"agent", key, self._certificate, self._words)
        if not hmac.compare_digest(proof, self._said):
            return False
        self._key = key
        return True

    def answer(self, greeting: bytes) -> Steps[None]:
        """Answer an agent that is believed, and prove to be its master."""
        proof = self._proof(b"master", self._key, self._certificate, greeting)
        yield from self._write(_LENGTH.pack(len(greeting)) + greeting + proof)

    def disbelieve(self) -> Steps[None]:
        """Answer one that is not."""
        yield from self._write(_LENGTH.pack(0) + bytes(_PROOF_SIZE))


def _words(error: Exception) -> str:
    if isinstance(error, ssl.SSLError) and error.reason:
        return error.reason.lower().replace("_", " ")
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error)
