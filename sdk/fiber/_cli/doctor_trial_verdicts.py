"""Verdicts about the trial of ``fiber doctor``: functions of its course.  They are pure."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import fiber
from fiber._cli.display import counted
from fiber._cli.doctor_attempt import TrialCourse, mismatch_in
from fiber._cli.doctor_verdicts import Verdict, fault, note, ok
from fiber._cli.image_packages import canonical
from fiber_api.names import LABEL_RELAY, MASTER_PORT, Reason

NAME = "trial"

_BUILD = "`fiber image build --tag REGISTRY/NAME --push`"

_NAMED = 5
"""Packages that are named, at most."""


class Program(NamedTuple):
    """Program that the trial stands for."""

    namespace: str
    image: str
    python: str = platform.python_version()
    fiber: str = fiber.__version__
    wants_relay: bool = False
    """True if the configuration has relay='always'."""
    packages: frozenset[str] = frozenset()
    """Names of the packages that it has installed."""


def judge(trial: TrialCourse, program: Program) -> list[Verdict]:
    """Return the verdicts about a trial: how it went and, after a success, what it showed."""
    found = [*(_success(trial, program) if trial.answer else _failure(trial, program))]
    if trial.left:
        found.append(
            fault(
                "something is left of the trial",
                trial.left,
                f"`kubectl delete fiberpools --namespace {program.namespace} NAME`",
            )
        )
    return [verdict._replace(check=NAME) for verdict in found]


def _success(trial: TrialCourse, program: Program) -> Iterator[Verdict]:
    answer = trial.answer or {}
    yield ok(f"a worker ran a task ({_times(trial.steps)})")
    if answer["fiber"] == program.fiber:
        yield ok(
            f"the image has Python {answer['python']}, Fiber {answer['fiber']} and "
            f"{len(answer['packages'])} packages; this program has Python {program.python}"
        )
    else:
        yield fault(
            f"the image has Fiber {answer['fiber']}, this program {program.fiber}",
            f"{program.image} was built from another version",
            _rebuild(program),
        )
    if missing := sorted(program.packages - set(map(canonical, answer["packages"]))):
        yield _lacking(missing)
    if program.wants_relay:
        yield ok("the worker came by a relay, as relay='always' asks")
    elif trial.relay:
        yield ok("pods do not reach this program, and came by a relay")
    else:
        yield ok("pods reach this program")


def _lacking(packages: Sequence[str]) -> Verdict:
    more = len(packages) - _NAMED
    named = f"{', '.join(packages[:_NAMED])}{f' and {more} more' if more > 0 else ''}"
    return note(
        f"the image lacks {counted(len(packages), 'package')} of this program: {named}",
        "a worker has the packages of its image, and a task that imports another one fails",
        f"if tasks need them, {_BUILD} makes an image with them",
    )


_STEPS = {
    "pool": "FiberPool",
    "pod": "pod made",
    "running": "pod runs",
    "task": "task done",
    "removed": "removed",
}


def _times(steps: Mapping[str, float]) -> str:
    """Return the seconds that each step took after the one before."""
    words, before = [], 0.0
    for step, name in _STEPS.items():
        if step in steps:
            words.append(f"{name} {max(steps[step] - before, 0.0):.1f} s")
            before = max(steps[step], before)
    return ", ".join(words)


# ---- failures -------------------------------------------------------------------------------


def _failure(trial: TrialCourse, program: Program) -> Iterator[Verdict]:
    reason, message = _cause(trial)
    if mismatch := trial.refusal or mismatch_in(message):
        yield _other_version(mismatch, program)
        return
    for known in (_of_image, _of_refusal, _of_place, _of_way):
        if (verdict := known(reason, message, program)) is not None:
            yield verdict
            return
    yield fault(
        "no worker ran the task",
        f"{reason}: {message}" if reason else message,
        f"see `kubectl describe fiberpools --namespace {program.namespace}` during another trial",
    )


def _cause(trial: TrialCourse) -> tuple[str, str]:
    """Return the reason in one word, and in words: the program's, or the worst problem's."""
    error, problem = trial.error or {}, trial.problem or {}
    interrupted = error.get("kind") == "KeyboardInterrupt"
    if error and not interrupted:
        return error.get("reason", ""), _one_line(error.get("message", ""))
    if problem:
        return str(problem.get("reason")), _one_line(str(problem.get("message", "")))
    last = trial.said[-1] if trial.said else "it said nothing"
    return "", f"the program of the trial ended without an answer: {_one_line(last)}"


def _other_version(refusal: str, program: Program) -> Verdict:
    what = "Python" if refusal.startswith("Python") else "Fiber"
    own = program.python if what == "Python" else program.fiber
    return fault(
        f"the image has another {what} than this program, {own}",
        _one_line(refusal),
        _rebuild(program),
    )


_NO_FIBER = ("no module named", "executable file not found", "no such file or directory")
_PULL = (
    Reason.IMAGE_PULL_ERROR,
    Reason.IMAGE_NEVER_PULL,
    Reason.INVALID_IMAGE_NAME,
)
_START = (Reason.CONTAINER_FAILED, Reason.RUN_CONTAINER_ERROR, Reason.CONTAINER_ERROR)


def _of_image(reason: str, message: str, program: Program) -> Verdict | None:
    if reason in _PULL:
        return fault(
            f"the nodes cannot pull the image {program.image!r}",
            message,
            "push the image to a registry that the nodes reach, correct --image or FIBER_IMAGE, "
            "or name the registry's Secret as imagePullSecrets in the template",
        )
    if "runasnonroot" in message.lower() or "non-root" in message:
        return fault(
            f"the image {program.image!r} runs as root",
            message,
            "give the image a numeric USER, as `fiber image build` does",
        )
    if reason in (*_START, Reason.BACKOFF_LIMIT_EXCEEDED):
        if any(words in message.lower() for words in _NO_FIBER):
            return fault(
                f"the image {program.image!r} lacks Fiber, or Python", message, _rebuild(program)
            )
        return fault(
            f"the worker's container of the image {program.image!r} ends at once",
            message,
            f"see its log with `kubectl logs`, or {_rebuild(program)}",
        )
    return None


def _of_refusal(reason: str, message: str, program: Program) -> Verdict | None:
    if "PodSecurity" in message:
        return fault(
            f"the pod security of the namespace {program.namespace!r} refuses workers",
            message,
            "set the named fields in the template (`securityContext`), or use a namespace with a "
            "lower standard",
        )
    if reason in (Reason.QUOTA_EXCEEDED, Reason.REQUESTS_MISSING):
        return fault(
            f"a quota of the namespace {program.namespace!r} refuses workers",
            message,
            "delete what is not needed, ask for a larger quota, or set cpu_request and "
            "memory_request",
        )
    if reason == Reason.FORBIDDEN:
        return fault("the cluster refuses the trial", message, "see the words of the API server")
    if reason == Reason.INVALID_TEMPLATE:
        return fault("the pod template is invalid", message, "correct the key template")
    if reason == "OutdatedDefinition":
        return fault(
            "the definition of FiberPools is older than this program", message, "upgrade the chart"
        )
    return None


def _of_place(reason: str, message: str, program: Program) -> Verdict | None:
    if reason == Reason.UNSCHEDULABLE:
        return fault(
            "no node takes a worker",
            message,
            "add nodes, end other pods, or ask for less in the configuration",
        )
    if reason == "NamespaceNotFound":
        return fault(
            f"there is no namespace {program.namespace!r}",
            message,
            f"`kubectl create namespace {program.namespace}`, or name another with --namespace",
        )
    if reason == "InUse":
        return fault(
            "another program uses the FiberPool of the key pool",
            message,
            "wait for the end of that program, or choose another FiberPool",
        )
    if reason == "NoOperator":
        return fault("no operator serves this namespace", message, "start or install the operator")
    return None


def _of_way(reason: str, message: str, program: Program) -> Verdict | None:
    if reason != "Unreachable" or "API server" in message:
        return None
    if "to the relay" in message:
        return fault(
            "pods reach neither this program nor its relay",
            message,
            f"let a NetworkPolicy allow pods of the namespace {program.namespace!r} to connect to "
            f"port {MASTER_PORT} of pods with the label {LABEL_RELAY}; the chart's value "
            "workerNetworkPolicy does",
        )
    return fault(
        "pods do not reach this program",
        message,
        "set relay='auto' (FIBER_RELAY=auto), or allow the connection",
    )


def _rebuild(program: Program) -> str:
    return (
        f"build an image for this program with {_BUILD}, or choose one with Python "
        f"{'.'.join(program.python.split('.')[:2])} and Fiber {program.fiber} with --image"
    )


def _one_line(text: str) -> str:
    return " ".join(text.split())
