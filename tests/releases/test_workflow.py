"""The workflow of a release: its rights, its secrets, its order, and the scripts that it calls."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from release.__main__ import _arguments

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = ROOT / ".github" / "workflows"
Job = dict[str, Any]


def read(name: str) -> dict[str, Any]:
    text = (WORKFLOWS / name).read_text(encoding="utf-8")
    found: dict[str, Any] = yaml.load(text, yaml.BaseLoader)  # else `on` is True
    return found


RELEASE = read("release.yml")
JOBS: dict[str, Job] = RELEASE["jobs"]


def steps(workflow: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for job in workflow["jobs"].values():
        yield from job.get("steps", ())


def scripts() -> Iterator[str]:
    yield from (step["run"] for step in steps(RELEASE) if "run" in step)


def needed(name: str) -> set[str]:
    """Return the jobs that must succeed before this one begins."""
    direct = JOBS[name].get("needs", [])
    return set(direct).union(*map(needed, direct))


def test_only_a_tag_releases() -> None:
    assert RELEASE["on"] == {"push": {"tags": ["v*"]}}


def test_each_job_has_the_rights_that_it_needs_and_no_other() -> None:
    assert RELEASE["permissions"] == {}
    attests = {"contents": "read", "id-token": "write", "attestations": "write"}
    assert {name: job["permissions"] for name, job in JOBS.items()} == {
        "test": {"contents": "read"},
        "build": attests,
        "image": {**attests, "packages": "write"},
        "chart": {**attests, "packages": "write"},
        "package": {"id-token": "write"},
        "page": {"contents": "write"},
    }


def test_what_cannot_be_undone_comes_last() -> None:
    """The package names the images, so they exist before it; all tests come before both."""
    assert needed("image") == {"test", "build"}
    assert needed("chart") == {"test", "build", "image"}
    assert needed("package") == {"test", "build", "image", "chart"}
    assert needed("page") == {"test", "build", "image", "chart", "package"}
    assert JOBS["test"]["uses"] == "./.github/workflows/ci.yml"
    assert "workflow_call" in read("ci.yml")["on"]


def test_no_secret_and_no_expression_is_in_a_command() -> None:
    """A tag's name could hold a command, and arguments are seen by other processes."""
    assert [script for script in scripts() if "${{" in script] == []
    text = (WORKFLOWS / "release.yml").read_text(encoding="utf-8")
    assert set(re.findall(r"secrets\.(\w+)", text)) == {"GITHUB_TOKEN"}
    variables = {
        name
        for step in steps(RELEASE)
        for name, value in step.get("env", {}).items()
        if "secrets." in value
    }
    for script in scripts():
        for name in variables:
            assert f"${name}" not in script
            assert f"${{{name}" not in script


def test_the_package_is_published_without_a_password() -> None:
    (publish,) = (s for s in JOBS["package"]["steps"] if s["uses"].startswith("pypa/"))
    assert publish["with"] == {"packages-dir": "build/release/pypi"}
    assert JOBS["package"]["environment"]["name"] == "pypi"


@pytest.mark.parametrize("workflow", ["ci.yml", "release.yml"])
def test_actions_of_others_are_pinned_to_a_commit(workflow: str) -> None:
    for step in steps(read(workflow)):
        owner, _, rest = step.get("uses", "actions/none@v1").partition("/")
        version = rest.partition("@")[2]
        assert re.fullmatch(r"v\d+" if owner == "actions" else "[0-9a-f]{40}", version), step


def test_the_logic_is_in_scripts_that_the_tests_run() -> None:
    commands = [c for script in scripts() for c in re.findall(r"-m release ([^)]*)", script)]
    known = [_arguments(re.sub(r'["$]', "", command).split()) for command in commands]
    assert [found.command for found in known] == ["images", "push-image", "push-chart"]
    makes = [found for script in scripts() for found in re.findall(r"^make (\S+)", script, re.M)]
    assert makes == ["release"]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^release: .*\n\t\$\(BIN\)/python -m release build --tag", makefile, re.M)
    dry_runs = [step.get("run") for step in read("ci.yml")["jobs"]["release-dry-run"]["steps"]]
    assert "make release-dry-run" in dry_runs


def test_files_images_and_chart_have_a_provenance() -> None:
    attested = {
        name: step["with"]
        for name, job in JOBS.items()
        for step in job.get("steps", ())
        if step.get("uses", "").startswith("actions/attest-build-provenance@")
    }
    assert attested["build"] == {"subject-path": "build/release/assets/*"}
    pushed = {
        "subject-name": "${{ steps.push.outputs.repository }}",
        "subject-digest": "${{ steps.push.outputs.digest }}",
        "push-to-registry": "true",
    }
    assert attested == {"build": attested["build"], "image": pushed, "chart": pushed}
