"""From a connected socket to a proven peer and fresh secrets.

    agent                                      master
      │  TLS 1.3                                 │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      │                          32 random bytes │
      │◄─────────────────────────────────────────┤
      │  32 random bytes, AgentHello, proof      │
      ├─────────────────────────────────────────►│  checks the proof and the versions
      │◄─────────────────────────────────────────┤
      │    MasterWelcome or MasterRefusal, proof │
      │  end of TLS                              │
      ├─────────────────────────────────────────►│
      │◄─────────────────────────────────────────┤
      ▼  the same connection, without TLS        ▼

The greetings say who each side is and how many datagrams of the link have arrived.  So the same
exchange begins a link and resumes it on a new connection.  A greeting is one byte for the kind, and
JSON.  The fields of an identity are the same in every version, so that two sides that do not
understand each other can still say why.

The agent's proof covers the random bytes of both sides, the certificate that TLS has shown, and the
greeting beside it.  So it is valid for one connection with one master.  A peer in the middle, which
shows another certificate, cannot pass it on.  The master's proof covers the same, or, in a warm
pool, its certificate and epoch alone: TLS proves the rest.  ``fiber._transport.credentials`` makes
and checks the proofs.

Each side of the handshake is a generator: it yields the event (``select.POLLIN`` or ``POLLOUT``)
for which it has to wait, and never blocks.  TLS works on the socket itself and not on buffers in
memory, because the bytes that follow the end of TLS must stay in the socket.
"""

from __future__ import annotations

import dataclasses
import hashlib
import hmac
import json
import os
import platform
import select
import socket
import ssl
import struct
from collections.abc import Callable, Generator, Mapping
from importlib import metadata
from typing import Any, NamedTuple, TypeAlias, TypeVar

from fiber._transport.credentials import (
    Certificate,
    Credentials,
    MasterCredentials,
    ProvenMaster,
)
from fiber._wire.messages import ProtocolError
from fiber._wire.packet_layout import PROTOCOL
from fiber.errors import AuthenticationError, ConfigError, VersionMismatch

_HELLO, _WELCOME, _REFUSAL = 0x10, 0x11, 0x12

_LONGEST_NAME = 253
"""Characters of the longest name that a pod can have.  Logs repeat what a stranger claims to be."""


@dataclasses.dataclass(frozen=True)
class Identity:
    """Identity of one side.  ``facts`` describe its host."""

    name: str
    protocol: int
    python: str
    fiber: str
    facts: Mapping[str, str] = dataclasses.field(default_factory=dict)
    uid: str = ""
    """Uid of the agent's pod.  An agent has proved to have this name and uid."""

    @classmethod
    def of_this_process(cls, name: str, uid: str = "", **facts: str) -> Identity:
        """Return the identity of this interpreter and this Fiber, under ``name``."""
        return cls(name, PROTOCOL, platform.python_version(), _fiber_version(), facts, uid)


class AgentHello(NamedTuple):
    """Greeting of an agent."""

    identity: Identity
    link: str
    """Random name of the link.  A master that restarted takes it for no other link, and no other
    agent can guess it."""
    arrived: int
    """Number of the master's datagrams that the agent has."""
    welcomed: bool
    """True if a master has spoken on this link.  Then only that master can continue it."""

    def encode(self) -> bytes:
        """Return the datagram."""
        return _encode(_HELLO, self)


class MasterWelcome(NamedTuple):
    """Greeting of a master that takes a new link, or continues a known one."""

    identity: Identity
    arrived: int
    """Number of the agent's datagrams that the master has."""
    heartbeat: float
    """Limits of silence on the link: the fields of a ``Keepalive``, in seconds."""
    suspect_after: float
    lost_after: float
    lost_grace: float | None = None
    """Seconds for which the agent waits for another master if this one is lost.  None: it uses its
    own setting, or waits for none."""

    def encode(self) -> bytes:
        """Return the datagram."""
        return _encode(_WELCOME, self)


class MasterRefusal(NamedTuple):
    """Greeting of a master that refuses the agent."""

    identity: Identity
    reason: str

    def encode(self) -> bytes:
        """Return the datagram."""
        return _encode(_REFUSAL, self)


