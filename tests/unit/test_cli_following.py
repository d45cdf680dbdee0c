"""Output of a program that ``fiber run`` follows, and the ends of both."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fakes.kubernetes_api import Call, Fault
from fakes.program_nodes import kill
from fiber_api import names
from patience import PATIENCE
from terminal import Terminal
from unit.kubernetes_rig import NAMESPACE
from unit.pool_command_rig import Outcome
from unit.run_rig import COMMAND, WAITS, Site, interrupt, read_line, run_site
from unit.test_cli_run import refused

NUMBERS = "".join(f"{number}\n" for number in range(20_000))


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with run_site(tmp_path) as made:
        yield made


# ---- broken connections


def test_a_broken_connection_loses_and_repeats_nothing(site: Site) -> None:
    site.write("train.py", "print(*range(20_000), sep='\\n')\nraise SystemExit(3)")
    site.nodes.cuts = [1, 10_000_000, 3, 1000, 50_000, 70_000]
    assert site.fiber("run", "train.py") == Outcome(3, NUMBERS, "")
    # The command meets the later cuts only if it is faster than the program.
    assert site.nodes.forwards > 2


def test_an_api_server_that_fails_for_a_while_does_not_matter(site: Site) -> None:
    site.write("train.py", "print(*range(20_000), sep='\\n')")
    site.nodes.cuts = [10_000_000, 1000]
    site.server.api.faults += [
        Fault("get", "pods", 503, times=2, skip=1),
        Fault("list", "pods", 503, times=2),
    ]
    assert site.fiber("run", "train.py") == Outcome(0, NUMBERS, "")


@pytest.mark.parametrize("status", [401, 403])
def test_an_api_server_that_starts_and_refuses_everything_does_not_matter(
    site: Site, status: int
) -> None:
    site.write("train.py", "print(*range(20_000), sep='\\n')")
    site.nodes.cuts = [10_000_000, 1000]
    site.server.api.faults += [
        Fault("get", "pods", status, times=3, skip=1),
        Fault("list", "pods", status, times=2, skip=1),
    ]
    assert site.fiber("run", "train.py") == Outcome(0, NUMBERS, "")


def test_much_output_is_shown_whole(site: Site) -> None:
    site.nodes.linger = PATIENCE  # a reader that is slower than that loses output
    site.write("train.py", "for n in range(40): print(chr(65 + n) * (1 << 20))")
    outcome = site.fiber("run", "train.py")
    assert outcome.err == ""
    assert outcome.out == "".join(chr(65 + n) * (1 << 20) + "\n" for n in range(40))


def test_a_missing_right_ends_the_program_that_nobody_could_start(site: Site) -> None:
    site.write("train.py", "")

    def allows(call: Call) -> bool:
        return call.subresource != "portforward"

    site.server.api.allows = allows
    what, why, remedy = refused(site.fiber("run", "--name", "mine", "train.py"), 125)
    assert what == "cannot follow the program 'mine'"
    assert why == "you may not get pods"
    assert "fiber-user" in remedy
    assert site.nodes.jobs() == []


# ---- ends that the cluster causes


@pytest.mark.parametrize(
    ("reason", "pod", "status", "why"),
    [
        ("OOMKilled", {}, 137, "OOMKilled: its memory limit is 64Mi"),
        (
            "Error",
            {"reason": "Evicted", "message": "The node was low on resource: memory."},
            137,
            "Evicted: The node was low on resource: memory",
        ),
        ("Error", {"reason": "NodeShutdown"}, 137, "NodeLost"),
        (
            "ContainerStatusUnknown",
            {},
            125,
            "NodeLost: its node has no record of the container",
        ),
    ],
    ids=["memory", "evicted", "shutdown", "lost"],
)
def test_the_end_by_the_cluster_is_told(
    site: Site, reason: str, pod: dict[str, str], status: int, why: str
) -> None:
    site.waits()
    command = site.begin("run", "--name", "mine", "--memory", "64Mi", "train.py")
    site.nodes.kill(site.pod(), container_reason=reason, **pod)
    what, told, _ = refused(site.end(command), status)
    assert what == "the program 'mine' was ended by the cluster"
    assert told == why


def test_the_rest_comes_from_the_log(site: Site) -> None:
    site.waits()
    site.nodes.logs.append([b"beg", b"un\nand ", b"the rest\n"])
    command = site.spawn("run", "--name", "mine", "train.py")
    assert command.stdout is not None
    read_line(command.stdout, b"begun")
    site.nodes.kill(site.pod())
    assert site.end(command) == Outcome(137, "and the rest\n", "")
    assert site.nodes.queries == [{"container": names.PROGRAM_CONTAINER}]


def test_a_log_that_is_shorter_than_what_was_shown(site: Site) -> None:
    site.nodes.logs.append([b"x"])
    site.waits()
    command = site.begin()
    site.nodes.kill(site.pod())
    outcome = site.end(command)
    assert (outcome.status, outcome.out) == (137, "")
    assert "the last output may be missing" in outcome.err


def test_a_deleted_program(site: Site) -> None:
    site.waits()
    command = site.begin("run", "--name", "mine", "train.py")
    assert site.fiber("stop", "mine", "--now").out == "deleted the program 'mine'\n"
    assert refused(site.end(command), 143)[0] == "the program 'mine' was deleted"


def test_a_pod_that_is_gone_with_its_node(site: Site) -> None:
    site.waits()
    command = site.begin("run", "--name", "mine", "train.py")
    pod = site.pod()
    site.remove("pods", pod)
    kill(site.nodes.launched[pod])
    assert refused(site.end(command), 125)[0] == "the program 'mine' was lost"


def test_the_deadline(site: Site) -> None:
    site.waits()
    command = site.begin("run", "--name", "mine", "--timeout", "60", "train.py")
    over = {"type": "Failed", "status": "True", "reason": "DeadlineExceeded"}
    site.set_job(conditions=[over])
    pod = site.pod()
    site.remove("pods", pod)
    site.nodes.launched[pod].process.send_signal(signal.SIGTERM)
    what, why, _ = refused(site.end(command), 143)
    assert what == "the program 'mine' was ended by its deadline"
    assert why == "it had not ended 60 s after its start"
    again = site.fiber("run", "--attach", "mine")
    assert refused(again, 125)[0] == "the program 'mine' was ended by its deadline"


# ---- programs that do not start


def test_a_pod_that_waits_is_told_once(site: Site) -> None:
    site.nodes.auto = False
    site.waits()
    command = site.spawn("run", "--name", "mine", "train.py")
    assert command.stderr is not None
    assert b"waiting for the program 'mine': its pod starts" in command.stderr.readline()
    site.nodes.start(site.pod())
    assert command.stdout is not None
    read_line(command.stdout, b"begun")
    interrupt(command)
    assert site.end(command)[:2] == (9, "interrupted\n")


@pytest.mark.parametrize(
    ("condition", "what"),
    [
        ({"type": "Failed", "message": "no\nquota"}, "the program 'mine' has no pod"),
        ({"type": "Complete"}, "the program 'mine' has no pod any longer"),
    ],
)
def test_a_job_that_makes_no_pod(site: Site, condition: dict[str, str], what: str) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    command = site.spawn("run", "--name", "mine", "train.py")
    site.nodes.wait(site.nodes.pods)
    site.set_job(conditions=[{"status": "True", **condition}])
    site.remove("pods", site.pod())
    assert refused(site.end(command), 125)[0] == what


def test_why_a_job_has_no_pod_yet_is_told_once(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    command = site.spawn("run", "--name", "mine", "train.py")
    site.nodes.wait(site.nodes.pods)
    site.remove("pods", site.pod())
    for number in "12":
        site.server.do(
            site.server.store.create,
            "events",
            NAMESPACE,
            {
                "metadata": {"name": f"mine.{number}"},
                "involvedObject": {"kind": "Job", "name": "mine"},
                "reason": "FailedCreate",
                "message": f'pods "mine-abcd{number}" is forbidden:\nexceeded quota',
            },
        )
    assert command.stderr is not None
    line = read_line(command.stderr, b"no pod yet")
    while b"quota" not in line:
        line = read_line(command.stderr, b"no pod yet")
    assert b"no pod yet: pods mine is forbidden: exceeded quota\n" in line
    interrupt(command)
    assert "no pod yet" not in site.end(command).err


def test_an_image_that_cannot_be_is_an_error(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    command = site.spawn("run", "--name", "mine", "train.py")
    site.nodes.wait(site.nodes.pods)
    waiting = {"waiting": {"reason": "InvalidImageName", "message": "BAD"}}
    status = {
        "phase": "Pending",
        "containerStatuses": [{"name": names.PROGRAM_CONTAINER, "state": waiting}],
    }
    site.server.do(site.server.store.set_status, "pods", NAMESPACE, site.pod(), status)
    what, why, _ = refused(site.end(command), 125)
    assert what == "the program 'mine' cannot start"
    assert why == "its pod waits: InvalidImageName: BAD"
    assert site.nodes.jobs() == []


# ---- attach and detach


def test_a_detached_program_is_followed_later(site: Site) -> None:
    site.waits()
    outcome = site.fiber("run", "--detach", "--name", "mine", "train.py")
    assert (outcome.status, outcome.out) == (0, "mine\n")
    assert "fiber run --attach mine" in outcome.err
    command = site.begin("run", "--attach", "mine")
    interrupt(command)
    assert site.end(command)[:2] == (9, "interrupted\n")
    again = site.fiber("run", "--attach", "mine")
    assert (again.status, again.out) == (9, "begun\ninterrupted\n")


def test_a_detached_program_ends_although_nobody_follows(site: Site) -> None:
    site.write("train.py", "raise SystemExit(4)")
    assert site.fiber("run", "--detach", "--name", "mine", "train.py").status == 0
    site.nodes.wait(lambda: site.job()["status"].get("conditions"))
    assert site.fiber("run", "--attach", "mine") == Outcome(4, "", "")


def test_two_commands_follow_one_program(site: Site) -> None:
    site.waits()
    first = site.begin("run", "--name", "mine", "train.py")
    second = site.begin("run", "--attach", "mine")
    interrupt(second)
    for command in (first, second):
        assert site.end(command)[:2] == (9, "interrupted\n")


# ---- Ctrl-C


def test_ctrl_c_interrupts_the_program(site: Site) -> None:
    site.waits()
    command = site.begin()
    interrupt(command)
    outcome = site.end(command)
    assert outcome[:2] == (9, "interrupted\n")
    assert outcome.err == "[fiber] interrupting the program; Ctrl-C again ends it\n"


def test_a_second_ctrl_c_ends_the_program(site: Site) -> None:
    site.waits(then="signal.pause()")
    command = site.begin("run", "--name", "mine", "train.py")
    interrupt(command)
    assert command.stdout is not None
    read_line(command.stdout, b"interrupted")
    interrupt(command)
    outcome = site.end(command)
    assert outcome.status == 130
    assert "fiber: the program 'mine' was ended" in outcome.err
    assert site.nodes.jobs() == []


def test_ctrl_c_before_there_is_a_pod_ends_the_program(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    command = site.spawn("run", "train.py")
    assert command.stderr is not None
    read_line(command.stderr, b"waiting for the program")
    interrupt(command)
    assert site.end(command).status == 130
    assert site.nodes.jobs() == []


@pytest.mark.parametrize("step", ["job", "files"])
def test_ctrl_c_during_the_start_ends_the_program(site: Site, step: str) -> None:
    site.write("train.py", "import signal\nsignal.pause()")
    commands: list[subprocess.Popen[bytes]] = []

    def strike() -> None:
        site.nodes.wait(lambda: commands)
        interrupt(commands[0])

    def after(call: Call) -> None:
        if (call.verb, call.plural) == ("create", "jobs"):
            strike()

    if step == "job":
        site.nodes.also_after = after
    else:
        site.nodes.at_forward = strike
    commands.append(site.spawn("run", "train.py"))
    assert site.end(commands[0]).status == 130
    assert site.nodes.jobs() == []


def test_ctrl_c_while_attaching_leaves_the_program(site: Site) -> None:
    site.nodes.auto = False
    site.write("train.py", "")
    first = site.spawn("run", "--name", "mine", "train.py")
    assert first.stderr is not None
    read_line(first.stderr, b"waiting")
    second = site.spawn("run", "--attach", "mine")
    assert second.stderr is not None
    read_line(second.stderr, b"waiting")
    interrupt(second)
    assert site.end(second).status == 130
    assert len(site.nodes.jobs()) == 1


# ---- terminals and pipes


def terminal(site: Site, *words: str) -> Terminal:
    """Run a command in a terminal; its program waits for Ctrl-C."""
    site.waits()
    return Terminal([*COMMAND, *words], site.folder, site.environment)


def test_a_killed_terminal_leaves_the_program(site: Site) -> None:
    with terminal(site, "run", "--name", "mine", "train.py") as window:
        window.shows("begun")
    assert window.close() == -signal.SIGHUP
    again = site.begin("run", "--attach", "mine")
    interrupt(again)
    assert site.end(again)[:2] == (9, "interrupted\n")


def test_ctrl_c_in_a_terminal(site: Site) -> None:
    with terminal(site, "run", "train.py") as window:
        window.shows("begun")
        window.press(window.CTRL_C)
        window.shows("interrupted")
        assert window.ends() == 9


def test_a_closed_pipe_ends_the_program(site: Site) -> None:
    site.write("train.py", "import os\nprint(os.getpid())\nwhile True: print('y' * 1000)")
    command = site.spawn("run", "train.py")
    assert command.stdout is not None
    program = Path("/proc") / command.stdout.readline().decode().strip()
    assert program.exists()
    command.stdout.close()
    assert command.wait(PATIENCE) == 141
    site.nodes.wait(lambda: not program.exists())
    assert command.stderr is not None
    assert command.stderr.read() == b""


def test_output_that_was_closed_before_is_left_out(site: Site) -> None:
    site.write("train.py", "print('out')\nraise SystemExit(3)")
    words = "exec python -m fiber._cli.main run train.py >&- 2>&-"
    command = subprocess.run(
        ["sh", "-c", words.replace("python", sys.executable)],
        cwd=site.folder,
        env=site.environment,
        timeout=PATIENCE,
    )
    assert command.returncode == 3


def test_the_log_of_the_pod_has_what_was_shown(site: Site) -> None:
    site.write("train.py", WAITS.format(then="sys.exit(9)"))
    command = site.begin()
    site.nodes.wait(lambda: site.nodes.log_of(site.pod()) == b"begun\n")
    interrupt(command)
    site.end(command)
    assert json.loads(site.variables()["FIBER_LAUNCHER_COMMAND"])[0] == "python"
