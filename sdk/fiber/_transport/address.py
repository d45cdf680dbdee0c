"""Addresses of masters: ``host:port``."""

from __future__ import annotations

from fiber.errors import ConfigError


def parse(address: str) -> tuple[str, int]:
    """Host and port; ConfigError if there are none.  ``[::1]:80`` is an address too."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address: it must be host:port, as in 10.0.0.7:8642")
    return host.strip("[]"), int(port)
