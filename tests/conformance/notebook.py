"""Notebooks whose cells run in a real kernel.

This module is also the program that starts the kernel, in a process of its own: it reads a JSON
list of cells from its input, and prints one of ``CellOutput``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jupyter_client.manager import start_new_kernel

from patience import PATIENCE
from terminal import drawn

LIMIT = 120
"""Seconds for all cells of a notebook."""
TESTS = Path(__file__).parents[1]


@dataclass
class CellOutput:
    """Output of one cell."""

    stdout: str = ""
    stderr: str = ""
    error: str = ""
    displays: int = 0
    """Number of widgets and other objects below it."""
    widgets: dict[str, dict[str, Any]] = field(default_factory=dict)
    """State of each widget that the cell has made or changed, by its identity."""

    def add(self, kind: str, content: dict[str, Any]) -> None:
        """Add a message of the kernel."""
        if kind == "stream":
            name = content["name"]
            setattr(self, name, getattr(self, name) + content["text"])
        elif kind == "error":
            self.error = "\n".join(content["traceback"])
        elif kind == "display_data":
            self.displays += 1
        elif kind in ("comm_open", "comm_msg"):
            state = content["data"].get("state", {})
            self.widgets.setdefault(content["comm_id"], {}).update(state)


def outputs_of(folder: Path, variables: Mapping[str, str], *cells: str) -> list[Any]:
    """Run cells in a kernel with these environment variables; return each ``CellOutput``."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(TESTS), *filter(None, sys.path)]),
        "HOME": str(folder),  # kernels keep their files there
        "COLUMNS": "100",
        **variables,
    }
    done = subprocess.run(
        [sys.executable, "-m", "conformance.notebook"],
        cwd=folder,
        env=environment,
        input=json.dumps(cells),
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr
    outputs: list[Any] = json.loads(done.stdout)
    assert [output["error"] for output in outputs] == [""] * len(cells)
    return outputs


def bar(output: Any, name: str) -> str:
    """Return the last state of the cell's bar, which is text, or the texts of a widget."""
    if output["widgets"]:
        assert output["displays"] == 1
        values = [str(state.get("value", "")) for state in output["widgets"].values()]
        return " ".join(values).replace("\u2007", " ")
    lines = [line for line in drawn(output["stderr"]) if line.startswith(name)]
    assert len(lines) == 1, output["stderr"]
    return lines[0]


def run(cells: list[str]) -> list[CellOutput]:
    """Run cells one after the other in a new kernel."""
    manager, client = start_new_kernel(startup_timeout=PATIENCE)
    try:
        return [_run(client, cell) for cell in cells]
    finally:
        client.stop_channels()
        manager.shutdown_kernel()


def _run(client: Any, cell: str) -> CellOutput:
    request, output = client.execute(cell), CellOutput()
    while True:
        message = client.get_iopub_msg(timeout=PATIENCE)
        kind, content = message["msg_type"], message["content"]
        is_below = message["parent_header"].get("msg_id") == request
        if is_below and content.get("execution_state") == "idle":
            return output
        if is_below or kind.startswith("comm"):  # widgets change from any place
            output.add(kind, content)


if __name__ == "__main__":
    print(json.dumps([asdict(output) for output in run(json.load(sys.stdin))]))
