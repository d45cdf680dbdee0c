"""kopf's part: it watches and says that something happened.  Nothing else imports kopf.

kopf keeps watches alive well: it lists, watches, begins anew after 410, bookmarks and silence.
It is used for that alone.  Its change detection would write annotations and finalizers on users'
objects, its indices keep what was deleted during a 410, and its handlers are not repeated when
they fail; so the one kind of handler is ``on.event``, which puts a pool's name into a queue, or
tells that a Lease has changed.

kopf takes the event loop that it runs in for its own and cancels what it finds there, so it has a
thread with a loop of its own.  Whatever ends it, a garbled answer or a resource that is gone, it
is started again, once the pools can be listed.
"""

from __future__ import annotations

import asyncio
import collections
import functools
import logging
import threading
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Mapping
from typing import Any

import aiohttp
import kopf

from fiber_api import names
from fiber_operator.cluster import LEASES, PAGE, Configuration
from fiber_operator.lease_monitor import connected_in
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.watch_session import open_watch_session
from fiber_operator.watches import Answered, tracing
from fiber_operator.workqueue import Key

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
TOGETHER = 0.02
"""Seconds for which what happens is gathered."""
END_WAIT = 4.0
"""Seconds for kopf to end; its thread does not keep the process from ending."""

Notice = Callable[[Key, str, int | None], None]
"""Told of a pool: its uid and generation if it is the pool itself that changed, else None."""

Renewed = Callable[[str, str, str, int | None], None]
"""Told of a Lease of a pool: its namespace, name, resourceVersion (empty: it is deleted), and how
many agents its master has."""

Configure = Callable[[], Awaitable[Configuration]]
"""Function that returns address and login.  It is called again when a login has expired."""

_IDENTITY: Any = "fiber-operator"
"""kopf would ask the system for the user's name, which a container's user need not have."""

log = logging.getLogger(__name__)


class _Patience:
    """Delays between requests that fail: without end, so that no outage ends kopf."""

    def __iter__(self) -> Iterator[float]:
        yield from (0.5, 1, 2)
        while True:
            yield 5


class _NoDiffs(kopf.DiffBaseStorage):
    """Keeps kopf from comparing objects with what annotations say of their past."""

    def build(self, **_: Any) -> kopf.BodyEssence:
        return kopf.BodyEssence()

    def fetch(self, **_: Any) -> kopf.BodyEssence | None:
        return None

    def store(self, **_: Any) -> None:
        pass


def registry(
    notice: Notice,
    renewed: Renewed,
    configure: Configure,
    answered: Answered,
    sessions: list[aiohttp.ClientSession],
) -> kopf.OperatorRegistry:
    """The handlers: each says which object it is about and returns nothing."""
    handlers = kopf.OperatorRegistry()

    @kopf.on.login(registry=handlers)
    async def login(**_: Any) -> kopf.AiohttpSession:
        configuration = await configure()
        sessions.append(await open_watch_session(configuration, tracing(answered)))
        return kopf.AiohttpSession(server=str(configuration.host), aiohttp_session=sessions[-1])

    @kopf.on.event(names.GROUP, names.VERSION, names.PLURAL, registry=handlers)
    async def pool_event(type: str | None, body: Mapping[str, Any], **_: Any) -> None:
        metadata = mapping(body, "metadata")
        key = Key(text(metadata.get("namespace")), text(metadata.get("name")))
        generation = -1 if type == "DELETED" else whole(metadata.get("generation"), -1)
        notice(key, text(metadata.get("uid")), generation)

    @kopf.on.event("v1", "pods", registry=handlers)
    async def pod_event(body: Mapping[str, Any], **_: Any) -> None:
        metadata = mapping(body, "metadata")
        name = text(mapping(metadata, "labels").get(names.LABEL_POOL))
        notice(Key(text(metadata.get("namespace")), name), "", None)

    @kopf.on.event(LEASES.group, LEASES.version, LEASES.plural, registry=handlers)
    async def lease_event(type: str | None, body: Mapping[str, Any], **_: Any) -> None:
        metadata = mapping(body, "metadata")
        version = "" if type == "DELETED" else text(metadata.get("resourceVersion"))
        namespace, name = text(metadata.get("namespace")), text(metadata.get("name"))
        renewed(namespace, name, version, connected_in(body))

    return handlers


