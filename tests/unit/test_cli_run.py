"""The command ``fiber run``: what it sends, starts and refuses."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from fakes.kubernetes_api import Call, Fault
from fiber._cli import run
from fiber_api import names
from unit.kubernetes_rig import NAMESPACE
from unit.pool_command_rig import Outcome, examples_of
from unit.run_rig import Site, run_site

SHOWS = "import os, sys\nprint(sys.argv[1:], os.path.basename(os.getcwd()))\n"
EXAMPLES = [words for _, words in examples_of(run.command)]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with run_site(tmp_path) as made:
        yield made


def refused(outcome: Outcome, status: int) -> list[str]:
    """Return what happened, why, and what to do."""
    assert outcome.status == status, outcome
    lines = [line for line in outcome.err.splitlines() if not line.startswith("[fiber]")]
    assert [line[:6] for line in lines] == ["fiber:", "  why:", "  do: "], outcome.err
    return [lines[0][7:], *(line[8:] for line in lines[1:])]


# ---- programs


def test_each_help_has_two_examples() -> None:
    assert len(EXAMPLES) == 2


@pytest.mark.parametrize("words", EXAMPLES, ids=shlex.join)
def test_an_example_of_the_help_succeeds(site: Site, words: list[str]) -> None:
    site.write("train.py", SHOWS)
    site.write("package/train.py", SHOWS)
    outcome = site.fiber(*words)
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out.endswith(" project\n")


def test_output_errors_and_status_are_the_programs(site: Site) -> None:
    site.write("train.py", "import sys\nprint('out')\nprint('err', file=sys.stderr)\nsys.exit(7)")
    assert site.fiber("run", "train.py") == Outcome(7, "out\n", "err\n")


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (["train.py", "--name", "x", "--", "-h"], "['--name', 'x', '--', '-h'] project"),
        (["sub/train.py", "--help"], "['--help'] sub"),
        (["--name", "mine", "-m", "package.train", "--name", "x"], "['--name', 'x'] project"),
        (["-mpackage.train", "--detach"], "['--detach'] project"),
        (["--", "python", "train.py", "--cpu", "x"], "['--cpu', 'x'] project"),
        (["python", "train.py", "-m", "x"], "['-m', 'x'] project"),
        (["-m", "whole", "a"], "['a'] project"),
    ],
    ids=lambda value: shlex.join(value) if isinstance(value, list) else "",
)
def test_options_of_the_program_are_left_to_it(site: Site, words: list[str], shown: str) -> None:
    for name in ("train.py", "sub/train.py", "package/train.py", "whole/__main__.py"):
        site.write(name, SHOWS)
    outcome = site.fiber("run", *words)
    assert outcome == Outcome(0, f"{shown}\n", "")


def test_a_command_of_the_image_and_its_dollars(site: Site) -> None:
    words = ["sh", "-c", "echo $(echo a) $$ ${B}"]
    outcome = site.fiber("run", "--env", "B=$$(C)", "--", *words)
    number = outcome.out.split()[1]
    assert outcome == Outcome(0, f"a {number} $$(C)\n", "")
    assert number.isdigit()
    assert site.job()["metadata"]["annotations"][names.ANNOTATION_COMMAND] == shlex.join(words)


def test_a_command_that_the_image_does_not_have(site: Site) -> None:
    outcome = site.fiber("run", "--", "no-such-command")
    assert outcome.status == 127
    assert "cannot run 'no-such-command': there is no such command" in outcome.err


def test_detach_says_why_a_program_does_not_start(site: Site) -> None:
    outcome = site.fiber("run", "--detach", "--", "no-such-command")
    assert (outcome.status, outcome.out) == (127, "")
    assert "there is no such command" in outcome.err


def test_files_that_look_like_secrets_are_not_sent(site: Site) -> None:
    site.write("train.py", "import os\nprint(sorted(os.listdir()))")
    site.write(".env", "A=1")
    outcome = site.fiber("run", "train.py")
    assert outcome.out == "['train.py']\n"
    assert "not sent: " in outcome.err
    assert ".env (environment variables)" in outcome.err


def test_local_becomes_the_program(site: Site) -> None:
    site.write("train.py", "import os, sys\nprint(os.environ['FIBER_BACKEND'], sys.argv[1:])")
    assert site.fiber("run", "--local", "train.py", "-x") == Outcome(0, "local ['-x']\n", "")
    assert site.fiber("run", "--local", "--env", "TOKEN=1", "--", "sh", "-c", "exit $TOKEN")[0] == 1
    assert site.server.api.calls == []
    assert site.fiber("run", "--local", "no-such-command").status == 127


# ---- the Job


def test_the_job_asks_for_what_the_options_name(site: Site) -> None:
    site.write("train.py", "")
    site.environment["HERE"] = "there"
    outcome = site.fiber(
        *("run", "--name", "mine", "--image", "mine:1", "--cpu", "500m", "--memory", "1Gi"),
        *("--gpu", "1", "--env", "HERE", "--env", "EMPTY=", "--secret", "keys"),
        *("--volume", "data:/data:ro", "--service-account", "me", "--timeout", "60", "train.py"),
    )
    assert outcome == Outcome(0, "", "")
    spec = site.job()["spec"]
    assert site.job()["metadata"]["name"] == "mine"
    assert (spec["activeDeadlineSeconds"], spec["backoffLimit"]) == (60, 0)
    pod, container = spec["template"]["spec"], site.container()
    assert pod["serviceAccountName"] == "me"
    assert container["image"] == "mine:1"
    amounts = {"cpu": "500m", "memory": "1024Mi"}
    assert container["resources"]["requests"] == amounts
    assert container["resources"]["limits"] == {**amounts, "nvidia.com/gpu": "1"}
    assert site.variables().items() >= {("HERE", "there"), ("EMPTY", ""), ("FIBER_IMAGE", "mine:1")}
    assert container["envFrom"] == [{"secretRef": {"name": "keys"}}]
    assert container["volumeMounts"][0]["readOnly"] is True
    assert "fsGroup" not in pod["securityContext"]
    assert site.server.objects("serviceaccounts") == []


def test_the_port_of_metrics_has_a_name_by_which_a_scraper_finds_it(site: Site) -> None:
    site.write("train.py", "")
    port = ("--env", "FIBER_METRICS_PORT=9100", "--env", "FIBER_METRICS_HOST=0.0.0.0")
    assert site.fiber("run", *port, "train.py") == Outcome(0, "", "")
    assert {"name": "metrics", "containerPort": 9100} in site.container()["ports"]


def test_a_configured_template_keeps_its_variables_and_containers(site: Site) -> None:
    worker = {
        "name": "worker",
        "env": [{"name": "A", "value": "1"}, {"name": "B", "value": "2"}],
        "envFrom": [{"secretRef": {"name": "theirs"}}],
    }
    template = {"spec": {"containers": [worker, {"name": "sidecar", "image": "sidecar:1"}]}}
    site.write("template.json", json.dumps(template))
    site.write("train.py", "import os\nprint(os.environ['A'], os.environ['B'])")
    site.environment["FIBER_TEMPLATE"] = str(site.folder / "template.json")
    outcome = site.fiber("run", "--env", "B=3", "--secret", "mine", "train.py")
    assert outcome == Outcome(0, "1 3\n", "")
    named = [each["name"] for each in site.container()["env"]]
    assert len(named) == len(set(named))
    assert [each["secretRef"]["name"] for each in site.container()["envFrom"]] == ["theirs", "mine"]


def test_the_program_may_write_to_its_volumes(site: Site) -> None:
    site.write("train.py", "")
    outcome = site.fiber("run", "--volume", "data:/data", "--volume", "more:/more:ro", "train.py")
    assert outcome == Outcome(0, "", "")
    context = site.job()["spec"]["template"]["spec"]["securityContext"]
    assert (context["fsGroup"], context["fsGroupChangePolicy"]) == (65532, "OnRootMismatch")


def test_the_group_of_the_template_stays(site: Site) -> None:
    site.write("train.py", "")
    site.write("template.yaml", "spec: {securityContext: {fsGroup: 7}}")
    site.environment["FIBER_TEMPLATE"] = "template.yaml"
    assert site.fiber("run", "--volume", "data:/data", "train.py") == Outcome(0, "", "")
    assert site.job()["spec"]["template"]["spec"]["securityContext"]["fsGroup"] == 7


@pytest.mark.parametrize(("known", "kind"), [(True, "Role"), (False, "ClusterRole")])
def test_the_account_gets_the_role_that_the_chart_has_made(
    site: Site, known: bool, kind: str
) -> None:
    site.write("train.py", "")
    if known:
        role = {"metadata": {"name": "fiber-user"}, "rules": []}
        site.server.do(site.server.store.create, "roles", NAMESPACE, role)
    assert site.fiber("run", "train.py").status == 0
    (binding,) = site.server.objects("rolebindings")
    assert binding["roleRef"]["kind"] == kind


def test_the_account_of_programs_is_made_once_with_its_rights(site: Site) -> None:
    site.write("train.py", "")
    for _ in range(2):
        assert site.fiber("run", "train.py").status == 0
    (account,) = site.server.objects("serviceaccounts")
    (binding,) = site.server.objects("rolebindings")
    assert account["metadata"]["name"] == binding["subjects"][0]["name"] == names.PROGRAM_ACCOUNT
    assert site.server.api.count("create", "serviceaccounts") == 1


def test_an_account_without_rights_is_not_left_behind(site: Site) -> None:
    site.write("train.py", "")

    def allows(call: Call) -> bool:
        return call.plural != "rolebindings"

    site.server.api.allows = allows
    _, why, remedy = refused(site.fiber("run", "train.py"), 125)
    assert why == "you may not create rolebindings"
    assert f"kubectl create serviceaccount {names.PROGRAM_ACCOUNT} -n {NAMESPACE}" in remedy
    assert site.server.objects("serviceaccounts") == site.nodes.jobs() == []


# ---- mistakes and errors


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ([], "nothing to run"),
        (["--"], "nothing to run"),
        (["trian.py"], "there is no script 'trian.py'"),
        (["sub/trian.py"], "there is no script 'sub/trian.py'"),
        (["-m", "pakcage"], "there is no module 'pakcage' to run"),
        (["-m", "package"], "there is no module 'package' to run"),
        (["-m", ".."], "there is no module '..' to run"),
        (["--name", "Bad_Name", "train.py"], "'Bad_Name' cannot be the name of a program"),
        (["--cpu", "lots", "train.py"], "the program's pod cannot be made"),
        (["--memory", "1TB", "train.py"], "the program's pod cannot be made"),
        (["--env", "NOT_HERE", "train.py"], "the variable 'NOT_HERE' has no value"),
        (["--env", "=x", "train.py"], "'=x' names no variable"),
        (["--env", "API_TOKEN=x", "train.py"], "the variable 'API_TOKEN' looks like a secret"),
        (["--volume", "data", "train.py"], "'data' names no volume"),
        (["--volume", "a:/d", "--volume", "b:/d", "train.py"], "two volumes are mounted at /d"),
        (["--attach", "", "train.py"], "--attach starts no program"),
        (["--attach", ""], "'' cannot be the name of a program"),
        (["--attach", "mine", "train.py"], "--attach starts no program"),
        (["--attach", "mine", "--detach"], "--attach starts no program"),
        (["--local", "--detach", "train.py"], "--local runs the program in this place"),
    ],
    ids=lambda value: shlex.join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_told_before_anything_is_made(site: Site, words: list[str], what: str) -> None:
    site.write("train.py", "")
    site.write("sub/train.py", "")
    site.write("package/__init__.py", "")
    assert refused(site.fiber("run", *words), 2)[0] == what
    assert site.nodes.jobs() == []


def test_a_program_without_an_image_is_refused(site: Site) -> None:
    site.write("train.py", "")
    del site.environment["FIBER_IMAGE"]
    what, why, do = refused(site.fiber("run", "train.py"), 2)
    assert what == "there is no image for workers"
    assert "development build" in why
    assert "--image" in do
    assert site.nodes.jobs() == []


def test_a_remedy_names_what_was_meant(site: Site) -> None:
    site.write("sub/train.py", "")
    site.write("train.py", "")
    assert "'sub/train.py'?" in refused(site.fiber("run", "sub/trian.py"), 2)[2]
    assert "--secret" in refused(site.fiber("run", "--env", "TOKEN=x", "train.py"), 2)[2]


@pytest.mark.parametrize(
    "words",
    [["--wrokers", "8", "train.py"], ["--timeout", "0", "train.py"], ["--name"], ["-m"]],
    ids=shlex.join,
)
def test_options_that_do_not_exist_or_lack_a_value(site: Site, words: list[str]) -> None:
    outcome = site.fiber("run", *words)
    assert outcome.status == 2
    assert "Error: " in outcome.err
    assert site.server.api.calls == []


@pytest.mark.parametrize(
    ("fault", "what"),
    [
        (Fault("create", "jobs", 403, "Forbidden", "exceeded quota"), "cannot start the program"),
        (Fault("create", "jobs", 422, "Invalid", "bad value"), "cannot start the program"),
        (Fault("create", "jobs", 409, "AlreadyExists"), "there is a program 'mine' already"),
        (Fault("list", "pods", 401, "Unauthorized", times=9), "cannot wait for the pod"),
    ],
)
def test_errors_of_the_command_have_the_status_125(site: Site, fault: Fault, what: str) -> None:
    site.write("train.py", "")
    site.server.api.faults.append(fault)
    outcome = site.fiber("run", "--name", "mine", "train.py")
    assert outcome.status == 125
    assert what in outcome.err


@pytest.mark.parametrize(("status", "advice"), [(401, "log in"), (403, "--service-account")])
def test_the_remedy_is_that_of_the_fault(site: Site, status: int, advice: str) -> None:
    """A login that has ended is no lack of rights."""
    site.write("train.py", "")
    for verb in ("get", "create"):
        kind = "serviceaccounts" if verb == "get" else "rolebindings"
        if verb == "get" and status == 403:
            continue  # accounts need not be readable
        site.server.api.faults.append(Fault(verb, kind, status, "Refused", times=9))
    assert advice in refused(site.fiber("run", "train.py"), 125)[2]


def test_a_program_that_is_not_there_is_an_error_of_the_command(site: Site) -> None:
    assert refused(site.fiber("run", "--attach", "mine"), 125)[0] == "there is no program 'mine'"
    site.environment["KUBECONFIG"] = "/no/such/file"
    site.write("train.py", "")
    assert site.fiber("run", "train.py").status == 125


def test_a_lost_answer_makes_no_second_program(site: Site) -> None:
    site.write("train.py", "print(1)")
    site.server.api.faults.append(Fault("create", "jobs", 500, carried_out=True))
    assert site.fiber("run", "--name", "mine", "train.py") == Outcome(0, "1\n", "")


def test_a_lost_answer_does_not_hide_the_program_of_another(site: Site) -> None:
    site.write("train.py", "print(1)")
    assert site.fiber("run", "--name", "mine", "train.py").status == 0
    site.server.api.faults.append(Fault("create", "jobs", 500))
    outcome = site.fiber("run", "--name", "mine", "train.py")
    assert refused(outcome, 125)[0] == "there is a program 'mine' already"
    assert len(site.nodes.jobs()) == 1
