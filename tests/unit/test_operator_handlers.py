"""kopf as the watcher: what it tells, what it outlives, and that it writes nothing."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import itertools
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import kopf
import pytest
from kopf._core.intents.causes import Activity

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.world import NAMESPACE, World, a_world, configuration
from fiber_api import names
from fiber_api.rest import ApiError
from fiber_operator import watches
from fiber_operator.cluster import Configuration, load_configuration
from fiber_operator.process import OperatorProcess
from fiber_operator.settings import OperatorSettings
from fiber_operator.watches import KopfThread
from fiber_operator.workqueue import Key
from patience import PATIENCE

ES = Key(NAMESPACE, "es")
Notice = tuple[Key, str, int]
WATCHED = ("fiberpools", "leases")


class Watching:
    """kopf in this loop, and what it has told."""

    def __init__(self, world: World, namespaces: tuple[str, ...]) -> None:
        self.world = world
        self.api = world.api
        self.store = world.store
        self.notices: list[Notice] = []
        self.renewals: list[tuple[str, str, str, int | None]] = []
        self.starts: list[bool] = []
        self.answers: dict[str, str] = {}
        """Errors by request: why it failed the last time, if it did."""
        self.gates = 0
        self.stop = asyncio.Event()
        self._task = asyncio.ensure_future(
            watches.watch(
                lambda *notice: self.notices.append(notice),
                renewed=lambda *renewal: self.renewals.append(renewal),
                configure=self._configure,
                namespaces=namespaces,
                gate=self._gate,
                on_start=self.starts.append,
                answered=self._answered,
                stop=self.stop,
            )
        )

    async def _configure(self) -> Configuration:
        return configuration(self.api)

    async def _gate(self) -> None:
        self.gates += 1

    def _answered(self, what: str, error: ApiError | None) -> None:
        self.answers[what] = str(error or "")

    async def ended(self) -> None:
        self.stop.set()
        await self._task

    async def told(self, *keys: Key, within: float = 600) -> list[Notice]:
        """Wait until each of ``keys`` is among what was told; what that is, and forget it."""
        await self.world.until(lambda: {*keys} <= {key for key, _, _ in self.notices}, within)
        told, self.notices[:] = list(self.notices), []
        return told

    async def watched(self, times: int = 1) -> None:
        """Wait until all watches are open, so many times each."""
        await self.world.until(
            lambda: min(self.api.count("watch", plural) for plural in WATCHED) >= times
        )


@contextlib.asynccontextmanager
async def watching(*namespaces: str) -> AsyncIterator[Watching]:
    async with a_world(operator=False) as world:
        watching = Watching(world, namespaces)
        try:
            yield watching
        finally:
            await watching.ended()


def played(*namespaces: str) -> Callable[[Callable[[Watching], Coroutine[Any, Any, None]]], Any]:
    def decorate(test: Callable[[Watching], Coroutine[Any, Any, None]]) -> Callable[[], None]:
        async def main() -> None:
            async with watching(*namespaces) as kopf:
                await test(kopf)

        def run() -> None:
            virtual_time.run(main())
            gc.collect()  # a watch that was not closed warns now, not in another test

        run.__doc__ = test.__doc__
        return run

    return decorate


@played()
async def test_pools_are_reported(kopf: Watching) -> None:
    pool = kopf.world.make_pool()
    uid = pool["metadata"]["uid"]
    assert (ES, uid, 1) in await kopf.told(ES)
    kopf.world.edit(replicas=2)
    assert (ES, uid, 2) in await kopf.told(ES)
    kopf.store.delete("fiberpools", NAMESPACE, "es")
    assert (ES, uid, -1) in await kopf.told(ES)


@played()
async def test_lists_and_watches_ask_for_metadata_alone(kopf: Watching) -> None:
    large = {"template": {"big": "\N{GRINNING FACE}" * 100_000}}
    body = {"metadata": {"name": "es"}, "spec": large}
    kopf.store.create("fiberpools", NAMESPACE, body)
    await kopf.told(ES)
    await kopf.watched()
    kopf.store.merge("fiberpools", NAMESPACE, "es", {"spec": {"replicas": 2}})
    await kopf.told(ES)
    assert kopf.api.largest_answer < 10_000


@played()
async def test_existing_pools_are_reported(kopf: Watching) -> None:
    kopf.world.make_pool()
    kopf.world.make_pool("another")
    await kopf.told(ES, Key(NAMESPACE, "another"))


@played()
async def test_only_renewals_of_the_masters_leases_are_reported(kopf: Watching) -> None:
    await kopf.watched()
    labels = {"fiber.dev/pool": "es", "fiber.dev/pool-uid": "1"}
    kopf.store.create("leases", NAMESPACE, {"metadata": {"name": "kubernetes"}})
    said = {names.ANNOTATION_CONNECTED: "2"}
    made = kopf.store.create("leases", NAMESPACE, {"metadata": {"name": "es", "labels": labels}})
    told = {"metadata": {"annotations": said}, "spec": {"renewTime": "now"}}
    renewed = kopf.store.merge("leases", NAMESPACE, "es", told)
    kopf.store.remove("leases", NAMESPACE, "es")
    versions = [lease["metadata"]["resourceVersion"] for lease in (made, renewed)]
    await kopf.world.until(lambda: len(kopf.renewals) >= 3)
    first, second, last = kopf.renewals
    assert first == (NAMESPACE, "es", versions[0], None)
    assert second == (NAMESPACE, "es", versions[1], 2)
    assert last[:3] == (NAMESPACE, "es", "")
    assert kopf.notices == []


@played()
async def test_kopf_writes_no_object(kopf: Watching) -> None:
    marks = {"kopf.zalando.org/last-handled-configuration": "{nonsense"}
    kopf.store.create("fiberpools", NAMESPACE, {"metadata": {"name": "es", "annotations": marks}})
    await kopf.told(ES)
    kopf.world.edit(replicas=1)
    await kopf.told(ES)
    kopf.store.delete("fiberpools", NAMESPACE, "es")
    await kopf.told(ES)
    assert {call.verb for call in kopf.api.calls} == {"list", "watch"}
    assert {call.plural for call in kopf.api.calls} == set(WATCHED)


@played("one", "two")
async def test_only_the_given_namespaces_are_asked_for(kopf: Watching) -> None:
    for namespace in ("one", "two", "three"):
        kopf.world.make_pool(namespace=namespace)
    await kopf.told(Key("one", "es"), Key("two", "es"))
    assert {call.namespace for call in kopf.api.calls} == {"one", "two"}


@played("one", "two")
async def test_each_answer_to_kopf_is_reported(kopf: Watching) -> None:
    await kopf.watched(2)
    assert kopf.answers["get /apis/fiber.dev/v1alpha1"] == ""
    assert {what for what in kopf.answers if not what.startswith("get ")} == {
        f"{verb} {plural} in {namespace}"
        for verb in ("list", "watch")
        for plural in WATCHED
        for namespace in ("one", "two")
    }


@pytest.mark.parametrize("verb", ["list", "watch"])
@pytest.mark.parametrize("plural", WATCHED)
def test_a_missing_right_and_its_return_are_reported(verb: str, plural: str) -> None:
    @played()
    async def test(kopf: Watching) -> None:
        said = f'{plural} is forbidden: User "operator" cannot {verb} resource "{plural}"'
        denied = Fault(verb, plural, status=403, reason="Forbidden", message=said, times=10**6)
        kopf.api.faults.append(denied)
        asked = f"{verb} {plural}"
        await kopf.world.until(lambda: kopf.answers.get(asked) == f"{asked}: {said}", within=10)
        denied.times = 0
        await kopf.world.until(lambda: kopf.answers[asked] == "", within=10)
        kopf.world.make_pool()
        await kopf.told(ES)

    test()


@played()
async def test_a_watch_that_breaks_goes_on(kopf: Watching) -> None:
    kopf.world.make_pool()
    await kopf.watched()
    await kopf.told(ES)
    kopf.api.drop_watches()
    await kopf.watched(2)
    kopf.world.edit(replicas=1)
    await kopf.told(ES)
    assert kopf.starts == [True]


@played()
async def test_after_410_all_objects_are_reported_again(kopf: Watching) -> None:
    kopf.world.make_pool()
    await kopf.watched()
    await kopf.told(ES)
    kopf.world.edit(replicas=1)
    await kopf.told(ES)
    kopf.store.create("secrets", NAMESPACE, {"metadata": {"name": "unrelated"}})
    kopf.store.forget_history()
    kopf.api.drop_watches()
    await kopf.told(ES)


@played()
async def test_a_silent_watch_is_given_up(kopf: Watching) -> None:
    """A connection that died without a word: no event, no bookmark, no end."""
    kopf.world.make_pool()
    await kopf.watched()
    await kopf.told(ES)
    kopf.api.silent = True
    kopf.world.edit(replicas=1)
    await asyncio.sleep(1)
    kopf.api.silent = False
    await kopf.told(ES, within=300)


@played()
async def test_delayed_events_are_reported(kopf: Watching) -> None:
    await kopf.watched()
    kopf.api.watch_delay = 20
    kopf.world.make_pool()
    await kopf.told(ES)


@pytest.mark.parametrize(
    "fault",
    [
        Fault("list", status=500, times=20),
        Fault("list", status=503, times=20),
        Fault("list", status=429, retry_after=7, times=5),
        Fault("list", status=403, reason="Forbidden", times=20),
        Fault("list", times=20),
        Fault("watch", status=500, times=10),
        Fault("watch", times=10),
    ],
    ids=lambda fault: f"{fault.verb}-{fault.status}",
)
def test_an_api_server_in_trouble_is_waited_for(fault: Fault) -> None:
    @played()
    async def test(kopf: Watching) -> None:
        kopf.api.faults.append(fault)
        kopf.world.make_pool()
        await kopf.told(ES)
        kopf.world.edit(replicas=1)
        await kopf.told(ES)

    test()


@pytest.mark.parametrize(
    "fault",
    [
        Fault("watch", text="{nonsense\n"),
        Fault("watch", text='{"type": "ADDED"}\n'),
        Fault("watch", text='{"type": "ADDED", "object": {}}\n'),
        Fault("watch", text='{"type": "ERROR", "object": {"code": 500}}\n'),
        Fault("watch", status=410, reason="Expired"),
        Fault("list", text="<html>"),
        Fault("list", text='{"items": [{}]}'),
        Fault("list", status=404, reason="NotFound"),
    ],
    ids=lambda fault: f"{fault.verb}-{fault.status or fault.text}",
)
def test_the_end_of_kopf_does_not_end_the_watches(fault: Fault) -> None:
    @played()
    async def test(kopf: Watching) -> None:
        kopf.api.faults.append(fault)
        kopf.world.make_pool()
        await kopf.told(ES)
        await kopf.watched(2)
        kopf.world.edit(replicas=1)
        await kopf.told(ES)
        assert kopf.gates == len([start for start in kopf.starts if start])

    test()


def test_an_expired_login_is_renewed() -> None:
    @played()
    async def test(kopf: Watching) -> None:
        kopf.world.make_pool()
        await kopf.told(ES)
        await kopf.watched()
        kopf.api.faults += [Fault("watch", status=401, reason="Unauthorized", times=1)]
        kopf.api.drop_watches()
        await kopf.world.until(lambda: sum(c.verb == "watch" for c in kopf.api.calls) >= 5)
        kopf.world.edit(replicas=1)
        await kopf.told(ES)

    test()


def test_a_user_without_a_name_can_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless() -> str:
        raise KeyError("getpwuid(): uid not found: 65532")

    @played()
    async def test(kopf: Watching) -> None:
        kopf.world.make_pool()
        await kopf.told(ES)
        assert kopf.starts == [True]

    monkeypatch.setattr("getpass.getuser", nameless)
    test()


@pytest.mark.slow
def test_the_thread_tells_the_loop_that_made_it_and_ends_with_it() -> None:
    """The whole program with kopf in its thread, in real time."""

    async def main() -> None:
        async with a_world(operator=False) as world:
            stop = asyncio.Event()

            async def configure() -> Configuration:
                return configuration(world.api)

            settings = OperatorSettings(host="127.0.0.1", port=0, identity="operator-1")
            program = OperatorProcess(settings, configure=configure, now=world.store.unix_now)
            task = asyncio.ensure_future(program.run(stop))
            world.make_pool(replicas=2)
            await world.ready(2, within=PATIENCE)
            world.kubelet.evict(NAMESPACE, world.names()[0])
            await world.until(lambda: world.status()["failures"]["disrupted"] == 1, within=PATIENCE)
            stop.set()
            await task

    asyncio.run(main())


def test_a_bug_in_a_handler_does_not_stop_other_events() -> None:
    """Lose the first of two events that come together."""

    async def main() -> None:
        told: list[str] = []

        def notice(what: str) -> None:
            told.append(what)
            if what == "bad":
                raise KeyError("a fault of ours")

        watcher = KopfThread(
            lambda *_: None,
            configure=load_configuration,
            namespaces=(),
            gate=lambda: asyncio.sleep(0),
            on_start=lambda _: None,
        )
        watcher._kopf_loop = asyncio.get_running_loop()
        tell = functools.partial(watcher._add_event, notice)
        for pair in (("bad", "good"), ("bad", "again")):
            for what in pair:
                tell(what)
            await asyncio.sleep(2 * watches.TOGETHER)
        assert told == ["bad", "good", "bad", "again"]

    virtual_time.run(main())


def test_a_thread_that_cannot_watch_ends_the_program() -> None:
    async def main() -> None:
        def fail() -> None:
            raise KeyError("a fault of ours")

        watcher = KopfThread(
            lambda *_: None,
            configure=load_configuration,
            namespaces=(),
            gate=fail,  # type: ignore[arg-type]
            on_start=lambda _: None,
        )
        with pytest.raises(KeyError):
            await watcher.run()

    asyncio.run(main())


def test_a_kopf_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a kopf that loses the first cancellations while it ends."""
    runs = 0

    async def stubborn(**options: Any) -> None:
        nonlocal runs
        runs += 1
        handler = next(
            iter(options["registry"]._activities.get_handlers(activity=Activity.CLEANUP))
        )
        if runs == 1:
            await handler.fn()
        for _ in range(3):
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                if runs > 1:
                    raise

    monkeypatch.setattr(kopf, "operator", stubborn)

    @played()
    async def test(kopf: Watching) -> None:
        await kopf.world.until(lambda: runs == 2, within=30)
        assert kopf.starts == [True, False, True]

    test()


def test_patience_never_ends() -> None:
    delays = iter(watches._EndlessDelays())
    assert max(itertools.islice(delays, 10_000)) == 5
