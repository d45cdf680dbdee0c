"""The pods that a program asks for: like its own, or an image; and the FiberPool around them."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from fiber._backends.kubernetes import published
from fiber._backends.kubernetes.published import worker_image
from fiber._backends.kubernetes.template import (
    ImageMissing,
    PodShape,
    fiber_pool_body,
    own_container,
    pod_template,
    secrets_left_out,
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


@pytest.fixture(autouse=True)
def _release(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(published, "REGISTRY", "registry.example/fiber")


def worker_of(template: dict[str, Any]) -> dict[str, Any]:
    (worker,) = template["spec"]["containers"]
    assert worker["name"] == names.WORKER_CONTAINER
    return dict(worker)


def like(shape: PodShape | None = None, pod: dict[str, Any] = POD) -> dict[str, Any]:
    return pod_template(shape or PodShape(), pod, "main", PYTHON)


class TestElsewhere:
    def test_a_pod_is_this_versions_worker(self) -> None:
        template = pod_template(PodShape(), None, "", PYTHON)
        worker = {"name": "worker", "image": worker_image(), "command": AGENT}
        assert template == {"spec": {"containers": [worker]}}

    def test_a_template_can_have_the_image(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(published, "REGISTRY", "")
        worker = {"name": "worker", "image": "es:1"}
        shape = PodShape.of(Config(template={"spec": {"containers": [worker]}}))
        assert worker_of(pod_template(shape, None, "", PYTHON))["image"] == "es:1"

    def test_a_development_build_needs_an_image(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(published, "REGISTRY", "")
        with pytest.raises(ImageMissing, match=r"no image for workers: .*set image.*FIBER_IMAGE"):
            pod_template(PodShape(), None, "", PYTHON)

    def test_a_program_in_a_pod_has_its_own_image(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(published, "REGISTRY", "")
        assert worker_of(like())["image"] == POD["spec"]["containers"][1]["image"]

    def test_the_configured_image_takes_its_place(self) -> None:
        template = pod_template(PodShape(image="es:1"), None, "", PYTHON)
        assert worker_of(template) == {"name": "worker", "image": "es:1", "command": AGENT}


class TestInAPod:
    def test_a_worker_has_its_programs_settings(self) -> None:
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

    def test_a_worker_has_no_setting_of_that_pod_alone(self) -> None:
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

    def test_priority_and_grace_are_the_programs(self) -> None:
        settings = {"priorityClassName": "batch", "terminationGracePeriodSeconds": 600}
        spec = like(pod={**POD, "spec": {**POD["spec"], **settings}})["spec"]
        assert {name: spec[name] for name in settings} == settings

    def test_workers_are_spread_among_themselves(self) -> None:
        zones = {"maxSkew": 1, "topologyKey": "zone", "whenUnsatisfiable": "ScheduleAnyway"}
        app = {"labelSelector": {"matchLabels": {"app": "train"}}, "matchLabelKeys": ["version"]}
        spec = {**POD["spec"], "topologySpreadConstraints": [{**zones, **app}]}
        (constraint,) = like(pod={**POD, "spec": spec})["spec"]["topologySpreadConstraints"]
        assert constraint == {
            **zones,
            "labelSelector": {
                "matchExpressions": [{"key": names.LABEL_POOL_UID, "operator": "Exists"}]
            },
            "matchLabelKeys": [names.LABEL_POOL_UID],
        }

    def test_a_pod_has_the_programs_environment_without_fibers_variables(self) -> None:
        variables = worker_of(like())["env"]
        assert [variable["name"] for variable in variables] == ["SEED", "CPUS"]
        reference = variables[1]["valueFrom"]["resourceFieldRef"]
        assert reference["containerName"] == "worker"

    @pytest.mark.parametrize(
        "name",
        [
            *("WANDB_API_KEY", "GITHUB_TOKEN", "DB_PASSWORD", "AWS_SECRET_ACCESS_KEY", "secret"),
            *("PGPASSWORD", "DB_PASS", "MYSQL_PWD", "DATABASE_URL", "REDIS_URL", "GITHUB_PAT"),
            *("SSH_KEY", "ENCRYPTION_KEY", "DOCKER_AUTH_CONFIG"),
        ],
    )
    def test_a_secret_in_its_manifest_stays_behind(self, name: str) -> None:
        pod = copy.deepcopy(POD)
        main = pod["spec"]["containers"][1]
        main["env"] = [{"name": name, "value": "hunter2"}, {"name": "SEED", "value": "1"}]
        assert worker_of(like(pod=pod))["env"] == [{"name": "SEED", "value": "1"}]
        assert secrets_left_out(pod, "main") == [name]

    @pytest.mark.parametrize(
        "name", ["TOKENIZERS_PARALLELISM", "MAX_TOKENS", "MONKEY", "KEYBOARD", "PWD"]
    )
    def test_a_name_that_only_resembles_a_secrets_goes_along(self, name: str) -> None:
        pod = copy.deepcopy(POD)
        pod["spec"]["containers"][1]["env"] = variables = [{"name": name, "value": "1"}]
        assert worker_of(like(pod=pod))["env"] == variables

    def test_a_reference_to_a_secret_goes_along(self) -> None:
        pod = copy.deepcopy(POD)
        reference = {"secretKeyRef": {"name": "keys", "key": "token"}}
        variables = [{"name": "GITHUB_TOKEN", "valueFrom": reference}]
        pod["spec"]["containers"][1]["env"] = variables
        assert worker_of(like(pod=pod))["env"] == variables
        assert secrets_left_out(pod, "main") == []

    def test_a_pod_runs_the_agent_with_the_programs_interpreter(self) -> None:
        assert worker_of(like())["command"] == [PYTHON, "-m", "fiber.agent"]

    def test_a_pod_with_another_image_runs_the_agent_of_that_image(self) -> None:
        worker = worker_of(like(PodShape(image="es:1")))
        assert worker["command"] == AGENT
        assert worker["image"] == "es:1"
        assert "imagePullPolicy" not in worker

    def test_the_programs_own_pod_is_not_changed(self) -> None:
        before = copy.deepcopy(POD)
        like(PodShape(image="es:1").with_resources(Resources(cpu=1)))
        assert before == POD

    def test_an_empty_pod_is_enough(self) -> None:
        pod = {"metadata": {}, "spec": {"containers": [{"name": "main", "image": "x"}]}}
        assert like(pod=pod)["spec"] == {
            "containers": [
                {"name": "worker", "image": "x", "command": [PYTHON, "-m", "fiber.agent"]}
            ]
        }


class TestResources:
    def test_wishes_are_guaranteed(self) -> None:
        shape = PodShape().with_resources(Resources(cpu=0.5, memory=512))
        assert worker_of(like(shape))["resources"] == {
            "requests": {"cpu": "500m", "memory": "512Mi"},
            "limits": {"cpu": "500m", "memory": "512Mi"},
        }

    def test_a_gpu_is_a_limit(self) -> None:
        shape = PodShape().with_resources(Resources(gpu=1))
        assert worker_of(like(shape))["resources"] == {"limits": {"nvidia.com/gpu": "1"}}

    def test_a_pod_has_the_resources_of_all_its_processes(self) -> None:
        shape = PodShape(processes_per_pod=4).with_resources(Resources(cpu=0.3, memory=100, gpu=2))
        assert worker_of(like(shape))["resources"] == {
            "requests": {"cpu": "1200m", "memory": "400Mi"},
            "limits": {"cpu": "1200m", "memory": "400Mi", "nvidia.com/gpu": "8"},
        }

    def test_requests_of_the_configuration_are_for_functions_without_wishes(self) -> None:
        config = Config(cpu_request=0.1, memory_request=64, processes_per_pod=2)
        assert worker_of(like(PodShape.of(config)))["resources"] == {
            "requests": {"cpu": "200m", "memory": "128Mi"}
        }
        wishing = PodShape.of(config).with_resources(Resources(cpu=1))
        assert worker_of(like(wishing))["resources"] == {
            "requests": {"cpu": "2", "memory": "128Mi"},
            "limits": {"cpu": "2"},
        }

    def test_an_empty_request_is_omitted(self) -> None:
        shape = PodShape.of(Config(cpu_request=0, memory_request=0))
        assert "resources" not in worker_of(like(shape))

    def test_a_template_that_limits_a_resource_has_requested_it(self) -> None:
        worker = {"name": "worker", "resources": {"limits": {"memory": "32Mi"}}}
        shape = PodShape.of(Config(template={"spec": {"containers": [worker]}}))
        assert worker_of(like(shape))["resources"] == {
            "limits": {"memory": "32Mi"},
            "requests": {"cpu": "50m"},
        }

    def test_extended_resources_are_limits(self) -> None:
        wishes = Resources(extended=(("amd.com/gpu", 1),))
        shape = PodShape(processes_per_pod=2).with_resources(wishes)
        assert worker_of(like(shape))["resources"] == {"limits": {"amd.com/gpu": "2"}}

    def test_nodes_are_those_of_program_configuration_and_function(self) -> None:
        config = Config(node_selector={"disk": "ssd"}, tolerations=({"key": "spot"},))
        wishes = Resources(node_selector=(("zone", "b"),), tolerations=((("key", "gpu"),),))
        spec = like(PodShape.of(config).with_resources(wishes))["spec"]
        assert spec["nodeSelector"] == {"zone": "b", "disk": "ssd"}
        spot = {"key": "spot", "operator": "Exists"}
        assert spec["tolerations"] == [spot, {"key": "spot"}, {"key": "gpu"}]

    def test_shared_memory_counts_to_the_memory(self) -> None:
        shape = PodShape.of(Config(shm=2048, processes_per_pod=2))
        template = like(shape.with_resources(Resources(memory=100)))
        worker = worker_of(template)
        assert worker["resources"]["limits"] == {"memory": "2248Mi"}
        assert worker["resources"]["requests"] == {"memory": "2248Mi", "cpu": "100m"}
        assert worker["volumeMounts"][-1] == {"name": "fiber-shm", "mountPath": "/dev/shm"}
        memory = {"medium": "Memory", "sizeLimit": "2048Mi"}
        assert template["spec"]["volumes"][-1] == {"name": "fiber-shm", "emptyDir": memory}

    def test_shared_memory_takes_the_place_of_the_programs(self) -> None:
        pod = copy.deepcopy(POD)
        pod["spec"]["volumes"].append({"name": "shm", "emptyDir": {"medium": "Memory"}})
        mounts = pod["spec"]["containers"][1]["volumeMounts"]
        mounts.append({"name": "shm", "mountPath": "/dev/shm"})
        spec = like(PodShape.of(Config(shm=64, cpu_request=0)), pod)["spec"]
        assert [v["name"] for v in spec["volumes"]] == ["data", "fiber-shm"]
        assert worker_of({"spec": spec})["resources"] == {"requests": {"memory": "128Mi"}}

    def test_zero_gpus_are_not_requested(self) -> None:
        assert "resources" not in worker_of(like(PodShape().with_resources(Resources(gpu=0))))


class TestTheUsersTemplate:
    def template(self, spec: dict[str, Any], **wishes: Any) -> dict[str, Any]:
        shape = PodShape.of(Config(template={"spec": spec}))
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
        assert worker["resources"]["limits"] == {"memory": "1Gi"}
        assert worker["resources"]["requests"] == {"cpu": "50m"}
        assert (worker["image"], worker["command"]) == ("mine:1", AGENT)

    @pytest.mark.parametrize("field", ["command", "args"])
    def test_the_template_may_set_the_command(self, field: str) -> None:
        worker = worker_of(self.template({"containers": [{"name": "worker", field: ["x"]}]}))
        assert {key: worker[key] for key in worker if key in ("command", "args")} == {field: ["x"]}

    def test_the_template_of_a_user_may_have_metadata(self) -> None:
        template = like(PodShape.of(Config(template={"metadata": {"labels": {"team": "a"}}})))
        assert template["metadata"] == {"labels": {"team": "a"}}


class TestOwnContainer:
    MOUNTINFO = (
        "700 699 0:30 / / rw - overlay overlay rw\n"
        "712 700 8:1 /lib/kubelet/pods/0f/containers/main/4e6b /dev/termination-log rw,relatime "
        "- ext4 /dev/sda1 rw\n"
    )

    def test_the_own_container_is_found_by_its_mounts(self) -> None:
        assert own_container(POD, self.MOUNTINFO) == "main"

    def test_kubectls_default_container_is_taken_if_the_own_is_unknown(self) -> None:
        pod = copy.deepcopy(POD)
        assert own_container(pod, "") == "proxy"
        pod["metadata"]["annotations"] = {"kubectl.kubernetes.io/default-container": "main"}
        assert own_container(pod, "") == "main"
        del pod["metadata"]["annotations"]
        assert own_container(pod, self.MOUNTINFO.replace("main", "gone")) == "proxy"


def test_the_operator_can_read_a_fiber_pool_of_the_sdk() -> None:
    config = Config(max_pods=50, processes_per_pod=8, idle_timeout=1.5)
    body = fiber_pool_body("es-1a2b3c", pod_template(PodShape(), None, ""), config)
    pool = FiberPool.read(body)
    assert body["metadata"]["labels"] == {names.LABEL_MANAGED_BY: names.SDK_MANAGER}
    assert pool.metadata.name == "es-1a2b3c"
    assert pool.wanted == 0
    assert pool.spec.max_replicas == 50
    assert pool.spec.processes_per_pod == 8
    assert pool.spec.scale_down.idle_timeout_seconds == 2
    assert pool.spec.template == pod_template(PodShape(), None, "")
