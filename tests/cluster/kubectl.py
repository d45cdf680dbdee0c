"""kubectl as the cluster's administrator."""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.shell import answer, output


def kubectl(*arguments: str, check: bool = True) -> str:
    """Return kubectl's output for the project's cluster."""
    return output(*_command(), *arguments, check=check)


def answer_of(*arguments: str) -> str:
    """Return kubectl's output, or its error."""
    return answer(*_command(), *arguments)


def _command() -> tuple[str | Path, ...]:
    return (places.program("kubectl"), "--kubeconfig", places.KUBECONFIG)


def ready_nodes(selector: str) -> int:
    """Return how many nodes with these labels are Ready; 0 if no API server answers."""
    listed = kubectl("get", "nodes", "--no-headers", "--selector", selector, check=False)
    return sum(line.split()[1] == "Ready" for line in listed.splitlines())
