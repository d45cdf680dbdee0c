"""Addresses of masters: ``host:port``."""

from __future__ import annotations

from fiber.errors import ConfigError


def parse(address: str) -> tuple[str, int]:
    """Return host and port; ConfigError if there are none.  ``[::1]:80`` is an address too."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address: it must be host:port, as in 10.0.0.7:8642")
    return host.strip("[]"), int(port)


def parse_list(addresses: str) -> list[tuple[str, int]]:
    """Parse addresses with commas between them, all of one master."""
    return [parse(address) for address in addresses.split(",")]


def join(host: str, port: int | str) -> str:
    """Return ``host:port``, an IPv6 address in brackets; ``port`` may be a range."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
