"""Prose as CONTRIBUTING.md asks: docstrings begin with a verb or a noun, records are short.

A reader must guess the noun of a docstring that begins with a pronoun or a question word.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

BADLY = re.compile(
    "(As|By|For|Has|Here|How|In|Is|It|Its|Nobody|Nothing|Of|On|One|Such|That|There|These|They|This"
    r"|Those|To|What|Whatever|When|Where|Whether|Which|Who|Whoever|With|Without)\b"
)

RECORDS = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: str(record.name))
def test_decision_records_have_four_parts_and_are_short(record: Path) -> None:
    text = record.read_text(encoding="utf-8")
    parts = re.findall(r"^\*\*(\w+)\.\*\* ", text, re.MULTILINE)
    assert parts == ["Context", "Decision", "Price", "Evidence"]
    assert len(text.split()) <= 250
    title = text.splitlines()[0].removeprefix(f"# {int(record.name[:4])}. ")
    index = (record.parent / "README.md").read_text(encoding="utf-8")
    assert f"| [{title}]({record.name}) |" in index


@pytest.mark.parametrize("folder", ["operator", "sdk"])
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


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield docstrings, and the strings below attributes and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield statement.lineno, text
