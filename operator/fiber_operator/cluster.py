"""Client of the API server: JSON documents go in and come out; nothing is cached.

A call that ends in ``Transient`` may have been carried out.  The client never retries: the caller
plans again, because a request that was right a minute ago may be wrong now.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, TypeVar

import aiohttp
from kubernetes.aio import config
from kubernetes.aio.client.api_client import ApiClient
from kubernetes.aio.client.configuration import Configuration
from kubernetes.aio.client.rest import RESTClientObject, RESTResponse

from fiber_api.rest import (
    ApiError,
    Body,
    Expired,
    NotServed,
    ResourceType,
    ServerUnreachable,
    Transient,
    Unauthorized,
    event_of,
)
from fiber_operator.responses import (
    METADATA,
    METADATA_LIST,
    PIECE,
    ListReader,
    limited_document_of,
    object_of,
)

__all__ = [
    "Cluster",
    "Configuration",
    "Permit",
    "load_configuration",
    "open_session",
]

T = TypeVar("T")
Observer = Callable[[str, str, str, float], None]
"""Called after each call with verb, resource, HTTP status or kind of failure, and seconds."""
Permit = Callable[[], float]

MAY_PASS = (Transient, Unauthorized, NotServed)
"""Errors after which the same call may succeed.  The token of an account is read again each minute,
and the chart may install the definition of FiberPools just now."""

PAGE = 500
"""Objects in a page of a list."""

READ_TIMEOUT = 30.0
WATCH_SECONDS = 240
"""Seconds after which the API server ends a watch."""
WATCH_TIMEOUT = 300.0
"""Seconds after which this client ends a watch that the API server has not ended."""
SILENCE = 90.0
"""Seconds without a byte after which a watch is taken for dead.  A bookmark comes each minute."""
WRITE_TIMEOUT = 10.0
"""Longest time of a write, so that it has ended before another operator may begin."""
CONNECT_TIMEOUT = 5.0

_MERGE_PATCH = "application/merge-patch+json"
_JSON = "application/json"
_METADATA_OF_ONE = f"{_JSON};as={METADATA};g=meta.k8s.io;v=v1"
_METADATA = f"{_JSON};as={METADATA_LIST};g=meta.k8s.io;v=v1"


async def _document(response: RESTResponse, what: str) -> Body:
    return limited_document_of(response.status, response.headers, await response.read(), what)


async def _success(response: RESTResponse, what: str) -> None:
    """Raise the error of a response that is no success; do not decode the others."""
    data = await response.read()
    if not 200 <= response.status < 300:
        limited_document_of(response.status, response.headers, data, what)


class Cluster:
    """Client of one API server.

    ``permit`` is called before each write.  It returns how many seconds the write may take, and
    raises if this process may not write now.  ``connections`` limits the calls at the same time;
    namespaces take turns for them.
    """

    def __init__(
        self,
        configuration: Configuration,
        *,
        connections: int,
        permit: Permit = lambda: WRITE_TIMEOUT,
        observe: Observer = lambda verb, resource, code, seconds: None,
    ) -> None:
        configuration.connection_pool_maxsize = connections
        # Looking for proxies and .netrc would cost two turns of a thread for each call.  A proxy
        # for the API server is in the kubeconfig.
        configuration.client_session_kwargs = {"trust_env": False}
        self._client = ApiClient(configuration)
        self._client.user_agent = "fiber-operator"
        self._turns = NamespaceSemaphore(connections)
        self._permit = permit
        self._observe = observe

    async def close(self) -> None:
        """Close the connections."""
        await self._client.close()

    def check_permit(self) -> None:
        """Raise the error of ``permit`` if this process may not write now."""
        self._permit()

    async def read(
        self, resource: ResourceType, namespace: str, name: str, *, only_metadata: bool = False
    ) -> Body:
        """Return the current object, not one from a cache."""
        accept = _METADATA_OF_ONE if only_metadata else _JSON
        answer = await self._call("get", resource, namespace, name, accept=accept)
        return object_of(answer, name, f"get {resource.plural} {name}")

    async def list_metadata(
        self, resource: ResourceType, namespace: str | None, keep: Callable[[Body], T]
    ) -> list[T]:
        """Return the results of ``keep`` for each object's metadata, which are read in pages."""
        kept: list[T] = []

        def take(item: Body) -> None:
            kept.append(keep(item))

        try:
            await self._pages(resource, namespace, take, {"limit": str(PAGE)}, _METADATA)
        except Expired:
            # The request for the next page came too late.  A list without pages cannot be too late.
            kept.clear()
            await self._pages(resource, namespace, take, {}, _METADATA)
        return kept

    async def _pages(
        self,
        resource: ResourceType,
        namespace: str | None,
        take: Callable[[Body], object],
        query: dict[str, str],
        accept: str,
    ) -> str:
        """Call ``take`` with each object; return the version of the list."""

        async def read(response: RESTResponse, what: str) -> tuple[str, str]:
            if not 200 <= response.status < 300:
                await _document(response, what)  # raises what the status means
            listing = ListReader(response.response.content.iter_chunked(PIECE), what)
            async for item in listing:
                take(item)
            return listing.more(), listing.version()

        while True:
            more, version = await self._call(
                "list", resource, namespace, query=query, read=read, accept=accept
            )
            if not more:
                return str(version)
            query["continue"] = more

    async def list(
        self,
        resource: ResourceType,
        namespace: str | None,
        keep: Callable[[Body], T],
        *,
        selector: str = "",
        fields: str = "",
    ) -> list[T]:
        """Return what ``keep`` makes of each object (``namespace`` None: of all namespaces)."""
        kept: list[T] = []
        query = {"labelSelector": selector, "fieldSelector": fields}
        await self._pages(resource, namespace, lambda item: kept.append(keep(item)), query, _JSON)
        return kept

    async def list_all(
        self,
        resource: ResourceType,
        namespace: str | None,
        take: Callable[[Body], object],
        *,
        selector: str,
    ) -> str:
        """Call ``take`` with each object; return the version from which a watch goes on.

        In one piece: the API server answers that, and not a page, from what it has in memory, once
        it has made sure that this is the newest.  It need not read and decode all of a namespace
        for the few objects that are selected.
        """
        return await self._pages(resource, namespace, take, {"labelSelector": selector}, _JSON)

    async def watch(
        self,
        resource: ResourceType,
        namespace: str | None,
        take: Callable[[str, Body], object],
        *,
        selector: str,
        version: str,
        opened: Callable[[], object],
    ) -> None:
        """Call ``take`` with the type and the object of each event, until the watch ends.

        ``opened`` is called once the API server has accepted the watch.  A version that the API
        server has forgotten raises ``Expired``.
        """
        query = {
            "watch": "true",
            "labelSelector": selector,
            "resourceVersion": version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": str(WATCH_SECONDS),
        }

        async def read(response: RESTResponse, what: str) -> None:
            if not 200 <= response.status < 300:
                await _document(response, what)  # raises what the status means
            opened()
            rest = b""
            async for piece in response.response.content.iter_any():
                *lines, rest = (rest + piece).split(b"\n")
                for line in lines:
                    take(*event_of(line, what))

        await self._call("watch", resource, namespace, query=query, read=read)

    async def create(
        self, resource: ResourceType, namespace: str, body: Body, *, dry_run: bool = False
    ) -> Body:
        """Create the object, and return it as the API server has stored it.

        A dry run stores nothing, and is refused for unknown fields, which the API server would
        otherwise drop in silence.
        """
        query = {"dryRun": "All", "fieldValidation": "Strict"} if dry_run else {}
        answer = await self._call("create", resource, namespace, query=query, body=body)
        return object_of(answer, body["metadata"]["name"], f"create {resource.plural}")

    async def replace(self, resource: ResourceType, namespace: str, name: str, body: Body) -> Body:
        """Replace the object; Conflict if ``metadata.resourceVersion`` is not its current one."""
        answer = await self._call("update", resource, namespace, name, body=body)
        return object_of(answer, name, f"update {resource.plural} {name}")

    async def patch(
        self, resource: ResourceType, namespace: str, name: str, patch: Body, subresource: str = ""
    ) -> Body:
        """Apply a JSON merge patch: None removes a field, a list replaces a list."""
        answer = await self._call(
            "patch", resource, namespace, name, subresource=subresource, body=patch
        )
        return object_of(answer, name, f"patch {resource.plural} {name}")

    async def delete(
        self,
        resource: ResourceType,
        namespace: str,
        name: str,
        *,
        uid: str,
        resource_version: str | None = None,
    ) -> None:
        """Delete the object with this uid; Conflict if it is another or has changed."""
        preconditions = {"uid": uid, "resourceVersion": resource_version}
        options: Body = {
            "apiVersion": "v1",
            "kind": "DeleteOptions",
            "preconditions": {key: value for key, value in preconditions.items() if value},
            "propagationPolicy": "Background",
        }
        await self._call("delete", resource, namespace, name, body=options, read=_success)

    async def _call(
        self,
        verb: str,
        resource: ResourceType,
        namespace: str | None,
        name: str = "",
        *,
        subresource: str = "",
        query: Mapping[str, str] | None = None,
        body: Body | None = None,
        read: Callable[[RESTResponse, str], Awaitable[Any]] = _document,
        accept: str = _JSON,
    ) -> Any:
        path = resource.path(namespace, name, subresource)
        shown = f"{resource.plural}/{subresource}" if subresource else resource.plural
        what = f"{verb} {shown} {name}".rstrip() + (f" in {namespace}" if namespace else "")
        async with self._turns.take(namespace or ""):
            seconds = WATCH_TIMEOUT if verb == "watch" else READ_TIMEOUT
            if verb in _WRITES:
                seconds = min(WRITE_TIMEOUT, self._permit())
            started = time.perf_counter()
            code = "cancelled"
            try:
                response = await self._send(verb, path, query or {}, body, accept, seconds)
                code = str(response.status)
                try:
                    return await read(response, what)
                finally:
                    response.response.close()
            except (TimeoutError, aiohttp.ClientError, OSError) as error:
                # A TimeoutError has no message.
                code = "timeout" if isinstance(error, TimeoutError) else "connection"
                raise ServerUnreachable(str(error) or "no answer in time", what=what) from error
            except ApiError as error:
                code = code if error.status else "garbage"
                raise
            finally:
                self._observe(verb, shown, code, time.perf_counter() - started)

    async def _send(
        self,
        verb: str,
        path: str,
        query: Mapping[str, str],
        body: Body | None,
        accept: str,
        seconds: float,
    ) -> RESTResponse:
        headers = {"Accept": accept}
        if body is not None:
            headers["Content-Type"] = _MERGE_PATCH if verb == "patch" else _JSON
        # The body is not passed: it is JSON already, and the client would search it for models.
        method, url, headers, _, _ = await self._client.param_serialize(
            _METHODS[verb],
            path,
            query_params=[(key, value) for key, value in query.items() if value],
            header_params=headers,
            auth_settings=["BearerToken"],
        )
        timeout = aiohttp.ClientTimeout(
            total=seconds, sock_connect=CONNECT_TIMEOUT, sock_read=SILENCE
        )
        return await self._client.call_api(method, url, headers, body, _request_timeout=timeout)


