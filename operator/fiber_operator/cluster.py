"""The only door to the API server.  JSON documents go in and come out; nothing is cached.

A call that ends in ``Unavailable`` may have been carried out.  Nothing is tried again in here:
whoever asks plans anew, which is safer than a repeated request that was right a minute ago.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import aiohttp
from kubernetes.aio import config
from kubernetes.aio.client.api_client import ApiClient
from kubernetes.aio.client.configuration import Configuration
from kubernetes.aio.client.rest import RESTClientObject

from fiber_api import names
from fiber_operator.api_errors import (
    ApiError,
    Body,
    Conflict,
    Gone,
    Invalid,
    Refused,
    TooMany,
    Unavailable,
    document_of,
    object_of,
)
from fiber_operator.listing import Listing

__all__ = [
    "ApiError",
    "Body",
    "Cluster",
    "Configuration",
    "Conflict",
    "Gone",
    "Invalid",
    "Permit",
    "Refused",
    "Resource",
    "TooMany",
    "Unavailable",
    "load_configuration",
    "open_session",
]

T = TypeVar("T")
Observer = Callable[[str, str, str, float], None]
"""Told of each call: verb, resource, HTTP status or what went wrong, seconds."""
Permit = Callable[[str], float]

AT_ONCE = 200
"""Objects of a list that are read before others may go on."""

READ_TIMEOUT = 30.0
WRITE_TIMEOUT = 10.0
"""At most: a write has ended before another operator may begin."""
CONNECT_TIMEOUT = 5.0

_MERGE_PATCH = "application/merge-patch+json"


class Resource(NamedTuple):
    """A kind of object, as the API's paths name it."""

    group: str
    version: str
    plural: str

    def path(self, namespace: str | None, name: str = "", subresource: str = "") -> str:
        """The path of one object or, without a name, of all in ``namespace`` (None: in all)."""
        start = f"/apis/{self.group}/{self.version}" if self.group else f"/api/{self.version}"
        scope = f"namespaces/{namespace}" if namespace is not None else ""
        return "/".join(part for part in (start, scope, self.plural, name, subresource) if part)


POOLS = Resource(names.GROUP, names.VERSION, names.PLURAL)
PODS = Resource("", "v1", "pods")
SERVICES = Resource("", "v1", "services")
SECRETS = Resource("", "v1", "secrets")
EVENTS = Resource("", "v1", "events")
SLICES = Resource("discovery.k8s.io", "v1", "endpointslices")
LEASES = Resource("coordination.k8s.io", "v1", "leases")


