"""The bodies of a pool's Service, EndpointSlice and Secret."""

from __future__ import annotations

import base64
from typing import Any

from fiber_api import names
from fiber_operator.planning import manifests
from fiber_operator.planning.podspec import pod
from unit.operator_objects import MASTER, UID, make_pool


def test_everything_belongs_to_the_pool() -> None:
    pool = make_pool(master=MASTER)
    bodies = [
        manifests.service(pool),
        manifests.endpoint_slice(pool),
        manifests.secret(pool, {}),
        pod(pool, "es-0000000001", "10.96.1.2:7070"),
    ]
    for body in bodies:
        metadata = body["metadata"]
        assert metadata["namespace"] == "team"
        assert metadata["labels"][names.LABEL_POOL_UID] == UID
        assert metadata["labels"][names.LABEL_POOL] == "es"
        assert "finalizers" not in metadata
        (owner,) = metadata["ownerReferences"]
        assert (owner["kind"], owner["uid"], owner["controller"]) == ("FiberPool", UID, True)
        assert manifests.is_ours(pool, body)


def test_an_object_of_an_earlier_pool_or_without_owner_is_foreign() -> None:
    pool = make_pool()
    body = manifests.service(pool)
    body["metadata"]["ownerReferences"][0]["uid"] = "earlier"
    assert not manifests.is_ours(pool, body)
    assert not manifests.is_ours(pool, {"metadata": {}})
    assert not manifests.is_ours(pool, {"metadata": {"ownerReferences": "junk"}})


def test_the_service_has_no_selector() -> None:
    spec = manifests.service(make_pool())["spec"]
    assert "selector" not in spec
    assert (spec["type"], spec["ipFamilyPolicy"]) == ("ClusterIP", "PreferDualStack")
    assert [(port["name"], port["port"]) for port in spec["ports"]] == [("fiber", 7070)]


def test_the_slice_leads_to_the_master() -> None:
    body = manifests.endpoint_slice(make_pool(master=MASTER))
    assert body["metadata"]["labels"]["kubernetes.io/service-name"] == "es-fiber"
    assert body["addressType"] == "IPv4"
    assert body["endpoints"][0]["addresses"] == ["10.0.3.7"]
    assert body["ports"] == [{"name": "fiber", "port": 41337, "protocol": "TCP"}]


def test_the_slice_of_a_warm_pool_leads_nowhere() -> None:
    body = manifests.endpoint_slice(make_pool())
    assert (body["endpoints"], body["ports"]) == ([], [])


def read_back(body: dict[str, Any]) -> dict[str, Any]:
    """Return a slice as the API server shows it: empty lists are null, and more is filled in."""
    empty = {key: None for key in ("endpoints", "ports") if not body[key]}
    return {**body, **empty, "metadata": {**body["metadata"], "uid": "x"}}


def test_a_slice_is_patched_when_the_master_moves_and_else_not() -> None:
    warm, here = make_pool(), make_pool(master=MASTER)
    there = make_pool(master={**MASTER, "port": 5, "epoch": 2})
    for pool in (warm, here, there):
        assert manifests.slice_patch(pool, read_back(manifests.endpoint_slice(pool))) is None
    patch = manifests.slice_patch(there, read_back(manifests.endpoint_slice(here)))
    assert patch is not None
    assert patch["ports"][0]["port"] == 5
    patch = manifests.slice_patch(warm, read_back(manifests.endpoint_slice(here)))
    assert patch is not None
    assert patch["endpoints"] == []


def test_a_slice_without_its_labels_is_mended() -> None:
    pool = make_pool(master=MASTER)
    body = manifests.endpoint_slice(pool)
    body["metadata"]["labels"] = {}
    patch = manifests.slice_patch(pool, body)
    assert patch is not None
    assert patch["metadata"]["labels"]["kubernetes.io/service-name"] == "es-fiber"


def test_a_slice_is_replaced_when_the_address_family_changes() -> None:
    pool = make_pool(master={**MASTER, "host": "fd00::7"})
    assert manifests.endpoint_slice(pool)["addressType"] == "IPv6"
    assert manifests.slice_must_be_replaced(pool, manifests.endpoint_slice(make_pool()))
    assert not manifests.slice_must_be_replaced(pool, manifests.endpoint_slice(pool))
    assert not manifests.slice_must_be_replaced(make_pool(), manifests.endpoint_slice(pool))


def test_the_secret_holds_the_given_data() -> None:
    body = manifests.secret(make_pool(), {"ca.crt": "PEM"})
    assert body["metadata"]["name"] == "es-fiber-key"
    assert base64.b64decode(body["data"]["ca.crt"]) == b"PEM"
