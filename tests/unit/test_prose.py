"""Prose as CONTRIBUTING.md asks: docstrings begin with a verb or a noun, tables have short cells.

A reader must guess the noun of a docstring that begins with a pronoun or a question word.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

BADLY = re.compile(
    "(As|By|For|Has|Here|How|In|Is|It|Its|Nobody|Nothing|Of|On|One|Such|That|There|These|They|This"
    r"|Those|To|What|Whatever|When|Where|Whether|Which|Who|Whoever|With|Without)\b"
)

VAGUE = re.compile(r"\b(whoever|whatever)\b", re.IGNORECASE)
MOST_VAGUE = 40
MOST_WORDS_OF_A_CELL = 40
CELL_BORDER = re.compile(r"(?<!\\)\|")
NAMED_CLASS = re.compile(r"\b[A-Z][a-z]+(?:[A-Z][a-z]+)+\b")
NAMED_MODULE = re.compile(r"`([\w/.-]*\w\.py)(?:::\w+)?`")

RECORDS = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))


def tracked(*patterns: str) -> list[Path]:
    """Return the repository's files that match, without the license."""
    if not (ROOT / ".git").exists():
        pytest.skip("the files of the repository are known in a checkout only")
    command = ["git", "ls-files", "-z", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    names = (name for name in listed.split("\0") if name and name != "LICENSE")
    return [path for path in map(ROOT.joinpath, names) if path.is_file()]


def lines_of(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of each line."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        yield f"{path.relative_to(ROOT)}:{number}", line


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: str(record.name))
def test_decision_records_have_four_parts_and_are_short(record: Path) -> None:
    text = record.read_text(encoding="utf-8")
    parts = re.findall(r"^\*\*(\w+)\.\*\* ", text, re.MULTILINE)
    assert parts == ["Context", "Decision", "Price", "Evidence"]
    assert len(text.split()) <= 250
    title = text.splitlines()[0].removeprefix(f"# {int(record.name[:4])}. ")
    index = (record.parent / "README.md").read_text(encoding="utf-8")
    assert f"| [{title}]({record.name}) |" in index


@pytest.mark.parametrize(
    "folder", ["benchmarks", "crds", "docsite", "examples", "operator", "release", "sdk", "tests"]
)
def test_docstrings_begin_with_a_verb_or_a_noun(folder: str) -> None:
    paths = sorted((ROOT / folder).rglob("*.py"))
    assert paths
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.strip().splitlines()[0]}"
        for path in paths
        for line, text in _docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if BADLY.match(text.strip())
    ]
    assert not found, "\n".join(found)


def test_the_subject_of_a_sentence_is_rarely_vague() -> None:
    found = [
        f"{place}: {line.strip()}"
        for path in tracked()
        if path.suffix not in {".png", ".svg"} and path != Path(__file__)
        for place, line in lines_of(path)
        if VAGUE.search(line)
    ]
    assert len(found) < MOST_VAGUE, "\n".join(found)


def test_cells_of_tables_are_short() -> None:
    found = [
        f"{place}: {len(cell.split())} words: {cell.strip()[:60]}"
        for path in tracked("*.md")
        for place, line in lines_of(path)
        if line.startswith("|")
        for cell in CELL_BORDER.split(line)
        if len(cell.split()) > MOST_WORDS_OF_A_CELL
    ]
    assert not found, "\n".join(found)


def test_named_modules_exist() -> None:
    modules = [f"/{path.relative_to(ROOT)}" for path in tracked("*.py")]
    pages = [ROOT / "CONTRIBUTING.md", ROOT / "docs" / "architecture.md", *RECORDS]
    found = [
        f"{place}: {name}"
        for page in pages
        for place, line in lines_of(page)
        for name in NAMED_MODULE.findall(line)
        if not any(module.endswith(f"/{name}") for module in modules)
    ]
    assert not found, "\n".join(found)


def test_named_classes_exist() -> None:
    sources = "".join(
        path.read_text(encoding="utf-8")
        for path in tracked("sdk/*.py", "operator/*.py", "crds/*.py")
    )
    found = [
        f"{place}: {name}"
        for place, line in lines_of(ROOT / "docs" / "architecture.md")
        for name in NAMED_CLASS.findall(line)
        if not re.search(rf"\b{name}\b", sources)
    ]
    assert not found, "\n".join(found)


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield docstrings, and the strings below attributes and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield statement.lineno, text
