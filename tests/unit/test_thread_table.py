"""docs/architecture.md names every thread that the SDK starts."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NAMED = re.compile(r"\"(fiber-[a-z-]+|QueueFeederThread)(?:\{kind\})?\"")
STARTS = re.compile(r"name=f?(\"[^\"]+\")|thread\((\"[^\"]+\")\)|start_thread\((\"[^\"]+\")\)")


def test_every_thread_is_in_the_table() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = set(re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE))
    started = set()
    for path in (ROOT / "sdk" / "fiber").rglob("*.py"):
        for found in STARTS.findall(path.read_text(encoding="utf-8")):
            if name := NAMED.fullmatch("".join(found)):
                started.add(name[1] + "…" if name[1].endswith("-") else name[1])
    assert started
    assert started <= table
