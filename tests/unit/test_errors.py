"""The error tree: classes that callers catch, messages that help, pickles that survive."""

from __future__ import annotations

import copy
import errno
import multiprocessing
import multiprocessing.pool
import pickle
import resource
import signal

import pytest

from fiber import errors


class Custom(errors.FiberError):
    """Error that a user may derive: its __init__ takes something else than the message."""

    def __init__(self, *, code: int) -> None:
        super().__init__(f"code {code}")
        self.code = code


def worker_died(exitcode: int | None = -signal.SIGKILL, attempts: int = 4) -> errors.WorkerDied:
    return errors.WorkerDied(
        task="task 17 (train)",
        worker="Worker-3",
        host="node-1",
        pid=4711,
        exitcode=exitcode,
        reason="killed by SIGKILL",
        log=["loading", "epoch 1"],
        attempts=attempts,
    )


EXAMPLES = [
    errors.FiberError("something"),
    errors.AdoptionError("cannot adopt"),
    errors.AgentLost("agent-1", "node-1", "no heartbeat for 15 s"),
    errors.ConfigError("unknown key 'agent'"),
    errors.ConnectionClosed(),
    errors.ConnectionClosed("Worker-1", "killed by SIGSEGV"),
    errors.FiberPoolError("no quota", pool="es-1", namespace="team", reason="QuotaExceeded"),
    errors.FileTooLarge("sending a message"),
    errors.MemberLost(3, "killed by SIGKILL"),
    errors.StartError("worker 'Worker-1'", "its initializer raised", "ValueError: no", 3),
    errors.TooManyOpenFiles("starting process 'Worker-1'"),
    errors.UnpicklableError("argument 0 of f", "cannot pickle '_thread.lock' object", ".lock"),
    errors.VersionMismatch("Fiber protocol", ours="1", theirs="2", peer="agent-1"),
    worker_died(),
    Custom(code=3),
]


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("error", EXAMPLES, ids=lambda error: type(error).__name__)
def test_errors_survive_the_way_to_another_process(error: errors.FiberError, protocol: int) -> None:
    back = pickle.loads(pickle.dumps(error, protocol))
    assert type(back) is type(error)
    assert back.args == error.args
    assert str(back) == str(error)
    assert vars(back) == vars(error)


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda error: type(error).__name__)
def test_errors_can_be_copied(error: errors.FiberError) -> None:
    assert vars(copy.copy(error)) == vars(error)


def test_notes_travel_with_the_error() -> None:
    error = worker_died()
    error.add_note("seen in epoch 3")
    assert pickle.loads(pickle.dumps(error)).__notes__ == ["seen in epoch 3"]


@pytest.mark.parametrize(
    "name", ["ProcessError", "BufferTooShort", "TimeoutError", "AuthenticationError"]
)
def test_multiprocessings_errors_are_the_very_same(name: str) -> None:
    assert getattr(errors, name) is getattr(multiprocessing, name)


def test_maybe_encoding_error_is_the_pools() -> None:
    assert errors.MaybeEncodingError is vars(multiprocessing.pool)["MaybeEncodingError"]


def test_unknown_names_of_the_module_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="Nonsense"):
        _ = errors.Nonsense  # type: ignore[attr-defined]  # there is none


@pytest.mark.parametrize(
    ("ours", "caught_as"),
    [
        (errors.FiberError, multiprocessing.ProcessError),
        (errors.ConfigError, ValueError),
        (errors.ConnectionClosed, EOFError),
        (errors.FileTooLarge, OSError),
        (errors.TooManyOpenFiles, OSError),
        (errors.UnpicklableError, TypeError),
        (errors.UnpicklableError, pickle.PicklingError),
    ],
)
def test_handlers_for_multiprocessings_errors_catch_fibers(
    ours: type[Exception], caught_as: type[Exception]
) -> None:
    assert issubclass(ours, caught_as)
    assert issubclass(ours, errors.FiberError)


def test_worker_died_names_the_event_the_reason_and_the_remedy() -> None:
    text = str(worker_died())
    for part in ("task 17 (train)", "Worker-3", "node-1", "4711", "killed by SIGKILL", "4 times"):
        assert part in text
    assert "out of memory" in text
    assert text.endswith("  | loading\n  | epoch 1")


def test_worker_died_keeps_its_facts() -> None:
    error = worker_died()
    assert (error.task, error.worker, error.host) == ("task 17 (train)", "Worker-3", "node-1")
    assert (error.pid, error.exitcode, error.attempts) == (4711, -9, 4)
    assert error.log == ("loading", "epoch 1")