_UNREADABLE = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,  # an infinite number
    RecursionError,  # brackets without end
)

Greeting: TypeAlias = AgentHello | MasterWelcome | MasterRefusal


def decode_greeting(datagram: bytes) -> Greeting:
    """Read a greeting; ProtocolError if it is malformed."""
    reader = _READERS.get(datagram[0]) if datagram else None
    if reader is None:
        raise ProtocolError(f"its first {len(datagram)} bytes are no greeting")
    try:
        fields = json.loads(datagram[1:])
        return reader(_identity(fields["identity"]), fields)
    except _UNREADABLE as error:
        # JSON of the wrong shape.
        raise ProtocolError(
            f"its greeting is malformed ({type(error).__name__}: {error})"
        ) from None


def version_mismatch(ours: Identity, theirs: Identity) -> VersionMismatch | None:
    """Return an error if the two sides cannot work together, else None.

    They exchange pickles and messages, so Python's and the protocol's versions must be equal.
    """
    if ours.protocol != theirs.protocol:
        return VersionMismatch(
            "Fiber protocol",
            ours=f"{ours.protocol} (fiberpool {ours.fiber})",
            theirs=f"{theirs.protocol} (fiberpool {theirs.fiber})",
            peer=theirs.name,
        )
    if _minor(ours.python) != _minor(theirs.python):
        return VersionMismatch("Python", ours=ours.python, theirs=theirs.python, peer=theirs.name)
    return None


def _mismatch_in(greeting: bytes) -> VersionMismatch | None:
    try:
        theirs = decode_greeting(greeting).identity
    except ProtocolError:
        return None
    return version_mismatch(Identity.of_this_process(""), theirs)


def _minor(version: str) -> list[str]:
    return version.split(".")[:2]


def _fiber_version() -> str:
    try:
        return metadata.version("fiberpool")
    except metadata.PackageNotFoundError:
        # Run from a source tree that was never installed.
        return "unknown"


def _encode(kind: int, greeting: Greeting) -> bytes:
    fields = {**greeting._asdict(), "identity": dataclasses.asdict(greeting.identity)}
    return bytes([kind]) + json.dumps(fields).encode()


def _identity(fields: Mapping[str, Any]) -> Identity:
    facts = {str(key): str(value) for key, value in fields["facts"].items()}
    return Identity(
        _name(fields["name"]),
        int(fields["protocol"]),
        str(fields["python"]),
        str(fields["fiber"]),
        facts,
        _name(fields.get("uid", "")),
    )


def _name(value: object) -> str:
    """Return a name or uid; ValueError if it is too long or cannot be encoded."""
    name = str(value)
    if len(name) > _LONGEST_NAME:
        raise ValueError(f"a name of {len(name)} characters")
    name.encode()
    return name


def _read_hello(identity: Identity, fields: Mapping[str, Any]) -> AgentHello:
    if identity.protocol != PROTOCOL:  # another version may put other things here
        return AgentHello(identity, "", 0, False)
    return AgentHello(
        identity, str(fields["link"]), int(fields["arrived"]), bool(fields["welcomed"])
    )


def _read_welcome(identity: Identity, fields: Mapping[str, Any]) -> MasterWelcome:
    grace = fields.get("lost_grace")
    return MasterWelcome(
        identity,
        int(fields["arrived"]),
        heartbeat=float(fields["heartbeat"]),
        suspect_after=float(fields["suspect_after"]),
        lost_after=float(fields["lost_after"]),
        lost_grace=None if grace is None else float(grace),
    )


def _read_refusal(identity: Identity, fields: Mapping[str, Any]) -> MasterRefusal:
    return MasterRefusal(identity, str(fields["reason"]))


_READERS: dict[int, Callable[[Identity, Mapping[str, Any]], Greeting]] = {
    _HELLO: _read_hello,
    _WELCOME: _read_welcome,
    _REFUSAL: _read_refusal,
}