def kopf_settings() -> kopf.OperatorSettings:
    """kopf as a watcher and nothing else."""
    settings = kopf.OperatorSettings()
    settings.scanning.disabled = True
    settings.peering.standalone = True
    settings.posting.enabled = False
    settings.persistence.diffbase_storage = _NoDiffs()
    settings.persistence.consistency_timeout = 0
    settings.networking.error_backoffs = _Patience()
    settings.networking.request_timeout = 30
    settings.networking.connect_timeout = 5
    # The server ends a watch in time; where it does not, or says nothing at all, we do.
    settings.watching.server_timeout = 240
    settings.watching.client_timeout = 300
    settings.watching.connect_timeout = 5
    settings.watching.inactivity_timeout = 90
    settings.watching.chunk_size = PAGE
    # Of the Leases of a namespace, and every node has one somewhere, those of masters.
    for resource in (("v1", "pods"), LEASES):
        settings.watching.label_selectors[resource] = names.LABEL_POOL_UID
    # A handler of ours takes no time, and a task for each of a thousand pods is memory.
    settings.queueing.idle_timeout = 0.05
    settings.queueing.exit_timeout = 0.5
    settings.process.ultimate_exiting_timeout = None
    return settings


async def watch(
    notice: Notice,
    *,
    renewed: Renewed = lambda *_: None,
    configure: Configure,
    namespaces: Collection[str],
    gate: Callable[[], Awaitable[None]],
    on_start: Callable[[bool], None] = lambda running: None,
    answered: Answered = lambda what, error: None,
    stop: asyncio.Event,
) -> None:
    """Watch until ``stop``, in a loop that is kopf's.

    ``gate`` returns when the API server serves pools: kopf would not notice them later.
    ``on_start`` is told that watching begins (True) or ends (False), ``answered`` of each list
    and watch.
    """
    pause = FIRST_PAUSE
    loop = asyncio.get_running_loop()
    while not stop.is_set():
        await _unless(stop, gate())
        if stop.is_set():
            return
        started, sessions = loop.time(), list[aiohttp.ClientSession]()
        on_start(True)
        try:
            handlers = registry(notice, renewed, configure, answered, sessions)
            await _run_kopf(handlers, namespaces, stop)
        finally:
            on_start(False)
            # kopf leaves its own open where it ends with an error.
            await asyncio.gather(*(session.close() for session in sessions))
        pause = FIRST_PAUSE if loop.time() - started > LONGEST_PAUSE else pause
        await _unless(stop, asyncio.sleep(pause))
        pause = min(2 * pause, LONGEST_PAUSE)


async def _run_kopf(
    handlers: kopf.OperatorRegistry, namespaces: Collection[str], stop: asyncio.Event
) -> None:
    """Run kopf until it ends for whatever reason, and end what it leaves behind.

    kopf can lose a cancellation: one that comes while a watch ends by itself.  It then waits for
    that watch for ever, so it is given some time from when it begins to end.
    """
    ending = asyncio.Event()

    @kopf.on.cleanup(registry=handlers)
    async def cleanup(**_: Any) -> None:
        ending.set()

    before = asyncio.all_tasks()
    operator = asyncio.ensure_future(
        kopf.operator(
            registry=handlers,
            settings=kopf_settings(),
            identity=_IDENTITY,
            standalone=True,
            clusterwide=not namespaces,
            namespaces=tuple(namespaces),
            stop_flag=stop,
        )
    )
    signs = [asyncio.ensure_future(event.wait()) for event in (ending, stop)]
    try:
        await asyncio.wait([operator, *signs], return_when=asyncio.FIRST_COMPLETED)
        await asyncio.wait([operator], timeout=END_WAIT / 2)
    finally:
        await _end_tasks(asyncio.all_tasks() - before)
    if not stop.is_set():
        # kopf has logged it. Whatever it is, pools must be watched: try again.
        error = None if operator.cancelled() else operator.exception()
        log.warning("watching ended (%r); it begins anew", error)


