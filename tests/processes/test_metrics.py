"""Metrics of a program: scraped over HTTP as Prometheus does it, on each backend."""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import socket
import sys
import threading
import urllib.request
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
from prometheus_client.parser import text_string_to_metric_families

import fiber
from census import wait_until
from faults.program import Program
from faults.runtime import BACKENDS, running
from fiber._runtime import metrics
from fiber._runtime.metrics import MetricsServer
from fiber._runtime.state import Runtime, runtime, shutdown
from patience import PATIENCE

Labels = tuple[tuple[str, str], ...]


def get(url: str, **headers: str) -> str:
    request = urllib.request.Request(url, headers=headers)
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
        text: str = answer.read().decode()
    return text


def url_of(running: Runtime) -> str:
    assert running.metrics is not None
    return running.metrics.url


def scrape(running: Runtime) -> dict[tuple[str, Labels], float]:
    """Return the value of each series, by its name without the prefix and its labels."""
    return {
        (sample.name.removeprefix("fiber_program_"), tuple(sorted(sample.labels.items()))): (
            sample.value
        )
        for family in text_string_to_metric_families(get(url_of(running)))
        for sample in family.samples
    }


@pytest.fixture(params=BACKENDS)
def program(request: pytest.FixtureRequest) -> Iterator[Runtime]:
    with running(backend=request.param, metrics_port=0) as runtime:
        yield runtime


def halve(number: int) -> float:
    if number < 0:
        raise ValueError(number)
    return number / 2


def kill_worker() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def serves() -> bool:
    with fiber.Pool(1) as pool:
        pool.apply(abs, (-1,))
        return runtime().metrics is not None


def work_on(**settings: Any) -> tuple[int, MetricsServer | None]:
    """Return the result of a task under these settings, and the server of the metrics."""
    with running(backend="local", **settings) as program, fiber.Pool(1) as pool:
        return pool.apply(abs, (-1,)), program.metrics


def test_tasks_and_workers_are_counted(program: Runtime) -> None:
    with fiber.Pool(2) as pool:
        pool.map(halve, range(100))
        with pytest.raises(ValueError, match="-1"):
            pool.apply(halve, (-1,))
        idle = ("workers", (("state", "idle"),))
        assert wait_until(lambda: scrape(program)[idle] == 2, PATIENCE)
        found = scrape(program)
    assert found["tasks_done_total", ()] == 101
    assert found["tasks_failed_total", ()] == 1
    assert found["tasks_waiting", ()] == found["tasks_held", ()] == 0
    assert found["hosts", ()] >= 1
    assert found["processes", ()] == 2
    assert found["sent_bytes_total", ()] > 0
    assert found["received_bytes_total", ()] > 0
    function = (("function", "halve"),)
    assert found["function_tasks_total", function] == 101
    assert found["function_failed_total", function] == 1
    assert found["function_work_seconds_total", function] > 0
    ((_, facts),) = [series for series in found if series[0] == "info"]
    assert dict(facts)["backend"] == program.backend.name
    assert dict(facts)["version"] == fiber.__version__


def test_deaths_and_lost_runs_are_counted(program: Runtime) -> None:
    with fiber.Pool(1, retries=1) as pool, pytest.raises(fiber.errors.WorkerDied):
        pool.apply(kill_worker)
    found = scrape(program)
    assert found["child_deaths_total", ()] == 2
    assert found["tasks_lost_total", ()] == 2


def test_children_do_not_serve(program: Runtime) -> None:
    process = fiber.Process(target=print, args=("runs",))
    process.start()
    process.join()
    results: Any = fiber.SimpleQueue()
    child = fiber.Process(target=tell, args=(results,))
    child.start()
    assert results.get() is False
    child.join()
    results.close()


def tell(results: Any) -> None:
    results.put(serves())


def test_the_page_ends_with_the_program(program: Runtime) -> None:
    where = urlsplit(url_of(program))
    scrape(program)
    shutdown()
    assert "fiber-metrics" not in {thread.name for thread in threading.enumerate()}
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((where.hostname, where.port), timeout=PATIENCE)


FORKS = """
    import fiber, os
    if __name__ == "__main__":
        fiber.init(metrics_port=0)
        with fiber.Pool(1) as pool:
            pool.apply(abs, (-1,))
        child = os.fork()
        if child == 0:
            with fiber.Pool(1) as pool:
                print(pool.apply(abs, (-2,)), flush=True)
            os._exit(0)
        os.waitpid(child, 0)
"""


