"""Greetings on a connection before it belongs to a link, and addresses of masters (``host:port``).

    agent                                master
      │  Hello: identity, link,            │
      │         how much has arrived       │
      ├───────────────────────────────────►│  versions fit, link new or known?
      │◄───────────────────────────────────┤
         Welcome: identity, how much has arrived, keepalive      or      Refusal: identity, reason

The same exchange resumes a link on a new connection.  It takes place within TLS.  The layout is one
byte for the kind and JSON.  The fields of an identity stay what they are in every version, so that
two sides that do not understand each other can still say why.
"""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, NamedTuple, TypeAlias

from fiber._wire.messages import PROTOCOL, ProtocolError
from fiber.errors import ConfigError, VersionMismatch

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


class Hello(NamedTuple):
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


class Welcome(NamedTuple):
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
    epoch: int = 0
    """Number of this master among those that follow one another in a pool."""

    def encode(self) -> bytes:
        """Return the datagram."""
        return _encode(_WELCOME, self)


class Refusal(NamedTuple):
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

Greeting: TypeAlias = Hello | Welcome | Refusal


def decode(datagram: bytes) -> Greeting:
    """Read a greeting; ProtocolError if it is none."""
    reader = _READERS.get(datagram[0]) if datagram else None
    if reader is None:
        raise ProtocolError(f"its first {len(datagram)} bytes are no greeting")
    try:
        fields = json.loads(datagram[1:])
        return reader(_identity(fields["identity"]), fields)
    except _UNREADABLE as error:
        # Whatever JSON holds instead of what belongs there.
        raise ProtocolError(
            f"its greeting is malformed ({type(error).__name__}: {error})"
        ) from None


def mismatch(ours: Identity, theirs: Identity) -> VersionMismatch | None:
    """Why these two cannot work together: pickles and messages cross, so both must be equal."""
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


def _read_hello(identity: Identity, fields: Mapping[str, Any]) -> Hello:
    if identity.protocol != PROTOCOL:  # another version may put other things here
        return Hello(identity, "", 0, False)
    return Hello(identity, str(fields["link"]), int(fields["arrived"]), bool(fields["welcomed"]))


def _read_welcome(identity: Identity, fields: Mapping[str, Any]) -> Welcome:
    grace = fields.get("lost_grace")
    return Welcome(
        identity,
        int(fields["arrived"]),
        heartbeat=float(fields["heartbeat"]),
        suspect_after=float(fields["suspect_after"]),
        lost_after=float(fields["lost_after"]),
        lost_grace=None if grace is None else float(grace),
        epoch=int(fields.get("epoch", 0)),
    )


def _read_refusal(identity: Identity, fields: Mapping[str, Any]) -> Refusal:
    return Refusal(identity, str(fields["reason"]))


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
