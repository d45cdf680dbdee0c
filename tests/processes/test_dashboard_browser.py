"""The live page in a real browser: its figures are the engine's, and it says what happens."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

import browser as browsers
from faults.program import Program, wait_for
from fiber._monitor import client
from patience import PATIENCE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browsers.chromium() is None, reason=browsers.MISSING),
]

_SCRIPT = """
import os, signal, sys, threading, fiber

def work(number):
    if number % 10 == 3:
        raise ValueError(number)
    return number

def rest(number):
    threading.Event().wait()

if __name__ == "__main__":
    fiber.init(dashboard=True, retries=0)
    with fiber.Pool(3) as pool:
        print(os.getpid(), flush=True)
        for line in sys.stdin:
            word, _, argument = line.strip().partition(" ")
            if word == "work":
                pool.map_async(work, range(int(argument)), chunksize=1).wait()
            elif word == "rest":
                pool.apply_async(rest, (1,))
            elif word == "kill":
                busy = [worker for worker in pool.workers() if worker.state == "busy"]
                os.kill(busy[0].pid, signal.SIGKILL)
                print(busy[0].name, flush=True)
                continue
            print(word, flush=True)
"""

ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")
MILLISECONDS = PATIENCE * 1000


class WatchedProgram:
    """Program with a page, which does what it is told."""

    def __init__(self, folder: Path) -> None:
        self.program = Program(
            _SCRIPT, stdin=subprocess.PIPE, env={"FIBER_RUNTIME_DIRECTORY": str(folder)}
        )
        self.folder = folder
        self.program.line()
        self.tell("work 1")
        wait_for(lambda: bool(ADDRESS.search(self.program.stderr)), what="the address of the page")
        (self.address,) = ADDRESS.findall(self.program.stderr)

    def tell(self, line: str) -> str:
        """Return the program's answer to a line."""
        stdin = self.program.process.stdin
        assert stdin is not None
        stdin.write(line.encode() + b"\n")
        stdin.flush()
        return self.program.line()

    def activity(self) -> dict[str, Any]:
        """Return the record of the program's engine."""
        (path,) = client.sockets(str(self.folder))
        lines = client.ask(path, {"ask": "activity"})
        return next(dict(line["activity"]) for line in lines if "activity" in line)

    def close(self) -> None:
        stdin = self.program.process.stdin
        assert stdin is not None
        stdin.close()
        self.program.close()


@pytest.fixture
def browser() -> Iterator[Browser]:
    """A browser for one test: it starts and ends its processes when it likes."""
    with browsers.opened() as browser:
        yield browser


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[WatchedProgram]:
    watched = WatchedProgram(tmp_path)
    yield watched
    watched.close()


@pytest.fixture
def page(browser: Browser, watched: WatchedProgram) -> Iterator[Page]:
    """The program's page.  After the test: the browser has reported no error or broken policy."""
    problems: list[str] = []
    context = browser.new_context(viewport={"width": 1200, "height": 900})
    context.set_default_timeout(MILLISECONDS)
    page = context.new_page()
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(watched.address)
    figure(page, "tasks done").wait_for()
    yield page
    context.close()
    assert [found for found in problems if "WebSocket" not in found] == []


def figure(page: Page, name: str) -> Any:
    return page.locator(f'#figures dd[data-figure="{name}"]')


def shows(page: Page, name: str, value: str) -> None:
    expect(figure(page, name)).to_have_text(value, timeout=MILLISECONDS)


def rows(page: Page, table: str) -> list[list[str]]:
    lines = page.locator(f"#{table} tbody tr").all()
    return [line.locator("td").all_inner_texts() for line in lines]


def wait_for_row(page: Page, table: str, text: str) -> None:
    row = page.locator(f"#{table} tbody tr").filter(has_text=text)
    expect(row.first).to_be_visible(timeout=MILLISECONDS)


