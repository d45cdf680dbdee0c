"""CPython's own multiprocessing tests, every process of theirs in a pod."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from e2e.clusters import Cluster
from e2e.kube import environment
from e2e.scene import Scene

RUN = Path(__file__).resolve().parents[1] / "conformance" / "run.py"
SECONDS = 1800


@pytest.mark.long
@pytest.mark.usefixtures("release")
@pytest.mark.timeout(SECONDS + 60, func_only=True)
def test_cpythons_tests_on_pods(cluster: Cluster, scene: Scene, image: str) -> None:
    if cluster.outside is None:
        pytest.skip(f"{cluster.description}: pods cannot reach a program outside of it")
    variables = environment(
        KUBECONFIG=str(cluster.kubeconfig), FIBER_NAMESPACE=scene.namespace, FIBER_IMAGE=image
    )
    command = [sys.executable, str(RUN), "--backend", "kubernetes"]
    done = subprocess.run(
        command, env=variables, capture_output=True, text=True, timeout=SECONDS, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
