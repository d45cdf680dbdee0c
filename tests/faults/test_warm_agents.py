"""An agent that outlives its masters, as in a pool that waits for work."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

import leaks
from faults.program import Program, wait_for
from fiber._transport.credentials import WarmCredentials
from ports import reserved_port
from warm_key import WarmKey

AGENT = """
    import runpy, sys
    sys.argv = ["agent"]
    runpy.run_module("fiber.agent", run_name="__main__")
"""

MASTER = """
    import pickle, signal, sys
    from fiber._transport.link import Keepalive
    from fiber._transport.listener import MasterListener
    from fiber._transport.loop import Loop
    from fiber._wire.messages import Shutdown, Recall

    class Observer:
        def on_frame(self, frame): pass
        def on_suspect(self): pass
        def on_trusted(self): pass
        def on_lost(self, reason): print("lost", reason, flush=True)

    links = []
    def joined(link):
        links.append(link)
        link.attach(Observer())
        link.send(Recall(0).encode())
        tell(link)

    def tell(link):
        # Once it has acknowledged the message, it knows that it was welcome.  The loop sends later.
        statistics = link.statistics()
        waits = statistics.queued_frames or statistics.unacknowledged_datagrams
        if statistics.frames_sent and not waits:
            print("joined", link.peer.name, flush=True)
        else:
            loop.call_later(0.01, tell, link)

    def end(*_):
        def act():
            for link in links:
                link.send(Shutdown(0.0).encode())
            listener.close("the master ended", then=loop.stop)
        loop.call_soon(act)

    loop = Loop()
    signal.signal(signal.SIGTERM, end)
    listener = MasterListener(
        loop, sys.argv[2], pickle.load(open(sys.argv[1], "rb")),
        on_agent=joined, on_refused=lambda reason: None,
        keepalive=Keepalive(0.2, 0.5, 1.0), lost_grace=float(sys.argv[3]) if sys.argv[3:] else None,
    )
    print("listens", flush=True)
    loop.run()