_METHODS = {
    "get": "GET",
    "list": "GET",
    "watch": "GET",
    "create": "POST",
    "update": "PUT",
    "patch": "PATCH",
    "delete": "DELETE",
}
_WRITES = {"create", "update", "patch", "delete"}


async def load_configuration() -> Configuration:
    """Load address and login of the API server from KUBECONFIG, else from the pod's account."""
    configuration = Configuration()
    file = os.environ.get("KUBECONFIG")
    if not file and "KUBERNETES_SERVICE_HOST" in os.environ:
        config.load_incluster_config(configuration)
    else:
        await config.load_kube_config(
            config_file=file or None, client_configuration=configuration, persist_config=False
        )
    return configuration


async def open_session(configuration: Configuration, **options: Any) -> aiohttp.ClientSession:
    """Open a session with this login for another client; ``options`` are aiohttp's."""
    token = await configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
    tls = RESTClientObject(configuration).ssl_context
    return aiohttp.ClientSession(
        connector=aiohttp.TCPConnector(limit=0, ssl=tls),
        headers={"Authorization": token} if token else None,
        proxy=configuration.proxy,
        **options,
    )


# -- Turns of namespaces


class NamespaceSemaphore:
    """Semaphore of ``places`` for which namespaces take turns.

    A namespace that wants a thousand places does not make another namespace wait for all of them.
    """

    def __init__(self, places: int) -> None:
        self._free = places
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()
        """Waiting tasks by namespace, in the order of the namespaces' turns."""

    @contextlib.asynccontextmanager
    async def take(self, namespace: str) -> AsyncIterator[None]:
        """Hold a place."""
        await self._acquire(namespace)
        try:
            yield
        finally:
            self._release()

    async def _acquire(self, namespace: str) -> None:
        if self._free:
            self._free -= 1
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(namespace, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._release()  # the place was assigned just before
            raise

    def _release(self) -> None:
        while self._waiting:
            namespace, turns = self._waiting.popitem(last=False)
            turn = turns.popleft()
            if turns:
                self._waiting[namespace] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1
