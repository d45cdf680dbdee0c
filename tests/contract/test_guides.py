"""The manifests, templates, settings and commands of the guides are valid, without a cluster."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest
import yaml
from kubernetes.aio.client import models
from pydantic import BaseModel

from contract.test_example_manifests import unknown
from fakes.strict import unknown_fields
from fiber._backends.kubernetes.template import PodShape, pod_template
from fiber._cli.main import _group
from fiber._cli.run_job import METRICS_PORT
from fiber.config import Config
from fiber_api import names
from fiber_api.rest import POOLS
from fiber_api.schema import schema
from fiber_api.v1alpha1 import FiberPool

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [ROOT / "README.md", *ROOT.glob("docs/*.md"), ROOT / "charts/fiber-operator/README.md"]
)
YAML = re.compile(r"^```yaml\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHELL = re.compile(r"^```(?:console|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROMPT = re.compile(r"^\$ (.*\bfiber .*?)(?:\s+# .*)?$", re.MULTILINE)
QUOTED = re.compile(r"`(fiber [^`]+)`")
IMAGE = "registry.example/worker:1"
KEYS = {field.name for field in dataclasses.fields(Config)}
VARIABLES = {f"FIBER_{key.upper()}" for key in KEYS}

ROLES = ROOT / "charts/fiber-operator/templates/users.yaml"
POLICIES = ROOT / "charts/fiber-operator/templates/workernetworkpolicy.yaml"


class Block(NamedTuple):
    """YAML document of a page."""

    page: str
    document: dict[str, Any]


def blocks() -> Iterator[Block]:
    for page in PAGES:
        for text in YAML.findall(page.read_text(encoding="utf-8")):
            yield from (Block(page.name, found) for found in yaml.safe_load_all(text) if found)


BLOCKS = list(blocks())
MONITORS = [block.document for block in BLOCKS if block.document.get("kind") == "PodMonitor"]
MANIFESTS = [
    block
    for block in BLOCKS
    if "kind" in block.document and block.document not in MONITORS  # not a kind of Kubernetes
]
TEMPLATES = [block for block in BLOCKS if "kind" not in block.document]


def name_of(block: Block) -> str:
    kind = block.document.get("kind", "template")
    return f"{block.page}-{kind}-{block.document.get('metadata', {}).get('name', '')}"


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [block.document for block in MANIFESTS if block.document["kind"] == kind]


def check(document: dict[str, Any], kind: str) -> None:
    """Raise an error if the document is not of this kind: unknown fields, wrong types."""
    model: type[BaseModel] = getattr(models, f"V1{kind}")
    assert list(unknown_fields(document, model)) == []
    model.model_validate_json(json.dumps(document), strict=True)


@pytest.mark.parametrize("block", MANIFESTS, ids=name_of)
def test_a_manifest_has_the_fields_of_its_kind(block: Block) -> None:
    document = block.document
    if document["kind"] == names.KIND:
        FiberPool.read(document)
        assert unknown(document["spec"], schema()["properties"]["spec"], "spec") == []
    else:
        check(document, document["kind"])


@pytest.mark.parametrize("block", TEMPLATES, ids=name_of)
def test_a_template_gives_a_valid_pod(block: Block) -> None:
    template = pod_template(PodShape.of(Config(image=IMAGE, template=block.document)), None, "")
    (worker,) = template["spec"]["containers"]
    assert worker["name"] == names.WORKER_CONTAINER
    check(template, "PodTemplateSpec")


@pytest.mark.parametrize("block", TEMPLATES, ids=name_of)
def test_a_template_mounts_the_volumes_that_it_has(block: Block) -> None:
    spec = block.document["spec"]
    mounts = [m for c in spec.get("containers", ()) for m in c.get("volumeMounts", ())]
    assert {m["name"] for m in mounts} == {v["name"] for v in spec.get("volumes", ())}


def test_the_check_finds_mistakes() -> None:
    claim = of_kind("PersistentVolumeClaim")[0]
    with pytest.raises(AssertionError, match="accessMode"):
        check({**claim, "spec": {"accessMode": ["ReadWriteMany"]}}, claim["kind"])
    with pytest.raises(ValueError, match="accessModes"):
        check({**claim, "spec": {"accessModes": "ReadWriteMany"}}, claim["kind"])


# ---- names that the chart and Fiber give ----------------------------------------------------


def test_roles_that_are_bound_are_the_charts() -> None:
    made = set(re.findall(r"^  name: (fiber-\w+)$", ROLES.read_text("utf-8"), re.MULTILINE))
    bound = {binding["roleRef"]["name"] for binding in of_kind("RoleBinding")}
    assert {"fiber-user", "fiber-runner"} == bound <= made


def test_the_account_of_programs_has_the_role() -> None:
    (account,) = of_kind("ServiceAccount")
    (subject,) = (
        subject
        for binding in of_kind("RoleBinding")
        for subject in binding["subjects"]
        if subject["kind"] == "ServiceAccount"
    )
    assert account["metadata"]["name"] == subject["name"] == names.PROGRAM_ACCOUNT
    assert account["metadata"]["namespace"] == subject["namespace"]


def test_the_monitor_of_programs_finds_the_port_of_fiber_run() -> None:
    (monitor,) = MONITORS
    (selected,) = monitor["spec"]["selector"]["matchExpressions"]
    assert selected == {"key": names.LABEL_PROGRAM, "operator": "Exists"}
    (endpoint,) = monitor["spec"]["podMetricsEndpoints"]
    assert endpoint == {"port": METRICS_PORT}


def test_the_quota_counts_fiber_pools() -> None:
    (quota,) = of_kind("ResourceQuota")
    assert f"count/{POOLS.plural}.{names.GROUP}" in quota["spec"]["hard"]


def test_the_policy_of_programs_selects_labels_that_pods_have() -> None:
    (policy,) = of_kind("NetworkPolicy")
    keys = re.findall(r"'key': '([^']+)'", str(policy))
    assert keys == [names.LABEL_PROGRAM, names.LABEL_POOL_UID]
    assert names.LABEL_POOL_UID in POLICIES.read_text("utf-8")


# ---- settings -------------------------------------------------------------------------------


def test_the_settings_are_keys_of_the_configuration() -> None:
    text = (ROOT / "docs/kubernetes.md").read_text(encoding="utf-8")
    section = text.partition("## Settings\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    named = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    assert len(named) > 15
    assert named <= KEYS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_variable_of_a_page_is_one_of_the_configuration(page: Path) -> None:
    variables = set(re.findall(r"\bFIBER_[A-Z_]+\b", page.read_text(encoding="utf-8")))
    assert {name for name in variables if not name.startswith("FIBER_AGENT_")} <= VARIABLES


# ---- versions -------------------------------------------------------------------------------


def test_the_versions_are_those_of_chart_tests_and_package() -> None:
    page = (ROOT / "docs/kubernetes.md").read_text(encoding="utf-8")
    chart = (ROOT / "charts/fiber-operator/Chart.yaml").read_text(encoding="utf-8")
    programs = (ROOT / "tests/cluster/kubernetes/go.mod").read_text(encoding="utf-8")
    (least,) = re.findall(r'^kubeVersion: ">=(1\.\d+)\.', chart, re.MULTILINE)
    (tested,) = re.findall(r"^require k8s.io/kubernetes v(1\.\d+)", programs, re.MULTILINE)
    (helm,) = re.findall(r"helm.sh/helm/v3 v(3\.\d+)", programs)
    assert f"Kubernetes {least} or newer. The tests use {tested} " in page
    assert f"Helm 3 (the tests use {helm})" in page
    supported = re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text("utf-8"))
    assert f"Python {', '.join(supported[:-1])} or {supported[-1]}." in page


# ---- commands -------------------------------------------------------------------------------


def commands(page: Path) -> Iterator[str]:
    """Yield the commands ``fiber …`` of a page, in its blocks and in its sentences."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in SHELL.findall(text) for line in PROMPT.findall(block)]
    yield from (found for line in lines for found in simple_commands(line))
    yield from (found for quoted in QUOTED.findall(text) for found in simple_commands(quoted))