class Cluster:
    """One API server.

    ``permit`` is called with the namespace before each call that changes something.  It returns how
    many seconds the call may take, and raises where this process may not.  ``connections`` bounds
    the calls under way; further ones wait for their turn.
    """

    def __init__(
        self,
        configuration: Configuration,
        *,
        connections: int,
        permit: Permit = lambda namespace: WRITE_TIMEOUT,
        observe: Observer = lambda verb, resource, code, seconds: None,
    ) -> None:
        configuration.connection_pool_maxsize = connections
        # Looking for proxies and .netrc costs two turns of a thread for each call; a proxy that
        # the API server needs stands in the kubeconfig.
        configuration.client_session_kwargs = {"trust_env": False}
        self._client = ApiClient(configuration)
        self._client.user_agent = "fiber-operator"
        self._turns = asyncio.Semaphore(connections)
        self._permit = permit
        self._observe = observe

    async def close(self) -> None:
        """Close the connections."""
        await self._client.close()

    def check_permit(self, namespace: str) -> None:
        """Raise what ``permit`` does where this process may change nothing now."""
        self._permit(namespace)

    async def read(self, resource: Resource, namespace: str, name: str) -> Body:
        """The object as it is now, not as a cache had it."""
        answer = await self._call("get", resource, namespace, name)
        return object_of(answer, name, f"get {resource.plural} {name}")

    async def list(
        self,
        resource: Resource,
        namespace: str | None,
        keep: Callable[[Body], T],
        *,
        selector: str = "",
        fields: str = "",
    ) -> list[T]:
        """What ``keep`` makes of each object there is now (``namespace`` None: anywhere).

        In one piece, as the API server answers that, and not a list in pages, from what it has in
        memory, once it has made sure that this is the newest: it need not read and decode all of
        a namespace for the few objects that are selected.
        """
        kept: list[T] = []
        query = {"labelSelector": selector, "fieldSelector": fields}
        while True:
            listing = await self._call("list", resource, namespace, query=query, read=_listing)
            for item in listing:
                kept.append(keep(item))
                if len(kept) % AT_ONCE == 0:
                    await asyncio.sleep(0)
            if not listing.more():
                return kept
            query["continue"] = listing.more()

    async def create(
        self, resource: Resource, namespace: str, body: Body, *, dry_run: bool = False
    ) -> Body:
        """Create the object; the answer is what it became.

        A dry run makes nothing and is refused for fields that the API server does not know, which
        it would else drop in silence.
        """
        query = {"dryRun": "All", "fieldValidation": "Strict"} if dry_run else {}
        answer = await self._call("create", resource, namespace, query=query, body=body)
        return object_of(answer, body["metadata"]["name"], f"create {resource.plural}")

    async def replace(self, resource: Resource, namespace: str, name: str, body: Body) -> Body:
        """Replace the object; Conflict if ``metadata.resourceVersion`` is not its current one."""
        answer = await self._call("update", resource, namespace, name, body=body)
        return object_of(answer, name, f"update {resource.plural} {name}")

    async def patch(
        self, resource: Resource, namespace: str, name: str, patch: Body, subresource: str = ""
    ) -> Body:
        """A JSON merge patch: None removes a field, a list replaces the list."""
        answer = await self._call(
            "patch", resource, namespace, name, subresource=subresource, body=patch
        )
        return object_of(answer, name, f"patch {resource.plural} {name}")

    async def delete(
        self,
        resource: Resource,
        namespace: str,
        name: str,
        *,
        uid: str,
        resource_version: str | None = None,
    ) -> None:
        """Delete this very object; Conflict if another has its name, or it changed since."""
        preconditions = {"uid": uid, "resourceVersion": resource_version}
        options: Body = {
            "apiVersion": "v1",
            "kind": "DeleteOptions",
            "preconditions": {key: value for key, value in preconditions.items() if value},
            "propagationPolicy": "Background",
        }
        await self._call("delete", resource, namespace, name, body=options)

    async def _call(
        self,
        verb: str,
        resource: Resource,
        namespace: str | None,
        name: str = "",
        *,
        subresource: str = "",
        query: Mapping[str, str] | None = None,
        body: Body | None = None,
        read: Callable[[int, Mapping[str, str], bytes, str], Any] = document_of,
    ) -> Any:
        path = resource.path(namespace, name, subresource)
        shown = f"{resource.plural}/{subresource}" if subresource else resource.plural
        what = f"{verb} {shown} {name}".rstrip() + (f" in {namespace}" if namespace else "")
        async with self._turns:
            seconds = READ_TIMEOUT
            if verb in _WRITES:
                seconds = min(WRITE_TIMEOUT, self._permit(namespace or ""))
            started = time.perf_counter()
            code = "cancelled"
            try:
                status, headers, data = await self._send(verb, path, query or {}, body, seconds)
                code = str(status)
                return read(status, headers, data, what)
            except (TimeoutError, aiohttp.ClientError, OSError) as error:
                # A TimeoutError says nothing of its own.
                code = "timeout" if isinstance(error, TimeoutError) else "connection"
                raise Unavailable(str(error) or "no answer in time", what=what) from error
            except Unavailable as error:
                code = code if error.status else "garbage"
                raise
            finally:
                self._observe(verb, shown, code, time.perf_counter() - started)

    async def _send(
        self, verb: str, path: str, query: Mapping[str, str], body: Body | None, seconds: float
    ) -> tuple[int, Mapping[str, str], bytes]:
        headers = {"Accept": "application/json"}
        if body is not None:
            headers["Content-Type"] = _MERGE_PATCH if verb == "patch" else "application/json"
        # Without the body: it is JSON already and need not be walked through for models.
        method, url, headers, _, _ = await self._client.param_serialize(
            _METHODS[verb],
            path,
            query_params=[(key, value) for key, value in query.items() if value],
            header_params=headers,
            auth_settings=["BearerToken"],
        )
        timeout = aiohttp.ClientTimeout(total=seconds, sock_connect=CONNECT_TIMEOUT)
        response = await self._client.call_api(method, url, headers, body, _request_timeout=timeout)
        data = await response.read()
        return response.status, response.headers, data


def _listing(status: int, headers: Mapping[str, str], data: bytes, what: str) -> Listing:
    if not 200 <= status < 300:
        document_of(status, headers, data, what)  # raises what it means
    return Listing(data, what)


_METHODS = {
    "get": "GET",
    "list": "GET",
    "create": "POST",
    "update": "PUT",
    "patch": "PATCH",
    "delete": "DELETE",
}
_WRITES = {"create", "update", "patch", "delete"}


async def load_configuration() -> Configuration:
    """Where the API server is and how to log in: KUBECONFIG, else the pod's own account."""
    configuration = Configuration()
    file = os.environ.get("KUBECONFIG")
    if not file and "KUBERNETES_SERVICE_HOST" in os.environ:
        config.load_incluster_config(configuration)
    else:
        await config.load_kube_config(
            config_file=file or None, client_configuration=configuration, persist_config=False
        )
    return configuration


async def open_session(
    configuration: Configuration, trace: aiohttp.TraceConfig
) -> aiohttp.ClientSession:
    """A session that is logged in, for whoever has a client of his own.

    A watch brings the metadata alone, which say whose an object is.
    """
    token = await configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
    tls = RESTClientObject(configuration).ssl_context
    return aiohttp.ClientSession(
        connector=aiohttp.TCPConnector(limit=0, ssl=tls),
        headers={"Authorization": token} if token else None,
        proxy=configuration.proxy,
        trace_configs=[trace],
        middlewares=[_ask_for_metadata],
    )


async def _ask_for_metadata(
    request: aiohttp.ClientRequest, handler: aiohttp.ClientHandlerType
) -> aiohttp.ClientResponse:
    # Not of a list: where that is empty the API server has null for its items.
    if request.url.query.get("watch") == "true":
        kind = "PartialObjectMetadata;g=meta.k8s.io;v=v1"
        request.headers["Accept"] = f"application/json;as={kind}"
    return await handler(request)
