"""Packet filters in place of a network plugin: they enforce NetworkPolicy.

A node is closed as a whole: its pods reach what is allowed, and nothing reaches them. Packets
between two pods of one node pass the filter, too: the kernel shows it what a bridge forwards.
"""

from __future__ import annotations

from typing import NamedTuple

from cluster import network

_CHAIN = "FIBER-POLICY"
_JUMP = ("FORWARD", "--jump", _CHAIN)


class Allowed(NamedTuple):
    """Packets that may leave the pods of a closed node. Answers may come back."""

    destination: str = "0.0.0.0/0"
    """An address, or a range of addresses."""
    protocol: str = "all"
    port: int | None = None
    """None: any."""


def close(index: int) -> None:
    """Drop each packet from and to the pods of a node, except those of existing connections."""
    reopen(index)
    answers = ("--match", "conntrack", "--ctstate", "ESTABLISHED,RELATED", "--jump", "RETURN")
    _iptables(index, "--new-chain", _CHAIN)
    _iptables(index, "--append", _CHAIN, *answers)
    _iptables(index, "--append", _CHAIN, "--jump", "DROP")
    _iptables(index, "--insert", *_JUMP)


def allow(index: int, allowed: Allowed) -> None:
    """Let these packets pass on a node that is closed."""
    port = () if allowed.port is None else ("--dport", str(allowed.port))
    what = ("--destination", allowed.destination, "--protocol", allowed.protocol, *port)
    _iptables(index, "--insert", _CHAIN, *what, "--jump", "RETURN")


def reopen(index: int) -> None:
    """Let all packets pass again; do nothing if the node is not closed."""
    for command in (("--delete", *_JUMP), ("--flush", _CHAIN), ("--delete-chain", _CHAIN)):
        _iptables(index, *command, check=False)


def _iptables(index: int, *command: str, check: bool = True) -> None:
    network.inside(index, "iptables", "--wait", *command, check=check)
