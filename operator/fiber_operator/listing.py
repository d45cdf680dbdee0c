"""A list of objects, read one object at a time.

A pod is some 4 kB of JSON and five times that once it is parsed: of a thousand, one at a time is
in memory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from fiber_operator.api_errors import Body, Unavailable

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


class Listing:
    """The answer to a list.  Iterate over its objects first, then ask ``more``.

    Strict, because a list that is taken for empty by mistake makes the operator create pods: what
    is no whole list of objects raises Unavailable, at its end at the latest.
    """

    def __init__(self, data: bytes, what: str) -> None:
        self._data = data
        self._what = what
        self._text = ""
        self._at = 0
        self._rest: Body = {}
        self._has_items = False

    def __iter__(self) -> Iterator[Body]:
        try:
            self._text, self._data = self._data.decode(), b""
            yield from self._objects()
        except (ValueError, RecursionError):
            # Not shown: it may be half a Secret.
            raise Unavailable("the answer is no JSON object", what=self._what) from None
        finally:
            self._text = ""
        metadata = self._rest.get("metadata")
        is_list = str(self._rest.get("kind", "")).endswith("List")
        if not (is_list and self._has_items and isinstance(metadata, dict)):
            raise Unavailable("the answer is no list of objects", what=self._what)

    def more(self) -> str:
        """What to continue with; empty if this was all."""
        return str(self._rest["metadata"].get("continue") or "")

    def _objects(self) -> Iterator[Body]:
        for _ in self._parts("{", "}"):
            key = self._value()
            self._take(":")
            if key == "items" and self._peek() == "[":
                self._has_items = True
                for _ in self._parts("[", "]"):
                    item = self._value()
                    if not isinstance(item, dict):
                        raise Unavailable("the answer is no list of objects", what=self._what)
                    yield item
            else:
                self._rest[str(key)] = self._value()
        if self._peek():
            raise ValueError("more than one document")

    def _parts(self, start: str, end: str) -> Iterator[None]:
        """One step for each part between the brackets; whoever asked reads it."""
        self._take(start)
        if self._peek() == end:
            self._take(end)
            return
        while True:
            yield
            if self._peek() == end:
                self._take(end)
                return
            self._take(",")

    def _value(self) -> object:
        self._peek()
        value, self._at = _decode(self._text, self._at)
        return value

    def _peek(self) -> str:
        """The next character that is no space."""
        space = _SPACE.match(self._text, self._at)
        self._at = space.end() if space else self._at
        return self._text[self._at : self._at + 1]

    def _take(self, expected: str) -> None:
        if self._peek() != expected:
            raise ValueError(f"no {expected!r} at {self._at}")
        self._at += 1
