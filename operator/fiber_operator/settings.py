"""Settings of the operator, from environment variables that begin with FIBER_OPERATOR_.

An unknown name is an error, because a misspelt setting would otherwise be ignored in silence.
"""

from __future__ import annotations

import re
import socket
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PREFIX = "FIBER_OPERATOR_"

# Kubernetes gives each container such variables for the Services of its namespace; one that is
# called fiber-operator gives them our prefix.
_SERVICE_LINK = re.compile(r".*SERVICE_(HOST|PORT\w*)|(.*_)?PORT(_\d+_(TCP|UDP|SCTP)(_\w+)?)?")
_OWN_NAMESPACE = Path("/var/run/secrets/kubernetes.io/serviceaccount/namespace")
_DNS_LABEL = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_QUANTITY = re.compile(r"[0-9]+(\.[0-9]+)?(m|k|Ki|M|Mi|G|Gi|T|Ti|P|Pi|E|Ei|e[0-9]+)?", re.ASCII)
_LOG_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_LOG_FORMATS = ("json", "text")


class SettingsError(ValueError):
    """The environment does not make sense; the message names every variable that is wrong."""


@dataclass(frozen=True, kw_only=True)
class OperatorSettings:
    """Settings of this operator.  Times are in seconds."""

    namespaces: tuple[str, ...] = ()
    """FIBER_OPERATOR_NAMESPACES: serve only these, separated by commas; empty: all of them."""
    namespace: str = "default"
    """FIBER_OPERATOR_NAMESPACE: where the operator's own Lease is; its pod's if left out."""
    identity: str = field(default_factory=lambda: f"{socket.gethostname()}-{uuid.uuid4().hex[:8]}")
    """FIBER_OPERATOR_IDENTITY: holder of the Lease.  No two processes that may run at the same
    time may share it; the name of the operator's pod is right, and lets a container that was
    restarted go on at once."""
    lease: str = "fiber-operator"
    """FIBER_OPERATOR_LEASE: what the operator's own Lease is called after.  Processes with the same
    Lease are one release, of which one acts; with its namespace it says which release serves a
    pool."""
    lease_seconds: int = 15
    """FIBER_OPERATOR_LEASE_SECONDS: how long another process of the release waits for one
    that is silent."""
    host: str = ""
    port: int = 8080
    """FIBER_OPERATOR_LISTEN: ``address:port`` of /healthz, /readyz and /metrics."""
    resync_seconds: float = 60.0
    """FIBER_OPERATOR_RESYNC_SECONDS: each pool is looked at this often though nothing happened."""
    concurrency: int = 8
    """FIBER_OPERATOR_CONCURRENCY: pools that are worked on at the same time."""
    connections: int = 32
    """FIBER_OPERATOR_CONNECTIONS: connections to the API server, watches not included."""
    cpu_request: str = "50m"
    """FIBER_OPERATOR_CPU_REQUEST: what a worker requests where neither the template nor the program
    says anything, as a quantity of Kubernetes; empty: nothing."""
    memory_request: str = "64Mi"
    """FIBER_OPERATOR_MEMORY_REQUEST: the same of memory."""
    log_level: str = "INFO"
    """FIBER_OPERATOR_LOG_LEVEL: DEBUG, INFO, WARNING or ERROR."""
    log_format: str = "json"
    """FIBER_OPERATOR_LOG_FORMAT: json, or text for people."""

    @property
    def requests(self) -> dict[str, str]:
        """Default requests of a worker, for resources that its template does not mention."""
        asked = {"cpu": self.cpu_request, "memory": self.memory_request}
        return {kind: amount for kind, amount in asked.items() if amount}

    @classmethod
    def from_environment(
        cls, environment: Mapping[str, str], own_namespace: Path = _OWN_NAMESPACE
    ) -> OperatorSettings:
        """Read the settings.  Raises SettingsError that names all that is wrong at once."""
        given = {
            name.removeprefix(PREFIX): value.strip()
            for name, value in environment.items()
            if name.startswith(PREFIX) and not _SERVICE_LINK.fullmatch(name.removeprefix(PREFIX))
        }
        values: dict[str, Any] = {}
        if own_namespace.exists():
            values["namespace"] = own_namespace.read_text().strip()
        wrong = []
        for name, value in given.items():
            try:
                values.update(_READERS[name](value))
            except KeyError:
                known = ", ".join(sorted(PREFIX + known for known in _READERS))
                wrong.append(f"{PREFIX}{name} is no setting; there are {known}")
            except ValueError as error:
                wrong.append(f"{PREFIX}{name}={value!r}: {error}")
        if wrong:
            raise SettingsError("; ".join(wrong))
        return cls(**values)


def _reader(attribute: str, parse: Callable[[str], Any]) -> Callable[[str], dict[str, Any]]:
    return lambda value: {attribute: parse(value)}


def _name(value: str) -> str:
    if not _DNS_LABEL.fullmatch(value):
        raise ValueError("must be lower-case letters, digits and '-', 63 at most")
    return value


def _names(value: str) -> tuple[str, ...]:
    found = (name.strip() for name in value.split(","))
    return tuple(dict.fromkeys(_name(name) for name in found if name))


def _identity(value: str) -> str:
    if not value:
        raise ValueError("must not be empty: leave it out, or give the name of the operator's pod")
    return value


def _choice(choices: tuple[str, ...], spelling: Callable[[str], str]) -> Callable[[str], str]:
    def parse(value: str) -> str:
        if spelling(value) not in choices:
            raise ValueError(f"must be one of {', '.join(choices)}")
        return spelling(value)

    return parse


def _whole(least: int, most: int) -> Callable[[str], int]:
    def parse(value: str) -> int:
        if not value.isascii() or not value.isdigit() or not least <= int(value) <= most:
            raise ValueError(f"must be a whole number from {least} to {most}")
        return int(value)

    return parse


def _quantity(value: str) -> str:
    if value and not _QUANTITY.fullmatch(value):
        raise ValueError("must be a quantity such as 50m or 64Mi, or empty")
    return value


def _address(value: str) -> dict[str, Any]:
    host, separator, port = value.rpartition(":")
    if not separator:
        raise ValueError("must be address:port; the address may be empty, which means all")
    return {"host": host.strip("[]"), "port": _whole(0, 65535)(port)}


_READERS: dict[str, Callable[[str], dict[str, Any]]] = {
    "NAMESPACES": _reader("namespaces", _names),
    "NAMESPACE": _reader("namespace", _name),
    "IDENTITY": _reader("identity", _identity),
    "LEASE": _reader("lease", _name),
    # Shorter ones would be lost by one slow answer of the API server.
    "LEASE_SECONDS": _reader("lease_seconds", _whole(6, 3600)),
    "LISTEN": _address,
    "RESYNC_SECONDS": _reader("resync_seconds", _whole(5, 3600)),
    "CONCURRENCY": _reader("concurrency", _whole(1, 100)),
    "CONNECTIONS": _reader("connections", _whole(4, 1000)),
    "CPU_REQUEST": _reader("cpu_request", _quantity),
    "MEMORY_REQUEST": _reader("memory_request", _quantity),
    "LOG_LEVEL": _reader("log_level", _choice(_LOG_LEVELS, str.upper)),
    "LOG_FORMAT": _reader("log_format", _choice(_LOG_FORMATS, str.lower)),
}
