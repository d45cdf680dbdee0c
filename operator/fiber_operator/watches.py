"""Watches of FiberPools and of the masters' Leases, which kopf keeps open in a separate thread.

kopf lists, watches, and begins again after status 410, after the end of a watch and after silence.
The operator uses only this part of kopf.  kopf's change detection would write annotations and
finalizers on the objects of users, its indices keep objects that were deleted during a 410, and it
does not retry a handler that failed.  So all handlers are ``on.event`` handlers.  They pass on the
name of the object that changed.

kopf takes over its event loop and cancels the other tasks there.  So kopf has a separate thread and
loop, and ``KopfThread`` delivers the events to the operator's loop.  If kopf ends, for example
because of a garbled response or a deleted resource type, ``watch`` starts it again as soon as the
pools can be listed.

The watches ask the API server for metadata only, and the session keeps the fields that the handlers
read.  kopf retries forever and reports no error.  So the session reports each answer, and an
operator without the right to watch can say which right is missing (``health.WatchStatus``).
"""

from __future__ import annotations

import asyncio
import collections
import functools
import logging
import threading
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import aiohttp
import kopf

from fiber_api import names
from fiber_api.rest import LEASES, POOLS, ApiError, Body
from fiber_operator.cluster import PAGE, Configuration, open_session
from fiber_operator.lease_monitor import connected_in
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.responses import (
    METADATA,
    METADATA_LIST,
    PIECE,
    Answered,
    ListReader,
    limited_document_of,
)
from fiber_operator.workqueue import Key

log = logging.getLogger(__name__)


WATCHED = (POOLS, LEASES)
"""Resources that kopf watches.  The informer watches the pods."""


# -- kopf's HTTP session

_PASSING_ERRORS = frozenset({401, 410})
"""Status codes of an expired login and of a watch that is too old: kopf begins anew at once."""
_KEPT = ("namespace", "name", "uid", "generation", "resourceVersion")


async def open_watch_session(
    configuration: Configuration, trace: aiohttp.TraceConfig
) -> aiohttp.ClientSession:
    """Open a session with the credentials of ``configuration``; ``trace`` observes each request."""
    return await open_session(
        configuration,
        trace_configs=[trace],
        middlewares=[_request_metadata],
        response_class=_MetadataResponse,
    )


async def _request_metadata(
    request: aiohttp.ClientRequest, handler: aiohttp.ClientHandlerType
) -> aiohttp.ClientResponse:
    if request.url.name in {resource.plural for resource in WATCHED}:
        watch = request.url.query.get("watch") == "true"
        kind = METADATA if watch else METADATA_LIST
        request.headers["Accept"] = f"application/json;as={kind};g=meta.k8s.io;v=v1"
    return await handler(request)


class _MetadataResponse(aiohttp.ClientResponse):
    """Response that decodes a list of metadata one object at a time."""

    async def json(self, **options: Any) -> Any:
        accept = self.request_info.headers.get("Accept", "")
        if self.status >= 400 or METADATA_LIST not in accept:
            return await super().json(**options)
        listing = ListReader(self.content.iter_chunked(PIECE), f"list {self.url.name}")
        items = [_shorten(item) async for item in listing]
        return {**listing.rest, "items": items}


def _shorten(item: Body) -> Body:
    """Return ``item`` with the fields that the handlers read."""
    metadata = mapping(item, "metadata")
    label = {names.LABEL_POOL: mapping(metadata, "labels").get(names.LABEL_POOL)}
    kept = {name: metadata[name] for name in _KEPT if name in metadata}
    connected = mapping(metadata, "annotations").get(names.ANNOTATION_CONNECTED)
    if connected is not None:
        kept["annotations"] = {names.ANNOTATION_CONNECTED: connected}
    return {"metadata": {**kept, "labels": label}}


def tracing(answered: Answered) -> aiohttp.TraceConfig:
    """Return a trace configuration that calls ``answered`` for each response to a GET."""

    async def ended(
        session: aiohttp.ClientSession,
        context: SimpleNamespace,
        request: aiohttp.TraceRequestEndParams,
    ) -> None:
        if request.method.upper() != "GET" or request.response.status in _PASSING_ERRORS:
            return
        what, response = _request_name(request), request.response
        if response.status < 400:
            answered(what, None)
            return
        try:
            # aiohttp keeps the body, so kopf can read it again.
            limited_document_of(response.status, response.headers, await response.read(), what)
        except ApiError as error:
            answered(what, error)

    trace = aiohttp.TraceConfig()
    trace.on_request_end.append(ended)
    return trace


def _request_name(request: aiohttp.TraceRequestEndParams) -> str:
    """Return the verb, the resource and the namespace, for example ``watch pods in team``."""
    path = request.url.path
    before, namespace, plural = ["", "", *path.split("/")][-3:]
    if plural not in [resource.plural for resource in WATCHED]:
        return f"get {path}"  # kopf first reads which resources there are
    verb = "watch" if request.url.query.get("watch") == "true" else "list"
    return f"{verb} {plural} in {namespace}" if before == "namespaces" else f"{verb} {plural}"


