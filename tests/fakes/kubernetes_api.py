"""A small Kubernetes API in this process: real HTTP and JSON, watches included, and its faults.

Clients cannot tell it from an API server as far as the operator goes.  ``calls`` says what was
asked; ``faults`` are used up one by one; ``after`` is told of each call once it was carried out
and before it is answered, which is where a test ends the client to see what a restart makes of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from aiohttp import web

from fakes import server_side_apply, strict
from fakes.port_forward import PortForwards
from fakes.store import KINDS, Body, Change, Failure, Place, Store, has_fields, line, matches

BOOKMARK_SECONDS = 60.0


@dataclass(frozen=True)
class Call:
    """Request, as RBAC sees it."""

    verb: str
    plural: str
    namespace: str | None = None
    name: str = ""
    subresource: str = ""
    dry_run: bool = False


@dataclass
class Fault:
    """Fault of the next ``times`` calls of this kind, after ``skip`` good ones."""

    verb: str = ""
    plural: str = ""
    status: int = 0
    """An answer with this status; 0: the connection ends without an answer."""
    reason: str = "InternalError"
    message: str = "this is a test"
    retry_after: float | None = None
    text: str | None = None
    """Body instead of JSON, with status 200 unless ``status`` is set."""
    carried_out: bool = False
    """The call is carried out all the same."""
    late: float = 0.0
    """Seconds of delay; with no other field set, the call then succeeds."""
    times: float = 1
    skip: int = 0
    name: str = ""
    """Only calls about the object of this name."""

    def strikes(self, call: Call) -> bool:
        if (
            self.times <= 0
            or self.verb not in ("", call.verb)
            or self.plural not in ("", call.plural)
            or self.name not in ("", call.name)
        ):
            return False
        if self.skip:
            self.skip -= 1
            return False
        self.times -= 1
        return True


Subresource = Callable[[web.Request, Call], Awaitable[web.StreamResponse]]


class KubernetesApi:
    """Serves ``store`` on a port of 127.0.0.1."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.calls: list[Call] = []
        self.tokens: list[str] = []
        """Tokens of the clients that sent one."""
        self.faults: list[Fault] = []
        self.after: Callable[[Call], None] = lambda call: None
        self.page = 0
        """Largest page of a list, also if the client asks for no pages; 0: unlimited."""
        self.watch_delay = 0.0
        """Seconds between a change and its event."""
        self.largest_answer = 0
        """Bytes of the largest list, or event of a watch, that was sent."""
        self.silent = False
        """True to silence open watches: they bring no events or bookmarks, and do not end."""
        self.down = False
        """Every connection is reset, as with an API server that is gone."""
        self.accepts: set[str] | None = None
        """Values of Authorization that are let in; None: anybody."""
        self.allows: Callable[[Call], bool] = lambda call: True
        """Decision whether clients that send a token may make such a call; others may make all."""
        self.documents: dict[str, Body | None] = {}
        """Answers by path, in place of those below; None: the path is not served."""
        self.date: str | None = None
        """Header ``Date`` of these answers; None: the time of this machine."""
        self.forwards = PortForwards()
        self.subresources: dict[str, Subresource] = {}
        """Servers of GET calls about a part of an object, by the name of the part."""
        self.port = 0
        self.server: Callable[[], asyncio.Protocol]
        """Makes the protocol of a connection, for clients that need no socket."""
        self._watches: set[asyncio.Task[Any]] = set()
        self._applied: dict[Place, Body] = {}
        """Bodies that the one applying field manager has applied last."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @contextlib.asynccontextmanager
    async def serving(self, tls: ssl.SSLContext | None = None) -> AsyncIterator[KubernetesApi]:
        application = web.Application(client_max_size=2**24)
        application.router.add_route("*", "/{path:.*}", self._serve)
        runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.1)
        await runner.setup()
        assert runner.server is not None
        self.server = runner.server
        site = web.TCPSite(runner, "127.0.0.1", self.port, ssl_context=tls)
        await site.start()
        self.port = runner.addresses[0][1]
        try:
            yield self
        finally:
            self.drop_watches()
            await runner.cleanup()

    def drop_watches(self) -> None:
        """End each watch in the middle, without a word."""
        for task in list(self._watches):
            task.cancel()

    def count(self, verb: str, plural: str) -> int:
        return sum(call.verb == verb and call.plural == plural for call in self.calls)

    async def _serve(self, request: web.Request) -> web.StreamResponse:
        if not self._answers():
            return _reset(request)
        about = await self._answer_without_objects(request)
        if about is not None:
            return about
        call = _parse(request)
        if call is None:
            return web.Response(status=404, text="404 page not found")
        self.calls.append(call)
        self.tokens += request.headers.getall("Authorization", [])
        if self.accepts is not None and request.headers.get("Authorization") not in self.accepts:
            return _refused(Failure(401, "Unauthorized", "Unauthorized"))
        if "Authorization" in request.headers and not self.allows(call):
            return _refused(Failure(403, "Forbidden", f"you may not {call.verb} {call.plural}"))
        fault = next((fault for fault in self.faults if fault.strikes(call)), None)
        if fault is not None and fault.late:
            await asyncio.sleep(fault.late)
        if call.verb == "watch" and (fault is None or _harmless(fault)):
            return await self._watch(request, call)
        answer = None
        if fault is None or fault.carried_out or _harmless(fault):
            answer = await self._carry_out(request, call)
            self.after(call)
        if not self._answers():
            return _reset(request)
        if fault is None or _harmless(fault):
            assert answer is not None
            return answer
        return _faulty(request, fault)

    async def _answer_without_objects(self, request: web.Request) -> web.Response | None:
        """Return the answer to a question about the API or a right; None if it is another."""
        found = self.documents.get(request.path, discovery(request.path))
        if found is None and request.path not in (_REVIEWS, *self.documents):
            return None
        if self.accepts is not None and request.headers.get("Authorization") not in self.accepts:
            return _refused(Failure(401, "Unauthorized", "Unauthorized"))
        if request.path == _REVIEWS:
            return web.json_response(self._review(await request.json()))
        if found is None:
            return web.Response(status=404, text="404 page not found")
        headers = {} if self.date is None else {"Date": self.date}
        return web.json_response(found, headers=headers)

    def _review(self, body: Body) -> Body:
        asked = body["spec"]["resourceAttributes"]
        place = (asked["verb"], asked["resource"], asked["namespace"])
        call = Call(*place, asked.get("name", ""), asked.get("subresource", ""))
        return {**body, "status": {"allowed": self.allows(call)}}

    async def _carry_out(self, request: web.Request, call: Call) -> web.StreamResponse:
        try:
            if call.verb == "get" and call.subresource in self.subresources:
                return await self.subresources[call.subresource](request, call)
            if call.subresource == "portforward":
                self.store.get(call.plural, call.namespace or "", call.name)
                return await self.forwards.serve(request)
            body = json.loads(await request.read() or b"{}")
            answer = web.json_response(self._perform(request, call, body))
        except Failure as failure:
            return _refused(failure)
        if call.verb == "list":
            self._sent(answer.body)
        return answer

    def _sent(self, data: object) -> None:
        if isinstance(data, bytes):
            self.largest_answer = max(self.largest_answer, len(data))

    def _perform(self, request: web.Request, call: Call, body: Body) -> Body:
        where = (call.plural, call.namespace or "", call.name)
        if call.verb == "list":
            return _list_as_asked(request, self._list(request, call))
        if call.verb == "get":
            return _as_asked(request, self.store.get(*where))
        if call.verb == "create":
            if request.query.get("fieldValidation") == "Strict":
                strict.check(body, call.plural)
            return self.store.create(*where[:2], body, dry_run=call.dry_run)
        if call.verb == "update":
            return self.store.update(*where, body)
        if call.verb == "patch" and request.content_type == server_side_apply.CONTENT_TYPE:
            return self._apply(where, body)
        if call.verb == "patch":
            return self.store.merge(*where, body, call.subresource)
        self.store.delete(*where, body)
        return {"kind": "Status", "apiVersion": "v1", "status": "Success"}

    def _apply(self, where: Place, body: Body) -> Body:
        answer = server_side_apply.apply(self.store, where, self._applied.get(where, {}), body)
        self._applied[where] = body
        return answer

    def _list(self, request: web.Request, call: Call) -> Body:
        items = [
            item
            for item in self.store.list(
                call.plural, call.namespace, request.query.get("labelSelector", "")
            )
            if has_fields(item, request.query.get("fieldSelector", ""))
        ]
        start = int(request.query.get("continue", "0"))
        limit = int(request.query.get("limit", "0")) or self.page or len(items)
        rest = str(start + limit) if start + limit < len(items) else ""
        version, kind = KINDS[call.plural]
        return {
            "apiVersion": version,
            "kind": f"{kind}List",
            "metadata": {"resourceVersion": self.store.version, "continue": rest},
            "items": items[start : start + limit],
        }

    async def _watch(self, request: web.Request, call: Call) -> web.StreamResponse:
        response = web.StreamResponse(headers={"Content-Type": "application/json"})
        await response.prepare(request)
        task = asyncio.ensure_future(self._stream(request, response, call))
        self._watches.add(task)
        try:
            async with asyncio.timeout(float(request.query.get("timeoutSeconds", "300"))):
                await task
        except asyncio.CancelledError:
            if not task.cancelled():
                raise
            _reset(request)
        except (TimeoutError, ConnectionError):
            pass  # it ends as a watch does
        finally:
            task.cancel()
            self._watches.discard(task)
        return response

    async def _stream(self, request: web.Request, response: web.StreamResponse, call: Call) -> None:
        seen = int(request.query.get("resourceVersion") or self.store.version)
        if seen < self.store.oldest:
            await response.write(line("ERROR", Failure(410, "Expired", "too old").body()))
            return
        selector = request.query.get("labelSelector", "")
        fields = request.query.get("fieldSelector", "")
        clock = asyncio.get_running_loop().time
        marked = clock()
        while True:
            for change in [change for change in self.store.changes if change.version > seen]:
                seen = change.version
                found = change.object
                if (
                    self._concerns(call, change)
                    and matches(found, selector)
                    and has_fields(found, fields)
                ):
                    data = line(change.type, _as_asked(request, found))
                    self._sent(data)
                    await response.write(data)
            if self.store.changes and self.store.changes[-1].version > seen:
                continue  # it came while the last ones were written
            try:
                async with asyncio.timeout_at(marked + BOOKMARK_SECONDS + self.watch_delay):
                    await self.store.changed()
                    await asyncio.sleep(self.watch_delay)
                if self.silent:
                    await asyncio.Event().wait()
            except TimeoutError:
                marked = clock()
                mark = {"kind": "Bookmark", "metadata": {"resourceVersion": str(seen)}}
                await response.write(line("BOOKMARK", mark))

    def _concerns(self, call: Call, change: Change) -> bool:
        plural, namespace, _ = change.place
        return plural == call.plural and call.namespace in (None, namespace)

    def _answers(self) -> bool:
        return not self.down


_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"
_VERBS = {"POST": "create", "PUT": "update", "PATCH": "patch", "DELETE": "delete"}


def _parse(request: web.Request) -> Call | None:
    parts = request.path.strip("/").split("/")
    parts = parts[2:] if parts[0] == "api" else parts[3:]
    namespace = None
    if len(parts) > 2 and parts[0] == "namespaces":
        namespace, parts = parts[1], parts[2:]
    if not parts or parts[0] not in KINDS:
        return None
    plural, name, subresource = (*parts, "", "")[:3]
    verb = _VERBS.get(request.method) or ("get" if name else "list")
    if request.query.get("watch") == "true":
        verb = "watch"
    return Call(verb, plural, namespace, name, subresource, request.query.get("dryRun") == "All")


def discovery(path: str) -> Body | None:
    """Return the API server's description of itself, or None if the path is about objects."""
    groups: dict[str, list[str]] = {}
    for plural, (version, _) in KINDS.items():
        groups.setdefault(version, []).append(plural)
    if path == "/version":
        return {"major": "1", "minor": "34"}
    if path == "/api":
        return {"kind": "APIVersions", "versions": ["v1"]}
    if path == "/apis":
        return {"kind": "APIGroupList", "groups": [_group(name) for name in groups if "/" in name]}
    version = path.removeprefix("/apis/").removeprefix("/api/").strip("/")
    if version not in groups:
        return None
    resources = [
        {
            "name": plural,
            "singularName": KINDS[plural][1].lower(),
            "namespaced": plural not in ("namespaces", "nodes", "customresourcedefinitions"),
            "kind": KINDS[plural][1],
            "verbs": ["create", "delete", "get", "list", "patch", "update", "watch"],
        }
        for plural in groups[version]
    ]
    return {"kind": "APIResourceList", "groupVersion": version, "resources": resources}


