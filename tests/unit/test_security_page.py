"""docs/security.md names tests that exist, in tables that can be read."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
NAMED = re.findall(r"`(tests/[^`:]+)::(\w+)`", PAGE)
ROWS = [line for line in PAGE.splitlines() if line.startswith("| ")]


@pytest.mark.parametrize(("file", "test"), sorted(set(NAMED)))
def test_a_test_that_the_security_page_names_exists(file: str, test: str) -> None:
    module = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    assert test in {node.name for node in ast.walk(module) if isinstance(node, functions)}


def test_each_row_names_a_test() -> None:
    rows = [row for row in ROWS if not row.startswith("| attempt |")]
    assert len(rows) > 40
    for row in rows:
        last = row.rstrip(" |").rpartition("|")[2]
        assert re.search(r"`tests/", last), row


def test_no_cell_is_long() -> None:
    for row in ROWS:
        for cell in row.strip("| ").split("|"):
            assert len(cell.split()) < 40, cell