# -- kopf

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
TOGETHER = 0.02
"""Seconds for which events are collected before they go to the operator's loop together."""
END_WAIT = 4.0
"""Seconds that kopf has to end.  After that the process ends without it: the thread is a daemon."""

Notice = Callable[[Key, str, int], None]
"""Called with the key, uid and generation (-1: deleted) of a pool that changed."""

Renewed = Callable[[str, str, str, int | None], None]
"""Called with the namespace, name and resourceVersion (empty: deleted) of a Lease that changed, and
with the number of agents that its master has, if the Lease says so."""

Configure = Callable[[], Awaitable[Configuration]]
"""Returns the address and the login of the API server.  Called again when a login has expired."""

_IDENTITY: Any = "fiber-operator"
"""Name of this process for kopf.  By default kopf asks for the user's name, and the user of a
container may have none."""


class _EndlessDelays:
    """Delays between attempts of kopf's requests; they never end, so no outage ends kopf."""

    def __iter__(self) -> Iterator[float]:
        yield from (0.5, 1, 2)
        while True:
            yield 5


class _EmptyStorage(kopf.DiffBaseStorage):
    """Storage of earlier states of objects that stays empty, so that kopf compares no states."""

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
    """Return kopf's handlers, which pass events to ``notice`` and ``renewed``.

    Each session that kopf logs in is appended to ``sessions``.
    """
    handlers = kopf.OperatorRegistry()

    @kopf.on.login(registry=handlers)
    async def login(**_: Any) -> kopf.AiohttpSession:
        configuration = await configure()
        sessions.append(await open_watch_session(configuration, tracing(answered)))
        return kopf.AiohttpSession(server=str(configuration.host), aiohttp_session=sessions[-1])

    @kopf.on.event(POOLS.api_version, POOLS.plural, registry=handlers)
    async def pool_event(type: str | None, body: Mapping[str, Any], **_: Any) -> None:
        metadata = mapping(body, "metadata")
        key = Key(text(metadata.get("namespace")), text(metadata.get("name")))
        generation = -1 if type == "DELETED" else whole(metadata.get("generation"), -1)
        notice(key, text(metadata.get("uid")), generation)

    @kopf.on.event(LEASES.api_version, LEASES.plural, registry=handlers)
    async def lease_event(type: str | None, body: Mapping[str, Any], **_: Any) -> None:
        metadata = mapping(body, "metadata")
        version = "" if type == "DELETED" else text(metadata.get("resourceVersion"))
        namespace, name = text(metadata.get("namespace")), text(metadata.get("name"))
        renewed(namespace, name, version, connected_in(body))

    return handlers


def kopf_settings() -> kopf.OperatorSettings:
    """Return settings by which kopf only watches."""
    settings = kopf.OperatorSettings()
    settings.scanning.disabled = True
    settings.peering.standalone = True
    settings.posting.enabled = False
    settings.persistence.diffbase_storage = _EmptyStorage()
    settings.persistence.consistency_timeout = 0
    settings.networking.error_backoffs = _EndlessDelays()
    settings.networking.request_timeout = 30
    settings.networking.connect_timeout = 5
    # The server ends a watch after 240 s.  If it does not, or sends nothing, the client ends it.
    settings.watching.server_timeout = 240
    settings.watching.client_timeout = 300
    settings.watching.connect_timeout = 5
    settings.watching.inactivity_timeout = 90
    settings.watching.chunk_size = PAGE
    # Other programs have Leases too, and each node has one.  The label selects those of masters.
    settings.watching.label_selectors[LEASES.api_version, LEASES.plural] = names.LABEL_POOL_UID
    # kopf keeps a task for each object for this long.  A thousand Leases would take memory.
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
    """Run kopf until ``stop`` is set, and start it again when it ends.  Call this in kopf's loop.

    ``gate`` returns when the API server serves pools.  kopf must not start earlier, because it
    looks for the resource type only once.  ``on_start`` is called with True when kopf starts and
    with False when it ends.  ``answered`` is called with the result of each list and watch.
    """
    pause = FIRST_PAUSE
    loop = asyncio.get_running_loop()
    while not stop.is_set():
        await _run_unless(stop, gate())
        if stop.is_set():
            return
        started, sessions = loop.time(), list[aiohttp.ClientSession]()
        on_start(True)
        try:
            handlers = registry(notice, renewed, configure, answered, sessions)
            await _run_kopf(handlers, namespaces, stop)
        finally:
            on_start(False)
            # kopf leaves its sessions open when it ends with an error.
            await asyncio.gather(*(session.close() for session in sessions))
        pause = FIRST_PAUSE if loop.time() - started > LONGEST_PAUSE else pause
        await _run_unless(stop, asyncio.sleep(pause))
        pause = min(2 * pause, LONGEST_PAUSE)


