"""Responses of the API server: documents, lists and errors.

Each error is one of these classes, by which a caller decides what to do::

    ApiError
    ├── Gone         404  the object does not exist
    ├── Conflict     409  the name is taken, or a precondition does not hold
    ├── Refused      403  quota, policy, or a missing right
    ├── Oversized         the answer has more values than are decoded
    ├── Invalid      400, 422 and the rest of 4xx: a retry will not help
    └── Unavailable  the outcome is not known: 5xx, no connection, timeout, a garbled answer
        └── TooMany  429  retry after ``retry_after`` seconds

``ListReader`` decodes a list one object at a time while the response arrives, so that neither the
response nor its text is in memory as a whole.  A character takes four bytes once there is an emoji
near it, and objects of a megabyte are possible.
"""

from __future__ import annotations

import asyncio
import codecs
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

Body = dict[str, Any]

LONGEST_RETRY_AFTER = 60.0
_MESSAGE_LIMIT = 2000
_STRING = re.compile(rb'"[^"]*"')


class ApiError(Exception):
    """Failed call.  ``str`` names the call and what went wrong."""

    def __init__(self, message: str, *, what: str = "", status: int = 0, reason: str = "") -> None:
        super().__init__(f"{what}: {message}" if what else message)
        self.message = message
        """Words of the API server."""
        self.call = " ".join(what.split()[:2])
        """Verb and resource as in a right: ``get secrets``."""
        self.status = status
        self.reason = reason
        """API server's word for the error, for example ``AlreadyExists``."""

    @property
    def writes(self) -> bool:
        """True if the call changes an object and therefore passes admission webhooks."""
        return not self.call.startswith(("get ", "list ", "watch "))

    def again(self) -> ApiError:
        """Return an equal error: one object that is raised twice keeps what raised it alive."""
        error = type(self).__new__(type(self), *self.args)
        vars(error).update(vars(self))
        return error


class Gone(ApiError):
    """Error of an object that does not exist."""


class Conflict(ApiError):
    """Error of a name that is taken, or of a precondition that does not hold."""


class Refused(ApiError):
    """Error of a call that a quota, a policy or a missing right forbids."""


class Invalid(ApiError):
    """Error of a call that the API server will never accept."""


class Unavailable(ApiError):
    """Error of a call without a valid response, which may have been carried out."""


class TooMany(Unavailable):
    """Error of a call that may be retried after ``retry_after`` seconds."""

    def __init__(self, message: str, *, retry_after: float, **about: Any) -> None:
        super().__init__(message, **about)
        self.retry_after = retry_after


class Oversized(ApiError):
    """The object has so many values that it is not decoded: each takes memory."""


Answered = Callable[[str, ApiError | None], None]
"""Called with the answer to a list or watch: the request (``watch pods in team``) and its error."""


def complaint(error: ApiError) -> str:
    """Return the text of an error, and the remedy if it is known."""
    if isinstance(error, Refused):
        return f"{error}. Give the operator's account this right: the chart's roles have it"
    return str(error)


MOST_VALUES = 50_000
"""Values of an object that is decoded.  A FiberPool may have a million, which take 25 times the
memory of their JSON; a long template has some hundred."""


def object_of(answer: Body, name: str, what: str) -> Body:
    """Return ``answer`` if it is the object of that name; raise ``Unavailable`` otherwise."""
    metadata = answer.get("metadata")
    if not isinstance(metadata, dict) or metadata.get("name") != name:
        raise Unavailable(f"the answer is not the object {name}", what=what)
    return answer


def document_of(status: int, headers: Mapping[str, str], data: bytes, what: str) -> Body:
    """Return the document in a response; raise ``ApiError`` if the response is no success."""
    good = 200 <= status < 300
    body = None
    if not _has_more_values(data, MOST_VALUES):
        with contextlib.suppress(ValueError, RecursionError):
            body = json.loads(data)
    elif good:
        raise Oversized(f"it has more than {MOST_VALUES} values", what=what, status=status)
    if good:
        if isinstance(body, dict):
            return body
        # The data are not shown: they may be part of a Secret.
        raise Unavailable(f"the answer is no JSON object ({len(data)} bytes)", what=what)
    raise _error(status, headers, body if isinstance(body, dict) else {}, data, what)


def _has_more_values(data: bytes, most: int) -> bool:
    if _count_values(data) <= most:
        return False
    # Text in strings does not count: a list of comma-separated names is one value.
    unescaped = data.replace(rb"\\", b"").replace(rb"\"", b"")
    return _count_values(_STRING.sub(b"", unescaped)) > most


def _count_values(data: bytes) -> int:
    # Each value but the first of its list or object has a comma before it.
    return data.count(b",") + data.count(b"[") + data.count(b"{")


def event_of(line: bytes, what: str) -> tuple[str, Body]:
    """Return the type and the object of an event of a watch; an error among them is raised."""
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        event = None
    event = event if isinstance(event, dict) else {}
    kind, body = event.get("type"), event.get("object")
    if not isinstance(kind, str) or not isinstance(body, dict):
        raise Unavailable("the answer is no event of a watch", what=what)
    if kind == "ERROR":
        code = body.get("code")
        raise _error(code if isinstance(code, int) else 500, {}, body, b"", what)
    return kind, body