def _group(version: str) -> Body:
    name, short = version.split("/")
    entry = {"groupVersion": version, "version": short}
    return {"name": name, "versions": [entry], "preferredVersion": entry}


def _as_asked(request: web.Request, body: Body) -> Body:
    """The object, or its metadata alone where the client asks for that."""
    if "as=PartialObjectMetadata" not in request.headers.get("Accept", ""):
        return body
    about = {"apiVersion": "meta.k8s.io/v1", "kind": "PartialObjectMetadata"}
    return {**about, "metadata": body["metadata"]}


def _list_as_asked(request: web.Request, found: Body) -> Body:
    if "as=PartialObjectMetadataList" not in request.headers.get("Accept", ""):
        return found
    about = {"apiVersion": "meta.k8s.io/v1", "kind": "PartialObjectMetadataList"}
    # As the API server does it, an empty list of metadata has null for its items.
    items = [_as_asked(request, item) for item in found["items"]] or None
    return {**found, **about, "items": items}


def _refused(failure: Failure) -> web.Response:
    return web.json_response(failure.body(), status=failure.status)


def _harmless(fault: Fault) -> bool:
    return fault.late > 0 and not fault.status and fault.text is None and not fault.carried_out


def _faulty(request: web.Request, fault: Fault) -> web.StreamResponse:
    if not fault.status and fault.text is None:
        return _reset(request)
    headers = {} if fault.retry_after is None else {"Retry-After": str(fault.retry_after)}
    status = fault.status or 200
    if fault.text is not None:
        return web.Response(status=status, text=fault.text, headers=headers)
    failure = Failure(status, fault.reason, fault.message)
    return web.json_response(failure.body(), status=status, headers=headers)


def _reset(request: web.Request) -> web.StreamResponse:
    if request.transport is not None:
        request.transport.abort()
    return web.Response(status=500)
