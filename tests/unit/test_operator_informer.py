"""The informer of pods: what it knows, when, and what it outlives."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Call, Fault, KubernetesApi
from fakes.store import Body, Store
from fakes.world import NAMESPACE, configuration
from fiber_api import names
from fiber_api.rest import ApiError, Forbidden, Transient
from fiber_operator import informer
from fiber_operator.cluster import Cluster
from fiber_operator.informer import PodInformer
from fiber_operator.planning.pods import PodState, PodView
from fiber_operator.workqueue import Key

ES = Key(NAMESPACE, "es")
UID = "uid-of-es"
WITHIN = 300.0


class Site:
    """An API server, and an informer of its pods."""

    def __init__(self, api: KubernetesApi, cluster: Cluster, namespaces: tuple[str, ...]) -> None:
        self.api = api
        self.store = api.store
        self.changed: list[Key] = []
        self.answers: dict[str, str] = {}
        """Errors by request: why it failed the last time, if it did."""
        self.answered_well = 0
        """Number of reports that a request works."""
        self.informer = PodInformer(
            cluster, namespaces=namespaces, changed=self.changed.append, answered=self._answered
        )

    def _answered(self, what: str, error: ApiError | None) -> None:
        self.answers[what] = str(error or "")
        self.answered_well += error is None

    def body(self, name: str, namespace: str = NAMESPACE, pool: str = UID) -> Body:
        labels = {names.LABEL_POOL: "es", names.LABEL_POOL_UID: pool}
        return {"metadata": {"name": name, "namespace": namespace, "labels": labels}, "spec": {}}

    def make(self, name: str, namespace: str = NAMESPACE, pool: str = UID) -> Body:
        return self.store.create("pods", namespace, self.body(name, namespace, pool))

    async def views(self, namespace: str = NAMESPACE, pool: str = UID) -> dict[str, PodView]:
        pods = await self.informer.pods(Key(namespace, "es"), pool)
        assert len({pod.uid for pod in pods}) == len(pods)
        return {pod.name: pod for pod in pods}

    async def names(self) -> list[str]:
        return sorted(await self.views())

    async def until(self, condition: Callable[[], Awaitable[bool]]) -> float:
        clock = asyncio.get_running_loop().time
        began = clock()
        async with asyncio.timeout(WITHIN):
            while not await condition():
                await asyncio.sleep(0.1)
        return clock() - began

    async def until_there(self, *pods: str) -> float:
        async def there() -> bool:
            try:
                return await self.names() == sorted(pods)
            except ApiError:
                return False

        return await self.until(there)


@contextlib.asynccontextmanager
async def a_site(*namespaces: str, store: Store | None = None) -> AsyncIterator[Site]:
    api = KubernetesApi(store or Store(asyncio.get_running_loop().time))
    async with api.serving():
        cluster = Cluster(configuration(api), connections=4)
        site = Site(api, cluster, namespaces)
        task = asyncio.ensure_future(site.informer.run())
        try:
            yield site
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await cluster.close()


def played(*namespaces: str) -> Callable[[Callable[[Site], Coroutine[Any, Any, None]]], Any]:
    def decorate(test: Callable[[Site], Coroutine[Any, Any, None]]) -> Callable[[], None]:
        async def main() -> None:
            async with a_site(*namespaces) as site:
                await test(site)

        return lambda: virtual_time.run(main())

    return decorate


@played()
async def test_pods_are_those_of_the_list_and_of_the_watch(site: Site) -> None:
    site.make("before")
    assert await site.names() == ["before"]
    site.make("after")
    await site.until_there("after", "before")
    site.store.set_status("pods", NAMESPACE, "before", {"phase": "Failed"})

    async def has_ended() -> bool:
        return (await site.views())["before"].state is PodState.ENDED

    await site.until(has_ended)
    site.store.remove("pods", NAMESPACE, "before")
    await site.until_there("after")
    assert (site.api.count("list", "pods"), site.api.count("watch", "pods")) == (1, 1)


@played()
async def test_the_pool_of_each_pod_that_changes_is_named(site: Site) -> None:
    await site.names()
    site.make("a")
    await site.until_there("a")
    site.store.set_status("pods", NAMESPACE, "a", {"phase": "Failed"})
    await asyncio.sleep(1)
    site.store.merge("pods", NAMESPACE, "a", {"metadata": {"annotations": {"note": "irrelevant"}}})
    await asyncio.sleep(1)
    site.store.remove("pods", NAMESPACE, "a")
    await site.until_there()
    assert site.changed == [ES] * 3, "made, failed, gone"


@played()
async def test_the_version_is_the_newest_even_without_other_changes(site: Site) -> None:
    site.make("a")
    await site.names()
    new = site.store.merge("pods", NAMESPACE, "a", {"metadata": {"annotations": {"note": "x"}}})
    await asyncio.sleep(1)
    version = (await site.views())["a"].resource_version
    assert version == new["metadata"]["resourceVersion"]


@played()
async def test_pods_of_other_pools_and_of_no_pool_are_not_returned(site: Site) -> None:
    site.store.create("pods", NAMESPACE, {"metadata": {"name": "stranger"}})
    site.make("ours")
    site.make("theirs", pool="another")
    await site.until_there("ours")
    assert sorted(await site.views(pool="another")) == ["theirs"]
    labels = {names.LABEL_POOL_UID: UID}
    site.store.merge("pods", NAMESPACE, "theirs", {"metadata": {"labels": labels}})
    await site.until_there("ours", "theirs")
    assert await site.views(pool="another") == {}


@played()
async def test_pods_of_another_namespace_are_not_the_pools(site: Site) -> None:
    site.make("ours")
    site.make("theirs", "another")
    await site.until_there("ours")
    assert list(await site.views("another")) == ["theirs"]


@played("one", "two")
async def test_only_the_given_namespaces_are_watched(site: Site) -> None:
    for namespace in ("one", "two", "three"):
        site.make("pod-" + namespace, namespace)
    assert list(await site.views("one")) == ["pod-one"]
    assert list(await site.views("two")) == ["pod-two"]
    await asyncio.sleep(1)
    assert {call.namespace for call in site.api.calls} == {"one", "two"}
    assert site.answers == {"watch pods in one": "", "watch pods in two": ""}


# -- The operator's own changes


@played()
async def test_a_created_pod_is_there_before_the_watch_shows_it(site: Site) -> None:
    await site.names()
    site.api.watch_delay = 20
    site.informer.created(NAMESPACE, site.make("a"))
    assert await site.names() == ["a"]
    site.store.remove("pods", NAMESPACE, "a")
    assert await site.names() == ["a"]
    await site.until_there()


@played()
async def test_the_answer_to_a_creation_may_come_after_the_end_of_the_pod(site: Site) -> None:
    await site.names()
    document = site.make("a")
    await site.until_there("a")
    site.store.remove("pods", NAMESPACE, "a")
    await site.until_there()
    site.informer.created(NAMESPACE, document)
    assert await site.names() == []


@played()
async def test_a_creation_that_the_watch_never_shows_is_looked_for(site: Site) -> None:
    """The pod was there and gone between a list and the watch that follows."""
    await site.names()
    document = {**site.body("a"), "status": {}}
    document["metadata"] |= {"uid": "never-shown", "resourceVersion": "1"}
    site.informer.created(NAMESPACE, document)
    assert await site.names() == ["a"]
    assert await site.until_there() < informer.CONFIRMED_WITHIN + 65
    assert site.api.count("list", "pods") == 2


@played()
async def test_a_list_that_began_earlier_does_not_hide_a_created_pod(site: Site) -> None:
    await site.names()
    made: list[Body] = []

    def create(call: Call) -> None:
        if call.verb == "list":
            site.api.after = lambda call: None
            made.append(site.make("new"))  # the list is made already
            site.informer.created(NAMESPACE, made[0])

    site.api.after = create
    site.api.watch_delay = 5
    site.informer.refresh()
    assert await site.names() == ["new"]
    await asyncio.sleep(10)
    assert await site.names() == ["new"]


@played()
async def test_a_deleted_pod_is_terminating_even_if_the_watch_shows_it_alive(site: Site) -> None:
    site.make("a")
    uid = (await site.views())["a"].uid
    site.store.pods_linger = True
    site.api.watch_delay = 5
    site.store.set_status("pods", NAMESPACE, "a", {"phase": "Running"})  # shown after the deletion
    site.informer.deleted(NAMESPACE, uid, gone=False)
    assert (await site.views())["a"].state is PodState.TERMINATING
    await asyncio.sleep(10)
    assert (await site.views())["a"].state is PodState.TERMINATING
    site.store.remove("pods", NAMESPACE, "a")
    await site.until_there()


@played()
async def test_a_pod_that_was_gone_when_it_was_deleted_is_gone(site: Site) -> None:
    site.make("a")
    uid = (await site.views())["a"].uid
    site.informer.deleted(NAMESPACE, uid, gone=True)
    assert await site.names() == []
    site.informer.deleted(NAMESPACE, "unknown", gone=False)
    assert await site.names() == []


@played()
async def test_a_refresh_lists_before_pods_are_returned(site: Site) -> None:
    await site.names()
    site.api.watch_delay = 60
    site.make("of another operator")
    assert await site.names() == []
    site.informer.refresh()
    assert await site.names() == ["of another operator"]


@played()
async def test_two_refreshes_are_as_good_as_one(site: Site) -> None:
    site.make("a")
    await site.names()
    await asyncio.sleep(1)  # it watches
    site.informer.refresh()
    site.informer.refresh()
    assert await site.names() == ["a"]


@played()
async def test_a_refresh_in_the_middle_of_a_list_lists_again(site: Site) -> None:
    def refresh(call: Call) -> None:
        if call.verb == "list":
            site.api.after = lambda call: None
            site.make("of another operator")  # the list is made already
            site.informer.refresh()

    site.api.after = refresh
    site.api.watch_delay = 60
    assert await site.names() == ["of another operator"]


@played()
async def test_an_event_just_after_a_refresh_does_not_undo_it(site: Site) -> None:
    """The event that causes the refresh and the next event may come in one piece of data."""
    await site.names()
    await asyncio.sleep(1)
    made = site.make("a")

    def changed(key: Key) -> None:
        site.informer.refresh()

    site.informer._reflectors[None]._changed = changed
    site.make("b")
    await asyncio.sleep(1)
    assert site.api.count("list", "pods") >= 2
    assert await site.names() == ["a", "b"], made


@played()
async def test_a_list_that_began_earlier_does_not_bring_back_a_pod_that_is_gone(site: Site) -> None:
    uid = site.make("a")["metadata"]["uid"]
    await site.names()

    def remove(call: Call) -> None:
        if call.verb == "list":
            site.api.after = lambda call: None
            site.store.remove("pods", NAMESPACE, "a")  # the list is made already
            site.informer.deleted(NAMESPACE, uid, gone=True)

    site.api.after = remove
    site.api.watch_delay = 60
    site.informer.refresh()
    assert await site.names() == []


@played()
async def test_a_pod_that_changes_its_pool_is_announced_to_both(site: Site) -> None:
    site.make("a")
    await site.until_there("a")
    site.changed.clear()
    labels = {names.LABEL_POOL: "other", names.LABEL_POOL_UID: "uid-of-other"}
    site.store.merge("pods", NAMESPACE, "a", {"metadata": {"labels": labels}})
    await site.until_there()
    assert site.changed == [ES, Key(NAMESPACE, "other")]


# -- Trouble


@played()
async def test_a_watch_that_breaks_goes_on_where_it_was(site: Site) -> None:
    site.make("a")
    await site.until_there("a")
    site.api.drop_watches()
    site.make("b")
    site.store.remove("pods", NAMESPACE, "a")
    await site.until_there("b")
    assert site.api.count("list", "pods") == 1


@played()
async def test_after_410_the_list_reveals_deleted_pods(site: Site) -> None:
    site.make("a")
    site.make("b")
    await site.until_there("a", "b")
    site.api.faults.append(Fault("watch", times=2))  # until the history is forgotten
    site.api.drop_watches()
    site.store.remove("pods", NAMESPACE, "a")
    site.store.forget_history()
    await site.until_there("b")
    assert site.changed[-1] == ES


@played()
async def test_a_silent_watch_is_given_up(site: Site) -> None:
    """A connection that died without a word: no event, no bookmark, no end."""
    await site.names()
    site.api.silent = True
    site.make("a")
    await asyncio.sleep(1)
    site.api.silent = False
    assert await site.until_there("a") < 100


@played()
async def test_a_quiet_watch_lasts(site: Site) -> None:
    await site.names()
    await asyncio.sleep(200)
    assert site.api.count("watch", "pods") == 1
    await asyncio.sleep(200)
    assert (site.api.count("watch", "pods"), site.api.count("list", "pods")) == (2, 1)


@pytest.mark.parametrize(
    "fault",
    [
        Fault("list", status=500, times=20),
        Fault("list", status=429, retry_after=7, times=5),
        Fault("list", status=403, reason="Forbidden", times=10),
        Fault("list", times=10),
        Fault("list", text="<html>", times=3),
        Fault("list", text='{"items": [{}]}', times=3),
        Fault("watch", status=500, times=10),
        Fault("watch", status=401, reason="Unauthorized", times=3),
        Fault("watch", status=410, reason="Expired", times=3),
        Fault("watch", times=10),
        Fault("watch", text="{nonsense\n", times=3),
        Fault("watch", text='{"type": "ADDED"}\n', times=3),
        Fault("watch", text='{"type": "ADDED", "object": {}}\n', times=3),
        Fault("watch", text='{"type": "ERROR", "object": {"code": 500}}\n', times=3),
        Fault("watch", text='{"type": "ERROR", "object": {"code": 410}}\n', times=3),
    ],
    ids=lambda fault: f"{fault.verb}-{fault.status or fault.text}",
)
def test_an_api_server_in_trouble_is_waited_for(fault: Fault) -> None:
    @played()
    async def test(site: Site) -> None:
        site.api.faults.append(fault)
        site.make("a")
        await site.until_there("a")
        site.make("b")
        await site.until_there("a", "b")
        await site.until(lambda: _is(site.answers.get("watch pods") == ""))

    test()


async def _is(held: bool) -> bool:
    return held


@pytest.mark.parametrize(
    "fault",
    [
        Fault("watch", status=410, reason="Expired"),
        Fault("watch", text=""),
        Fault("watch", text="{nonsense\n"),
        Fault("watch", text='{"type": "ADDED", "object": {}}\n'),
        Fault("watch", text='{"type": "ERROR", "object": {"code": 500}}\n'),
        Fault("watch", text='{"type": "ERROR", "object": {"code": 410}}\n'),
    ],
    ids=lambda fault: fault.text if fault.text is not None else str(fault.status),
)
def test_a_watch_that_fails_each_time_is_reported_and_paused(fault: Fault) -> None:
    @played()
    async def test(site: Site) -> None:
        site.api.faults.append(dataclasses.replace(fault, times=10**6))
        await site.until(lambda: _is(bool(site.answers.get("watch pods"))))
        site.answered_well = 0
        before = site.api.count("watch", "pods")
        await asyncio.sleep(600)
        assert site.api.count("watch", "pods") - before <= 600 / informer.PAUSES[-1] + 5
        assert site.answers["watch pods"] != ""
        assert site.answered_well == 0, "it was reported to work"
        with pytest.raises(ApiError):
            await site.names()

    test()


@played()
async def test_a_single_failure_of_a_watch_does_not_hide_the_pods(site: Site) -> None:
    site.make("a")
    await site.names()
    site.api.faults.append(Fault("watch", status=500))
    site.api.drop_watches()
    for _ in range(10):
        assert await site.names() == ["a"]
        assert not site.answers.get("watch pods"), "one failure is not reported"
        await asyncio.sleep(0.1)


@pytest.mark.parametrize("verb", ["list", "watch"])
def test_without_the_right_the_pods_are_not_known(verb: str) -> None:
    @played()
    async def test(site: Site) -> None:
        said = f'User "operator" cannot {verb} resource "pods"'
        denied = Fault(verb, "pods", status=403, reason="Forbidden", message=said, times=10**6)
        site.api.faults.append(denied)
        await asyncio.sleep(1)
        for _ in range(2):
            with pytest.raises(Forbidden, match=said):
                await site.names()
        assert said in site.answers["watch pods"]
        assert site.api.count(verb, "pods") < 5
        denied.times = 0
        await site.until_there()
        await site.until(lambda: _is(site.answers["watch pods"] == ""))

    test()


@played()
async def test_a_list_without_an_answer_is_an_error_in_time(site: Site) -> None:
    site.api.faults.append(Fault("list", late=10**6, times=10**6))
    clock = asyncio.get_running_loop().time
    with pytest.raises(Transient):
        await site.names()
    assert clock() <= informer.SYNC_TIMEOUT
