"""A program on a cluster: how it finds its own pod, and what of that pod stays behind."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from fakes.kubernetes_api import Fault
from fiber._backends.kubernetes import provisioner
from fiber._backends.kubernetes.attached_pool import OwnPool
from fiber._backends.kubernetes.provisioner import PoolProvisioner, VolumeClaims, without_claims
from fiber._backends.kubernetes.template import PodShape
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import ConfigError, FiberPoolError
from fiber_api import names
from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE, Rig, pool_body, rig


@pytest.fixture(name="rig")
def a_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with rig(tmp_path, monkeypatch) as made:
        yield made


@pytest.mark.parametrize(
    ("name", "why"), [("laptop", "with hostNetwork"), ("a" * 63, "cut after 63 characters")]
)
def test_the_reason_why_the_own_pod_is_not_found(rig: Rig, name: str, why: str) -> None:
    made = PoolProvisioner(Config())
    try:
        with pytest.raises(ConfigError, match=f"{why}.*fieldRef"):
            made._read_own_pod(name, threading.Event())
    finally:
        made.close()


def test_variables_that_stay_behind_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    provisioner._report_withheld_variables([])
    assert capsys.readouterr().err == ""
    provisioner._report_withheld_variables(["API_KEY", "TOKEN"])
    assert "API_KEY, TOKEN" in capsys.readouterr().err


POD = {
    "metadata": {"name": "train", "namespace": NAMESPACE, "uid": "1"},
    "spec": {
        "containers": [
            {
                "name": "main",
                "image": "train:1",
                "volumeMounts": [
                    {"name": name, "mountPath": f"/{name}"} for name in ("one", "shared", "secret")
                ],
            }
        ],
        "volumes": [
            {"name": name, "persistentVolumeClaim": {"claimName": f"{name}-claim"}}
            for name in ("one", "shared", "secret", "of-another-container")
        ],
    },
}


def prepared(made: PoolProvisioner, shape: PodShape) -> dict[str, Any]:
    """The pod template of a pool that is prepared in the pod."""
    loop = Loop()
    loop.start_thread("test-io")
    try:
        pool = made.prepare_own(shape, loop, Mock(), threading.Event())
        closed = threading.Event()
        loop.call_soon(lambda: pool.listener.close("", then=closed.set))
        assert closed.wait(PATIENCE)
    finally:
        loop.stop()
    assert isinstance(pool.attachment, OwnPool)
    return dict(pool.attachment._body["spec"]["template"]["spec"])


@pytest.mark.parametrize("mode", ["ReadWriteOnce", "ReadWriteOncePod"])
def test_a_claim_of_one_node_stays_behind_and_is_named_once(
    rig: Rig, mode: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provisioner, "reachable_address", lambda *args, **kwargs: "127.0.0.1")
    modes = {"one-claim": [mode], "shared-claim": [mode, "ReadOnlyMany"]}
    for name, allowed in modes.items():
        claim = {"metadata": {"name": name}, "spec": {"accessModes": allowed}}
        rig.server.do(rig.server.store.create, "persistentvolumeclaims", NAMESPACE, claim)
    rig.server.api.faults.append(Fault("get", name="secret-claim", status=403, times=math.inf))
    made = PoolProvisioner(Config())
    made._find_own_pod = lambda cancel: POD  # type: ignore[method-assign]
    try:
        spec = prepared(made, PodShape())
        assert [volume["name"] for volume in spec["volumes"]] == ["shared", "secret"]
        (worker,) = spec["containers"]
        assert [mount["name"] for mount in worker["volumeMounts"]] == ["shared", "secret"]
        unread, left_out = capsys.readouterr().err.splitlines()
        assert "mount the PersistentVolumeClaim secret-claim" in unread
        assert "do not get the PersistentVolumeClaims one-claim:" in left_out
        assert "fiber.init(template=)" in left_out
        assert len(prepared(made, PodShape(image="other"))["volumes"]) == 2
        assert capsys.readouterr().err == ""
    finally:
        made.close()


def test_a_claim_of_the_template_is_not_reported(rig: Rig) -> None:
    claims = VolumeClaims(("one-claim",))
    assert claims.warnings(POD) == []
    assert len(claims.warnings(without_claims(POD, claims.one_node))) == 1


# -- A warm pool, whose agents it knows by the public key in the status


@pytest.fixture
def made(rig: Rig) -> Iterator[PoolProvisioner]:
    rig.server.do(rig.server.store.create, names.PLURAL, NAMESPACE, pool_body("warm"))
    made = PoolProvisioner(Config())
    yield made
    made.close()


NO_KEY = {"reason": "InvalidCredentials", "message": "the Secret mine has no valid key."}


def tell(rig: Rig, **status: object) -> None:
    rig.server.do(rig.server.store.set_status, names.PLURAL, NAMESPACE, "warm", status)


def test_it_waits_until_the_operator_has_told_the_public_key(
    rig: Rig, made: PoolProvisioner
) -> None:
    looks = iter(range(2))

    def operator_looks(_: object) -> None:
        if next(looks, None) is None:
            rig.server.store.set_status(
                names.PLURAL, NAMESPACE, "warm", {"publicKey": "ab", "masterEpoch": 3}
            )

    rig.server.api.after = operator_looks
    found = made._seen_by_operator("warm", threading.Event())
    assert found["status"]["publicKey"] == "ab"


@pytest.mark.parametrize(
    ("status", "why"),
    [
        ({}, "Check that an operator runs and serves this namespace"),
        ({"credentialsSecret": "theirs"}, "names the only program that may ever use it"),
        ({"problems": [NO_KEY]}, "the Secret mine has no valid key"),
    ],
)
def test_a_pool_without_a_public_key_is_named_with_the_reason(
    rig: Rig,
    made: PoolProvisioner,
    monkeypatch: pytest.MonkeyPatch,
    status: dict[str, Any],
    why: str,
) -> None:
    monkeypatch.setattr(provisioner, "OPERATOR_ABSENT", 0.0)
    tell(rig, **status)
    with pytest.raises(FiberPoolError, match=why) as caught:
        made._seen_by_operator("warm", threading.Event())
    assert "cannot attach to the FiberPool 'warm' in namespace 'lab'" in str(caught.value)