def simple_commands(line: str) -> Iterator[str]:
    """Yield the commands ``fiber …`` of a line of a shell, without redirections."""
    words = shlex.shlex(line, posix=True, punctuation_chars="|&;<>")
    words.whitespace_split = True
    command: list[str] = []
    for word in [*words, ";"]:
        if set(word) <= set("|&;<>"):
            if command[:1] == ["fiber"] and len(command) > 1:
                yield shlex.join(command[1:])
            command = []
        else:
            command.append(word)


COMMANDS = sorted({(page.name, found) for page in PAGES for found in commands(page)})


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_a_command_has_options_that_exist(page: str, command: str) -> None:
    parse(_group(), "fiber", shlex.split(command))


def parse(
    command: click.Command, name: str, words: list[str], parent: click.Context | None = None
) -> None:
    """Parse the words as far as the command that they name; raise UsageError for a mistake."""
    context = command.make_context(
        name, words, parent, resilient_parsing=words in ([], ["--version"])
    )
    if isinstance(command, click.Group) and (below := [*context._protected_args, *context.args]):
        found, inner, rest = command.resolve_command(context, below)
        assert found is not None
        assert inner is not None
        if rest:  # else a sentence names the command alone
            parse(inner, found, rest, context)


def test_commands_with_mistakes_are_found() -> None:
    for mistake in ("rnu train.py", "run --gpus 1 train.py", "pool warm a --workers many"):
        with pytest.raises(click.UsageError):
            parse(_group(), "fiber", shlex.split(mistake))