def test_a_forked_copy_does_not_serve() -> None:
    program = Program(FORKS)
    try:
        assert program.finish() == "2\n"
        assert program.stderr.count("metrics are at http://127.0.0.1:") == 1
    finally:
        program.close()


def test_a_taken_port_is_a_warning_and_the_work_goes_on() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        words = rf"not served at 127\.0\.0\.1:{port}: Address already in use"
        with pytest.warns(RuntimeWarning, match=words):
            assert work_on(metrics_port=port) == (1, None)


@pytest.mark.parametrize("host", ["not.a.host.invalid", "192.0.2.1"])
def test_an_address_of_another_host_is_a_warning(host: str) -> None:
    with pytest.warns(RuntimeWarning, match=f"not served at {host}:0: "):
        assert work_on(metrics_port=0, metrics_host=host) == (1, None)


def test_a_missing_package_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.warns(RuntimeWarning, match=r'pip install "fiberpool\[metrics\]"'):
        assert work_on(metrics_port=0) == (1, None)


def test_nothing_is_served_or_imported_unless_asked_for() -> None:
    assert work_on() == (1, None)


# ---- the server -----------------------------------------------------------------------------


@pytest.fixture
def server() -> Iterator[MetricsServer]:
    server = MetricsServer("127.0.0.1", 0, lambda accept: ("text/plain", accept.encode() + b"."))
    yield server
    server.close()


def connect(server: MetricsServer) -> socket.socket:
    where = urlsplit(server.url)
    return socket.create_connection((where.hostname, where.port), timeout=PATIENCE)


def test_the_form_of_the_page_is_negotiated(server: MetricsServer) -> None:
    assert get(server.url, Accept="text/html") == "text/html."


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/metrics?x=1", 200),
        ("HEAD", "/metrics", 200),
        ("GET", "/", 404),
        ("POST", "/metrics", 405),
    ],
)
def test_only_the_page_is_served(
    server: MetricsServer, method: str, path: str, status: int
) -> None:
    where = urlsplit(server.url)
    assert where.hostname is not None
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=PATIENCE)
    connection.request(method, path)
    answer = connection.getresponse()
    assert answer.status == status
    answer.read()
    connection.close()


@pytest.mark.parametrize("words", [b"", b"nonsense", b"\x00\r\n\r\n", b"GET " + b"x" * 100_000])
def test_garbage_and_silence_end_no_server(server: MetricsServer, words: bytes) -> None:
    with connect(server) as stranger:
        stranger.sendall(words)
        assert get(server.url) == "identity." or get(server.url) == "."


def test_an_error_of_the_page_is_an_answer() -> None:
    def page(accept: str) -> tuple[str, bytes]:
        raise ZeroDivisionError("on purpose")

    server = MetricsServer("127.0.0.1", 0, page)
    try:
        with pytest.raises(urllib.error.HTTPError, match="503") as found:
            get(server.url)
        assert b"on purpose" in found.value.read()
        found.value.close()
    finally:
        server.close()


def test_a_silent_client_does_not_delay_the_end(server: MetricsServer) -> None:
    with connect(server):
        assert wait_until(lambda: bool(server._clients), PATIENCE)
        server.close()
        assert not server._thread.is_alive()
        assert not server._clients


def test_silent_clients_do_not_keep_a_scraper_waiting(server: MetricsServer) -> None:
    with contextlib.ExitStack() as strangers:
        for _ in range(2 * metrics._MOST_CLIENTS):
            strangers.enter_context(connect(server))
        assert get(server.url) in ("identity.", ".")
        # Fewer than all: the first strangers were sent away.
        assert wait_until(lambda: len(server._clients) <= metrics._MOST_CLIENTS, PATIENCE)


def test_names_of_functions_are_text() -> None:
    sample = metrics.ProgramSample(
        dict.fromkeys(metrics._TOTALS, 0),
        dict.fromkeys(metrics._GAUGES, 0),
        {},
        [("\udc00", 1, 0, 2)],
    )
    *_, tasks, _failed, _work = metrics.metrics_of(sample, {})
    assert tasks.samples[0].labels == {"function": "\\udc00"}