def parse_address(address: str) -> tuple[str, int]:
    """Return host and port; ConfigError if there are none.  ``[::1]:80`` is an address too."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address: it must be host:port, as in 10.0.0.7:8642")
    return host.strip("[]"), int(port)


def parse_addresses(addresses: str) -> list[tuple[str, int]]:
    """Parse addresses with commas between them, all of one master."""
    return [parse_address(address) for address in addresses.split(",")]


def join_address(host: str, port: int | str) -> str:
    """Return ``host:port``, an IPv6 address in brackets; ``port`` may be a range."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


SECRET_SIZE = 32


class Secrets(NamedTuple):
    """Secrets from which one side derives the keys of a connection."""

    outgoing: bytes
    incoming: bytes

    def __repr__(self) -> str:
        return "Secrets(...)"


def derive(agent: bytes, master: bytes, *, for_master: bool) -> Secrets:
    """Derive the secrets of a connection from the random bytes of both sides (HKDF, RFC 5869)."""
    both = hmac.digest(b"fiber link", agent + master, "sha256")
    up, down = expand(both, b"agent to master"), expand(both, b"master to agent")
    return Secrets(down, up) if for_master else Secrets(up, down)


def expand(secret: bytes, label: bytes) -> bytes:
    """Derive one more secret (the second step of HKDF)."""
    return hmac.digest(secret, b"fiber " + label + b"\x01", "sha256")


_T = TypeVar("_T")
Steps: TypeAlias = Generator[int, None, _T]

LARGEST_GREETING = 1 << 16
_LENGTH = struct.Struct(">I")
_LONGEST_PROOF = 256


class Untrusted(Exception):
    """Error: the peer has no valid proof, refused the proof of this side, or has no TLS 1.3."""


class PeerClosed(Exception):
    """Error: the peer closed the connection during the handshake."""


class _TakenSocket(ssl.SSLSocket):
    """Socket that was connected.

    The ssl module asks a new socket for its peer.  If the connection has just broken, it would then
    leave the socket open.  The handshake finds that out itself, and closes the socket.
    """

    def getpeername(self) -> None:
        """Do nothing, so that the ssl module does not ask the kernel."""


