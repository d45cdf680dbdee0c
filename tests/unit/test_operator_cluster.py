"""The door to the API server: every way in which a call can end."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from kubernetes.aio.client.configuration import Configuration
from kubernetes.aio.config import incluster_config

from fakes import virtual_time
from fakes.certificates import make_certificates
from fakes.kubernetes_api import Fault, KubernetesApi
from fakes.store import Store
from fakes.world import configuration
from fiber_api.rest import (
    PODS,
    POOLS,
    SECRETS,
    ApiError,
    Conflict,
    Invalid,
    NotFound,
    NotServed,
    TooManyRequests,
    Transient,
)
from fiber_operator import cluster
from fiber_operator.cluster import PAGE, Cluster
from fiber_operator.responses import MOST_VALUES, Oversized
from fiber_operator.watches import open_watch_session


@contextlib.asynccontextmanager
async def an_api(**options: Any) -> AsyncIterator[tuple[KubernetesApi, Cluster]]:
    api = KubernetesApi(Store(asyncio.get_running_loop().time))
    async with api.serving():
        door = Cluster(configuration(api), connections=4, **options)
        try:
            yield api, door
        finally:
            await door.close()


def with_api(
    test: Callable[[KubernetesApi, Cluster], Coroutine[Any, Any, None]], **options: Any
) -> None:
    async def main() -> None:
        async with an_api(**options) as (api, door):
            await test(api, door)

    virtual_time.run(main())


def pod(name: str, **labels: str) -> dict[str, Any]:
    return {"metadata": {"name": name, "labels": labels}, "spec": {}}


def names_of(body: dict[str, Any]) -> str:
    return str(body["metadata"]["name"])


def test_objects_are_made_read_changed_and_deleted() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        made = await door.create(PODS, "here", pod("a"))
        assert made["metadata"]["uid"]
        await door.patch(PODS, "here", "a", {"status": {"phase": "Running"}}, "status")
        assert (await door.read(PODS, "here", "a"))["status"] == {"phase": "Running"}
        made = await door.read(PODS, "here", "a")
        made["metadata"]["labels"] = {"new": "yes"}
        await door.replace(PODS, "here", "a", made)
        await door.delete(PODS, "here", "a", uid=made["metadata"]["uid"])
        with pytest.raises(NotFound):
            await door.read(PODS, "here", "a")

    with_api(test)


def test_a_list_has_every_page_of_the_selected_objects_only() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.page = 3  # the client asks for no pages; a server may still answer in pages
        for number in range(8):
            api.store.create("pods", "here", pod(f"p{number}", of="us"))
        api.store.create("pods", "here", pod("other", of="them"))
        api.store.create("pods", "there", pod("far", of="us"))
        here = await door.list(PODS, "here", names_of, selector="of=us")
        assert here == [f"p{number}" for number in range(8)]
        assert len(await door.list(PODS, None, names_of)) == 10
        assert api.count("list", "pods") == 3 + 4

    with_api(test)


@pytest.mark.parametrize("expired", [False, True])
def test_metadata_come_in_pages_and_all_at_once_if_a_page_was_asked_for_too_late(
    expired: bool,
) -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        for number in range(PAGE + 3):
            api.store.create("fiberpools", "here", {**pod(f"p{number:03}"), "spec": {"big": 1}})
        if expired:
            api.faults.append(Fault("list", "fiberpools", 410, reason="Expired", skip=1))
        found = await door.list_metadata(POOLS, "here", lambda body: (names_of(body), len(body)))
        # Of each its version, its kind and its metadata.
        assert found == [(f"p{number:03}", 3) for number in range(PAGE + 3)]
        assert api.count("list", "fiberpools") == 2 + expired

    with_api(test)


def test_an_empty_list_of_metadata_is_empty() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        assert await door.list_metadata(POOLS, None, names_of) == []

    with_api(test)


def test_a_dry_run_creates_no_object() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        await door.create(PODS, "here", pod("a"), dry_run=True)
        assert api.store.list("pods") == []

    with_api(test)


def test_a_changed_object_is_not_deleted() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        made = (await door.create(PODS, "here", pod("a")))["metadata"]
        with pytest.raises(Conflict):
            await door.delete(PODS, "here", "a", uid="another")
        with pytest.raises(Conflict):
            await door.delete(PODS, "here", "a", uid=made["uid"], resource_version="1")
        assert len(api.store.list("pods")) == 1

    with_api(test)


def test_an_error_names_the_call() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault(status=429, retry_after=7, message="words of the server"))
        with pytest.raises(TooManyRequests) as caught:
            await door.create(PODS, "here", pod("a"))
        assert str(caught.value) == "create pods in here: words of the server"
        assert caught.value.retry_after == 7

    with_api(test)


def test_an_object_of_many_values_is_deleted_and_not_decoded() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        text = json.dumps({"spec": [{}] * (MOST_VALUES + 1)})
        api.faults.append(Fault(text=text, times=2))
        await door.delete(PODS, "here", "a", uid="any")
        with pytest.raises(Oversized):
            await door.read(PODS, "here", "a")

    with_api(test)


def test_commas_in_a_message_do_not_change_the_error() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        message = "," * (MOST_VALUES + 1)
        api.faults.append(Fault(status=422, reason="Invalid", message=message))
        with pytest.raises(Invalid):
            await door.create(PODS, "here", pod("a"))

    with_api(test)


@pytest.mark.parametrize("text", ["", "<html>", "[]", "null", "3", '{"kind": "Pod"', "\ud83d"])
@pytest.mark.parametrize("verb", ["get", "list", "create"])
def test_nonsense_is_no_answer(text: str, verb: str) -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault(text=text.encode(errors="replace").decode()))
        calls: dict[str, Callable[[], Coroutine[Any, Any, object]]] = {
            "get": lambda: door.read(PODS, "here", "a"),
            "list": lambda: door.list(PODS, "here", names_of),
            "create": lambda: door.create(PODS, "here", pod("a")),
        }
        with pytest.raises(Transient):
            await calls[verb]()

    with_api(test)


@pytest.mark.parametrize("text", ["{}", '{"metadata": {}}', '{"metadata": {"name": "b"}}'])
def test_an_answer_that_is_no_object_is_refused(text: str) -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.store.create("pods", "here", pod("a"))
        api.faults.append(Fault(text=text, times=4))
        for call in (
            door.read(PODS, "here", "a"),
            door.create(PODS, "here", pod("a")),
            door.replace(PODS, "here", "a", pod("a")),
            door.patch(PODS, "here", "a", {}),
        ):
            with pytest.raises(Transient, match="not the object a"):
                await call

    with_api(test)


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"kind": "PodList", "metadata": {}}',
        '{"kind": "PodList", "metadata": {}, "items": null}',
        '{"kind": "PodList", "metadata": {}, "items": [1]}',
        '{"kind": "PodList", "items": []}',
        '{"kind": "Status", "metadata": {}, "items": []}',
    ],
)
def test_an_answer_that_is_no_list_is_not_an_empty_one(text: str) -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault(text=text))
        with pytest.raises(Transient):
            await door.list(PODS, "here", names_of)

    with_api(test)


def test_a_404_that_is_no_status_document_is_unavailable() -> None:
    """A proxy, or an API server that does not serve the resource yet."""

    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault(status=404, text="404 page not found"))
        with pytest.raises(NotServed, match="404 page not found"):
            await door.read(PODS, "here", "a")

    with_api(test)


def test_no_connection_and_no_answer_are_unavailable() -> None:
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults += [Fault(), Fault(late=1000)]
        with pytest.raises(Transient):
            await door.create(PODS, "here", pod("a"))
        with pytest.raises(Transient, match="no answer in time"):
            await door.read(PODS, "here", "a")

    with_api(test)


def test_no_server_is_unavailable() -> None:
    async def main() -> None:
        door = Cluster(Configuration(host="http://127.0.0.1:9"), connections=1)
        with pytest.raises(Transient):
            await door.read(PODS, "here", "a")
        await door.close()

    virtual_time.run(main())


def test_no_object_is_changed_without_permission() -> None:
    def forbid() -> float:
        raise PermissionError

    async def test(api: KubernetesApi, door: Cluster) -> None:
        made = api.store.create("pods", "here", pod("a"))
        assert await door.read(PODS, "here", "a")
        for write in (
            door.create(PODS, "here", pod("b")),
            door.create(PODS, "here", pod("b"), dry_run=True),
            door.replace(PODS, "here", "a", made),
            door.patch(PODS, "here", "a", {}),
            door.delete(PODS, "here", "a", uid=made["metadata"]["uid"]),
        ):
            with pytest.raises(PermissionError):
                await write
        assert {call.verb for call in api.calls} == {"get"}

    with_api(test, permit=forbid)


def test_a_write_lasts_no_longer_than_is_permitted() -> None:

    async def test(api: KubernetesApi, door: Cluster) -> None:
        clock = asyncio.get_running_loop().time
        for verb, call in (
            ("create", lambda: door.create(PODS, "here", pod("a"))),
            ("delete", lambda: door.delete(PODS, "here", "a", uid="1")),
        ):
            api.faults.append(Fault(verb, late=60.0))
            began = clock()
            with pytest.raises(Transient):
                await call()
            assert 2.9 < clock() - began < 3.5

    with_api(test, permit=lambda: 3.0)


def test_every_call_is_observed() -> None:
    seen: list[tuple[str, str, str]] = []

    async def test(api: KubernetesApi, door: Cluster) -> None:
        await door.list(SECRETS, "here", names_of)
        api.faults += [Fault(status=409), Fault(), Fault(text="no")]
        for _ in range(3):
            with pytest.raises(ApiError):
                await door.patch(PODS, "here", "a", {}, "status")

    with_api(
        test, observe=lambda verb, resource, code, seconds: seen.append((verb, resource, code))
    )
    assert seen == [
        ("list", "secrets", "200"),
        ("patch", "pods/status", "409"),
        ("patch", "pods/status", "connection"),
        ("patch", "pods/status", "garbage"),
    ]


def test_no_more_calls_at_once_than_connections() -> None:
    """Wait for a turn: that time does not count as the server's."""

    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault(late=8, times=12))
        await asyncio.gather(*(door.create(PODS, "here", pod(f"p{n}")) for n in range(12)))
        assert asyncio.get_running_loop().time() >= 3 * 8

    with_api(test)