def test_the_figures_are_the_engines(watched: WatchedProgram, page: Page) -> None:
    watched.tell("work 1999")
    shows(page, "tasks done", "2,000")
    activity = watched.activity()
    assert activity["tasks"] == 2000
    shows(page, "failed", str(activity["failed"]))
    shows(page, "waiting", "0")
    shows(page, "with workers", "0")
    shows(page, "processes", "3")
    (function,) = activity["functions"]
    assert rows(page, "functions")[0][:3] == ["work", "2,000", str(function["failed"])]
    page.locator("#process-table").locator("xpath=ancestor::details").locator("summary").click()
    wait_for_row(page, "process-table", "PoolWorker-1")
    shown = rows(page, "process-table")
    assert sum(int(row[4].replace(",", "")) for row in shown) == 2000
    assert {row[2] for row in shown} == {str(child["pid"]) for child in activity["children"]}
    about = page.locator("#about").inner_text()
    assert str(watched.program.script) in about
    assert "backend local" in about
    assert page.locator("#name").inner_text() == f"program-{watched.program.pid}"


def test_the_token_is_not_in_the_address_or_in_reach_of_scripts(page: Page) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", page.url)
    assert page.evaluate("document.cookie") == ""
    (cookie,) = page.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
    page.reload()
    figure(page, "tasks done").wait_for()


def test_another_page_of_the_browser_cannot_read_or_listen(page: Page) -> None:
    other = page.context.new_page()
    other.goto("data:text/html,<title>other</title>")
    read = "url => fetch(url).then(() => 'read', () => 'refused')"
    assert other.evaluate(read, page.url + "output") == "refused"
    listen = (
        "url => new Promise(done => { const feed = new WebSocket(url);"
        " feed.onopen = () => done('listens'); feed.onerror = () => done('refused'); })"
    )
    assert other.evaluate(listen, page.url.replace("http", "ws") + "feed") == "refused"


def test_a_worker_that_dies_is_shown_with_its_reason(watched: WatchedProgram, page: Page) -> None:
    watched.tell("rest")
    wait_for_row(page, "slowest", "rest()")
    name = watched.tell("kill")
    wait_for_row(page, "deaths", name)
    assert rows(page, "deaths")[0][1:] == [name, "local", "killed by SIGKILL"]
    shows(page, "lost runs", "1")
    page.locator("#process-table").locator("xpath=ancestor::details").locator("summary").click()
    wait_for_row(page, "process-table", "killed by SIGKILL")


def test_the_page_says_that_the_program_does_not_answer(
    watched: WatchedProgram, page: Page
) -> None:
    os.kill(watched.program.pid, signal.SIGSTOP)
    try:
        expect(page.locator("#status")).to_have_text("does not answer", timeout=MILLISECONDS)
        expect(page.locator("#notice")).to_contain_text("does not answer within")
    finally:
        os.kill(watched.program.pid, signal.SIGCONT)
    expect(page.locator("#status")).to_have_text("running", timeout=MILLISECONDS)
    expect(page.locator("#notice")).to_be_hidden()


@pytest.mark.parametrize("killed", [False, True], ids=["by itself", "killed"])
def test_the_page_says_that_the_program_has_ended(
    watched: WatchedProgram, page: Page, killed: bool
) -> None:
    watched.tell("work 99")
    if killed:
        shows(page, "tasks done", "100")
        watched.program.kill()
    else:
        stdin = watched.program.process.stdin
        assert stdin is not None
        stdin.close()
        watched.program.finish()
    expect(page.locator("#status")).to_have_text("ended", timeout=MILLISECONDS)
    expect(page.locator("#notice")).to_contain_text("The program has ended")
    shows(page, "tasks done", "100")
    assert watched.program.left() == []


def test_the_timeline_is_one_canvas_that_keys_move(watched: WatchedProgram, page: Page) -> None:
    watched.tell("work 500")
    shows(page, "tasks done", "501")
    timeline = page.locator("#timeline")
    assert timeline.locator("*").count() == 2  # however many tasks there are
    drawn = "() => document.querySelector('#timeline canvas').toDataURL().length"
    page.wait_for_function(f"({drawn})() > 2000", timeout=MILLISECONDS)
    timeline.focus()
    whole = page.evaluate(drawn)
    for key in ("+", "+", "ArrowLeft", "-", "ArrowRight", "0"):
        page.keyboard.press(key)
    assert page.evaluate(drawn) > whole / 10
    timeline.hover(position={"x": 300, "y": 30})
    expect(page.locator("#tip")).to_contain_text("PoolWorker-1 on local", timeout=MILLISECONDS)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone_in_both_themes(page: Page, scheme: Any) -> None:
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 360, "height": 740})
    page.wait_for_function("document.documentElement.scrollWidth <= 360")
    background = "getComputedStyle(document.body).backgroundColor"
    channels = [int(word) for word in re.findall(r"\d+", page.evaluate(background))[:3]]
    assert (sum(channels) > 380) == (scheme == "light")


