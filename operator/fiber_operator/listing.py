"""Reader of a list of objects that decodes one object at a time, while the answer arrives.

Neither the answer nor its text is ever in memory as a whole.  A character takes four bytes once
there is an emoji near it, and objects of a megabyte are possible.
"""

from __future__ import annotations

import asyncio
import codecs
import json
import re
from collections.abc import AsyncIterator
from typing import Any

from fiber_operator.api_errors import Body, Unavailable

PIECE = 2**16
"""Bytes that are read at least before others may go on: some 16 pods."""
METADATA_LIST = "PartialObjectMetadataList"

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


class Listing:
    """The answer to a list.  Iterate over its objects first, then ask ``more``.

    Strict, because a list that is taken for empty by mistake makes the operator create pods: an
    answer that is not a whole list of objects raises Unavailable, at its end at the latest.
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
        """The members of the list beside its items."""

    async def __aiter__(self) -> AsyncIterator[Body]:
        try:
            async for item in self._objects():
                yield item
        except (ValueError, RecursionError):
            # Not shown: it may be half a Secret.
            raise Unavailable("the answer is no JSON object", what=self._what) from None
        kind = str(self.rest.get("kind", ""))
        # The API server has null for the items of an empty list of metadata.
        has_items = self._items is list or (kind == METADATA_LIST and "items" in self.rest)
        if not (
            kind.endswith("List") and has_items and isinstance(self.rest.get("metadata"), dict)
        ):
            raise Unavailable("the answer is no list of objects", what=self._what)

    def more(self) -> str:
        """Return the token of the next page; empty if this was the last."""
        return str(self.rest["metadata"].get("continue") or "")

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
        """Yield once for each part between the brackets; the caller reads the part."""
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
                continue  # half a number is a number
            self._at = end
            return value

    async def _peek(self) -> str:
        """Return the next character that is no space; empty at the end."""
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
        """Read as much again as is left of the text, so that a large object is tried few times."""
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
