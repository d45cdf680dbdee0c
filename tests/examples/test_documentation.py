"""Test the documentation: its programs run, its links lead to existing pages."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.run_example import BACKENDS, environment

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("[!.]*/**/README.md")],
)
FENCED = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BENCHMARKS = (ROOT / "docs" / "benchmarks" / "README.md").read_text(encoding="utf-8")
LINK = re.compile(r"\]\(([^)\s#]+)[^)]*\)")
PLACE = re.compile(r"\]\(([^)\s#:]*)#([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
BLOCK = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)

PROGRESS = re.compile(r"^\[fiber\] .+: \d+ of \d+ tasks, .*\n", re.MULTILINE)
"""Line that a program with ``progress=True`` prints."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def programs() -> Iterator[object]:
    """Return every block that is fenced as python: each is a program (`py` marks fragments)."""
    for page in PAGES:
        for number, text in enumerate(FENCED.findall(page.read_text(encoding="utf-8")), 1):
            yield pytest.param(text, id=f"{name_of(page)} {number}")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("program", list(programs()))
def test_programs_of_the_documentation_run(program: str, backend: str, tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env=environment(backend),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert not PROGRESS.sub("", done.stderr)


@pytest.mark.parametrize("name", ["README.md", "docs/README.md"])
def test_the_first_page_fits_a_screen(name: str) -> None:
    first = (ROOT / name).read_text(encoding="utf-8").partition("\n## ")[0]
    program = FENCED.search(first)
    assert program is not None
    assert len(program[1].strip().splitlines()) <= 10
    assert len(LINK.findall(first)) == 3
    assert len(first.splitlines()) <= 32


@pytest.mark.parametrize(
    ("figure", "row"),
    [
        (r"runs (\d+) times as many tasks", "no-op tasks, chunksize 1"),
        (
            r"`apply` takes ([\d.]+) times as long",
            "latency of one apply, function of __main__, p50",
        ),
        (r"through a pipe ([\d.]+) times", "Pipe round trip, 1 MB"),
    ],
)
def test_the_readme_has_the_figures_of_the_benchmarks(figure: str, row: str) -> None:
    measured = re.search(rf"^\| {row} \|.*\| ([\d.]+)x \|", BENCHMARKS, re.MULTILINE)
    shown = re.search(figure, (ROOT / "README.md").read_text(encoding="utf-8"))
    assert measured is not None
    assert shown is not None
    decimals = len(shown[1].partition(".")[2])
    assert shown[1] == f"{float(measured[1]):.{decimals}f}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files(page: Path) -> None:
    links = LINK.findall(page.read_text(encoding="utf-8"))
    inside = [link for link in links if "://" not in link]
    assert [link for link in inside if not os.path.exists(page.parent / link)] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_headings(page: Path) -> None:
    links = PLACE.findall(BLOCK.sub("", page.read_text(encoding="utf-8")))
    pages = [(link, page.parent / link if link else page, place) for link, place in links]
    missing = [
        f"{link}#{place}"
        for link, target, place in pages
        if target.suffix == ".md" and place not in anchors(target)
    ]
    assert missing == []


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings: lower-case, without punctuation, hyphens for spaces."""
    headings = HEADING.findall(BLOCK.sub("", page.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", found.lower()).replace(" ", "-") for found in headings}


def test_makes_targets_are_the_ones_that_are_shown() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z0-9-]+):", makefile, re.MULTILINE))
    for page in PAGES:
        shown = re.findall(r"(?:`|\$ )make ([a-z0-9-]+)", page.read_text(encoding="utf-8"))
        assert set(shown) <= targets, page
