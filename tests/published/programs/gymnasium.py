"""Gymnasium: its own tests of AsyncVectorEnv."""

from __future__ import annotations

from published.records import Package, Program, Version
from published.runs import Run, Value

TESTS = ("tests/vector/test_async_vector_env.py",)


def run(run: Run) -> dict[str, Value]:
    """Run the tests; compare their outcomes."""
    run.import_from()
    adopted = ["gymnasium.vector.async_vector_env"]
    return run.tests(*TESTS, cwd=run.clone, adopt=adopted)


PROGRAMS = [
    Program(
        name="Gymnasium",
        upstream="https://github.com/Farama-Foundation/Gymnasium",
        clone="Gymnasium",
        way="`fiber.adopt`",
        ran="its tests of `AsyncVectorEnv`",
        run=run,
        files=TESTS,
        packages=(
            Package("numpy", "numpy>=1.26"),
            Package("pytest", "pytest>=8.3"),
            Package("pygame", "pygame-ce>=2.1.3"),
            Package("farama_notifications", "farama-notifications>=0.0.1"),
        ),
        version=Version("gymnasium/__init__.py", ">=1.0"),
    )
]
