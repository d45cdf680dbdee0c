"""``python -m fiber._cli.doctor_trial``: run one task on a worker of the configuration on stdin.

The configuration is a JSON object with keys of ``fiber.init``.  A line of JSON on stdout says what
the task returned, or which error came instead.  Fiber's own lines go to stderr.
"""

from __future__ import annotations

import json
import signal
import sys
from typing import Any

import fiber
from fiber.pool import Pool

QUESTION = """{
    "python": __import__("platform").python_version(),
    "fiber": __import__("fiber").__version__,
    "packages": [
        each.name for each in __import__("importlib.metadata").metadata.distributions() if each.name
    ],
}"""
"""Expression for the worker.  It needs no module of this package, which the image may lack."""


def main() -> None:
    """Run the trial; the exit status is 0 if the task returned."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the FiberPool goes, too
    try:
        fiber.init(**json.load(sys.stdin))
        with Pool(1) as pool:
            _say({"answer": pool.apply(eval, (QUESTION,))})
    except (Exception, KeyboardInterrupt) as error:
        _say({"error": _described(error)})
        sys.exit(1)


def _described(error: BaseException) -> dict[str, str]:
    return {
        "kind": type(error).__name__,
        "reason": str(getattr(error, "reason", "")),
        "message": str(error) or type(error).__name__,
    }


def _say(document: dict[str, Any]) -> None:
    print(json.dumps(document), flush=True)


if __name__ == "__main__":
    main()
