"""A thread that knows how some objects of the API server are: a pool, or its pods."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterable, Mapping

from fiber._backends.kubernetes.api import Api, ApiError, Body, Expired, Transient, Watch

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds before it goes on after an end that came early, growing."""

_EARLY = 1.0
"""A watch that ends sooner, in seconds, is not followed by the next one at once."""

_PAGE = 50
"""Objects of one answer.  Parsing holds the interpreter, and a thousand pods are several MB."""


class Informer:
    """Lists once, then watches; where a watch ends the next goes on, and where that cannot be it
    lists again and tells what is different from before.
    """

    def __init__(
        self,
        api: Api,
        path: str,
        selector: Mapping[str, str],
        *,
        known: Iterable[str] = (),
        on_change: Callable[[str, Body | None], None],
        on_trouble: Callable[[ApiError], None],
        on_fault: Callable[[Exception], None],
    ) -> None:
        """``known`` names what was there before: it is told if it is there no more.

        ``on_change`` is told the name and the object as it is, or None once it is gone;
        ``on_trouble`` what keeps the watch from going on, while it does; ``on_fault`` of a fault of
        ours, which ends it.  All on the thread.
        """
        self._api = api
        self._path = path
        self._selector = selector
        self._on_change = on_change
        self._on_trouble = on_trouble
        self._on_fault = on_fault
        self._version: str | None = None
        """Version from which the next watch goes on; None: begin with a list."""
        self._known = set(known)
        self._failed = False
        """The last attempt brought nothing."""
        self._lock = threading.Lock()
        self._watch: Watch | None = None
        self._stopped = threading.Event()
        kind = path.rpartition("/")[2]
        self._thread = threading.Thread(target=self._run, name=f"fiber-watch-{kind}", daemon=True)

    def start(self) -> None:
        """Begin, on a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """Tell nothing more; returns at once."""
        with self._lock:
            self._stopped.set()
            watch = self._watch
        if watch is not None:
            watch.stop()

    def join(self, timeout: float) -> None:
        """Wait for the thread's end after ``stop``."""
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def _run(self) -> None:
        pause = _PAUSE_MIN
        try:
            while not self._stopped.is_set():
                started = time.monotonic()
                asked = self._attempt()
                if time.monotonic() - started >= _EARLY:
                    pause, wait = _PAUSE_MIN, asked
                else:
                    wait = max(pause * random.uniform(0.5, 1.0), asked)
                    pause = min(2 * pause, _PAUSE_MAX)
                self._stopped.wait(wait)
        except Exception as error:
            self._on_fault(error)

    def _attempt(self) -> float:
        """Go on for as long as it goes; the seconds that the API server then asks to wait."""
        try:
            if self._version is None:
                self._version = self._list()
            self._follow(self._version)
        except Expired:
            self._version = None
        except ApiError as error:
            # A connection that breaks once is nothing to speak of: it is made again.
            if self._failed or not isinstance(error, Transient):
                self._on_trouble(error)
            self._failed = True
            return error.retry_after if isinstance(error, Transient) else 0.0
        else:
            self._failed = False
        return 0.0

    def _list(self) -> str:
        found: dict[str, Body] = {}
        version = rest = ""
        while not version or rest:
            page = {"limit": str(_PAGE), **({"continue": rest} if rest else {})}
            listing = self._api.list(self._path, {**self._selector, **page}, timeout=0.0)
            found |= {str(item["metadata"]["name"]): item for item in listing.get("items") or ()}
            # The first page's: whatever changes while the others are read is told once more.
            version = version or str(listing["metadata"]["resourceVersion"])
            rest = listing["metadata"].get("continue") or ""
        for name in sorted(self._known - found.keys()):
            self._tell(name, None)
        for name, item in found.items():
            self._tell(name, item)
        return version

    def _follow(self, version: str) -> None:
        watch = self._api.watch(self._path, self._selector, version)
        with self._lock:
            if self._stopped.is_set():
                return
            self._watch = watch
        for event in watch:
            found = event["object"]
            if event["type"] != "BOOKMARK":
                name = str(found["metadata"]["name"])
                self._tell(name, None if event["type"] == "DELETED" else found)
            self._version = str(found["metadata"]["resourceVersion"])

    def _tell(self, name: str, found: Body | None) -> None:
        self._failed = False
        if self._stopped.is_set():
            return
        (self._known.discard if found is None else self._known.add)(name)
        self._on_change(name, found)
