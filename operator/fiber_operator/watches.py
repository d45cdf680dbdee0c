"""Sources of the work queue: kopf's watches, and a resync that lists all pools regularly.

kopf keeps watches alive: it lists, watches, and starts again after status 410, bookmarks and
silence.  Only that is used.  Its change detection would write annotations and finalizers on users'
objects, its indices keep objects that were deleted during a 410, and its handlers are not retried
when they fail.  So all handlers are ``on.event`` handlers, which put the name of a pool into the
queue or report that a Lease has changed.

kopf takes over the event loop that it runs in and cancels the tasks it finds there, so it has a
separate thread and loop.  When kopf ends, for example because of a garbled response or a
deleted resource type, it is started again as soon as the pools can be listed.

The watches ask for the metadata of objects only.  Of each listed object only the fields that the
handlers read are kept.  kopf retries forever without a report, so its requests are observed: an
operator that lacks the right to watch is not ready and says which right it lacks.
"""

from __future__ import annotations

import asyncio
import collections
import functools
import logging
import threading
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import aiohttp
import kopf

from fiber_api import names
from fiber_operator.cluster import LEASES, PAGE, PODS, POOLS, Cluster, Configuration, open_session
from fiber_operator.lease_monitor import connected_in
from fiber_operator.logs import about
from fiber_operator.planning.documents import mapping, text, whole
from fiber_operator.responses import (
    METADATA,
    METADATA_LIST,
    PIECE,
    ApiError,
    Body,
    ListReader,
    complaint,
    document_of,
)
from fiber_operator.workqueue import Key, WorkQueue

log = logging.getLogger(__name__)


WATCHED = (POOLS, LEASES)

_KEPT = ("namespace", "name", "uid", "generation", "resourceVersion")


async def open_watch_session(
    configuration: Configuration, trace: aiohttp.TraceConfig
) -> aiohttp.ClientSession:
    """Open the session, logged in; ``trace`` sees each request."""
    return await open_session(
        configuration,
        trace_configs=[trace],
        middlewares=[_ask_for_metadata],
        response_class=_Answer,
    )


async def _ask_for_metadata(
    request: aiohttp.ClientRequest, handler: aiohttp.ClientHandlerType
) -> aiohttp.ClientResponse:
    if request.url.name in {resource.plural for resource in WATCHED}:
        watch = request.url.query.get("watch") == "true"
        kind = METADATA if watch else METADATA_LIST
        request.headers["Accept"] = f"application/json;as={kind};g=meta.k8s.io;v=v1"
    return await handler(request)


class _Answer(aiohttp.ClientResponse):
    """An answer whose JSON is read object by object if it is a list of metadata."""

    async def json(self, **options: Any) -> Any:
        accept = self.request_info.headers.get("Accept", "")
        if self.status >= 400 or METADATA_LIST not in accept:
            return await super().json(**options)
        listing = ListReader(self.content.iter_chunked(PIECE), f"list {self.url.name}")
        items = [_brief(item) async for item in listing]
        return {**listing.rest, "items": items}


def _brief(item: Body) -> Body:
    metadata = mapping(item, "metadata")
    label = {names.LABEL_POOL: mapping(metadata, "labels").get(names.LABEL_POOL)}
    kept = {name: metadata[name] for name in _KEPT if name in metadata}
    said = mapping(metadata, "annotations").get(names.ANNOTATION_CONNECTED)
    if said is not None:
        kept["annotations"] = {names.ANNOTATION_CONNECTED: said}
    return {"metadata": {**kept, "labels": label}}


# -- State of the watches

Answered = Callable[[str, ApiError | None], None]
"""Told of an answer: what was asked (``watch pods in team``) and why that failed, if it did."""

_PASSES = frozenset({401, 410})
"""A login that has expired and a watch that is too old: both are begun anew at once."""


class WatchStatus:
    """State of the watches.  ``namespaces``: the watched namespaces; empty: all."""

    def __init__(self, namespaces: Sequence[str]) -> None:
        self._needed = [
            f"watch {resource.plural}{where}"
            for where in ([f" in {namespace}" for namespace in namespaces] or [""])
            for resource in (*WATCHED, PODS)
        ]
        self._running = False
        self._open: set[str] = set()
        self._failures: dict[str, str] = {}

    def started(self, running: bool) -> None:
        """kopf begins to watch, or ends."""
        self._running = running
        # The informer watches the pods, and goes on.
        self._open = {what for what in self._open if what.startswith(f"watch {PODS.plural}")}

    def answered(self, what: str, error: ApiError | None) -> None:
        """A list or a watch was answered."""
        if error is None:
            self._open.add(what)
            if self._failures.pop(what, None):
                log.info("%s works again", what)
            return
        failure = complaint(error)
        if self._failures.get(what) != failure:
            log.warning("changes are not seen: %s", failure)
        self._failures[what] = failure

    def wrong(self) -> list[str]:
        """Why changes are not seen, or late, a sentence each."""
        wrong = [f"changes are not seen: {failure}" for failure in self._failures.values()]
        if not self._running:
            wrong.append("nothing is watched: changes are seen late")
        elif not wrong:
            missing = [what for what in self._needed if what not in self._open]
            wrong += [f"changes are seen late: {what} has not begun yet" for what in missing]
        return wrong


def tracing(answered: Answered) -> aiohttp.TraceConfig:
    """Makes a session tell of each answer to a GET."""

    async def ended(
        session: aiohttp.ClientSession,
        context: SimpleNamespace,
        request: aiohttp.TraceRequestEndParams,
    ) -> None:
        if request.method.upper() != "GET" or request.response.status in _PASSES:
            return
        what, response = _asked(request), request.response
        if response.status < 400:
            answered(what, None)
            return
        try:
            # It is kept, so that the caller reads it too.
            document_of(response.status, response.headers, await response.read(), what)
        except ApiError as error:
            answered(what, error)

    trace = aiohttp.TraceConfig()
    trace.on_request_end.append(ended)
    return trace


