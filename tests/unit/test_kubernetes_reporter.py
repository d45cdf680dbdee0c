"""Problems of a pool: which are reported, in which order, and how often."""

from __future__ import annotations

from typing import Any

import pytest

from fiber._backends.kubernetes.problems import PoolName, Reporter
from fiber.errors import FiberPoolError
from fiber_api.rest import Forbidden, ServerError, ServerUnreachable


class Told:
    """A loop that calls at once, and what it was asked to tell."""

    def __init__(self) -> None:
        self.said: list[str] = []
        loop: Any = self
        self.reporter = Reporter(
            loop,
            PoolName("es", "lab"),
            "kube",
            on_warning=lambda message: self.said.append(f"warning: {message}"),
            on_error=lambda error: self.said.append(f"error: {error}"),
            on_failure=lambda: self.said.append("it ends"),
        )

    def call_soon(self, callback: Any, *args: Any) -> None:
        callback(*args)

    def starts(self) -> list[str]:
        """The first words of each."""
        return [" ".join(text.split()[:4]) for text in self.said]


@pytest.fixture
def told() -> Told:
    return Told()


def test_only_the_first_error_of_a_chain_is_reported(told: Told) -> None:
    told.reporter.fail(told.reporter.error("Deleted", "was deleted"))
    told.reporter.refused("scale", Forbidden("no", status=403))
    told.reporter.fault(KeyError("spec"))
    assert told.said == [
        "error: the FiberPool 'es' in namespace 'lab' was deleted",
        "it ends",
    ]


def test_an_internal_error_has_its_cause(told: Told) -> None:
    errors: list[FiberPoolError] = []
    told.reporter._on_error = errors.append
    fault = KeyError("spec")
    told.reporter.fault(fault)
    (error,) = errors
    assert error.__cause__ is fault
    assert (error.pool, error.namespace, error.reason) == ("es", "lab", "Internal")


def test_a_lasting_problem_is_reported_once(told: Told) -> None:
    for doing in ("scale", "watch", "scale"):
        told.reporter.trouble(doing, ServerUnreachable("no route"))
    assert told.starts() == ["warning: cannot scale the"]
    told.reporter.trouble("watch", ServerError("etcd", status=500))
    assert told.starts()[1:] == ["warning: cannot watch the"]


def test_a_trouble_that_returns_is_reported_again(told: Told) -> None:
    told.reporter.trouble("scale", ServerUnreachable("no route"))
    told.reporter.answered()
    told.reporter.trouble("scale", ServerUnreachable("no route"))
    assert len(told.said) == 2


def test_a_missing_right_is_reported_once_in_spite_of_answers(told: Told) -> None:
    for _ in range(2):
        told.reporter.trouble("scale", Forbidden("no", status=403))
        told.reporter.answered()
    assert len(told.said) == 1
    told.reporter.warn_anew()
    told.reporter.trouble("scale", Forbidden("no", status=403))
    assert len(told.said) == 2


def test_a_returned_pool_is_not_reported(told: Told) -> None:
    told.reporter.mute()
    told.reporter.trouble("scale", ServerUnreachable("no route"))
    told.reporter.fail(told.reporter.error("Deleted", "was deleted"))
    assert told.said == []