def master_context(certificate: Certificate) -> ssl.SSLContext:
    """Return the context of a master; AuthenticationError if ``certificate`` cannot be used."""
    context = _context(ssl.PROTOCOL_TLS_SERVER)
    context.num_tickets = 0  # no side resumes a session, and no bytes may follow the handshake
    try:
        _load_own(context, certificate)
    except (ssl.SSLError, ValueError) as error:
        raise AuthenticationError(
            f"the master's certificate cannot be used: {_reason(error)}. It is incomplete or not "
            "PEM. Make it again."
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
    # The ssl module reads them only from a file.  This file is in memory and has no name.
    file = os.memfd_create("credentials")
    try:
        with open(file, "wb", closefd=False) as writer:
            writer.write(f"{certificate.text}\n{certificate.key}\n".encode())
        context.load_cert_chain(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


class _Handshake:
    """Handshake of one side.  It takes over ``sock`` and makes it non-blocking.

    PeerClosed if the connection has broken already.
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
            raise PeerClosed(_reason(error)) from error

    def end(self) -> Steps[tuple[int, Secrets]]:
        """End TLS in order; return the descriptor of the bare connection and the secrets.

        The caller owns the descriptor.
        """
        yield from self._when_ready(self.sock.unwrap)
        return self.sock.detach(), derive(*self._nonces, for_master=self._for_master)

    def close(self) -> None:
        """Close the connection."""
        self.sock.close()

    @property
    def _nonces(self) -> tuple[bytes, bytes]:
        """Random bytes of the agent and of the master."""
        if self._for_master:
            return self._theirs, self._ours
        return self._ours, self._theirs

    def _said(self, side: bytes, certificate: bytes, greeting: bytes) -> bytes:
        """Return what the proof of ``side`` for ``greeting`` covers."""
        agent, master = self._nonces
        return b"fiber " + side + agent + master + certificate + greeting

    def _write(self, data: bytes) -> Steps[None]:
        rest = memoryview(data)
        while rest:
            rest = rest[(yield from self._when_ready(self.sock.send, rest)) :]

    def _read(self, what: str, limit: int) -> Steps[bytes]:
        """Read a greeting or a proof."""
        (size,) = _LENGTH.unpack((yield from self._read_exactly(_LENGTH.size)))
        if size > limit:
            raise ProtocolError(f"its {what} is longer than {limit} bytes")
        return (yield from self._read_exactly(size))

    def _read_proven(self) -> Steps[tuple[bytes, bytes]]:
        """Read a greeting and its proof."""
        greeting = yield from self._read("greeting", LARGEST_GREETING)
        try:
            return greeting, (yield from self._read("proof", _LONGEST_PROOF))
        except ProtocolError:
            # Another version of Fiber may write proofs in another way.
            if mismatch := _mismatch_in(greeting):
                raise ProtocolError(str(mismatch)) from mismatch
            raise

    def _read_exactly(self, size: int) -> Steps[bytes]:
        data = b""
        while len(data) < size:
            more = yield from self._when_ready(self.sock.recv, size - len(data))
            if not more:
                raise PeerClosed("it closed the connection during the handshake")
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
                raise PeerClosed("it closed the connection during the handshake") from error
            except ssl.SSLError as error:
                raise Untrusted(f"the TLS handshake failed: {_reason(error)}") from error
            except OSError as error:
                raise PeerClosed(_reason(error)) from error


class AgentHandshake(_Handshake):
    """Handshake of the agent."""

    _for_master = False

    def ask(self, credentials: Credentials, hello: bytes) -> Steps[tuple[bytes, ProvenMaster]]:
        """Send ``hello`` with a proof; return the answer, and the master that has proved itself."""
        yield from self._when_ready(self.sock.do_handshake)
        seen = hashlib.sha256(self.sock.getpeercert(binary_form=True) or b"").digest()
        if credentials.master and seen.hex() != credentials.master:
            raise Untrusted("its certificate is refused: it is not that of this agent's master")
        self._theirs = yield from self._read_exactly(SECRET_SIZE)
        proof = credentials.prove(self._said(b"agent", seen, hello))
        yield from self._write(self._ours + _framed(hello) + _framed(proof))
        answer, proof = yield from self._read_proven()
        if not answer:
            raise Untrusted(
                "the master does not believe that this agent is the pod it claims to be"
            )
        said = self._said(b"master", seen, answer)
        master = credentials.check_master(said, seen, proof)
        if master is None:
            raise Untrusted("it cannot prove that it is this pool's master")
        return answer, master


class MasterHandshake(_Handshake):
    """Handshake of the master."""

    _for_master = True

    def __init__(
        self, sock: socket.socket, context: ssl.SSLContext, certificate: Certificate
    ) -> None:
        super().__init__(sock, context)
        self._certificate = certificate.hash
        self._greeting = self._agent_proof = b""

    def listen(self) -> Steps[bytes]:
        """Return the agent's hello, before its proof is checked."""
        yield from self._when_ready(self.sock.do_handshake)
        yield from self._write(self._ours)
        self._theirs = yield from self._read_exactly(SECRET_SIZE)
        self._greeting, self._agent_proof = yield from self._read_proven()
        return self._greeting

    def believes(self, credentials: MasterCredentials, agent: Identity) -> bool:
        """Return True if the peer has proved to be ``agent`` in the pool of ``credentials``."""
        said = self._said(b"agent", self._certificate, self._greeting)
        return credentials.believes(agent.name, agent.uid, said, self._agent_proof)

    def answer(
        self, credentials: MasterCredentials, agent: Identity, greeting: bytes
    ) -> Steps[None]:
        """Answer ``agent``, which has proved itself, and prove to be its master."""
        said = self._said(b"master", self._certificate, greeting)
        proof = credentials.prove(agent.name, agent.uid, said)
        yield from self._write(_framed(greeting) + _framed(proof))

    def disbelieve(self) -> Steps[None]:
        """Answer an agent whose proof is not valid."""
        yield from self._write(_framed(b"") + _framed(b""))


def _framed(data: bytes) -> bytes:
    return _LENGTH.pack(len(data)) + data


def _reason(error: Exception) -> str:
    if isinstance(error, ssl.SSLError) and error.reason:
        return error.reason.lower().replace("_", " ")
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error)