def _asked(request: aiohttp.TraceRequestEndParams) -> str:
    path = request.url.path
    before, namespace, plural = ["", "", *path.split("/")][-3:]
    if plural not in [resource.plural for resource in WATCHED]:
        return f"get {path}"  # kopf asks first what the API server serves
    verb = "watch" if request.url.query.get("watch") == "true" else "list"
    return f"{verb} {plural} in {namespace}" if before == "namespaces" else f"{verb} {plural}"


# -- kopf

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
TOGETHER = 0.02
"""Seconds for which notices are gathered before they are passed to the loop together."""
END_WAIT = 4.0
"""Seconds for kopf to end; its thread does not keep the process from ending."""

Notice = Callable[[Key, str, int], None]
"""Called with a pool that changed: its key, uid and generation (-1: it is deleted)."""

Renewed = Callable[[str, str, str, int | None], None]
"""Called with the namespace, name and resourceVersion of a Lease (empty: deleted), and with the
number of its master's agents."""

Configure = Callable[[], Awaitable[Configuration]]
"""Function that returns address and login.  It is called again when a login has expired."""

_IDENTITY: Any = "fiber-operator"
"""kopf would ask the system for the user's name, which a container's user need not have."""


class _Patience:
    """Delays between requests that fail: without end, so that no outage ends kopf."""

    def __iter__(self) -> Iterator[float]:
        yield from (0.5, 1, 2)
        while True:
            yield 5


class _NoDiffs(kopf.DiffBaseStorage):
    """Storage without contents: kopf compares no object with an earlier state of it."""

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
    """Return the handlers.  Each reports which object an event is about."""
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
    # The server ends a watch in time; if it does not, or is silent, the client does.
    settings.watching.server_timeout = 240
    settings.watching.client_timeout = 300
    settings.watching.connect_timeout = 5
    settings.watching.inactivity_timeout = 90
    settings.watching.chunk_size = PAGE
    # Of the Leases of a namespace, and every node has one somewhere, those of masters.
    settings.watching.label_selectors[LEASES] = names.LABEL_POOL_UID
    # The handlers take no time, and a task for each of a thousand Leases would take memory.
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
    """Run kopf until it ends for any reason, and end what it leaves behind.

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
        # kopf has logged it. Pools must be watched in any case: try again.
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


class KopfThread:
    """Thread that runs ``watch``.  Its callbacks run in the loop that made this object."""

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
        # To wake the other loop costs more than a notice.  So one wake-up brings all notices that
        # arrive within TOGETHER seconds.
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
            pass  # the operator is ending

    async def _pass_gate(self) -> None:
        coroutine = self._gate()
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(coroutine, self._home))


# -- Resync

RETRY = 5.0
"""Seconds until the pools are listed again where that failed."""


class Resync:
    """Lists the pools of ``namespaces`` (empty: of all) and puts them in the queue."""

    def __init__(
        self,
        cluster: Cluster,
        queue: WorkQueue,
        *,
        namespaces: tuple[str, ...],
        seconds: float,
        on_success: Callable[[], None] = lambda: None,
    ) -> None:
        self._cluster = cluster
        self._queue = queue
        self._namespaces: tuple[str | None, ...] = namespaces or (None,)
        self._seconds = seconds
        self._on_success = on_success
        self._poked = asyncio.Event()
        self._answered = asyncio.Event()
        self.failures: dict[str, str] = {}
        """Namespace (empty: all) -> why its pools cannot be listed."""
        self.tried: float | None = None
        """Time of the event loop at which the pools were last tried to be listed."""
        self.succeeded: float | None = None

    @property
    def seconds(self) -> float:
        return self._seconds

    def lists(self, namespace: str) -> bool:
        """Return True if the pools of the namespace (empty: of all) were listed the last time."""
        return self.tried is not None and namespace not in self.failures

    def poke(self) -> None:
        """List the pools now."""
        self._poked.set()

    async def answered(self) -> None:
        """List the pools now, and wait until that has succeeded somewhere: they are served."""
        self._answered.clear()
        self.poke()
        await self._answered.wait()

    async def run(self) -> None:
        """Go on until cancelled."""
        while True:
            self._poked.clear()
            for namespace in self._namespaces:
                await self._list(namespace)
            self.tried = self._now()
            if not self.failures:
                self.succeeded = self.tried
                self._on_success()
            try:
                async with asyncio.timeout(RETRY if self.failures else self._seconds):
                    await self._poked.wait()
            except TimeoutError:
                pass  # it is time again

    async def _list(self, namespace: str | None) -> None:
        where = namespace or ""
        try:
            found = await self._cluster.list_metadata(POOLS, namespace, _key)
        except ApiError as error:
            failure = complaint(error)
            if self.failures.get(where) != failure:
                log.warning("%s", failure, extra=about(where, reason=error.reason))
            self.failures[where] = failure
            return
        self.failures.pop(where, None)
        self._answered.set()
        # Pools whose deletion was missed get a last reconcile, which finds that they are gone.
        known = [key for key in self._queue.known() if namespace in (None, key.namespace)]
        for key in dict.fromkeys([key for key in found if key is not None] + known):
            self._queue.add(key)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def _key(pool: Body) -> Key | None:
    metadata = mapping(pool, "metadata")
    key = Key(text(metadata.get("namespace")), text(metadata.get("name")))
    return key if all(key) else None