async def _run_kopf(
    handlers: kopf.OperatorRegistry, namespaces: Collection[str], stop: asyncio.Event
) -> None:
    """Run kopf until it ends, and cancel the tasks that it leaves behind.

    kopf loses a cancellation that arrives while a watch ends by itself, and then waits for that
    watch forever.  So from the begin of its cleanup kopf has a limited time to end.
    """
    cleaning_up = asyncio.Event()

    @kopf.on.cleanup(registry=handlers)
    async def cleanup(**_: Any) -> None:
        cleaning_up.set()

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
    signals = [asyncio.ensure_future(event.wait()) for event in (cleaning_up, stop)]
    try:
        await asyncio.wait([operator, *signals], return_when=asyncio.FIRST_COMPLETED)
        await asyncio.wait([operator], timeout=END_WAIT / 2)
    finally:
        await _end_tasks(asyncio.all_tasks() - before)
    if not stop.is_set():
        # kopf has logged the traceback.
        error = None if operator.cancelled() else operator.exception()
        log.warning("kopf ended (%r) and is started again", error)


async def _end_tasks(tasks: set[asyncio.Task[Any]]) -> None:
    for _ in range(10):
        for task in tasks:
            task.cancel()
        if tasks:
            _, tasks = await asyncio.wait(tasks, timeout=END_WAIT / 10)


async def _run_unless(stop: asyncio.Event, awaitable: Awaitable[None]) -> None:
    """Await ``awaitable``, and cancel it if ``stop`` is set first."""
    task, stopped = asyncio.ensure_future(awaitable), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait([task, stopped], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
    finally:
        task.cancel()
        stopped.cancel()
        await asyncio.gather(task, stopped, return_exceptions=True)


class KopfThread:
    """Thread that runs ``watch`` in a loop for kopf alone.

    The callbacks run in the operator's loop, which is the one that made this object.
    """

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
        self._operator_loop = asyncio.get_running_loop()
        self._notice = notice
        self._renewed = renewed
        self._configure = configure
        self._namespaces = namespaces
        self._gate = gate
        self._on_start = on_start
        self._answered = answered
        self._events: collections.deque[Callable[[], None]] = collections.deque()
        self._kopf_loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()
        self._stopping = threading.Event()
        self._ended: asyncio.Future[None] = self._operator_loop.create_future()
        self._thread = threading.Thread(target=self._run, name="watches", daemon=True)

    async def run(self) -> None:
        """Watch until cancelled.  Raises the error of ``watch`` if it has a bug."""
        self._thread.start()
        try:
            await self._ended
        finally:
            self._stopping.set()
            try:
                if self._kopf_loop is not None:
                    self._kopf_loop.call_soon_threadsafe(self._stop.set)
            except RuntimeError:
                pass  # kopf's loop has ended already
            await asyncio.shield(asyncio.to_thread(self._thread.join, END_WAIT))

    def _run(self) -> None:
        error: BaseException = RuntimeError("the watches ended before the operator")
        try:
            with asyncio.Runner() as runner:
                self._kopf_loop = runner.get_loop()
                if not self._stopping.is_set():
                    runner.run(self._watch())
        except BaseException as raised:
            error = raised
        self._call_operator(self._end, error)

    def _end(self, error: BaseException) -> None:
        if not self._ended.done():
            self._ended.set_exception(error)

    async def _watch(self) -> None:
        await watch(
            functools.partial(self._add_event, self._notice),
            renewed=functools.partial(self._add_event, self._renewed),
            configure=self._configure,
            namespaces=self._namespaces,
            gate=self._wait_for_gate,
            on_start=functools.partial(self._call_operator, self._on_start),
            answered=functools.partial(self._call_operator, self._answered),
            stop=self._stop,
        )

    def _add_event(self, listener: Callable[..., None], *event: object) -> None:
        self._events.append(functools.partial(listener, *event))
        # A wake-up of the other loop costs more than an event.  So one wake-up delivers all events
        # of TOGETHER seconds.
        if len(self._events) == 1 and self._kopf_loop is not None:
            self._kopf_loop.call_later(TOGETHER, self._call_operator, self._deliver_events)

    def _deliver_events(self) -> None:
        while self._events:
            deliver = self._events.popleft()
            try:
                deliver()
            except Exception:
                # Deliver the other events: ``_add_event`` asks for a delivery only if none waits.
                log.exception("the handling of an event failed")

    def _call_operator(self, function: Callable[..., None], *arguments: object) -> None:
        try:
            self._operator_loop.call_soon_threadsafe(function, *arguments)
        except RuntimeError:
            pass  # the operator is ending

    async def _wait_for_gate(self) -> None:
        coroutine = self._gate()
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(coroutine, self._operator_loop))
