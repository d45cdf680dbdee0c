"""Datagrams as the peer of a stream receives them: each in one piece."""

from __future__ import annotations

from fiber._transport.link_protocol import Datagram, LinkProtocol


def joined(datagram: Datagram) -> bytes:
    return datagram if isinstance(datagram, bytes) else b"".join(datagram)


def outgoing(end: LinkProtocol, now: float) -> list[bytes]:
    """Return the datagrams that it sends now."""
    return [joined(datagram) for datagram in end.outgoing(now)]
