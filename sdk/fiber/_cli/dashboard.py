"""``fiber dashboard``: a live page of a program, for a browser on this machine."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from fiber._cli import local_logs
from fiber._cli.asking import Ask, find_program
from fiber._cli.dashboard_poller import PATIENCE, News, ProgramPoller
from fiber._cli.failures import USAGE, CommandError
from fiber._cli.local import find_local, only_program
from fiber._cli.logs import last_lines
from fiber._cli.session import cluster_options
from fiber._monitor import client

if TYPE_CHECKING:
    from fiber._cli.dashboard_server import PageServer

_LAST_LOOK = 1.0
"""Seconds that the last look at a program that ends may take."""

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
"""Variables of which one is set if a browser can open a window."""

_OPENS = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Fiber</title>
<meta http-equiv="refresh" content="0; url={url}"><p><a href="{url}">Open the page</a></p></html>
"""


@click.command("dashboard")
@click.argument("name", required=False)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    metavar="PORT",
    help="Port of this machine.  Default: a free one.",
)
@click.option(
    "--open/--no-open",
    "opens",
    default=None,
    help="Open a browser.  Default: only in a terminal of a desktop.",
)
@click.option("--for-program", is_flag=True, hidden=True, help="Serve the program that started it.")
@cluster_options
def command(
    name: str | None,
    port: int,
    opens: bool | None,
    for_program: bool,
    namespace: str | None,
    context: str | None,
) -> None:
    """Serve a live page of a program: its tasks, workers, hosts, functions and deaths.

    NAME may be left out if one program runs on this machine.  The command prints the page's
    address, which has a secret: only a browser that knows it sees the page.  The page shows this
    machine's user what the program does, and changes nothing.  Ctrl-C ends it.

    \b
    Examples:
      fiber dashboard
      fiber dashboard train-4f2a1 --port 8787 --no-open
    """
    _need_aiohttp()
    if for_program:
        _serve_own_program(port)
        return
    name = name or only_program()
    _check_that_it_runs(name, context, namespace)
    output = partial(_output, name, context, namespace)
    find = partial(find_program, name, context, namespace, PATIENCE)
    asyncio.run(_serve(name, find, port, output, opens))


def _need_aiohttp() -> None:
    try:
        import aiohttp  # noqa: F401
    except ModuleNotFoundError as error:
        raise CommandError(
            "the dashboard needs a package that is not installed",
            str(error),
            "pip install 'fiberpool[dashboard]'",
            USAGE,
        ) from error


def _check_that_it_runs(name: str, context: str | None, namespace: str | None) -> None:
    """Raise CommandError if there is no such program.  A silent one may answer later."""
    with contextlib.suppress(client.NoAnswer):
        for _ in find_program(name, context, namespace)({}):
            return


def _serve_own_program(port: int) -> None:
    """Serve the program that started this process, until standard input ends.

    Its first line has the path of the program's monitor.
    """
    line = sys.stdin.buffer.readline()
    if not line:  # the program has ended already
        return
    facts = json.loads(line)
    ask: Ask = partial(client.ask, facts["monitor"], patience=PATIENCE)
    asyncio.run(_serve_until_the_end(facts["name"], lambda: ask, port))


async def _serve(
    name: str,
    find: Callable[[], Ask],
    port: int,
    output: Callable[[dict[str, Any]], dict[str, Any]],
    opens: bool | None,
) -> None:
    server, _ = await _started(find, port, output, always=False, seen=_tell_the_end(name))
    click.echo(f"The dashboard of {name} is at {server.url}")
    click.echo("Ctrl-C ends it.", err=True)
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    with _opened(server.url) if _is_wanted(opens) else contextlib.nullcontext():
        try:
            await ended.wait()
        finally:
            await server.close()


async def _serve_until_the_end(name: str, find: Callable[[], Ask], port: int) -> None:
    loop = asyncio.get_running_loop()
    ending = asyncio.Event()
    server, poller = await _started(find, port, _own_output, always=True)
    click.echo(f"the dashboard of {name} is at {server.url}")
    loop.add_reader(0, _read_on, ending)
    await ending.wait()
    loop.remove_reader(0)
    await asyncio.to_thread(poller.end, _LAST_LOOK)
    server.set_status("ended", "")
    await server.close()


def _read_on(ending: asyncio.Event) -> None:
    if not os.read(0, 4096):
        ending.set()


async def _started(
    find: Callable[[], Ask],
    port: int,
    output: Callable[[dict[str, Any]], dict[str, Any]],
    *,
    always: bool,
    seen: Callable[[News], None] | None = None,
) -> tuple[PageServer, ProgramPoller]:
    """Start a server and the poller that it publishes; ``seen`` gets the news after it."""
    from fiber._cli.dashboard_server import PageServer, listen  # it needs aiohttp

    loop = asyncio.get_running_loop()

    def publish(news: News) -> None:
        server.publish(news)
        if seen is not None:
            seen(news)

    def pass_on(news: News) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and this thread ends with it
            loop.call_soon_threadsafe(publish, news)

    poller = ProgramPoller(find, pass_on, always=always)
    server = PageServer(listen(port), poller.opened, poller.closed, output)
    await server.start()
    poller.start()
    return server, poller


def _tell_the_end(name: str) -> Callable[[News], None]:
    printed: list[str] = []

    def seen(news: News) -> None:
        if news.has_ended and not printed:
            printed.append(name)
            click.echo(f"The program {name} has ended.  Its page stays until Ctrl-C.", err=True)

    return seen


# Output of the program


def _output(
    name: str, context: str | None, namespace: str | None, program: dict[str, Any]
) -> dict[str, Any]:
    """Return the last lines of a program, on this machine or in its pod."""
    try:
        if find_local(name, context, namespace) is None:
            return {"text": last_lines(name, context, namespace)}
        return _own_output(program)
    except CommandError as error:
        return {"problem": f"{error.what}: {error.why}"}


def _own_output(program: dict[str, Any]) -> dict[str, Any]:
    try:
        return {"text": local_logs.tail(program["name"], program["pid"])}
    except CommandError as error:
        return {"problem": f"{error.what}: {error.why}"}


# Browser


def _is_wanted(opens: bool | None) -> bool:
    """Return whether to open a browser.  One that draws in the terminal would take that over."""
    if opens is None:
        return sys.stdout.isatty() and any(map(os.environ.get, _DISPLAYS))
    return opens


@contextlib.contextmanager
def _opened(url: str) -> Iterator[None]:
    """Open the page in a browser, if there is one.

    The browser gets the address of a file that leads to the page: other users of this machine see
    the arguments of processes, and the page's address has a secret.
    """
    import webbrowser

    folder = tempfile.mkdtemp(prefix="fiber-dashboard-")  # only this user can read it
    try:
        path = os.path.join(folder, "open.html")
        with open(path, "w", encoding="utf-8") as file:
            file.write(_OPENS.format(url=url))
        threading.Thread(
            target=webbrowser.open, args=(f"file://{path}",), name="fiber-browser", daemon=True
        ).start()
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
