"""Settings of the operator, from environment variables that begin with FIBER_OPERATOR_.

An unknown name is an error.  Otherwise a misspelt setting would have no effect and no message.
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

# Kubernetes sets variables for the Services of a namespace in each container.  Those of a Service
# that is called fiber-operator have this prefix.
_SERVICE_LINK = re.compile(r".*SERVICE_(HOST|PORT\w*)|(.*_)?PORT(_\d+_(TCP|UDP|SCTP)(_\w+)?)?")
_OWN_NAMESPACE = Path("/var/run/secrets/kubernetes.io/serviceaccount/namespace")
_DNS_LABEL = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_QUANTITY = re.compile(r"[0-9]+(\.[0-9]+)?(m|k|Ki|M|Mi|G|Gi|T|Ti|P|Pi|E|Ei|e[0-9]+)?", re.ASCII)
_LOG_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_LOG_FORMATS = ("json", "text")


class SettingsError(ValueError):
    """Error of settings.  The message names each variable that is wrong."""


@dataclass(frozen=True, kw_only=True)
class OperatorSettings:
    """Settings of this operator.  Times are in seconds."""

    namespaces: tuple[str, ...] = ()
    """FIBER_OPERATOR_NAMESPACES: namespaces to serve, separated by commas; empty: all."""
    namespace: str = "default"
    """FIBER_OPERATOR_NAMESPACE: namespace of the leader's Lease.  Default: that of the pod."""
    identity: str = field(default_factory=lambda: f"{socket.gethostname()}-{uuid.uuid4().hex[:8]}")
    """FIBER_OPERATOR_IDENTITY: name of this process in the leader's Lease.  Two processes that run
    at the same time must have different names.  With the name of the pod, a container that was
    restarted becomes the leader at once."""
    lease: str = "fiber-operator"
    """FIBER_OPERATOR_LEASE: name of the release, from which the leader's Lease gets its name.
    Processes with the same Lease are one release and have one leader.  The name and the namespace
    of the Lease also say which release serves a pool."""
    lease_seconds: int = 15
    """FIBER_OPERATOR_LEASE_SECONDS: seconds without a renewal after which another process of the
    release may become the leader."""
    host: str = ""
    """FIBER_OPERATOR_LISTEN, its address; empty: all addresses."""
    port: int = 8080
    """FIBER_OPERATOR_LISTEN, its port: ``address:port`` of /healthz, /readyz and /metrics."""
    resync_seconds: float = 60.0
    """FIBER_OPERATOR_RESYNC_SECONDS: seconds after which a pool is reconciled without an event."""
    concurrency: int = 8
    """FIBER_OPERATOR_CONCURRENCY: pools that are reconciled at the same time."""
    connections: int = 32
    """FIBER_OPERATOR_CONNECTIONS: connections to the API server, without watches."""
    cpu_request: str = "50m"
    """FIBER_OPERATOR_CPU_REQUEST: request of a worker if neither the template nor the program gives
    one, as a quantity of Kubernetes; empty: no request."""
    memory_request: str = "64Mi"
    """FIBER_OPERATOR_MEMORY_REQUEST: the same for memory."""
    log_level: str = "INFO"
    """FIBER_OPERATOR_LOG_LEVEL: DEBUG, INFO, WARNING or ERROR."""
    log_format: str = "json"
    """FIBER_OPERATOR_LOG_FORMAT: json, or text."""

    @property
    def requests(self) -> dict[str, str]:
        """Return the default requests of a worker for resources that its template does not name."""
        requests = {"cpu": self.cpu_request, "memory": self.memory_request}
        return {resource: quantity for resource, quantity in requests.items() if quantity}

    @classmethod
    def from_environment(
        cls, environment: Mapping[str, str], own_namespace: Path = _OWN_NAMESPACE
    ) -> OperatorSettings:
        """Read the settings.  Raises SettingsError, which names all wrong variables at once."""
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
                wrong.append(f"{PREFIX}{name} is not a setting. The settings are {known}")
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
        raise ValueError(
            "must not be empty: remove it, or set it to the name of the operator's pod"
        )
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
    # One slow answer of the API server would end a shorter Lease.
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
