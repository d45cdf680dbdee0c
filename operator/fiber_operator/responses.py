"""Responses of the API server that may be large: lists, and objects of a million values.

``ListReader`` decodes a list one object at a time while the response arrives, so that neither the
response nor its text is in memory as a whole.  A character takes four bytes once there is an emoji
near it, and objects of a megabyte are possible.
"""

from __future__ import annotations

import asyncio
import codecs
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

from fiber_api.rest import EXCERPT, ApiError, Body, Forbidden, ServerUnreachable, document_of

_STRING = re.compile(rb'"[^"]*"')


class Oversized(ApiError):
    """The object has so many values that it is not decoded: each takes memory."""


Answered = Callable[[str, ApiError | None], None]
"""Called with the answer to a list or watch: the request (``watch pods in team``) and its error."""


def complaint(error: ApiError) -> str:
    """Return the text of an error, and the remedy if it is known."""
    if isinstance(error, Forbidden):
        return f"{error}. Give the operator's account this right: the chart's roles have it"
    return str(error)


MOST_VALUES = 50_000
"""Values of an object that is decoded.  A FiberPool may have a million, which take 25 times the
memory of their JSON; a long template has some hundred."""


def object_of(answer: Body, name: str, what: str) -> Body:
    """Return ``answer`` if it is the object of that name; raise ``ServerUnreachable`` otherwise."""
    metadata = answer.get("metadata")
    if not isinstance(metadata, dict) or metadata.get("name") != name:
        raise ServerUnreachable(f"the answer is not the object {name}", what=what)
    return answer


def limited_document_of(status: int, headers: Mapping[str, str], data: bytes, what: str) -> Body:
    """Return the document in a response; raise ``Oversized`` if it has too many values."""
    if _has_more_values(data, MOST_VALUES):
        if 200 <= status < 300:
            raise Oversized(f"it has more than {MOST_VALUES} values", what=what, status=status)
        data = data[:EXCERPT]  # the API server sends no such error
    return document_of(status, headers, data, what)


def _has_more_values(data: bytes, most: int) -> bool:
    if _count_values(data) <= most:
        return False
    # Text in strings does not count: a list of comma-separated names is one value.
    unescaped = data.replace(rb"\\", b"").replace(rb"\"", b"")
    return _count_values(_STRING.sub(b"", unescaped)) > most


def _count_values(data: bytes) -> int:
    # Each value but the first of its list or object has a comma before it.
    return data.count(b",") + data.count(b"[") + data.count(b"{")


# -- Lists

PIECE = 2**16
"""Bytes that are read before other tasks may run: about 16 pods."""
METADATA = "PartialObjectMetadata"
METADATA_LIST = f"{METADATA}List"

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


class ListReader:
    """Reader of a list response.  Iterate over its objects first, then call ``more``.

    A response that is not a complete list of objects raises ``ServerUnreachable``, at the latest at
    its end.  A list that is wrongly taken for empty would make the operator create pods.
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
            raise ServerUnreachable("the answer is no JSON object", what=self._what) from None
        kind = str(self.rest.get("kind", ""))
        # The API server sends null as the items of an empty list of metadata.
        has_items = self._items is list or (kind == METADATA_LIST and "items" in self.rest)
        if not (
            kind.endswith("List") and has_items and isinstance(self.rest.get("metadata"), dict)
        ):
            raise self._no_list()

    def more(self) -> str:
        """Return the token of the next page; empty if this was the last."""
        return str(self.rest["metadata"].get("continue") or "")

    def version(self) -> str:
        """Return the version of the list, from which a watch goes on."""
        return str(self.rest["metadata"].get("resourceVersion") or "")

    def _no_list(self) -> ServerUnreachable:
        return ServerUnreachable("the answer is no list of objects", what=self._what)

    async def _objects(self) -> AsyncIterator[Body]:
        async for _ in self._parts("{", "}"):
            key = await self._value()
            await self._take(":")
            if key == "items" and await self._peek() == "[":
                self._items = list
                async for _ in self._parts("[", "]"):
                    item = await self._value()
                    if not isinstance(item, dict):
                        raise self._no_list()
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
