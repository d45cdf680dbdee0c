"""The command ``fiber logs``: whole logs, those of workers, and logs that break off."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fakes.kubernetes_api import Fault
from fiber._cli import logs
from fiber._cli.log_following import Lines
from fiber_api import names
from unit.kubernetes_rig import NAMESPACE, pool_body
from unit.pool_command_rig import Outcome, examples_of
from unit.run_rig import Site, interrupt, run_site
from unit.test_cli_run import refused

EXAMPLES = [words for _, words in examples_of(logs.command)]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with run_site(tmp_path) as made:
        yield made


def run_program(site: Site, name: str = "mine") -> str:
    """Run a program to its end; return its pod."""
    site.write("train.py", "print('out')")
    assert site.fiber("run", "--name", name, "train.py") == Outcome(0, "out\n", "")
    return site.pod()


def add_worker(site: Site, pod: str, worker: str) -> None:
    """Add a pool that a program in a pod uses, with one worker."""
    do, store = site.server.do, site.server.store
    body = pool_body("pool")
    body["spec"]["master"] = {"identity": f"{pod}:41", "host": pod, "epoch": 1}
    uid = do(store.create, names.PLURAL, NAMESPACE, body)["metadata"]["uid"]
    labels = {names.LABEL_POOL_UID: uid}
    do(store.create, "pods", NAMESPACE, {"metadata": {"name": worker, "labels": labels}})


def end_worker(site: Site, worker: str) -> None:
    site.server.do(site.server.store.set_status, "pods", NAMESPACE, worker, {"phase": "Succeeded"})


@pytest.mark.parametrize("words", EXAMPLES, ids=" ".join)
def test_an_example_of_the_help_succeeds(site: Site, words: list[str]) -> None:
    pod = run_program(site, words[1])
    if "--worker" in words:
        worker = words[words.index("--worker") + 1]
        add_worker(site, pod, worker)
        site.nodes.logs.append([b"of the worker\n"])
        assert site.fiber(*words) == Outcome(0, "of the worker\n", "")
        assert site.nodes.queries == [{"container": "worker", "sinceSeconds": "300"}]
    else:
        site.nodes.logs.append([b"2026-01-01T00:00:00.000000000Z out\n"])
        assert site.fiber(*words) == Outcome(0, "out\n", "")


def test_the_log_of_a_program(site: Site) -> None:
    run_program(site)
    assert site.fiber("logs", "mine") == Outcome(0, "out\n", "")


def test_a_closed_pipe_is_no_error(site: Site) -> None:
    run_program(site)
    site.nodes.logs.append([b"y\n" * 1000] * 1000)
    command = site.begin("logs", "mine", until=b"y")
    assert command.stdout is not None
    command.stdout.close()
    assert command.wait() == 141
    assert command.stderr.read() == b""


def test_a_log_that_breaks_off_goes_on_where_it_was(site: Site) -> None:
    site.waits()
    command = site.begin("run", "--name", "mine", "train.py")
    times = [f"2026-01-01T00:00:0{number}.000000000Z".encode() for number in range(3)]
    site.nodes.logs += [
        [times[0] + b" one\n" + times[1] + b" tw", None],
        [times[1] + b" two\n" + times[1] + b" too\n"],
        [times[1] + b" two\n" + times[1] + b" too\n" + times[2] + b" three"],
    ]
    follower = site.begin("logs", "mine", "--follow", "--since", "1h", until=b"too")
    interrupt(command)
    site.end(command)
    outcome = site.end(follower)
    assert (outcome.status, outcome.out) == (0, "three")
    first, second, *_ = site.nodes.queries
    assert first["sinceSeconds"] == "3600"
    assert "sinceSeconds" not in second
    assert second["sinceTime"] == times[1].decode()


def test_a_log_is_followed_from_the_start_of_the_container(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    run = site.spawn("run", "--name", "mine", "train.py")
    site.nodes.wait(site.nodes.pods)
    follower = site.spawn("logs", "mine", "--follow")
    assert follower.stderr is not None
    assert b"is waiting to start" in follower.stderr.readline()
    outcome = site.fiber("logs", "mine")
    assert outcome.status == 1
    assert "is waiting to start" in outcome.err
    site.nodes.logs.append([b"2026-01-01T00:00:00.000000000Z out\n"])
    site.nodes.start(site.pod())
    assert site.end(run).status == 0
    assert site.end(follower).out == "out\n"


def test_names_and_times_that_are_wrong(site: Site) -> None:
    pod = run_program(site)
    add_worker(site, pod, "pool-1")
    assert refused(site.fiber("logs", "mien"), 3)[2] == "did you mean 'mine'?"
    assert refused(site.fiber("logs", "mine", "--worker", "pool-2"), 3)[2].endswith("'pool-1'?")
    for since in ("5", "m", "0s", "-5m", "5w", "99999999999999999999s"):
        assert refused(site.fiber("logs", "mine", f"--since={since}"), 2)[2] == "--since 5m"
    site.remove("pods", "pool-1")
    without = refused(site.fiber("logs", "mine", "--worker", "pool-1"), 3)
    assert without[1] == "the program 'mine' has no workers now"
    site.remove("pods", pod)
    assert refused(site.fiber("logs", "mine"), 1)[0] == "the program 'mine' has no pod"


def test_an_empty_log_is_told(site: Site) -> None:
    run_program(site)
    pod = site.pod()
    site.nodes.logs.append([])
    outcome = site.fiber("logs", "mine")
    assert (outcome.status, outcome.out) == (0, "")
    assert "the log is empty" in outcome.err
    add_worker(site, pod, "pool-1")
    site.nodes.logs.append([])
    outcome = site.fiber("logs", "mine", "--worker", "pool-1")
    assert (outcome.status, outcome.out) == (0, "")
    assert "what its tasks print is in the program's" in outcome.err


def test_a_log_that_the_cluster_does_not_give(site: Site) -> None:
    run_program(site)
    site.server.api.faults.append(Fault("get", "pods", 403, "Forbidden", "you may not"))
    assert site.fiber("logs", "mine").status == 5
    site.server.api.faults.append(Fault("get", "pods", 404, "NotFound", "not found"))
    outcome = site.fiber("logs", "mine")
    assert refused(outcome, 1)[0].endswith("any longer")


# ---- lines


@given(
    st.lists(st.tuples(st.integers(0, 3), st.text("ab c", max_size=4)), max_size=8),
    st.lists(st.integers(0, 60), max_size=4),
    st.integers(1, 9),
)
def test_each_line_is_shown_once(
    given_lines: list[tuple[int, str]], cuts: list[int], size: int
) -> None:
    """However often the log breaks off, and wherever."""
    moments = sorted(number for number, _ in given_lines)
    whole = [
        (f"2026-01-01T00:00:0{moment}.000000000Z", text)
        for moment, (_, text) in zip(moments, given_lines, strict=True)
    ]
    lines, shown = Lines(), b""
    for cut in [*cuts, 10_000]:
        since = lines.query({}).get("sinceTime", "")
        log = "".join(f"{moment} {text}\n" for moment, text in whole if moment >= since)
        data = log.encode()[:cut]
        for at in range(0, len(data), size):
            shown += b"".join(lines.new(data[at : at + size]))
    assert shown.decode() == "".join(f"{text}\n" for _, text in whole)
