"""Thread that follows the state of some objects of the API server: a pool, or its pods."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterable, Mapping

from fiber._backends.kubernetes.api import Api, Watch
from fiber_api.rest import ApiError, Body, Expired, Transient

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds until the next watch after one that ended early; growing."""

_EARLY = 1.0
"""Seconds.  After a watch that ends sooner, the next one begins with a pause."""

_PAGE = 50
"""Objects in one answer.  Parsing blocks other threads, and a thousand pods are several MB."""


class Informer:
    """Follower of objects, which lists them once and then watches.

    After the end of a watch the next one continues.  If it cannot, the informer lists again and
    reports the differences.
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
        """Prepare to follow the objects at ``path``.  The functions are called on the thread.

        ``known``: names of objects that existed before; if one is missing, that is reported.
        ``on_change`` gets a name and the present object, or None once it is deleted.
        ``on_trouble`` gets errors that keep the watch from continuing.  ``on_fault`` gets a bug,
        which ends the thread.
        """
        self._api = api
        self._path = path
        self._selector = selector
        self._on_change = on_change
        self._on_trouble = on_trouble
        self._on_fault = on_fault
        self._version: str | None = None
        """Version from which the next watch continues; None: begin with a list."""
        self._known = set(known)
        self._failed = False
        """True if the last attempt brought nothing."""
        self._lock = threading.Lock()
        self._watch: Watch | None = None
        self._stopped = threading.Event()
        kind = path.rpartition("/")[2]
        self._thread = threading.Thread(target=self._run, name=f"fiber-watch-{kind}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Report no more changes; return at once."""
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
        """List and watch until the watch ends; return the seconds that the server asks to wait."""
        try:
            if self._version is None:
                self._version = self._list()
            self._follow(self._version)
        except Expired:
            self._version = None
        except ApiError as error:
            # A connection that breaks once is not reported: it is made again.
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
            # The version of the first page: changes during the other pages are reported again.
            version = version or str(listing["metadata"]["resourceVersion"])
            rest = listing["metadata"].get("continue") or ""
        for name in sorted(self._known - found.keys()):
            self._report(name, None)
        for name, item in found.items():
            self._report(name, item)
        return version

    def _follow(self, version: str) -> None:
        watch = self._api.watch(self._path, self._selector, version)
        with self._lock:
            if self._stopped.is_set():
                return
            self._watch = watch
        for kind, found in watch:
            if kind != "BOOKMARK":
                name = str(found["metadata"]["name"])
                self._report(name, None if kind == "DELETED" else found)
            self._version = str(found["metadata"]["resourceVersion"])

    def _report(self, name: str, found: Body | None) -> None:
        self._failed = False
        if self._stopped.is_set():
            return
        (self._known.discard if found is None else self._known.add)(name)
        self._on_change(name, found)
