"""Program that runs the cells of a notebook in a kernel, and prints what each cell shows.

It reads a JSON list of cells from its input, and prints one of ``CellOutput``.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, field
from typing import Any

from jupyter_client.manager import start_new_kernel

from patience import PATIENCE


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
