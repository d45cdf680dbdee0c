"""The pods that a program asks for: like its own, or an image; and the FiberPool around them."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import pytest

import fiber
from cluster import images, places
from fiber._backends.kubernetes.shape import Shape
from fiber._backends.kubernetes.template import (
    WORKER_IMAGE,
    fiber_pool_body,
    own_container,
    pod_template,
)
from fiber.config import Config
from fiber.resources import Resources
from fiber_api import names
from fiber_api.v1alpha1 import FiberPool

ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
AGENT = ["python", "-m", "fiber.agent"]
PYTHON = "/venv/bin/python"

POD: dict[str, Any] = {
    "metadata": {"name": "train-abc", "uid": "1", "labels": {"app": "train"}, "annotations": {}},
    "spec": {
        "nodeName": "node-1",
        "hostname": "train",
        "restartPolicy": "Never",
        "serviceAccountName": "trainer",
        "serviceAccount": "trainer",
        "priority": 0,
        "nodeSelector": {"zone": "a"},
        "imagePullSecrets": [{"name": "registry"}],
        "securityContext": {"fsGroup": 1000},
        "tolerations": [
            {"key": "spot", "operator": "Exists"},
            {
                "key": "node.kubernetes.io/not-ready",
                "operator": "Exists",
                "effect": "NoExecute",
                "tolerationSeconds": 300,
            },
        ],
        "initContainers": [{"name": "fetch", "image": "git"}],
        "containers": [
            {"name": "proxy", "image": "proxy:1"},
            {
                "name": "main",
                "image": "registry.example.com/train:1",
                "imagePullPolicy": "Always",
                "command": ["python", "train.py"],
                "args": ["--epochs", "3"],
                "workingDir": "/srv",
                "ports": [{"containerPort": 8080}],
                "livenessProbe": {"httpGet": {"port": 8080}},
                "resources": {"requests": {"cpu": "4"}, "limits": {"memory": "16Gi"}},
                "terminationMessagePath": "/dev/termination-log",
                "env": [
                    {"name": "FIBER_BACKEND", "value": "kubernetes"},
                    {"name": "FIBER_AGENT_NAME", "value": "x"},
                    {"name": "SEED", "value": "1"},
                    {
                        "name": "CPUS",
                        "valueFrom": {
                            "resourceFieldRef": {"containerName": "main", "resource": "limits.cpu"}
                        },
                    },
                ],
                "envFrom": [{"secretRef": {"name": "keys"}}],
                "securityContext": {"runAsUser": 1000},
                "volumeMounts": [
                    {"name": "data", "mountPath": "/data"},
                    {"name": "kube-api-access-x7", "mountPath": ACCOUNT, "readOnly": True},
                ],
            },
        ],
        "volumes": [
            {"name": "data", "persistentVolumeClaim": {"claimName": "data"}},
            {"name": "proxy-config", "configMap": {"name": "proxy"}},
            {"name": "kube-api-access-x7", "projected": {"sources": []}},
        ],
    },
    "status": {"phase": "Running"},
}


def worker_of(template: dict[str, Any]) -> dict[str, Any]:
    (worker,) = template["spec"]["containers"]
    assert worker["name"] == names.WORKER_CONTAINER
    return dict(worker)


def like(shape: Shape | None = None, pod: dict[str, Any] = POD) -> dict[str, Any]:
    return pod_template(shape or Shape(), pod, "main", PYTHON)


class TestElsewhere:
    def test_a_pod_is_this_versions_worker(self) -> None:
        template = pod_template(Shape(), None, "", PYTHON)
        assert template == {
            "spec": {"containers": [{"name": "worker", "image": WORKER_IMAGE, "command": AGENT}]}
        }

    def test_it_is_named_as_charts_and_builds_name_it(self) -> None:
        assert images.WORKER.released(places.CHECKOUT) == WORKER_IMAGE
        values = Path(places.CHECKOUT, "charts/fiber-operator/values.yaml").read_text()
        found = re.search(r"^workerImage:\n(?:  #.*\n)*  repository: (\S+)$", values, re.MULTILINE)
        assert found is not None
        assert f"{found[1]}:{fiber.__version__}" == WORKER_IMAGE

    def test_the_configured_image_takes_its_place(self) -> None:
        template = pod_template(Shape(image="es:1"), None, "", PYTHON)
        assert worker_of(template) == {"name": "worker", "image": "es:1", "command": AGENT}


class TestInAPod:
    def test_a_worker_has_what_its_program_has(self) -> None:
        template = like()
        worker = worker_of(template)
        assert set(template) == {"spec"}
        assert worker["image"] == "registry.example.com/train:1"
        assert worker["imagePullPolicy"] == "Always"
        assert worker["workingDir"] == "/srv"
        assert worker["envFrom"] == [{"secretRef": {"name": "keys"}}]
        assert worker["securityContext"] == {"runAsUser": 1000}
        assert worker["volumeMounts"] == [{"name": "data", "mountPath": "/data"}]
        spec = template["spec"]
        assert spec["serviceAccountName"] == "trainer"
        assert spec["nodeSelector"] == {"zone": "a"}
        assert spec["imagePullSecrets"] == [{"name": "registry"}]
        assert spec["securityContext"] == {"fsGroup": 1000}
        assert [volume["name"] for volume in spec["volumes"]] == ["data"]

    def test_and_nothing_that_is_that_pods_alone(self) -> None:
        template = like()
        assert set(template["spec"]) == {
            "containers",
            "imagePullSecrets",
            "nodeSelector",
            "securityContext",
            "serviceAccountName",
            "tolerations",
            "volumes",
        }
        assert not {"ports", "livenessProbe", "resources", "args"} & set(worker_of(template))
        assert template["spec"]["tolerations"] == [{"key": "spot", "operator": "Exists"}]

    def test_its_environment_is_the_programs_without_fibers(self) -> None:
        variables = worker_of(like())["env"]
        assert [variable["name"] for variable in variables] == ["SEED", "CPUS"]
        reference = variables[1]["valueFrom"]["resourceFieldRef"]
        assert reference["containerName"] == "worker"

    def test_it_runs_the_agent_with_the_programs_interpreter(self) -> None:
        assert worker_of(like())["command"] == [PYTHON, "-m", "fiber.agent"]

    def test_in_another_image_it_is_the_one_that_is_found(self) -> None:
        worker = worker_of(like(Shape(image="es:1")))
        assert worker["command"] == AGENT
        assert worker["image"] == "es:1"
        assert "imagePullPolicy" not in worker

    def test_the_programs_own_pod_is_not_changed(self) -> None:
        before = copy.deepcopy(POD)
        like(Shape(image="es:1").with_resources(Resources(cpu=1)))
        assert before == POD

    def test_a_pod_with_nothing_in_it_is_enough(self) -> None:
        pod = {"metadata": {}, "spec": {"containers": [{"name": "main", "image": "x"}]}}
        assert like(pod=pod)["spec"] == {
            "containers": [
                {"name": "worker", "image": "x", "command": [PYTHON, "-m", "fiber.agent"]}
            ]
        }


class TestResources:
    def test_wishes_are_guaranteed(self) -> None:
        shape = Shape().with_resources(Resources(cpu=0.5, memory=512))
        assert worker_of(like(shape))["resources"] == {
            "requests": {"cpu": "500m", "memory": "512Mi"},
            "limits": {"cpu": "500m", "memory": "512Mi"},
        }

    def test_a_gpu_is_a_limit(self) -> None:
        shape = Shape().with_resources(Resources(gpu=1))
        assert worker_of(like(shape))["resources"] == {"limits": {"nvidia.com/gpu": "1"}}

    def test_they_are_those_of_each_process(self) -> None:
        shape = Shape(processes_per_pod=4).with_resources(Resources(cpu=0.3, memory=100, gpu=2))
        assert worker_of(like(shape))["resources"] == {
            "requests": {"cpu": "1200m", "memory": "400Mi"},
            "limits": {"cpu": "1200m", "memory": "400Mi", "nvidia.com/gpu": "8"},
        }

    def test_no_gpu_is_nothing_to_ask_for(self) -> None:
        assert "resources" not in worker_of(like(Shape().with_resources(Resources(gpu=0))))


class TestTheUsersTemplate:
    def template(self, spec: dict[str, Any], **wishes: Any) -> dict[str, Any]:
        shape = Shape.of(Config(template={"spec": spec}))
        return like(shape.with_resources(Resources(**wishes)))

    def test_wins_over_all(self) -> None:
        limits = {"limits": {"memory": "1Gi"}, "requests": None}
        spec = {
            "nodeSelector": {"zone": "b"},
            "containers": [{"name": "worker", "image": "mine:1", "resources": limits}],
        }
        template = self.template(spec, memory=512)
        assert template["spec"]["nodeSelector"] == {"zone": "b"}
        worker = worker_of(template)
        assert worker["resources"] == {"limits": {"memory": "1Gi"}}
        assert (worker["image"], worker["command"]) == ("mine:1", AGENT)

    @pytest.mark.parametrize("field", ["command", "args"])
    def test_may_say_what_runs(self, field: str) -> None:
        worker = worker_of(self.template({"containers": [{"name": "worker", field: ["x"]}]}))
        assert {key: worker[key] for key in worker if key in ("command", "args")} == {field: ["x"]}

    def test_may_have_metadata(self) -> None:
        template = like(Shape.of(Config(template={"metadata": {"labels": {"team": "a"}}})))
        assert template["metadata"] == {"labels": {"team": "a"}}


class TestOwnContainer:
    MOUNTINFO = (
        "700 699 0:30 / / rw - overlay overlay rw\n"
        "712 700 8:1 /lib/kubelet/pods/0f/containers/main/4e6b /dev/termination-log rw,relatime "
        "- ext4 /dev/sda1 rw\n"
    )

    def test_is_the_one_whose_files_are_mounted(self) -> None:
        assert own_container(POD, self.MOUNTINFO) == "main"

    def test_else_the_one_that_kubectl_takes(self) -> None:
        pod = copy.deepcopy(POD)
        assert own_container(pod, "") == "proxy"
        pod["metadata"]["annotations"] = {"kubectl.kubernetes.io/default-container": "main"}
        assert own_container(pod, "") == "main"
        del pod["metadata"]["annotations"]
        assert own_container(pod, self.MOUNTINFO.replace("main", "gone")) == "proxy"


def test_a_fiber_pool_is_one_that_the_operator_can_read() -> None:
    config = Config(max_pods=50, processes_per_pod=8, idle_timeout=1.5)
    body = fiber_pool_body("es-1a2b3c", pod_template(Shape(), None, ""), config)
    pool = FiberPool.read(body)
    assert body["metadata"]["labels"] == {names.LABEL_MANAGED_BY: names.SDK_MANAGER}
    assert pool.metadata.name == "es-1a2b3c"
    assert pool.wanted == 0
    assert pool.spec.max_replicas == 50
    assert pool.spec.processes_per_pod == 8
    assert pool.spec.scale_down.idle_timeout_seconds == 2
    assert pool.spec.template == pod_template(Shape(), None, "")
