"""Process of one run: `python -m published.child NAME BACKEND CLONE FOLDER` writes FOLDER.json."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from published.records import programs
from published.runs import STAND_INS, Run, RunFailed


def main(name: str, backend: str, clone: str, folder: str) -> int:
    """Run the program; return 0 if its values were written."""
    run = Run(backend, Path(clone), Path(folder))
    if run.on_fiber:
        os.environ["FIBER_BACKEND"] = backend
    else:
        # Programs that import fiber get multiprocessing in its place.
        run.import_from(STAND_INS / "fiber")
    try:
        values = programs()[name].run(run)
    except RunFailed as failed:
        print(failed, file=sys.stderr)
        return 1
    result = {"changed": run.changed, "values": values}
    Path(f"{folder}.json").write_text(json.dumps(result), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
