"""The user's pod template over what Fiber makes."""

from __future__ import annotations

from typing import Any

from fiber._backends.kubernetes.template import merge_template

OURS: dict[str, Any] = {
    "spec": {
        "nodeSelector": {"zone": "a"},
        "tolerations": [{"key": "spot"}],
        "containers": [
            {
                "name": "worker",
                "image": "es:1",
                "env": [{"name": "A", "valueFrom": {"fieldRef": {}}}, {"name": "B", "value": "2"}],
                "volumeMounts": [{"name": "data", "mountPath": "/data"}],
            }
        ],
        "volumes": [{"name": "data", "persistentVolumeClaim": {"claimName": "data"}}],
    }
}


def merged(**spec: Any) -> dict[str, Any]:
    result: dict[str, Any] = merge_template(OURS, {"spec": spec})["spec"]
    return result


def test_an_empty_patch_makes_a_copy() -> None:
    result = merge_template(OURS, {})
    assert result == OURS
    result["spec"]["nodeSelector"]["zone"] = "b"
    assert OURS["spec"]["nodeSelector"] == {"zone": "a"}


def test_objects_are_merged_and_other_values_replaced() -> None:
    assert merged(nodeSelector={"gpu": "yes"})["nodeSelector"] == {"zone": "a", "gpu": "yes"}
    assert merged(nodeSelector={"zone": "b"})["nodeSelector"] == {"zone": "b"}
    assert merged(tolerations=[{"key": "gpu"}])["tolerations"] == [{"key": "gpu"}]


def test_a_field_that_is_none_is_removed() -> None:
    assert "nodeSelector" not in merged(nodeSelector=None)
    assert merged(nodeSelector={"zone": None})["nodeSelector"] == {}
    assert merged(affinity={"nodeAffinity": None})["affinity"] == {}


def test_containers_are_merged_by_name_field_by_field() -> None:
    (worker,) = merged(containers=[{"name": "worker", "resources": {"limits": {"cpu": 1}}}])[
        "containers"
    ]
    assert worker == {**OURS["spec"]["containers"][0], "resources": {"limits": {"cpu": 1}}}
    sidecar = {"name": "proxy", "image": "proxy:1"}
    assert [c["name"] for c in merged(containers=[sidecar])["containers"]] == ["worker", "proxy"]


def test_a_namesake_replaces_a_variable_a_mount_and_a_volume_whole() -> None:
    container = {"name": "worker", "env": [{"name": "A", "value": "1"}, {"name": "C", "value": ""}]}
    volume = {"name": "data", "emptyDir": {}}
    result = merged(containers=[container], volumes=[volume])
    assert result["volumes"] == [volume]
    assert result["containers"][0]["env"] == [
        {"name": "A", "value": "1"},
        {"name": "B", "value": "2"},
        {"name": "C", "value": ""},
    ]


def test_a_named_thing_can_be_deleted() -> None:
    container = {
        "name": "worker",
        "env": [{"name": "B", "$patch": "delete"}],
        "volumeMounts": [{"mountPath": "/data", "$patch": "delete"}],
    }
    (worker,) = merged(containers=[container])["containers"]
    assert [variable["name"] for variable in worker["env"]] == ["A"]
    assert worker["volumeMounts"] == []


def test_invalid_templates_are_left_to_the_api_server() -> None:
    for nonsense in ("text", [{"value": "1"}], [3]):
        (worker,) = merged(containers=[{"name": "worker", "env": nonsense}])["containers"]
        assert worker["env"] == nonsense
