"""Files of the live page: nothing comes from another host, and nothing needs a weaker policy."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest

import fiber

PAGE = Path(fiber.__file__).parent / "_cli" / "dashboard_page"
OWN = sorted(path for path in PAGE.iterdir() if path.is_file())
VENDOR = PAGE / "vendor"


def test_the_files_of_others_are_unchanged() -> None:
    noted = re.findall(
        r"^([0-9a-f]{64})  (\S+)$", (VENDOR / "README.md").read_text("utf-8"), re.MULTILINE
    )
    assert {name for _, name in noted} == {"uPlot.iife.min.js", "uPlot.min.css"}
    for checksum, name in noted:
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == checksum
    assert "MIT License" in (VENDOR / "uPlot.LICENSE").read_text("utf-8")


@pytest.mark.parametrize("path", OWN, ids=lambda path: str(path.name))
def test_a_file_names_no_other_host_and_makes_no_code(path: Path) -> None:
    text = path.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
    addresses = re.findall(r"\b(?:https?|wss?)://[^`\"'\s]+", text)
    assert [address for address in addresses if address != "ws://${location.host}/feed"] == []
    assert re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|eval\(|new Function", text) == []


def test_the_page_has_no_code_or_style_of_its_own() -> None:
    text = (PAGE / "index.html").read_text("utf-8")
    assert re.findall(r"<style|\sstyle=|\son\w+=|javascript:", text) == []
    assert re.findall(r"<script(?![^>]*\ssrc=)", text) == []


def test_each_chart_has_a_table_that_says_the_same() -> None:
    text = (PAGE / "index.html").read_text("utf-8")
    described = re.findall(r'role="img"[^>]* aria-describedby="([\w-]+)"', text)
    assert len(described) == 5
    for name in described:
        assert f'<table id="{name}">' in text


@pytest.mark.parametrize("path", OWN, ids=lambda path: str(path.name))
def test_files_are_short(path: Path) -> None:
    assert len(path.read_text("utf-8").splitlines()) <= 400
