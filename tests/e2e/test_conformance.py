"""Run CPython's own tests of multiprocessing and executors with every process in a pod."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from conformance import executors
from e2e.clusters import Cluster
from e2e.kube import environment
from e2e.scene import Scene

CONFORMANCE = Path(__file__).resolve().parents[1] / "conformance"
SECONDS = 1800


@pytest.mark.long
@pytest.mark.usefixtures("release")
@pytest.mark.timeout(SECONDS + 60, func_only=True)
@pytest.mark.parametrize("script", ["run.py", "executors.py"])
def test_cpythons_tests_on_pods(script: str, cluster: Cluster, scene: Scene, image: str) -> None:
    if script == "executors.py" and not executors.available():
        pytest.skip("this Python has no test.test_concurrent_futures")
    if cluster.outside is None:
        pytest.skip(f"{cluster.description}: pods cannot reach a program outside of it")
    variables = environment(
        KUBECONFIG=str(cluster.kubeconfig), FIBER_NAMESPACE=scene.namespace, FIBER_IMAGE=image
    )
    command = [sys.executable, str(CONFORMANCE / script), "--backend", "kubernetes"]
    done = subprocess.run(
        command, env=variables, capture_output=True, text=True, timeout=SECONDS, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
