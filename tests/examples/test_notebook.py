"""The tutorial's notebook: it has the page's text and programs, and a kernel runs its cells."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from docsite import notebook

from patience import PATIENCE

PROGRAMS = [
    "".join(cell["source"]) + "\n"
    for cell in json.loads(notebook.NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    if cell["cell_type"] == "code"
]


def printed(folder: Path, *arguments: str) -> str:
    """Return the output of Python with these arguments."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "FIBER_BACKEND": "local", "HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def without_numbers(output: str) -> str:
    """Return the output with workers as of one pool: in a kernel the pools count on."""
    return re.sub(r"PoolWorker-\d+", "PoolWorker", output)


def test_the_notebook_is_written_from_the_page() -> None:
    """``make docs`` writes it anew."""
    assert notebook.NOTEBOOK.read_text(encoding="utf-8") == notebook.written()


def test_the_notebook_has_every_program_of_the_page() -> None:
    assert len(PROGRAMS) == notebook.PAGE.read_text(encoding="utf-8").count("```python\n") > 3


@pytest.mark.timeout(3 * PATIENCE)
def test_cells_print_in_a_kernel_what_the_programs_print_as_scripts(tmp_path: Path) -> None:
    names = [f"program_{number}.py" for number in range(len(PROGRAMS))]
    for name, program in zip(names, PROGRAMS, strict=True):
        (tmp_path / name).write_text(program, encoding="utf-8")
    in_kernel = printed(tmp_path, "-m", "jupyter_client.runapp", *names)
    as_scripts = "".join(printed(tmp_path, name) for name in names)
    assert without_numbers(in_kernel) == without_numbers(as_scripts)


def test_links_of_the_notebook_are_addresses(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "other.md").touch()
    (tmp_path / "pyproject.toml").write_text('[project.urls]\nSource = "https://host/x"\n')
    page = tmp_path / "docs" / "page.md"
    page.write_text("# A\n\nFirst. The same is [a notebook](other.md). [b](other.md#c)\n")
    cells = notebook.notebook(page, tmp_path)["cells"]
    text = "".join(line for cell in cells for line in cell["source"])
    assert "First. [b](https://host/x/blob/main/docs/other.md#c)" in text
    assert "a notebook]" not in text
