"""Metrics of a program for Prometheus: a page that is computed when it is asked for.

A thread answers one client after the other.  Each client has a deadline, so a slow client costs
others a few seconds at most, and the work of the program nothing.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from fiber._engine.activity import Activity
from fiber._runtime.activity_reading import on_loop
from fiber._runtime.children import Children
from fiber._runtime.monitoring import program_facts
from fiber._runtime.pool_state import WatchedPool
from fiber._transport.loop import Loop
from fiber.config import Config

if TYPE_CHECKING:
    from prometheus_client.core import Metric

    Family = Callable[..., Metric]

PATH = "/metrics"

STATES = ("waiting", "starting", "idle", "busy", "leaving")
"""States of workers, as in ``WorkerInfo``."""

_HEAD = 1 << 14
"""Bytes of the head of a request."""
_PATIENCE = 2.0
"""Seconds that a client may take to send its request."""
_SENDING = 5.0
"""Seconds that a client may take to read the page."""
_BACKLOG = 16
_MOST_CLIENTS = 8
"""Clients at a time.  One more takes the place of the oldest, which may be silent."""


class ProgramSample(NamedTuple):
    """Numbers of the program at one moment."""

    totals: dict[str, float]
    """Totals of the program, by the name of their metric."""
    gauges: dict[str, float]
    workers: dict[str, int]
    """Number of workers of pools by state."""
    functions: list[tuple[str, int, int, float]]
    """Name, tasks, failed tasks and seconds of work of each function."""


_TOTALS = {
    "tasks_done": "Tasks that workers have finished, failed ones included.",
    "tasks_failed": "Tasks that raised an error.",
    "tasks_retried": "Runs that were repeated after an error.",
    "tasks_lost": "Runs that were lost with their workers.",
    "pickling_seconds": "Seconds in which the program pickled tasks.",
    "sent_bytes": "Bytes of tasks that were sent to workers.",
    "received_bytes": "Bytes of results that came from workers.",
    "child_deaths": "Workers and other processes that ended without being asked to.",
}

_GAUGES = {
    "tasks_waiting": "Tasks that no worker has.",
    "tasks_held": "Tasks that workers have: they run, or wait in a worker.",
    "hosts": "Hosts on which workers or other processes are.",
    "processes": "Workers and other processes that have not ended.",
    "start_time_seconds": "Unix time at which the program began to use Fiber.",
}


def take_sample(
    activity: Activity, children: Children, pools: Iterable[WatchedPool], now: float
) -> ProgramSample:
    """Return the numbers of the program.  Runs on the loop thread."""
    activity.refresh()
    workers: Counter[str] = Counter()
    waiting = held = 0
    for pool in list(pools):
        state = pool.describe()
        workers.update(state.workers)
        waiting += state.waiting
        held += state.held
    hosts = {child.handle.host for child in children if child.handle is not None}
    return ProgramSample(
        totals={
            "tasks_done": activity.tasks,
            "tasks_failed": activity.failed,
            "tasks_retried": activity.retried,
            "tasks_lost": activity.lost,
            "pickling_seconds": activity.pickling,
            "sent_bytes": activity.bytes_sent,
            "received_bytes": activity.bytes_received,
            "child_deaths": activity.died,
        },
        gauges={
            "tasks_waiting": waiting,
            "tasks_held": held,
            "hosts": len(hosts - {""}),
            "processes": len(children),
            "start_time_seconds": time.time() - (now - activity.start),
        },
        workers={state: workers[state] for state in STATES},
        functions=[
            (totals.name, totals.tasks, totals.failed, totals.work)
            for totals in activity.functions.values()
        ],
    )


def metrics_of(sample: ProgramSample, facts: dict[str, str]) -> Iterator[Metric]:
    """Yield the metrics of a sample."""
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    info = GaugeMetricFamily("fiber_program_info", "The program.", labels=sorted(facts))
    info.add_metric([facts[key] for key in sorted(facts)], 1)
    yield info
    for name, text in _TOTALS.items():
        yield CounterMetricFamily(f"fiber_program_{name}", text, value=sample.totals[name])
    for name, text in _GAUGES.items():
        yield GaugeMetricFamily(f"fiber_program_{name}", text, value=sample.gauges[name])
    workers = GaugeMetricFamily("fiber_program_workers", "Workers, by state.", labels=["state"])
    for state, count in sample.workers.items():
        workers.add_metric([state], count)
    yield workers
    by_function = [
        CounterMetricFamily(f"fiber_program_function_{name}", text, labels=["function"])
        for name, text in (
            ("tasks", "Tasks that workers have finished, by function."),
            ("failed", "Tasks that raised an error, by function."),
            ("work_seconds", "Seconds of work in workers, by function."),
        )
    ]
    for function, *values in sample.functions:
        label = function.encode(errors="backslashreplace").decode()
        for family, value in zip(by_function, values, strict=True):
            family.add_metric([label], value)
    yield from by_function


class _ProgramCollector:
    """Collector of prometheus-client: asks the loop thread for a sample at each scrape."""

    def __init__(self, sample: Callable[[], ProgramSample], facts: dict[str, str]) -> None:
        self._sample = sample
        self._facts = facts

    def collect(self) -> Iterator[Metric]:
        return metrics_of(self._sample(), self._facts)


def serve(
    config: Config,
    loop: Loop,
    sample: Callable[[], ProgramSample],
    backend: str,
) -> MetricsServer | None:
    """Serve the metrics at the port of the configuration.

    A failure is a warning: the work of the program goes on.
    """
    if config.metrics_port is None:
        return None
    where = f"{config.metrics_host}:{config.metrics_port}"
    try:
        from prometheus_client import CollectorRegistry
        from prometheus_client.exposition import choose_encoder
    except ImportError as error:
        _warn(where, str(error), 'Install it: pip install "fiberpool[metrics]"')
        return None
    facts = {
        "program": str(program_facts()["name"]),
        "backend": backend,
        "version": str(cast("Any", sys.modules["fiber"]).__version__),
    }
    registry = CollectorRegistry(auto_describe=False)
    registry.register(cast("Any", _ProgramCollector(lambda: on_loop(loop, sample), facts)))

    def page(accept: str) -> tuple[str, bytes]:
        encode, kind = choose_encoder(accept)
        return kind, encode(registry)

    try:
        server = MetricsServer(config.metrics_host, config.metrics_port, page)
    except (OSError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        _warn(where, why, "Set metrics_port to a free port, or to 0, which takes one")
        return None
    if config.metrics_port == 0:
        with contextlib.suppress(OSError, ValueError):
            print(f"fiber: metrics are at {server.url}", file=sys.stderr, flush=True)
    return server


def _warn(where: str, why: str, advice: str) -> None:
    warnings.warn(
        f"the program's metrics are not served at {where}: {why}. {advice}, or leave out "
        "metrics_port.",
        RuntimeWarning,
        stacklevel=2,
    )


class MetricsServer:
    """HTTP server of one page.  ``page`` returns its type and text for an ``Accept`` header."""

    def __init__(self, host: str, port: int, page: Callable[[str], tuple[str, bytes]]) -> None:
        self._page = page
        self._clients: dict[threading.Thread, socket.socket] = {}
        """Threads that answer clients, the oldest first."""
        self._closed = False
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self._listener = socket.create_server(cast("Any", address), family=family, backlog=_BACKLOG)
        at, number = self._listener.getsockname()[:2]
        self.url = f"http://{f'[{at}]' if ':' in at else at}:{number}{PATH}"
        """Address of the page."""
        self._thread = threading.Thread(target=self._run, name="fiber-metrics", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            self._listener.close()
            raise

    def close(self) -> None:
        """Refuse clients, and end the threads."""
        self._closed = True
        _shut_down(self._listener)  # it wakes the thread
        self._thread.join(timeout=_PATIENCE)
        for thread, client in list(self._clients.items()):
            _shut_down(client)
            thread.join(timeout=_PATIENCE)
        self._listener.close()

    def forget(self) -> None:
        """Close this process's copies of the sockets, after a fork."""
        self._listener.close()
        for client in list(self._clients.values()):
            client.close()

    def _run(self) -> None:
        while not self._closed:
            try:
                client, _ = self._listener.accept()
            except OSError:  # it is closed, or no descriptor is free
                if not self._closed:
                    time.sleep(0.1)
                continue
            clients = list(self._clients.values())
            if len(clients) >= _MOST_CLIENTS:
                _shut_down(clients[0])
            self._begin(client)

    def _begin(self, client: socket.socket) -> None:
        thread = threading.Thread(
            target=self._serve, args=(client,), name="fiber-metrics-client", daemon=True
        )
        self._clients[thread] = client
        try:
            thread.start()
        except RuntimeError:  # the system has no room for a thread
            del self._clients[thread]
            client.close()

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            client.sendall(self._answer(_read_head(client)))
        self._clients.pop(threading.current_thread(), None)

    def _answer(self, head: str) -> bytes:
        request, *headers = head.split("\r\n")
        method, _, rest = request.partition(" ")
        if method not in ("GET", "HEAD"):
            return _response("405 Method Not Allowed", "text/plain", b"GET only\n")
        if rest.split(" ")[0].partition("?")[0] != PATH:
            return _response("404 Not Found", "text/plain", f"See {PATH}\n".encode())
        fields = (line.partition(":") for line in headers)
        accept = next((value for name, _, value in fields if name.lower() == "accept"), "")
        try:
            kind, body = self._page(accept.strip())
        except Exception as error:  # the loop is busy or has ended: the scraper shows it
            return _response("503 Service Unavailable", "text/plain", f"{error}\n".encode())
        answer = _response("200 OK", kind, body)
        return answer if method == "GET" else answer[: -len(body)]


def _shut_down(sock: socket.socket) -> None:
    """End the waits of other threads for a socket."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def _read_head(client: socket.socket) -> str:
    """Return the head of a request; OSError if it is not complete in time."""
    deadline = time.monotonic() + _PATIENCE
    data = b""
    while b"\r\n\r\n" not in data:
        client.settimeout(max(0.01, deadline - time.monotonic()))
        more = client.recv(_HEAD)
        if not more or len(data) > _HEAD or time.monotonic() > deadline:
            raise ConnectionAbortedError("no complete request came")
        data += more
    client.settimeout(_SENDING)
    return data.partition(b"\r\n\r\n")[0].decode("latin-1")


def _response(status: str, kind: str, body: bytes) -> bytes:
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode("latin-1") + body
