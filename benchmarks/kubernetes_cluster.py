"""Cluster of tests/cluster with all that kubernetes_run needs, while that measures.

`python -m benchmarks.kubernetes_cluster` passes its arguments on. Parts that existed before are
used and stay; parts that are made here are removed at the end. The run is a separate process: it
ends all processes below it, and the cluster must not be among them.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence

from benchmarks.operator_scale import preparation
from benchmarks.operator_scale.command import open_api
from benchmarks.operator_scale.installed import CannotMeasure
from benchmarks.rounds import say

from cluster import images
from cluster.shell import ClusterError
from e2e.kube import Failed, Refused, path_of

_TROUBLE = (CannotMeasure, ClusterError, Failed, Refused, OSError, AssertionError)


def main(arguments: Sequence[str]) -> int:
    """Return the run's exit status; 1 if no cluster can be made ready."""
    command = [sys.executable, "-m", "benchmarks.kubernetes_run", *arguments]
    try:
        with _place() as variables, subprocess.Popen(command, env=os.environ | variables) as run:
            return _wait_for(run)
    except KeyboardInterrupt:
        return 130
    except _TROUBLE as error:
        say(f"not measured: {error}")
        return 1


def _wait_for(run: subprocess.Popen[bytes]) -> int:
    """Run it and return its exit status. A terminal sends Ctrl-C to both; the run answers it."""
    while True:
        try:
            return run.wait()
        except KeyboardInterrupt:
            pass


@contextlib.contextmanager
def _place() -> Iterator[dict[str, str]]:
    """Return where pods are made, as variables for Fiber."""
    with contextlib.ExitStack() as stack:
        kubeconfig = stack.enter_context(preparation.own_cluster(0))
        kube = stack.enter_context(open_api(kubeconfig))
        stack.enter_context(preparation.operator(kube))
        image = images.bring_images()[images.WORKER_RL.name]
        body = {"metadata": {"generateName": "fiber-bench-"}}
        namespace = kube.create(path_of("namespaces"), body)["metadata"]["name"]
        stack.callback(kube.delete, path_of("namespaces", name=namespace))
        yield {
            "KUBECONFIG": str(kubeconfig),
            "FIBER_NAMESPACE": namespace,
            "FIBER_IMAGE": image,
        }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
