"""Watched namespace: its current objects, and when each reached its state."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from e2e.kube import Body, Failed, Kube, Refused, Stream, path_of
from fiber_api.names import LABEL_POOL

T = TypeVar("T")
_LINES = 150
"""Lines of each part that a failed test shows."""
_WATCHED = ("fiberpools", "pods", "endpointslices")


@dataclass(frozen=True)
class Moment:
    """Change of an object, and when the watch reported it."""

    at: float
    """Seconds of the monotonic clock."""
    resource: str
    gone: bool
    object: Body

    @property
    def name(self) -> str:
        return str(self.object["metadata"]["name"])


class NotSo(AssertionError):
    """A condition did not come true in time."""


class Scene:
    """A namespace.  ``now`` and ``moments`` are kept up to date by threads until ``close``."""

    def __init__(self, kube: Kube, namespace: str, watched: Sequence[str] = _WATCHED) -> None:
        self.kube = kube
        self.namespace = namespace
        self.now: dict[str, dict[str, Body]] = {resource: {} for resource in watched}
        self.moments: list[Moment] = []
        self._changed = threading.Condition()
        self._streams = [self._watch(resource) for resource in watched]

    def close(self) -> None:
        """Stop watching."""
        for stream in self._streams:
            stream.close()

    def path(self, resource: str, name: str = "", subresource: str = "") -> str:
        return path_of(resource, self.namespace, name, subresource)

    def wait(
        self, what: str, condition: Callable[[], T], seconds: float = 30.0, poll: float = 10.0
    ) -> T:
        """Return the value of ``condition`` once it is true.

        It is asked again after each change, and every ``poll`` seconds.
        """
        deadline = time.monotonic() + seconds
        with self._changed:
            while not (found := condition()):
                left = deadline - time.monotonic()
                if left <= 0:
                    raise NotSo(f"not so after {seconds:g} s: {what}")
                self._changed.wait(min(left, poll))
        return found

    def never(self, what: str, condition: Callable[[], object], seconds: float) -> None:
        """Fail if it comes true within that time."""
        try:
            self.wait(what, condition, seconds)
        except NotSo:
            return
        raise AssertionError(f"it must not be so: {what}")

    def first(self, resource: str, condition: Callable[[Body], object]) -> float:
        """Return when an object was first seen for which the condition is true.

        Wait for that: what one watch shows may come before what another one does.
        """

        def seen() -> Moment | None:
            there = (moment for moment in self.moments if moment.resource == resource)
            return next((m for m in there if not m.gone and condition(m.object)), None)

        moment = self.wait(f"{resource}: it is seen", seen)
        assert moment is not None
        return moment.at

    def most_at_once(self, condition: Callable[[Body], object]) -> int:
        """The largest number of pods that there ever were at a time with this condition true."""
        there: set[str] = set()
        most = 0
        for moment in list(self.moments):
            if moment.resource == "pods":
                counts = not moment.gone and condition(moment.object)
                (there.add if counts else there.discard)(moment.name)
                most = max(most, len(there))
        return most

    def remark(self) -> None:
        """Something that is waited for may have changed."""
        with self._changed:
            self._changed.notify_all()

    # The watches

    def _watch(self, resource: str) -> Stream:
        def begin() -> str:
            version = self._list(resource)
            query = f"watch=true&allowWatchBookmarks=true&resourceVersion={version}"
            return f"{self.path(resource)}?{query}"

        def tell(line: str) -> None:
            if not line.endswith("\n"):
                return  # the connection broke in the middle of it
            event = json.loads(line)
            if event["type"] == "ERROR":
                raise Refused(int(event["object"].get("code", 500)), line)
            if event["type"] != "BOOKMARK":
                self._note(resource, [(event["type"] == "DELETED", event["object"])])

        return Stream(self.kube, begin, tell)

    def _list(self, resource: str) -> str:
        listed = self.kube.call("GET", self.path(resource))
        there = {item["metadata"]["name"] for item in listed["items"]}
        gone = [body for name, body in self.now[resource].items() if name not in there]
        news = [(True, body) for body in gone] + [(False, body) for body in listed["items"]]
        self._note(resource, news)
        return str(listed["metadata"]["resourceVersion"])

    def _note(self, resource: str, news: Sequence[tuple[bool, Body]]) -> None:
        at = time.monotonic()
        with self._changed:
            there = dict(self.now[resource])  # a reader may go through the one of before
            for gone, body in news:
                name = body["metadata"]["name"]
                self.moments.append(Moment(at, resource, gone, body))
                if gone:
                    there.pop(name, None)
                else:
                    there[name] = body
            self.now[resource] = there
            self._changed.notify_all()

    # For a person

    def account(self) -> Iterator[tuple[str, str]]:
        """Yield the parts of a failed test's report: a title and a text each."""
        where = ("--namespace", self.namespace)
        for title, arguments in (
            ("pools", ("get", "fiberpools", "--output", "yaml")),
            ("pods", ("get", "pods", "--output", "wide")),
            ("workers' words", ("logs", "--selector", LABEL_POOL, "--tail=20", "--prefix")),
            ("events", ("get", "events", "--sort-by", "metadata.creationTimestamp")),
        ):
            try:
                said = self.kube.kubectl(*arguments, *where)
            except Failed as failed:  # a container that never ran has no log
                said = str(failed)
            yield f"{title} in {self.namespace}", "\n".join(said.splitlines()[-_LINES:])
