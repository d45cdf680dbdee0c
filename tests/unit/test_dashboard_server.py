"""The server of the live page: who is refused, what a page gets, and how it ends."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import pytest

from fiber._cli import dashboard_server
from fiber._cli.dashboard_poller import News
from fiber._cli.dashboard_server import OpenPage, PageServer, listen
from fiber._cli.failures import CommandError
from patience import PATIENCE
from unit.pool_command_rig import run
from unit.test_dashboard_poller import ScriptedProgram, poller_of


class Site:
    """Server under test, with a client that has logged in."""

    def __init__(self, server: PageServer, client: aiohttp.ClientSession) -> None:
        self.server = server
        self.client = client
        self.origin = f"http://127.0.0.1:{server.port}"
        self.program = ScriptedProgram()
        self.poller = poller_of(self.program.ask)
        self.opened: list[str] = []

    async def status(self, path: str, **headers: str) -> int:
        async with self.client.get(self.origin + path, headers=headers) as response:
            return response.status

    def look(self) -> None:
        self.server.publish(self.poller.look())

    @asynccontextmanager
    async def feed(self) -> AsyncIterator[Callable[[], Awaitable[dict[str, Any]]]]:
        """Yield the function that returns the next update of a page."""
        headers = {"Origin": self.origin}
        async with self.client.ws_connect(f"{self.origin}/feed", headers=headers) as feed:

            async def get() -> dict[str, Any]:
                return dict(json.loads(await feed.receive_str(timeout=PATIENCE)))

            yield get

    async def log_in(self) -> None:
        assert await self.status(f"/?token={self.server.token}") == 200


@asynccontextmanager
async def serving() -> AsyncIterator[Site]:
    calls: list[str] = []
    server = PageServer(
        listen(0),
        lambda: calls.append("opened"),
        lambda: calls.append("closed"),
        lambda program: {"text": f"output of {program['pid']}"},
    )
    await server.start()
    jar = aiohttp.CookieJar(unsafe=True)  # the name of the server is an address
    async with aiohttp.ClientSession(cookie_jar=jar) as client:
        site = Site(server, client)
        site.opened = calls
        try:
            yield site
        finally:
            await server.close()


def play(scene: Callable[[Site], Awaitable[None]]) -> None:
    """Play a scene with a server, within the deadline."""

    async def run() -> None:
        async with serving() as site:
            await asyncio.wait_for(scene(site), PATIENCE)

    asyncio.run(run())


PATHS = ["/", "/main.js", "/dashboard.css", "/vendor/uPlot.iife.min.js", "/feed", "/output", "/x"]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("token", ["", "?token=", "?token=wrong", "?token=%ff%00"])
def test_nothing_is_served_without_the_token(path: str, token: str) -> None:
    async def scene(site: Site) -> None:
        assert await site.status(path + token, Origin=site.origin) == 403

    play(scene)


def test_the_token_becomes_a_cookie_that_scripts_do_not_see() -> None:
    async def scene(site: Site) -> None:
        async with site.client.get(f"{site.origin}/?token={site.server.token}") as response:
            cookie = response.headers["Set-Cookie"]
            assert site.server.token not in cookie
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
            assert 'content="0; url=/"' in await response.text()
        for path in ("/", "/main.js", "/vendor/uPlot.min.css"):
            assert await site.status(path) == 200
        assert await site.status("/nothing") == 404
        assert await site.status("/../dashboard.py") == 404
        site.client.cookie_jar.clear()
        assert await site.status("/") == 403

    play(scene)


def test_the_token_opens_only_the_page() -> None:
    async def scene(site: Site) -> None:
        assert await site.status(f"/main.js?token={site.server.token}") == 403

    play(scene)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "[::1]", ""])
def test_another_host_is_refused(host: str) -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        named = host.format(port=site.server.port)
        assert await site.status("/", Host=named) == 403
        assert await site.status(f"/?token={site.server.token}", Host=named) == 403
        assert await site.status("/", Host=f"localhost:{site.server.port}") == 200

    play(scene)


@pytest.mark.parametrize("origin", ["https://evil.example", "http://127.0.0.1:1", "null"])
def test_a_page_of_another_server_is_refused(origin: str) -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        for path in ("/", "/feed", "/output"):
            assert await site.status(path, Origin=origin) == 403
        assert await site.status("/feed") == 403  # a WebSocket without an origin

    play(scene)


def test_nothing_can_be_changed() -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            async with site.client.request(method, site.origin + "/output") as response:
                assert response.status == 405

    play(scene)


@pytest.mark.parametrize("path", ["/", "/main.js", "/nothing"])
@pytest.mark.parametrize("is_known", [True, False])
def test_each_response_has_the_policy(path: str, is_known: bool) -> None:
    async def scene(site: Site) -> None:
        if is_known:
            await site.log_in()
        async with site.client.get(site.origin + path) as response:
            policy = response.headers["Content-Security-Policy"]
            assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
            assert "unsafe" not in policy
            assert response.headers["X-Content-Type-Options"] == "nosniff"
            assert response.headers["Referrer-Policy"] == "no-referrer"
            assert response.headers["Cache-Control"] == "no-store"

    play(scene)


# What a page gets


def test_a_page_gets_the_model_and_then_what_changes() -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        site.look()
        async with site.feed() as get:
            first = await get()
            assert first["activity"]["complete"]
            assert first["status"] == {"state": "running", "text": ""}
            assert len(first["samples"]) == 1
            site.program.work()
            site.look()
            second = await get()
            assert not second["activity"]["complete"]
            assert [child["id"] for child in second["activity"]["children"]] == [2]
            async with site.feed() as get_second:
                later = await get_second()
                assert [child["id"] for child in later["activity"]["children"]] == [1, 2]
        while site.opened.count("closed") < 2:
            await asyncio.sleep(0)
        assert site.opened[:1] == ["opened"]

    play(scene)


def test_a_page_is_told_that_the_program_is_silent_or_has_ended() -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        async with site.feed() as get:
            assert (await get())["status"]["state"] == "connecting"
            for news, state in (
                (News(problem="busy"), {"state": "silent", "text": "busy"}),
                (News(problem="gone", has_ended=True), {"state": "ended", "text": "gone"}),
            ):
                site.server.publish(news)
                assert (await get()) == {"status": state}

    play(scene)


def test_the_last_update_arrives_before_the_end() -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        async with site.feed() as get:
            await get()
            site.server.set_status("ended", "")
            closing = asyncio.create_task(site.server.close())
            assert (await get())["status"]["state"] == "ended"
            await closing

    play(scene)


def test_a_page_that_is_far_behind_gets_the_whole_model() -> None:
    async def scene() -> None:
        page = OpenPage()
        page.is_behind = False
        for number in range(dashboard_server._BACKLOG):
            page.put(str(number))
        assert await page.get() == "0"
        page.put("more")
        page.put("too much")
        assert page.is_behind
        assert await page.get() == ""  # the sender looks at `is_behind`
        page.put("part of the model")
        page.put(None)
        assert await page.get() is None

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_the_number_of_pages_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dashboard_server, "_MOST_PAGES", 1)

    async def scene(site: Site) -> None:
        await site.log_in()
        async with site.feed() as get:
            await get()
            assert await site.status("/feed", Origin=site.origin) == 503

    play(scene)


def test_the_output_of_the_program() -> None:
    async def scene(site: Site) -> None:
        await site.log_in()
        async with site.client.get(site.origin + "/output") as response:
            assert "not answered yet" in (await response.json())["problem"]
        site.look()
        async with site.client.get(site.origin + "/output") as response:
            assert await response.json() == {"text": "output of 1"}

    play(scene)


# Ports


def test_the_server_listens_at_the_loopback_only() -> None:
    with listen(0) as made:
        assert made.getsockname()[0] == "127.0.0.1"


def test_a_taken_port_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(CommandError, match=f"cannot serve the page at port {port}") as caught:
            listen(port)
    assert "--port" in caught.value.remedy


def test_a_port_that_does_not_exist_is_a_mistake_of_the_command_line() -> None:
    assert run("dashboard", "x", "--port", "65536").status == 2
