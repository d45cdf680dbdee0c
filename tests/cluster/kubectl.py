"""kubectl as the cluster's administrator."""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.shell import answer, output


def kubectl(*arguments: str, check: bool = True) -> str:
    """What kubectl prints, asked of our cluster."""
    return output(*_command(), *arguments, check=check)


def answer_of(*arguments: str) -> str:
    """What kubectl prints, or what it complains about."""
    return answer(*_command(), *arguments)


def _command() -> tuple[str | Path, ...]:
    return (places.program("kubectl"), "--kubeconfig", places.KUBECONFIG)


def ready_nodes(selector: str) -> int:
    """How many of the nodes with these labels are Ready; 0 when nobody answers."""
    listed = kubectl("get", "nodes", "--no-headers", "--selector", selector, check=False)
    return sum(line.split()[1] == "Ready" for line in listed.splitlines())