# -- Logging in


def test_a_pod_logs_in_with_its_own_account(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "token").write_text("first")
    (tmp_path / "ca.crt").write_text(make_certificates("any", "any").authority)
    monkeypatch.setattr(incluster_config, "SERVICE_TOKEN_FILENAME", str(tmp_path / "token"))
    monkeypatch.setattr(incluster_config, "SERVICE_CERT_FILENAME", str(tmp_path / "ca.crt"))
    monkeypatch.delenv("KUBECONFIG", raising=False)
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "fd00::1")
    monkeypatch.setenv("KUBERNETES_SERVICE_PORT", "443")

    async def main() -> None:
        configuration = await cluster.load_configuration()
        assert configuration.host == "https://[fd00::1]:443"
        async with await open_watch_session(configuration, aiohttp.TraceConfig()) as session:
            assert session.headers["Authorization"] == "bearer first"

    asyncio.run(main())


def test_a_token_that_was_renewed_is_used() -> None:
    """Each call is logged in with what the configuration says at that time."""

    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.store.create("pods", "here", pod("a"))
        for token in ("first", "second"):
            door._client.configuration.api_key["BearerToken"] = f"Bearer {token}"
            await door.read(PODS, "here", "a")
        assert api.tokens == ["Bearer first", "Bearer second"]

    with_api(test)