"""


class Pool:
    """Address where masters come and go, and one agent that dials it."""

    def __init__(self, launch: Callable[..., Program], folder: Path, port: int) -> None:
        self.key = WarmKey()
        self.address = f"127.0.0.1:{port}"
        self._folder = folder
        self._launch = launch
        self._epochs = itertools.count(1)

    def agent(self, grace: float, script: str = AGENT, epoch: int = 0, **env: str) -> Program:
        inherited = self.key.agent("warm-0", "uid", epoch).to_descriptor()
        told = {
            "FIBER_AGENT_ADDRESS": self.address,
            "FIBER_AGENT_CREDENTIALS": f"fd:{inherited}",
            "FIBER_AGENT_PARENT": str(os.getpid()),
            "FIBER_AGENT_LOST_GRACE": str(grace),
            "FIBER_START_TIMEOUT": "0.2",
        }
        try:
            return self._launch(script, env={**told, **env}, pass_fds=(inherited,))
        finally:
            os.close(inherited)

    def stranger(self) -> Program:
        """Start the master of another pool at the same address."""
        return self.master(credentials=WarmKey().master(1))

    def master(
        self, *grace: str, epoch: int | None = None, credentials: WarmCredentials | None = None
    ) -> Program:
        number = next(self._epochs)
        path = self._folder / f"master-{number}"
        path.write_bytes(pickle.dumps(credentials or self.key.master(epoch or number)))
        master = self._launch(MASTER, str(path), self.address, *grace)
        assert master.line() == "listens"
        return master


@pytest.fixture
def pool(launch: Callable[..., Program], tmp_path: Path) -> Iterator[Pool]:
    with reserved_port() as port:
        yield Pool(launch, tmp_path, port)


def test_a_warm_agent_waits_longer_than_its_grace_for_its_first_master(pool: Pool) -> None:
    agent = pool.agent(grace=0.1)
    with pytest.raises(AssertionError, match="still runs"):
        agent.wait(1.0)
    assert pool.master().line() == "joined warm-0"


def descriptors(program: Program) -> list[str]:
    """Return what a program has open, without its standard streams, once a connection is made.

    Until then it has nng's pipe not yet, or two descriptors of the socket.
    """
    found: list[str] = []

    def is_made() -> bool:
        found[:] = [target for fd, target in leaks.descriptors(program.pid) if fd > 2]
        sockets = [name for name in found if name.startswith("socket:")]
        return len(sockets) == len(set(sockets)) and any(name.startswith("pipe:") for name in found)

    wait_for(is_made, what="a connection that is made")
    return found


def test_an_agent_serves_one_master_after_the_other_and_keeps_no_state(pool: Pool) -> None:
    agent = pool.agent(grace=30)
    numbers, before = [], set[str]()
    for _ in range(3):
        master = pool.master()
        assert master.line() == "joined warm-0"
        now = descriptors(agent)
        numbers.append(len(now))
        own = {name for name in now if name.startswith(("socket:", "pipe:"))}
        assert own.isdisjoint(before)
        before = own
        master.signal(signal.SIGTERM)
        assert master.wait() == 0
    assert len(set(numbers)) == 1
    # A master that is on its way out refuses newcomers.
    assert set(agent.stderr.splitlines()) <= {
        f"fiber agent warm-0: the master at {pool.address} refused this agent: "
        "this master is ending"
    }


def test_an_agent_serves_no_master_before_the_one_that_its_pod_was_made_for(pool: Pool) -> None:
    agent = pool.agent(grace=30, epoch=2)
    earlier = pool.master(epoch=1)
    wait_for(lambda: "this agent belongs to one of epoch 2" in agent.stderr)
    earlier.kill()
    assert pool.master(epoch=2).line() == "joined warm-0"


def test_an_earlier_master_gets_the_agent_of_a_later_one_no_more(pool: Pool) -> None:
    """The earlier master still has all that it ever knew, and the address of the pool."""
    agent = pool.agent(grace=30)
    earlier, later = pool.key.master(1), pool.key.master(2)
    for credentials in (earlier, later):
        master = pool.master(credentials=credentials)
        assert master.line() == "joined warm-0"
        master.signal(signal.SIGTERM)
        assert master.wait() == 0
    again = pool.master(credentials=earlier)
    wait_for(lambda: "has epoch 1, and this agent belongs to one of epoch 2" in agent.stderr)
    again.kill()


def test_an_agent_that_refuses_all_later_masters_ends(pool: Pool) -> None:
    """The status of its pool was lost, so that the epochs begin anew."""
    agent = pool.agent(grace=1, epoch=9)
    pool.master(epoch=2)
    assert agent.wait() == 0
    assert "this agent belongs to one of epoch 9" in agent.stderr


PLANTED = """
import os
if "FIBER_AGENT_CREDENTIALS" in os.environ:  # which the agent alone has, as it begins
    open(__file__ + ".ran", "w").close()
raise ImportError(__name__)
"""


@pytest.mark.parametrize("module", ["sitecustomize", "socket", "fiber", "msvcrt"])
def test_modules_that_a_task_wrote_do_not_run_for_the_next_master(
    pool: Pool, tmp_path: Path, module: str
) -> None:
    """Write into the working directory, which Python searches first, and on PYTHONPATH."""
    before = "import sys; sys.path.insert(0, '')\n"
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    agent = pool.agent(30, before + textwrap.dedent(AGENT), PYTHONPATH=path)
    master = pool.master()
    assert master.line() == "joined warm-0"
    places = agent.folder / f"{module}.py", tmp_path / f"{module}.py"
    for place in places:
        place.write_text(PLANTED)
    master.signal(signal.SIGTERM)
    assert master.wait() == 0
    assert pool.master().line() == "joined warm-0"
    assert [place for place in places if Path(f"{place}.ran").exists()] == []


@pytest.mark.parametrize("settings", ["[tool.fiber", "[tool.fiber]\nunknown = 1"])
def test_settings_that_a_task_wrote_do_not_reach_the_next_master(pool: Pool, settings: str) -> None:
    agent = pool.agent(30)
    master = pool.master()
    assert master.line() == "joined warm-0"
    (agent.folder / "pyproject.toml").write_text(settings)
    master.signal(signal.SIGTERM)
    assert master.wait() == 0
    assert pool.master().line() == "joined warm-0"


def test_children_of_the_next_master_have_the_first_ones_flags() -> None:
    program = """
