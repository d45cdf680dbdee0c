"""kubectl as the cluster's administrator."""

from __future__ import annotations

from cluster import places
from cluster.shell import output


def kubectl(*arguments: str, check: bool = True) -> str:
    """What kubectl prints, asked of our cluster."""
    command = (places.program("kubectl"), "--kubeconfig", places.KUBECONFIG)
    return output(*command, *arguments, check=check)


def ready_nodes(selector: str) -> int:
    """How many of the nodes with these labels are Ready; 0 when nobody answers."""
    listed = kubectl("get", "nodes", "--no-headers", "--selector", selector, check=False)
    return sum(line.split()[1] == "Ready" for line in listed.splitlines())
