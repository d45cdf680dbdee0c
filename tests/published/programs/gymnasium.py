"""Gymnasium: its own tests of AsyncVectorEnv."""

from __future__ import annotations

from conformance.gymnasium_vector import TESTS_OF_ASYNC_VECTOR_ENV
from published.records import Package, Program, Version
from published.runs import Run, Value


def run(run: Run) -> dict[str, Value]:
    """Run the tests; compare their outcomes."""
    run.import_from()
    adopted = ["gymnasium.vector.async_vector_env"]
    return run.tests(*TESTS_OF_ASYNC_VECTOR_ENV, cwd=run.clone, adopt=adopted)


PROGRAMS = [
    Program(
        name="Gymnasium",
        upstream="https://github.com/Farama-Foundation/Gymnasium",
        clone="Gymnasium",
        way="`fiber.adopt`",
        ran="its tests of `AsyncVectorEnv`",
        run=run,
        files=TESTS_OF_ASYNC_VECTOR_ENV,
        packages=(
            Package("numpy", "numpy>=1.26"),
            Package("pytest", "pytest>=8.3"),
            Package("farama_notifications", "farama-notifications>=0.0.1"),
        ),
        version=Version("gymnasium/__init__.py", ">=1.0"),
    )
]
