"""Readiness of a worker's pod: a startup probe that waits until a master has answered the agent.

From then on the agent serves a master, waits for the next one on purpose, or ends.  So the probe
has to succeed once, and costs nothing after that.  A pod that is made while its pool has no master
that lives waits for one on purpose, and has no such probe.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning import credentials
from fiber_operator.planning.attachment import awaits_agents
from fiber_operator.planning.documents import items, mapping, text

_PROGRAM = f"{names.CREDENTIALS_DIRECTORY}/{names.PROBE_PROGRAM}"
_FILE = f"{names.CREDENTIALS_DIRECTORY}/{names.LINKED_FILE}"

_SCRIPT = """\
import os, sys, time
for _ in range(200):
    if os.path.exists(sys.argv[1]):
        sys.exit()
    time.sleep(0.1)
sys.exit("no master has answered the agent yet; the log of the pod may say why")
"""
"""Command of the probe.  A sleeping process is cheaper than a process each second, and faster."""

_PROBE: Mapping[str, Any] = {
    # Without the site module an interpreter needs a hundredth of a second.
    "exec": {"command": [_PROGRAM, "-ISc", _SCRIPT, _FILE]},
    "initialDelaySeconds": 1,  # the processor is the agent's while that starts
    "periodSeconds": 2,
    "timeoutSeconds": 30,
    "failureThreshold": 2**31 - 1,  # it ends no pod
}


def add(pool: FiberPool, spec: Mapping[str, Any], worker: dict[str, Any]) -> None:
    """Give the worker's ``container`` the probe, where its agent is known to be one of ours."""
    first = next(items(spec.get("initContainers") or ()), {})
    if first.get("name") != names.IDENTITY_CONTAINER or not credentials.runs_the_agent(worker):
        return
    if not awaits_agents(pool) or worker.get("startupProbe") is not None:
        return
    if not isinstance(worker.get("env"), list):
        return
    worker["startupProbe"] = dict(_PROBE)
    worker["env"] = [{"name": names.ENV_LINKED, "value": _FILE}, *worker["env"]]


def is_awaited(worker: Mapping[str, Any], status: Mapping[str, Any]) -> bool:
    """Return whether nothing but its agent's link is missed of the container with this status."""
    if status.get("started") is not False or worker.get("readinessProbe"):
        return False
    command = mapping(worker, "startupProbe", "exec").get("command")
    return isinstance(command, list) and bool(command) and text(command[0]) == _PROGRAM