def _error(status: int, headers: Mapping[str, str], body: Body, data: bytes, what: str) -> ApiError:
    message = str(body.get("message") or "") or _excerpt(data) or f"HTTP status {status}"
    about: dict[str, Any] = {
        "what": what,
        "status": status,
        "reason": str(body.get("reason") or ""),
    }
    message = message[:_MESSAGE_LIMIT]
    if status == 429:
        return TooMany(message, retry_after=_retry_after(headers), **about)
    # A response without a Status comes from a proxy, not from the API server.
    if status >= 500 or status in (401, 408, 410) or body.get("kind") != "Status":
        return Unavailable(message, **about)
    return {404: Gone, 409: Conflict, 403: Refused}.get(status, Invalid)(message, **about)


def _retry_after(headers: Mapping[str, str]) -> float:
    try:
        seconds = float(headers.get("Retry-After", ""))
    except ValueError:
        return 1.0
    return min(max(seconds, 0.1), LONGEST_RETRY_AFTER) if seconds == seconds else 1.0


def _excerpt(data: bytes) -> str:
    return data[:200].decode(errors="replace").strip()


# -- Lists

PIECE = 2**16
"""Bytes that are read before other tasks may run: about 16 pods."""
METADATA = "PartialObjectMetadata"
METADATA_LIST = f"{METADATA}List"

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


class ListReader:
    """Reader of a list response.  Iterate over its objects first, then call ``more``.

    A response that is not a complete list of objects raises ``Unavailable``, at its end at the
    latest.  A list that is wrongly taken for empty would make the operator create pods.
    """

    def __init__(self, pieces: AsyncIterator[bytes], what: str) -> None:
        self._pieces = pieces
        self._what = what
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._text = ""
        self._at = 0
        self._ended = False
        self._items: object = None
        self.rest: Body = {}
        """Members of the list document except its items."""

    async def __aiter__(self) -> AsyncIterator[Body]:
        try:
            async for item in self._objects():
                yield item
        except (ValueError, RecursionError):
            # The data are not shown: they may be part of a Secret.
            raise Unavailable("the answer is no JSON object", what=self._what) from None
        kind = str(self.rest.get("kind", ""))
        # The API server sends null as the items of an empty list of metadata.
        has_items = self._items is list or (kind == METADATA_LIST and "items" in self.rest)
        if not (
            kind.endswith("List") and has_items and isinstance(self.rest.get("metadata"), dict)
        ):
            raise Unavailable("the answer is no list of objects", what=self._what)

    def more(self) -> str:
        """Return the token of the next page; empty if this was the last."""
        return str(self.rest["metadata"].get("continue") or "")

    def version(self) -> str:
        """Return the version of the list, from which a watch goes on."""
        return str(self.rest["metadata"].get("resourceVersion") or "")

    async def _objects(self) -> AsyncIterator[Body]:
        async for _ in self._parts("{", "}"):
            key = await self._value()
            await self._take(":")
            if key == "items" and await self._peek() == "[":
                self._items = list
                async for _ in self._parts("[", "]"):
                    item = await self._value()
                    if not isinstance(item, dict):
                        raise Unavailable("the answer is no list of objects", what=self._what)
                    yield item
                    del item
            else:
                self.rest[str(key)] = await self._value()
        if await self._peek():
            raise ValueError("more than one document")

    async def _parts(self, start: str, end: str) -> AsyncIterator[None]:
        """Yield once for each part between the brackets; the caller reads that part."""
        await self._take(start)
        if await self._peek() == end:
            await self._take(end)
            return
        while True:
            yield
            if await self._peek() == end:
                await self._take(end)
                return
            await self._take(",")

    async def _value(self) -> Any:
        while True:
            first = await self._peek()
            try:
                value, end = _decode(self._text, self._at)
            except ValueError:
                if not await self._read_on():
                    raise
                continue
            if end == len(self._text) and first not in '{["' and await self._read_on():
                continue  # the rest of a number may follow
            self._at = end
            return value

    async def _peek(self) -> str:
        """Return the next character that is no space; an empty string at the end."""
        while True:
            space = _SPACE.match(self._text, self._at)
            self._at = space.end() if space else self._at
            if self._at < len(self._text) or not await self._read_on():
                return self._text[self._at : self._at + 1]

    async def _take(self, expected: str) -> None:
        if await self._peek() != expected:
            raise ValueError("not what is expected")
        self._at += 1

    async def _read_on(self) -> bool:
        """Read as much as the text already holds, so that a large object is tried few times.

        Return False at the end of the response.
        """
        if self._ended:
            return False
        await asyncio.sleep(0)
        parts = [self._text[self._at :]]
        self._text, self._at = "", 0
        wanted = len(parts[0]) or 1
        while wanted > 0 and not self._ended:
            piece = await anext(self._pieces, b"")
            self._ended = not piece
            parts.append(self._decoder.decode(piece, final=self._ended))
            wanted -= len(parts[-1])
        self._text = "".join(parts)
        return True
