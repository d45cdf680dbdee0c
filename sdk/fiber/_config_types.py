"""Types of the configuration: of some keys, and of all as arguments of ``fiber.init``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

Backend = Literal["local", "loopback", "kubernetes", "auto"]
Progress = Literal["auto", "always", "never"]
Relay = Literal["auto", "always", "never"]
PassOn = Literal["auto", "always", "never"]
LogLevel = Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"]


class ConfigKeywords(TypedDict, total=False):
    """The keys of `Config`, as `init` takes them."""

    backend: Backend
    agents: int
    processes_per_agent: int
    namespace: str | None
    context: str | None
    image: str | None
    template: str | os.PathLike[str] | Mapping[str, Any] | None
    pool: str | None
    processes_per_pod: int
    cpu_request: float | str
    memory_request: int | str
    shm: int | str | None
    node_selector: Mapping[str, str] | None
    tolerations: Sequence[str | Mapping[str, Any]] | None
    max_pods: int
    pod_timeout: float
    idle_timeout: float
    listen_host: str | None
    listen_port: int | str
    advertised_host: str | None
    relay: Relay
    pass_on: PassOn
    start_timeout: float
    heartbeat_interval: float
    suspect_after: float
    lost_after: float
    retries: int
    disruptions: int
    log_level: LogLevel
    progress: Progress
    dashboard: bool
    timeline: str | os.PathLike[str] | None
    metrics_port: int | None
    metrics_host: str
    log_to: str | os.PathLike[str] | None
    log_times: bool
    log_records: LogLevel | None
    runtime_directory: str | os.PathLike[str] | None