async def _end_tasks(tasks: set[asyncio.Task[Any]]) -> None:
    for _ in range(10):
        for task in tasks:
            task.cancel()
        if tasks:
            _, tasks = await asyncio.wait(tasks, timeout=END_WAIT / 10)


async def _unless(stop: asyncio.Event, awaitable: Awaitable[None]) -> None:
    """Await it, or until ``stop``."""
    task, stopped = asyncio.ensure_future(awaitable), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait([task, stopped], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
    finally:
        task.cancel()
        stopped.cancel()
        await asyncio.gather(task, stopped, return_exceptions=True)


class Watcher:
    """``watch`` in a thread of its own; what it tells arrives in the loop that made this."""

    def __init__(
        self,
        notice: Notice,
        *,
        renewed: Renewed = lambda *_: None,
        configure: Configure,
        namespaces: Collection[str],
        gate: Callable[[], Coroutine[Any, Any, None]],
        on_start: Callable[[bool], None],
        answered: Answered = lambda what, error: None,
    ) -> None:
        self._home = asyncio.get_running_loop()
        self._notice = notice
        self._renewed = renewed
        self._configure = configure
        self._namespaces = namespaces
        self._gate = gate
        self._on_start = on_start
        self._answered = answered
        self._untold: collections.deque[Callable[[], None]] = collections.deque()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()
        self._stopping = threading.Event()
        self._ended: asyncio.Future[None] = self._home.create_future()
        self._thread = threading.Thread(target=self._run, name="watches", daemon=True)

    async def run(self) -> None:
        """Watch until cancelled.  Ends earlier only where this module is at fault."""
        self._thread.start()
        try:
            await self._ended
        finally:
            self._stopping.set()
            try:
                if self._loop is not None:
                    self._loop.call_soon_threadsafe(self._stop.set)
            except RuntimeError:
                pass  # its loop has ended already
            await asyncio.shield(asyncio.to_thread(self._thread.join, END_WAIT))

    def _run(self) -> None:
        error: BaseException = RuntimeError("the watches ended")
        try:
            with asyncio.Runner() as runner:
                self._loop = runner.get_loop()
                if not self._stopping.is_set():
                    runner.run(self._watch())
        except BaseException as raised:
            error = raised
        self._call(self._end, error)

    def _end(self, error: BaseException) -> None:
        if not self._ended.done():
            self._ended.set_exception(error)

    async def _watch(self) -> None:
        await watch(
            functools.partial(self._tell, self._notice),
            renewed=functools.partial(self._tell, self._renewed),
            configure=self._configure,
            namespaces=self._namespaces,
            gate=self._pass_gate,
            on_start=functools.partial(self._call, self._on_start),
            answered=functools.partial(self._call, self._answered),
            stop=self._stop,
        )

    def _tell(self, listener: Callable[..., None], *told: object) -> None:
        self._untold.append(functools.partial(listener, *told))
        # Waking the other loop costs more than what is told: once for all that comes together.
        if len(self._untold) == 1 and self._loop is not None:
            self._loop.call_later(TOGETHER, self._call, self._pass_on)

    def _pass_on(self) -> None:
        while self._untold:
            tell = self._untold.popleft()
            try:
                tell()
            except Exception:
                # What is left would never be passed on: ``_tell`` waits for the last one to go.
                log.exception("an event could not be passed on")

    def _call(self, function: Callable[..., None], *arguments: object) -> None:
        try:
            self._home.call_soon_threadsafe(function, *arguments)
        except RuntimeError:
            pass  # the operator is ending: nobody wants to know any more

    async def _pass_gate(self) -> None:
        coroutine = self._gate()
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(coroutine, self._home))