def test_each_control_is_reached_by_the_keyboard(page: Page) -> None:
    reached = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("document.activeElement.id || document.activeElement.dataset.act")
        )
    assert {"earlier", "later", "in", "out", "all", "living", "timeline", "show-output"} <= reached


def test_charts_have_their_figures_as_tables(watched: WatchedProgram, page: Page) -> None:
    watched.tell("work 50")
    shows(page, "tasks done", "51")
    for chart in ("rate", "tasks", "workers"):
        details = page.locator(f"#{chart}-table").locator("xpath=ancestor::details")
        details.locator("summary").click()
        wait_for_row(page, f"{chart}-table", " s")
    assert rows(page, "workers-table")[0][1] == "3"


def test_the_output_of_the_program_is_shown_if_it_goes_to_a_file(page: Page) -> None:
    page.locator("#show-output").click()
    expect(page.locator("#output-problem")).to_contain_text("its output goes to pipe")


def test_the_output_can_be_filtered(page: Page) -> None:
    page.route("**/output", lambda route: route.fulfill(json={"text": "[w-1] a\n[w-2] b\n"}))
    page.locator("#show-output").click()
    expect(page.locator("#output")).to_have_text("[w-1] a [w-2] b", timeout=MILLISECONDS)
    page.locator("#output-filter").fill("[w-2]")
    expect(page.locator("#output")).to_have_text("[w-2] b")


def test_the_page_draws_a_thousand_workers(browser: Browser, tmp_path: Path) -> None:
    """The page's modules, with a model that no server sends."""
    folder = Path(client.__file__).parents[1] / "_cli" / "dashboard_page"
    context = browser.new_context()
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.route("**/*", lambda route: _serve(route, folder))
    page.add_init_script(f"window.made = {json.dumps(_thousand_workers())};" + _FEED)
    page.goto("http://127.0.0.1:9/")
    expect(figure(page, "processes")).to_have_text("1,000", timeout=MILLISECONDS)
    page.locator("#timeline").focus()
    page.keyboard.press("End")
    page.wait_for_function(
        "document.getElementById('timeline').scrollHeight > 16000", timeout=MILLISECONDS
    )
    assert page.locator("#timeline *").count() == 2
    context.close()
    assert problems == []


_FEED = """
window.WebSocket = class extends EventTarget {
  constructor() {
    super();
    setTimeout(() => this.dispatchEvent(
      new MessageEvent("message", { data: JSON.stringify(window.made) })));
  }
};
"""


def _serve(route: Any, folder: Path) -> None:
    name = route.request.url.partition(":9/")[2] or "index.html"
    route.fulfill(path=folder / name)


def _thousand_workers() -> dict[str, Any]:
    children = []
    for number in range(1, 1001):
        spans = [[at, at + 0.9, f"f{at % 3}", 0.9, 5, 0] for at in range(20)]
        facts = {"id": number, "name": f"w{number}", "host": "h", "node": "n", "pid": number}
        more = {"pool": 1, "began": 0, "started": 0, "ready": 0, "ended": None, "reason": ""}
        children.append(
            {**facts, **more, "tasks": 100, "failed": 0, "work": 18, "held": 18, "spans": spans}
        )
    state = [
        {"name": c["name"], "host": "h", "node": "n", "pid": c["pid"], "state": "busy"}
        for c in children
    ]
    activity = {"complete": True, "now": 20, "start": 0, "revision": 1, "children": children}
    totals = {"tasks": 100_000, "failed": 0, "retried": 0, "lost": 0, "bytes_sent": 1}
    rates = {"width": 1, "done": [5000] * 20, "failed": [0] * 20}
    program = {"name": "p", "command": "c", "backend": "local", "started": 0}
    return {
        "program": {**program, "python": "3", "fiber": "1"},
        "activity": {**activity, **totals, "bytes_received": 1, "functions": [], "rates": rates},
        "state": {"pools": [], "children": state, "deaths": []},
        "samples": [],
        "status": {"state": "running", "text": ""},
    }
