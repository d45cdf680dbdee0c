"""The structure that CONTRIBUTING.md describes is the structure there is."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OURS = ("sdk", "crds", "operator", "docsite", "release", "tests", "examples", "benchmarks")
MOST_LINES = 600
USUAL_LINES = 300
VAGUE_NAMES = {"utils", "helpers", "common", "misc"}
CLOCKS = {"monotonic", "perf_counter", "process_time", "thread_time", "time"}
# Packages that only a part of Fiber needs; a program that only imports Fiber loads none of them.
HEAVY = {"asyncio", "cloudpickle", "cryptography", "kubernetes", "numpy", "pydantic", "pynng"}

# Classes of two modules that mean the same: the error of executors is also a BrokenProcessPool.
SAME_NAMES = {"WorkerDied"}


def python_files() -> list[Path]:
    return [path for folder in OURS for path in sorted((ROOT / folder).rglob("*.py"))]


def run(*command: str) -> None:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.fail(f"{' '.join(command)}\n{done.stdout}{done.stderr}", pytrace=False)


def in_fresh_interpreter(statement: str) -> str:
    command = [sys.executable, "-c", statement]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def test_imports_follow_the_layers() -> None:
    run(str(Path(sys.executable).with_name("lint-imports")), "--no-cache")


@pytest.mark.slow
@pytest.mark.timeout(1200)  # mypy takes 50 s, and over 300 s beside a dozen busy processes
def test_mypy_finds_no_error() -> None:
    run(sys.executable, "-m", "mypy")


@pytest.mark.parametrize("arguments", [("check",), ("format", "--check")], ids=" ".join)
def test_ruff_finds_no_error(arguments: tuple[str, ...]) -> None:
    run(sys.executable, "-m", "ruff", *arguments, "--no-cache", ".")


def test_import_is_cheap() -> None:
    printed = in_fresh_interpreter("import fiber, sys; print(*sys.modules)")
    assert HEAVY.isdisjoint(printed.split())


def test_import_has_no_effect() -> None:
    """No thread, no child, no open file, no signal handler, and nothing printed."""
    statement = (
        "import os, signal, threading\n"
        "def state():\n"
        "    handlers = [signal.getsignal(number) for number in signal.valid_signals()]\n"
        "    with open('/proc/thread-self/children') as file:\n"
        "        return os.listdir('/proc/self/fd'), threading.enumerate(), handlers, file.read()\n"
        "before = state()\n"
        "import fiber\n"
        "assert state() == before\n"
    )
    assert in_fresh_interpreter(statement) == ""


def test_files_are_short() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in python_files()}
    longest = {str(path): lines for path, lines in lengths.items() if lines > MOST_LINES}
    assert longest == {}
    usual = sum(lines <= USUAL_LINES for lines in lengths.values())
    assert usual >= 0.75 * len(lengths)


def test_names_of_modules_describe_their_contents() -> None:
    assert [path for path in python_files() if path.stem.strip("_") in VAGUE_NAMES] == []


def test_a_class_name_names_one_class() -> None:
    """A search for a name finds one definition."""
    defined = Counter(
        statement.name
        for folder in ("sdk", "crds", "operator")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for statement in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(statement, ast.ClassDef)
    )
    assert {name for name, count in defined.items() if count > 1} == SAME_NAMES


def test_no_module_shadows_the_standard_library() -> None:
    """A regular package named operator, ours or a test's, would hide the standard library's."""
    packages = {path.parent.name for path in ROOT.glob("[!.]*/**/__init__.py")}
    assert packages & sys.stdlib_module_names == set()


def test_no_test_asserts_how_long_something_took() -> None:
    """A duration depends on what else the machine does: it is a figure of a benchmark."""
    paths = [path for path in (ROOT / "tests").rglob("test_*.py") if path.parent.name != "e2e"]
    assert [path for path in paths if measures_a_duration(path)] == []


def measures_a_duration(path: Path) -> bool:
    """Return whether the module subtracts something from what a clock shows."""
    return any(
        isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and reads_a_clock(node.left)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    )


def reads_a_clock(node: ast.expr) -> bool:
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    module = node.func.value
    return isinstance(module, ast.Name) and module.id == "time" and node.func.attr in CLOCKS
