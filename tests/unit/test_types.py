"""Types: `import fiber as mp` gives the types that multiprocessing gives."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import pytest

import fiber
from fiber.config import Config

ROOT = Path(__file__).resolve().parents[2]
SDK = ROOT / "sdk" / "fiber"
TYPED = Path(__file__).parent / "typed"

UNTYPED_UPSTREAM = {
    "fiber.joblib.FiberBackend",
    "fiber.vector.vector_env.VectorEnv.action_space",
    "fiber.vector.vector_env.VectorEnv.observation_space",
    "fiber.vector.vector_env.VectorEnv.single_action_space",
    "fiber.vector.vector_env.VectorEnv.single_observation_space",
}
"""joblib has no types, and gymnasium's spaces have a parameter that gymnasium itself leaves out."""


MYPY_SETTINGS = """
[mypy]
strict = true

[mypy-jax.*,kubernetes.*,stable_baselines3.*]
follow_imports = skip
"""
"""Skips packages that take mypy half a minute and are in no type of the programs."""


class Finding(NamedTuple):
    """Result of a checker for one line: a type, or the rule that the line breaks."""

    line: int
    type: str = ""
    rule: str = ""


Findings = dict[str, list[Finding]]
"""Findings by the name of the file."""


@pytest.fixture(scope="module", params=["mypy", "pyright"])
def findings(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Findings:
    """Findings of one checker, which reads all programs in one run."""
    folder = tmp_path_factory.mktemp("typed")
    program = (TYPED / "program.py").read_text(encoding="utf-8")
    texts = {
        "ours.py": program,
        "theirs.py": program.replace("fiber", "multiprocessing"),
        "additions.py": (TYPED / "additions.py").read_text(encoding="utf-8"),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    check = mypy if request.param == "mypy" else pyright
    found: Findings = {name: [] for name in texts}
    for name, finding in check(folder, *texts):
        found[name].append(finding)
    return {name: sorted(each) for name, each in found.items()}


def run(*arguments: str, folder: Path, **environment: str) -> str:
    command = [sys.executable, "-m", *arguments]
    environ = os.environ | environment
    done = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, timeout=300
    )
    assert done.returncode in (0, 1), f"{arguments}\n{done.stdout}{done.stderr}"
    return done.stdout


def mypy(folder: Path, *names: str) -> Iterator[tuple[str, Finding]]:
    cache = ROOT / ".mypy_cache" / "of_a_user"
    (folder / "mypy.ini").write_text(MYPY_SETTINGS, encoding="utf-8")
    options = ("--config-file=mypy.ini", f"--cache-dir={cache}")
    for text in run("mypy", *options, *names, folder=folder).splitlines():
        if match := re.match(r"(\w+\.py):(\d+): (note|error): (.*)", text):
            if revealed := re.match(r'Revealed type is "(.*)"', match[4]):
                yield match[1], Finding(int(match[2]), short(revealed[1]))
            elif match[3] == "error":
                yield match[1], Finding(int(match[2]), rule=match[4].rpartition("  ")[2])


def pyright(folder: Path, *names: str) -> Iterator[tuple[str, Finding]]:
    printed = run("pyright", "--pythonpath", sys.executable, "--outputjson", *names, folder=folder)
    for found in json.loads(printed)["generalDiagnostics"]:
        name, line = Path(found["file"]).name, found["range"]["start"]["line"] + 1
        if found["severity"] == "information":
            yield name, Finding(line, short(found["message"].partition(" is ")[2].strip('"')))
        else:
            yield name, Finding(line, rule=found["rule"])


def short(type_: str) -> str:
    """A type without the modules that its classes are in."""
    return re.sub(r"\b[a-z_]\w*\.(?=[\w.]*[A-Za-z])", "", type_)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_users_program_has_the_types_that_it_has_with_multiprocessing(findings: Findings) -> None:
    program = (TYPED / "program.py").read_text(encoding="utf-8")
    ours = findings["ours.py"]
    assert ours == findings["theirs.py"]
    assert sum(bool(found.type) for found in ours) == program.count("reveal_type(")
    assert sum(bool(found.rule) for found in ours) > 5


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_fibers_additions_have_types_and_mistakes_are_errors(findings: Findings) -> None:
    found = findings["additions.py"]
    lines = enumerate((TYPED / "additions.py").read_text(encoding="utf-8").splitlines(), 1)
    said = {number: match[1] for number, line in lines if (match := re.search(r"  # (.+)", line))}
    types = {finding.line: finding.type for finding in found if finding.type}
    assert types == {number: words for number, words in said.items() if words != "error"}
    broken = {finding.line for finding in found if finding.rule}
    assert broken == {number for number, words in said.items() if words == "error"}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_public_name_has_a_type(tmp_path: Path) -> None:
    """Check by pyright's standard, without inferences that differ between checkers."""
    options = ("--verifytypes", "fiber", "--ignoreexternal", "--outputjson")
    # It looks for the package where the first python of PATH does, and follows no .pth file.
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    printed = run("pyright", *options, folder=tmp_path, PATH=path, PYTHONPATH=str(SDK.parent))
    symbols = json.loads(printed)["typeCompleteness"]["symbols"]
    public = [symbol for symbol in symbols if symbol["isExported"]]
    assert len(public) > 500
    inferred = re.compile(r"could be inferred differently|Ambiguous base class|partially unknown")
    assert {
        symbol["name"]
        for symbol in public
        for said in symbol["diagnostics"]
        if said["severity"] == "error" and not inferred.search(said["message"])
    } == UNTYPED_UPSTREAM


def test_names_for_type_checkers_are_those_at_run_time() -> None:
    tree = ast.parse((SDK / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (
        node
        for node in tree.body
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
    )
    names: set[str] = set()
    for statement in block.body:
        if isinstance(statement, ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in statement.names}
        else:
            assert isinstance(statement, ast.Assign)
            names |= {target.id for target in statement.targets if isinstance(target, ast.Name)}
    assert names == {*fiber.__all__, *fiber._SUBMODULES}


def test_init_has_a_typed_keyword_for_each_key() -> None:
    tree = ast.parse((SDK / "_config_types.py").read_text(encoding="utf-8"))
    (settings,) = (
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and node.name == "ConfigKeywords"
    )
    typed = {
        entry.target.id: ast.unparse(entry.annotation)
        for entry in settings.body
        if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name)
    }
    # Paths in the configuration may be given as a pathlib.Path.
    narrowed = {key: text.replace("str | os.PathLike[str]", "str") for key, text in typed.items()}
    narrowed["template"] = narrowed["template"].removesuffix(" | None")
    expected = {entry.name: str(entry.type) for entry in fields(Config)}
    expected["template"] = expected["template"].removesuffix(" | None")
    # An amount may be given as text, such as "64Mi".
    expected |= {"cpu_request": "float | str", "memory_request": "int | str"}
    expected["shm"] = "int | str | None"
    assert narrowed == expected
