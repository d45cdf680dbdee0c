"""The tutorial as a notebook: ``python -m docsite.notebook`` writes it beside the tutorial.

The page is the only source. Each of its programs is a cell, and the text between is another.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docsite import ROOT, staging

PAGE = ROOT / "docs" / "tutorial.md"
NOTEBOOK = PAGE.with_suffix(".ipynb")

_PROGRAM = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_OF_ITSELF = re.compile(r" [^.\n]*\[a notebook\]\([^)]*\)\.")
"""Sentence of the page that leads to the notebook."""

_FIRST = (
    "*This notebook is written from docs/tutorial.md. It needs the packages fiberpool and "
    'ipykernel. Run its cells in order. The line `if __name__ == "__main__":` may stay away in a '
    "notebook.*"
)


def notebook(page: Path = PAGE, root: Path = ROOT) -> dict[str, Any]:
    """Return the notebook of a page. Its links are addresses, since it is read anywhere."""
    text = staging.with_absolute_links(page, staging.source_address(root), root, site=False)
    text = _OF_ITSELF.sub("", text).rstrip()
    return {
        "cells": [cell | {"id": f"cell-{place}"} for place, cell in enumerate(_cells(text), 1)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def written(page: Path = PAGE, root: Path = ROOT) -> str:
    """Return the notebook of a page as the text of its file."""
    return json.dumps(notebook(page, root), indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def _cells(text: str) -> Iterator[dict[str, Any]]:
    yield _text_cell(_FIRST)
    # Texts and programs take turns.
    for number, part in enumerate(_PROGRAM.split(text)):
        if number % 2:
            yield _cell("code", part) | {"execution_count": None, "outputs": []}
        elif part.strip():
            yield _text_cell(part)


def _text_cell(text: str) -> dict[str, Any]:
    return _cell("markdown", text)


def _cell(kind: str, text: str) -> dict[str, Any]:
    return {"cell_type": kind, "metadata": {}, "source": text.strip().splitlines(keepends=True)}


if __name__ == "__main__":
    NOTEBOOK.touch()  # the page links to it
    NOTEBOOK.write_text(written(), encoding="utf-8")
