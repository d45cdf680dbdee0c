"""``fiber dashboard`` of a program in a pod, on a cluster whose pods run real launchers."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from patience import PATIENCE
from unit.kubernetes_rig import NAMESPACE
from unit.run_rig import Site, interrupt, read_line, run_site

ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")

PROGRAM = """
import time, fiber
if __name__ == "__main__":
    fiber.init(backend="local")
    with fiber.Pool(2) as pool:
        pool.map(abs, range(50))
        print("begun", flush=True)
        time.sleep(3600)
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    folder = tmp_path / "pod"
    folder.mkdir()
    monkeypatch.setenv("FIBER_RUNTIME_DIRECTORY", str(folder))  # of the pod alone
    with run_site(tmp_path) as site:
        yield site


async def updates_until(address: str, state: str) -> list[dict[str, Any]]:
    """Return what a page gets until the program is in this state."""
    origin = address.partition("/?")[0]
    jar = aiohttp.CookieJar(unsafe=True)
    updates: list[dict[str, Any]] = []
    async with aiohttp.ClientSession(cookie_jar=jar) as client:
        async with client.get(address) as response:
            assert response.status == 200
        async with client.ws_connect(f"{origin}/feed", headers={"Origin": origin}) as feed:
            while not updates or updates[-1]["status"]["state"] != state:
                updates.append(json.loads(await feed.receive_str(timeout=PATIENCE)))
        async with client.get(f"{origin}/output") as response:
            updates.append(await response.json())
    return updates


def test_a_program_in_a_pod_is_shown_until_its_end(site: Site) -> None:
    site.write("train.py", PROGRAM)
    running = site.begin("run", "--name", "mine", "train.py")
    command = site.spawn("dashboard", "mine", "--namespace", NAMESPACE)
    assert command.stdout is not None
    assert command.stderr is not None
    found = ADDRESS.search(read_line(command.stdout, b"http").decode())
    assert found is not None
    *_, update, output = asyncio.run(updates_until(found[0], "running"))
    assert update["activity"]["tasks"] == 50
    assert len(update["state"]["children"]) == 2
    assert update["program"]["backend"] == "local"
    assert "begun\n" in output["text"]
    interrupt(running)
    running.communicate(timeout=PATIENCE)
    *_, last, _ = asyncio.run(updates_until(found[0], "ended"))
    assert last["status"]["state"] == "ended"
    read_line(command.stderr, b"has ended")
    interrupt(command)
    assert site.end(command).status == 130
