"""A real Kubernetes cluster on one Linux machine, without Docker or an image registry.

Kubernetes, etcd, Helm and KWOK are built from source once (Go 1.26); the rest comes from Debian
packages, which are installed where root and apt-get are. There is one such cluster on a machine.
Nodes are network namespaces, so that pods of different nodes really cross a network; limits,
Services, RBAC, logs and exec are the real ones. There is no cluster DNS, no registry, and
NetworkPolicies are not enforced. Each node has all CPUs of the machine: let pods request little.
"""

from __future__ import annotations

import sys

from cluster.commands import parser
from cluster.shell import ClusterError, say


def main() -> int:
    """Run the command of the command line; status 1 where the cluster has a complaint."""
    top = parser()
    top.description = __doc__
    given = top.parse_args()
    try:
        given.run(given)
    except ClusterError as error:
        say(str(error))
        return 1
    return 0


sys.exit(main())
