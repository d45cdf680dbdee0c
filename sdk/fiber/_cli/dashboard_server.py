"""Web server of the live page.  It serves one person on this machine, and changes nothing.

A request is answered only if

* its ``Host`` is this machine's loopback; this refuses DNS rebinding,
* its ``Origin``, if it has one, is the page's; this refuses pages of other servers,
* it has the cookie that the printed address is exchanged for.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from aiohttp import WSCloseCode, web

from fiber._cli.dashboard_model import ProgramModel
from fiber._cli.dashboard_poller import News
from fiber._cli.failures import CommandError

ADDRESS = "127.0.0.1"

_PAGE = Path(__file__).with_name("dashboard_page")

_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}

_MOST_PAGES = 32
_BACKLOG = 8
"""Updates that wait for a page.  A page that is further behind gets the whole model instead."""

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}

_LOGGED_IN = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Fiber</title>
<meta http-equiv="refresh" content="0; url=/"><p><a href="/">Open the page</a></p></html>
"""
"""Page that replaces the address with the token.  It is a page and no redirection, because a
browser sends a strict cookie only from a page of the same server."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def listen(port: int) -> socket.socket:
    """Return a socket that listens at a port of the loopback; 0 takes a free one; CommandError."""
    made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((ADDRESS, port))
        made.listen(64)
    except OSError as error:
        made.close()
        raise CommandError(
            f"cannot serve the page at port {port} of {ADDRESS}",
            str(error.strerror or error),
            "choose another port with --port, or leave it out for a free one",
        ) from error
    made.setblocking(False)
    return made


class OpenPage:
    """Connection of one page, with the updates that wait for it."""

    def __init__(self) -> None:
        self._updates: asyncio.Queue[str | None] = asyncio.Queue(_BACKLOG)
        self.is_behind = True
        """True if the page needs the whole model next."""

    def put(self, update: str | None) -> None:
        """Add an update; None ends the connection."""
        if update is not None and self.is_behind:
            return
        if self._updates.full():
            self.is_behind = True
            while not self._updates.empty():
                self._updates.get_nowait()
            self._updates.put_nowait("")  # wakes the sender
        if update is None or not self.is_behind:
            self._updates.put_nowait(update)

    async def get(self) -> str | None:
        """Return the next update."""
        return await self._updates.get()


class PageServer:
    """Server of the page.  Runs on the event loop of asyncio.

    ``opened`` and ``closed`` are called for each page; ``output`` returns the last lines that the
    program has written, or why they are not known.
    """

    def __init__(
        self,
        listener: socket.socket,
        opened: Callable[[], None],
        closed: Callable[[], None],
        output: Callable[[dict[str, Any]], dict[str, Any]],
    ) -> None:
        self.model = ProgramModel()
        self.token = secrets.token_urlsafe(32)
        self.port: int = listener.getsockname()[1]
        self._listener = listener
        self._session = secrets.token_urlsafe(32)
        self._opened, self._closed, self._output = opened, closed, output
        self._status: dict[str, Any] = {"state": "connecting", "text": ""}
        self._pages: set[OpenPage] = set()
        self._runner: web.AppRunner | None = None

    @property
    def url(self) -> str:
        """Address with the token, which opens the page."""
        return f"http://{ADDRESS}:{self.port}/?token={self.token}"

    @property
    def _cookie(self) -> str:
        """Name of the cookie: browsers send the cookies of all ports to each port."""
        return f"fiber-dashboard-{self.port}"

    async def start(self) -> None:
        """Begin to answer."""
        app = web.Application(middlewares=[self._check])
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/", self._index)
        app.router.add_get("/feed", self._feed)
        app.router.add_get("/output", self._program_output)
        for path in sorted(_PAGE.rglob("*")):
            if path.suffix in (".css", ".js"):
                app.router.add_get(f"/{path.relative_to(_PAGE)}", _file(path))
        # The log of requests would have the token.
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        await web.SockSite(self._runner, self._listener).start()

    async def close(self) -> None:
        """Tell the pages that this is the end, and stop."""
        for page in self._pages:
            page.put(None)
        if self._runner is not None:
            await self._runner.cleanup()

    def publish(self, news: News) -> None:
        """Merge what the program has said, and send it to the pages."""
        if news.activity is None or news.state is None:
            state = "ended" if news.has_ended else "silent"
            self.set_status(state, news.problem)
            return
        self._status = {"state": "running", "text": ""}
        self.model.program = news.program
        self.model.merge_activity(news.activity)
        sample = self.model.merge_state(news.state)
        update = {
            "program": news.program,
            "activity": news.activity,
            "state": news.state,
            "sample": sample,
            "status": self._status,
        }
        if self._pages:
            self._send(json.dumps(update))

    def set_status(self, state: str, text: str) -> None:
        """Tell the pages that the program does not answer, or has ended."""
        self._status = {"state": state, "text": text}
        self._send(json.dumps({"status": self._status}))

    def _send(self, update: str) -> None:
        for page in self._pages:
            page.put(update)

    # Requests

    @web.middleware
    async def _check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        hosts = (f"{ADDRESS}:{self.port}", f"localhost:{self.port}")
        origin = request.headers.get("Origin")
        if request.headers.get("Host", "") not in hosts:
            return _refused("this is not the address of the page")
        if origin is not None and origin not in [f"http://{host}" for host in hosts]:
            return _refused("the request comes from another page")
        given = request.query.get("token")
        if given is not None and request.path == "/" and _equal(given, self.token):
            return self._log_in()
        if not _equal(request.cookies.get(self._cookie, ""), self._session):
            return _refused("open the address that the command has printed")
        return await handler(request)

    def _log_in(self) -> web.Response:
        response = web.Response(text=_LOGGED_IN, content_type="text/html")
        response.set_cookie(self._cookie, self._session, httponly=True, samesite="Strict", path="/")
        return response

    async def _index(self, request: web.Request) -> web.StreamResponse:
        return await _file(_PAGE / "index.html")(request)

    async def _program_output(self, request: web.Request) -> web.Response:
        program = self.model.program
        if program is None:
            return web.json_response({"problem": "the program has not answered yet"})
        return web.json_response(await asyncio.to_thread(self._output, program))

    async def _feed(self, request: web.Request) -> web.StreamResponse:
        """Send the model to a page, and then each update, over a WebSocket."""
        if request.headers.get("Origin") is None:
            return _refused("a page of this server names its origin")
        if len(self._pages) >= _MOST_PAGES:
            return web.Response(status=503, text=f"{_MOST_PAGES} pages are open; close one\n")
        feed = web.WebSocketResponse(heartbeat=20.0, max_msg_size=1024)
        await feed.prepare(request)
        page = OpenPage()
        self._pages.add(page)
        self._opened()
        sender = asyncio.create_task(self._keep_sending(feed, page))
        try:
            async for _ in feed:  # a page has nothing to say
                pass
        finally:
            self._pages.discard(page)
            self._closed()
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
        return feed

    async def _keep_sending(self, feed: web.WebSocketResponse, page: OpenPage) -> None:
        update: str | None = ""
        try:
            while update is not None:
                if page.is_behind:
                    page.is_behind = False
                    update = json.dumps({**self.model.complete(), "status": self._status})
                if update:
                    await feed.send_str(update)
                update = await page.get()
        except ConnectionError:  # the page is gone
            return
        await feed.close(code=WSCloseCode.GOING_AWAY)


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(_HEADERS)


def _file(path: Path) -> Handler:
    async def answer(request: web.Request) -> web.StreamResponse:
        return web.Response(
            text=path.read_text(encoding="utf-8"), content_type=_TYPES[path.suffix], charset="utf-8"
        )

    return answer


def _refused(reason: str) -> web.Response:
    return web.Response(status=403, text=f"403: {reason}\n")


def _equal(given: str, expected: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), expected.encode())
