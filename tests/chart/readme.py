"""The table of values in the chart's README, made from values.yaml and its comments.

`python tests/chart/readme.py` writes it; a test compares.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

CHART = Path(__file__).resolve().parents[2] / "charts" / "fiber-operator"
BEGIN = "<!-- The table is made from values.yaml by tests/chart/readme.py. -->\n"
END = "<!-- End of the table. -->\n"


@dataclass(frozen=True)
class Value:
    """Row for one value that can be set."""

    path: str
    default: Any
    comment: str

    def row(self) -> str:
        cells = (f"`{self.path}`", f"`{json.dumps(self.default)}`", self.comment)
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def values() -> list[Value]:
    """Every value, in the order of the file."""
    text = (CHART / "values.yaml").read_text(encoding="utf-8")
    return list(_values(yaml.compose(text), text.splitlines(), ""))


def _values(node: Any, lines: list[str], prefix: str) -> Iterator[Value]:
    """The values of a mapping; one without comments inside is a value itself."""
    for key, content in node.value:
        path = prefix + key.value
        comment = _comment_above(lines, key.start_mark.line)
        inner = list(_values(content, lines, f"{path}.")) if _is_section(content) else []
        if any(value.comment for value in inner):
            yield from inner
        else:
            yield Value(path, yaml.SafeLoader("").construct_document(content), comment)


def _is_section(node: Any) -> bool:
    return isinstance(node, yaml.MappingNode) and bool(node.value)


def _comment_above(lines: list[str], line: int) -> str:
    first = line
    while first > 0 and lines[first - 1].lstrip().startswith("#"):
        first -= 1
    return " ".join(text.strip().removeprefix("#").strip() for text in lines[first:line])


def table() -> str:
    """The table with its markers."""
    head = "| value | default | what it does |\n|---|---|---|\n"
    return BEGIN + "\n" + head + "".join(value.row() for value in values()) + "\n" + END


def with_table(readme: str) -> str:
    """The README with the table as it should be."""
    before, _, rest = readme.partition(BEGIN)
    return before + table() + rest.partition(END)[2]


def main() -> None:
    """Write the table into the README."""
    path = CHART / "README.md"
    path.write_text(with_table(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
