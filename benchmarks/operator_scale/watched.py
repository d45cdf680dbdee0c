"""Objects of one trial by their own statuses, kept up to date by a watch."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable

from benchmarks.operator_scale.cases import Body, ready
from benchmarks.operator_scale.results import Curve

from e2e.kube import Kube, Refused, Stream


class Watched:
    """All objects of a collection. ``ready`` is the sum over them by time since ``since``."""

    def __init__(self, kube: Kube, collection: str, since: float) -> None:
        self._kube = kube
        self._collection = collection
        self._since = since
        self._objects: dict[str, Body] = {}
        self._changed = threading.Condition()
        self.ready: Curve = []
        self._stream = Stream(kube, self._begin, self._tell)  # its thread uses all of the above

    def close(self) -> None:
        """Stop watching."""
        self._stream.close()

    def wait(self, until: float) -> None:
        """Return after a change, or at this time of the monotonic clock."""
        with self._changed:
            self._changed.wait(max(0.0, until - time.monotonic()))

    def count(self, condition: Callable[[Body], bool]) -> int:
        """Return the number of objects for which it is true."""
        with self._changed:
            return sum(condition(body) for body in self._objects.values())

    def _begin(self) -> str:
        listed = self._kube.call("GET", self._collection)
        with self._changed:
            self._objects = {item["metadata"]["name"]: item for item in listed["items"]}
            self._note()
        return (
            f"{self._collection}?watch=true&resourceVersion={listed['metadata']['resourceVersion']}"
        )

    def _tell(self, line: str) -> None:
        event = json.loads(line)
        if event["type"] == "ERROR":
            raise Refused(int(event["object"].get("code", 500)), line)
        body = event["object"]
        with self._changed:
            if event["type"] == "DELETED":
                self._objects.pop(body["metadata"]["name"], None)
            else:
                self._objects[body["metadata"]["name"]] = body
            self._note()

    def _note(self) -> None:
        total = sum(ready(body) for body in self._objects.values())
        if not self.ready or self.ready[-1][1] != total:
            self.ready.append([time.monotonic() - self._since, total])
        self._changed.notify_all()