import subprocess, sys
from fiber._agent import main, zygote_process
show = "print(sys.flags.isolated, *zygote_process.interpreter_arguments('python', '')[:-2])"
exec(show)
sys.stdout.flush()
*command, statement = main._restart_command()
subprocess.run([*command, statement.partition("import runpy")[0] + show], check=True)
"""
    command = [sys.executable, "-O", "-c", program]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
    first, second = ran.stdout.splitlines()
    assert (first[0], second[0], first[1:]) == ("0", "1", second[1:])
    assert "-O" in first


def test_credentials_from_a_file_serve_for_all_its_masters(pool: Pool, tmp_path: Path) -> None:
    file = tmp_path / "agent.json"
    file.write_text(json.dumps(asdict(pool.key.agent("warm-0", "uid"))))
    pool.agent(30, FIBER_AGENT_CREDENTIALS=str(file))
    for _ in range(3):
        master = pool.master()
        assert master.line() == "joined warm-0"
        master.kill()


def test_an_agent_that_the_kernel_does_not_hide_serves_and_warns(pool: Pool) -> None:
    refused = """
    from fiber._agent import main as agent_main
    agent_main.hide_this_process = lambda: False
    """
    agent = pool.agent(30, refused + AGENT)
    assert pool.master().line() == "joined warm-0"
    assert "fiber agent warm-0: the kernel refused prctl(PR_SET_DUMPABLE)" in agent.stderr


def test_an_agent_that_cannot_find_the_tasks_files_serves_no_second_master(pool: Pool) -> None:
    refused = """
    from fiber._agent import child
    child.become_subreaper = lambda: False
    """
    agent = pool.agent(30, refused + AGENT)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.signal(signal.SIGTERM)
    assert agent.wait() == 1
    assert "the kernel refused prctl(PR_SET_CHILD_SUBREAPER)" in agent.stderr
    assert agent.left() == []


def test_a_warm_agent_finds_the_next_master_after_the_last_was_killed(pool: Pool) -> None:
    agent = pool.agent(grace=30)
    for _ in range(2):
        master = pool.master()
        assert master.line() == "joined warm-0"
        master.kill()
    assert pool.master().line() == "joined warm-0"
    assert re.fullmatch(r"(fiber agent warm-0: lost the master: .*\n){2}", agent.stderr)


def test_a_stranger_at_the_address_of_a_lost_master_is_not_the_end(pool: Pool) -> None:
    agent = pool.agent(grace=60)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.kill()
    stranger = pool.stranger()
    wait_for(lambda: "do not trust each other" in agent.stderr)
    stranger.kill()
    assert pool.master().line() == "joined warm-0"


def test_a_warm_agent_ends_when_no_master_follows_a_lost_one(pool: Pool) -> None:
    agent = pool.agent(grace=0.5)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.kill()
    assert agent.wait() == 0
    assert agent.left() == []
    assert "lost the master" in agent.stderr
    assert f"no master answered at {pool.address} within 0" in agent.stderr


def test_a_master_says_how_long_it_is_waited_for(pool: Pool) -> None:
    """Settings of the master are newer than the agent."""
    agent = pool.agent(grace=600)
    master = pool.master("0.5")
    assert master.line() == "joined warm-0"
    master.kill()
    assert agent.wait() == 0
    assert f"no master answered at {pool.address} within 0" in agent.stderr


def test_a_longer_grace_of_the_master_holds_too(pool: Pool) -> None:
    agent = pool.agent(grace=0.1)
    master = pool.master("600")
    assert master.line() == "joined warm-0"
    master.kill()
    wait_for(lambda: "lost the master" in agent.stderr)
    with pytest.raises(AssertionError, match="still runs"):
        agent.wait(1.0)
    assert pool.master().line() == "joined warm-0"


def test_a_master_that_ended_in_order_is_not_lost(pool: Pool) -> None:
    agent = pool.agent(grace=0.5)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.signal(signal.SIGTERM)
    assert master.wait() == 0
    with pytest.raises(AssertionError, match="still runs"):
        agent.wait(1.5)


def test_sigterm_ends_it_while_it_waits(pool: Pool) -> None:
    agent = pool.agent(grace=30)
    wait_for(lambda: _handles(agent.pid, signal.SIGTERM))
    agent.signal(signal.SIGTERM)
    assert agent.wait() == 0
    assert agent.left() == []


def test_sigterm_that_another_thread_takes_between_two_lives_ends_it(pool: Pool) -> None:
    told = """
    import os, signal, threading
    from fiber._agent import main as agent_main

    def take() -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
        os.kill(os.getpid(), signal.SIGTERM)

    def end(seconds: float) -> bool:
        thread = threading.Thread(target=take)
        thread.start()
        thread.join()
        return True

    agent_main.end_descendants = end
    """
    agent = pool.agent(30, told + AGENT)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.signal(signal.SIGTERM)
    assert agent.wait() == 0
    assert agent.left() == []


def test_a_grace_that_is_no_number(pool: Pool) -> None:
    agent = pool.agent(grace=1, FIBER_AGENT_LOST_GRACE="soon")
    assert agent.wait() == 1
    assert "FIBER_AGENT_LOST_GRACE='soon' is not a number of seconds" in agent.stderr


def _handles(pid: int, signum: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = re.search(r"SigCgt:\t(\w+)", status)
    return caught is not None and bool(int(caught[1], 16) >> (signum - 1) & 1)


MASK = "import signal; print(signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"


def test_in_the_image_a_signal_waits_for_python_itself() -> None:
    """Process 1 of a container would never get one that it is not ready for."""
    dockerfile = Path(__file__).parents[2] / "sdk" / "Dockerfile"
    (line,) = (line for line in dockerfile.read_text().splitlines() if "ENTRYPOINT" in line)
    *before, python, m, module = json.loads(line.removeprefix("ENTRYPOINT"))
    assert (python, m, module) == ("python", "-m", "fiber.agent")
    ran = subprocess.run([*before, sys.executable, "-c", MASK], capture_output=True, text=True)
    assert ran.stdout == "True\n", ran.stderr


def test_the_agent_waits_for_slow_imports_elsewhere() -> None:
    program = f"""
import runpy, sys, types
sys.argv = ["agent"]
main = sys.modules["fiber._agent.main"] = types.ModuleType("main")
def run():
    print("fiber._transport" in sys.modules)
    {MASK}
main.main = run
runpy.run_module("fiber.agent", run_name="__main__")
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ran.stdout == "False\nTrue\n", ran.stderr


def test_a_signal_that_another_thread_takes_before_the_restart_is_not_lost(pool: Pool) -> None:
    """The last look for signals is over, and the restart has not begun."""
    late = """
    import os, signal, threading
    restart = os.execve

    def take():
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGTERM,))
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)

    def after_a_signal(*command):
        thread = threading.Thread(target=take)
        thread.start()
        thread.join()
        restart(*command)

    os.execve = after_a_signal
    """
    agent = pool.agent(30, late + AGENT)
    master = pool.master()
    assert master.line() == "joined warm-0"
    master.signal(signal.SIGTERM)
    assert master.wait() == 0
    assert agent.wait() == 0
