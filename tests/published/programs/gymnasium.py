"""Gymnasium: its own tests of vector environments."""

from __future__ import annotations

from published.records import Package, Program, Version
from published.runs import Run, Value

TESTS = ("tests/vector", "tests/wrappers/vector", "tests/envs/registration/test_make_vec.py")
LEFT_OUT = (
    "tests/wrappers/vector/test_human_rendering.py",  # needs a screen
    "tests/wrappers/vector/test_record_video.py",  # needs moviepy
)


def run(run: Run) -> dict[str, Value]:
    """Run the tests; compare their outcomes."""
    run.import_from()
    adopted = ["gymnasium.vector.async_vector_env"]
    ignored = [f"--ignore={path}" for path in LEFT_OUT]
    return run.tests(*TESTS, cwd=run.clone, adopt=adopted, options=ignored)


PROGRAMS = [
    Program(
        name="Gymnasium",
        upstream="https://github.com/Farama-Foundation/Gymnasium",
        clone="Gymnasium",
        way="`fiber.adopt`",
        ran="its tests of vector environments and their wrappers",
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
