"""Pictures of the live page for the documentation, in both themes.

PYTHONPATH=tests python -m docsite.screenshots     writes docs/images/dashboard-*.png

It needs Chromium (.ci/browser installs it).
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Literal

from PIL import Image
from playwright.sync_api import Page

import browser as browsers
from docsite import ROOT

_PROGRAM = Path(__file__).with_name("dashboard_program.py")
_ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")
_COLOURS = 128
"""Colours of a picture.  More would make the file larger, and not better."""

_SCHEMES: tuple[Literal["light"], Literal["dark"]] = ("light", "dark")

_WIDTH, _HEIGHT = 1100, 1330


def main() -> None:
    """Run the program, and take the pictures."""
    with subprocess.Popen(
        ["python", _PROGRAM.name],  # the page shows it
        env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        cwd=_PROGRAM.parent,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        assert program.stderr is not None
        found = _ADDRESS.search(program.stderr.readline())
        assert found is not None
        with browsers.opened() as browser:
            program.stdout.readline()
            page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
            page.goto(found[0])
            page.locator("#slowest tbody tr").nth(3).wait_for()
            for scheme in _SCHEMES:
                _take(page, scheme)
        program.kill()


def _take(page: Page, scheme: Literal["light", "dark"]) -> None:
    page.emulate_media(color_scheme=scheme)
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        small = picture.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
        path = ROOT / "docs" / "images" / f"dashboard-{scheme}.png"
        small.save(path, optimize=True)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size >> 10} KiB")


if __name__ == "__main__":
    main()