@pytest.mark.parametrize(
    ("exitcode", "hint"),
    [
        (-signal.SIGKILL, "out of memory"),
        (-signal.SIGSEGV, "PYTHONFAULTHANDLER=1"),
        (-signal.SIGTERM, "who sends this signal"),
        (0, "os._exit()"),
        (1, "a module that is missing in a pod"),
        (3, "os._exit()"),
        (None, "not known"),
    ],
)
def test_worker_died_gives_advice_by_exit_code(exitcode: int | None, hint: str) -> None:
    assert hint in str(worker_died(exitcode))


def died_in_a_pod(reason: str, node: str | None = "node-2") -> errors.WorkerDied:
    return errors.WorkerDied(
        task="task 17 (train)",
        worker="Worker-3",
        host="es-1a2b3c-0011223344",
        pid=12,
        exitcode=-signal.SIGKILL,
        reason=reason,
        pod="es-1a2b3c-0011223344",
        node=node,
    )


def test_worker_died_names_pod_and_node() -> None:
    error = died_in_a_pod("OOMKilled: its memory limit is 512Mi")
    assert (error.pod, error.node) == ("es-1a2b3c-0011223344", "node-2")
    assert "(in pod 'es-1a2b3c-0011223344' on node 'node-2', pid 12)" in str(error)
    assert "(in pod 'es-1a2b3c-0011223344', pid 12)" in str(died_in_a_pod("Deleted: it is", None))
    assert (worker_died().pod, worker_died().node) == (None, None)


@pytest.mark.parametrize(
    ("reason", "hint"),
    [
        ("OOMKilled: its memory limit is 512Mi", "@fiber.meta(memory=)"),
        ("Evicted: The node was low on resource: memory", "@fiber.meta(memory=, cpu=)"),
        ("Preempted", "priorityClassName"),
        ("NodeLost: node-2", "look at the node"),
        ("Deleted: the pod was deleted", "who deletes the pods"),
        ("killed by SIGKILL", "the kernel, out of memory"),
    ],
)
def test_worker_died_gives_advice_by_the_reason_of_its_pod(reason: str, hint: str) -> None:
    assert hint in str(died_in_a_pod(reason))


def test_worker_died_at_the_only_attempt_does_not_speak_of_several() -> None:
    assert "times" not in str(worker_died(attempts=1))


def test_connection_closed_says_how_the_peer_ended() -> None:
    error = errors.ConnectionClosed("Worker-1", "killed by SIGSEGV")
    assert "Worker-1 is gone (killed by SIGSEGV)" in str(error)
    assert (error.peer, error.reason) == ("Worker-1", "killed by SIGSEGV")
    assert "closed" in str(errors.ConnectionClosed())
    assert "(exit status 3)" in str(errors.ConnectionClosed(reason="exit status 3"))


def test_start_error_shows_the_cause_of_the_other_process() -> None:
    cause = "Traceback (most recent call last):\nValueError: no such file"
    error = errors.StartError("worker 'Worker-1'", "its initializer raised", cause, attempts=3)
    assert "worker 'Worker-1' did not start after 3 attempts: its initializer raised" in str(error)
    assert "  | ValueError: no such file" in str(error)
    assert error.cause == cause


def test_too_many_open_files_names_the_limit_and_the_setting() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    error = errors.TooManyOpenFiles("making a pipe")
    assert error.errno == errno.EMFILE
    assert pickle.loads(pickle.dumps(error)).errno == errno.EMFILE
    assert (error.limit, error.hard_limit) == (soft, hard)
    for part in ("making a pipe", str(soft), "ulimit -n", "LimitNOFILE"):
        assert part in str(error)


def test_file_too_large_names_the_limit_and_the_setting() -> None:
    soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    error = errors.FileTooLarge("sending a message")
    assert (error.errno, error.limit) == (errno.EFBIG, soft)
    for part in ("sending a message", f"{soft} bytes", "ulimit -f", "LimitFSIZE"):
        assert part in str(error)


def test_unpicklable_names_the_object_and_the_way_to_it() -> None:
    error = errors.UnpicklableError("argument 0 of f", "cannot pickle a lock", "['x'].lock")
    assert "argument 0 of f cannot be pickled (at ['x'].lock): cannot pickle a lock" in str(error)
    assert "(at" not in str(errors.UnpicklableError("the target", "it is local"))


def test_version_mismatch_names_both_versions() -> None:
    error = errors.VersionMismatch("Python", ours="3.11", theirs="3.13", peer="agent-2")
    assert "Python version mismatch: agent-2 has 3.13, this process has 3.11" in str(error)


def test_agent_lost_names_agent_host_and_reason() -> None:
    error = errors.AgentLost("agent-1", "node-1", "no heartbeat for 15 s")
    for part in ("agent-1", "node-1", "no heartbeat for 15 s"):
        assert part in str(error)
