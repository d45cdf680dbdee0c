"""A program whose tasks look for the credentials of agents, and try to be agents themselves.

It says ``spied`` with what a task found, ``posed`` with what impostors were told, and ``done`` once
its workers have worked again.  The program knows the keys, and tells the task in disguise what to
look for, so that the task finds only what was there before it came.
"""

from __future__ import annotations

import base64
import contextlib
import gc
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeVar

import fiber
from fiber._transport.authentication import Identity
from fiber._transport.credentials import OwnCredentials

T = TypeVar("T")
DISGUISE = bytes(byte ^ 0x5A for byte in range(256))
CANARY = "canary"
"""A secret that the task has in its memory, to see that it would be found there."""
SMALL = 1 << 20
"""Bytes of the largest file that is read."""


def main() -> None:
    """Have a task spy, and others pose as agents; the pool works as before."""
    with fiber.Pool(2) as pool:
        hosts: set[str] = set()
        while len(hosts) < 2:
            hosts |= set(pool.map(host, range(8), chunksize=1))
        identities = [found for found in _all(Identity) if found.name in hosts and found.uid]
        uids = {found.name: found.uid for found in identities}
        (credentials,) = _all(OwnCredentials)
        keys = {name: credentials.agent(name, uid).key for name, uid in uids.items()}
        sought = {CANARY: secrets.token_hex(32), "the pool": credentials.pool_key, **keys}
        disguised = {
            f"{whose}, {form}": word.translate(DISGUISE)
            for whose, key in sought.items()
            for form, word in _forms(key)
        }
        say("spied", **pool.apply(spy, (disguised,)))
        say("posed", **pool.apply(pose, (uids, keys, credentials.fingerprint)))
        say("done", hosts=sorted(set(pool.map(host, range(8), chunksize=1)) & hosts))


def host(_: int) -> str:
    """Return the pod that this runs in."""
    time.sleep(0.05)
    return socket.gethostname()


def say(event: str, **facts: object) -> None:
    """Print a line for the test."""
    print(json.dumps({"event": event, **facts}) + "\n", end="", flush=True)


def _all(kind: type[T]) -> list[T]:
    return [found for found in gc.get_objects() if isinstance(found, kind)]


def _forms(key: str) -> Iterator[tuple[str, bytes]]:
    raw = bytes.fromhex(key)
    yield "hexadecimal", key.encode()
    yield "bytes", raw
    yield "base64", base64.b64encode(raw)


# -- The tasks


def spy(disguised: Mapping[str, bytes]) -> dict[str, object]:
    """Return which secrets are found where, and which processes' memory this one can read."""
    canary = disguised[f"{CANARY}, hexadecimal"].translate(DISGUISE)
    found: dict[str, list[str]] = {}
    opened = []
    with _copy_of_this_process():
        for place, data in _readable():
            opened.append(place)
            hidden = data.translate(DISGUISE)
            for what, word in disguised.items():
                if word in hidden:
                    found.setdefault(what, []).append(place)
    del canary
    return {"found": found, "opened": sorted(set(opened))}


@contextlib.contextmanager
def _copy_of_this_process() -> Iterator[None]:
    """Have a process with the memory of this one, and without what this one reads from now on."""
    copy = os.fork()
    if not copy:
        signal.pause()
    try:
        yield
    finally:
        os.kill(copy, signal.SIGKILL)
        os.waitpid(copy, 0)


def _readable() -> Iterator[tuple[str, bytes]]:
    for entry in os.listdir("/proc"):
        if entry.isdigit() and int(entry) != os.getpid():
            yield from _of_process(Path("/proc", entry))
    mounts = (line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines())
    folders = [mount for mount in mounts if not mount.startswith(("/proc", "/sys"))]
    for folder in {*folders, tempfile.gettempdir(), os.getcwd()} - {"/"}:
        for path in (Path(folder), *Path(folder).rglob("*")):
            with contextlib.suppress(OSError):
                if path.is_file() and path.stat().st_size < SMALL:
                    yield str(path), path.read_bytes()


def _of_process(folder: Path) -> Iterator[tuple[str, bytes]]:
    for name in ("environ", "cmdline"):
        with contextlib.suppress(OSError):
            yield str(folder / name), (folder / name).read_bytes()
    with contextlib.suppress(OSError), open(folder / "mem", "rb", buffering=0) as memory:
        for line in (folder / "maps").read_text().splitlines():
            span, rights, *_ = line.split()
            first, last = (int(address, 16) for address in span.split("-"))
            if rights.startswith("rw"):
                with contextlib.suppress(OSError):
                    data = os.pread(memory.fileno(), last - first, first)
                    yield str(folder / "mem"), data


def pose(uids: Mapping[str, str], keys: Mapping[str, str], master: str) -> dict[str, object]:
    """Dial the program as agents that this pod's is not, with all that its agent has."""
    own = socket.gethostname()
    (other,) = set(uids) - {own}
    has = {"key": keys[own], "master": master}
    return {
        "other": other,
        "as another": _agent({"name": other, "uid": uids[other], **has}),
        "a second time": _agent({"name": own, "uid": uids[own], **has}),
        "as none": _agent({"name": own, "uid": "0", **has}),
    }


def _agent(credentials: Mapping[str, str]) -> str:
    """Return the errors of an agent with these credentials, which must end with status 1."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "agent.json")
        file.write_text(json.dumps(credentials))
        environment = {"FIBER_AGENT_ADDRESS": _master(), "FIBER_AGENT_CREDENTIALS": str(file)}
        done = subprocess.run(
            [sys.executable, "-m", "fiber.agent"],
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
        )
    assert done.returncode == 1, done
    return done.stderr


def _master() -> str:
    """Return where the agent of this pod is connected to."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, _, remote, state, *_ = line.split()
        address, _, port = remote.partition(":")
        host = socket.inet_ntoa(bytes.fromhex(address)[::-1])
        if state == "01" and not host.startswith("127."):
            return f"{host}:{int(port, 16)}"
    raise LookupError("this pod has no connection")


if __name__ == "__main__":
    main()
