"""Runs some of CPython's tests in this interpreter and reports each as it starts and ends.

    python -m conformance.cpython_suite.worker list
    python -m conformance.cpython_suite.worker run REPORT_FD ID...

``$MP_CASES`` names the module that has them: `cases` (the default) or `executor_cases`. Reports are
lines of JSON on the descriptor, because tests write to, close and redirect the standard streams.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import sys
import time
import traceback
import unittest
from typing import Any


class Reporter(unittest.TestResult):
    """Sends one line when a test starts and one when it ends."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._started = 0.0
        self._outcome = "pass"
        self._details: list[str] = []

    def tell(self, event: str, **fields: Any) -> None:
        os.write(self._descriptor, (json.dumps({"event": event, **fields}) + "\n").encode())

    def startTest(self, test: unittest.TestCase) -> None:
        super().startTest(test)
        self._outcome, self._details = "pass", []
        self._started = time.monotonic()
        self.tell("start", id=_id_of(test))

    def stopTest(self, test: unittest.TestCase) -> None:
        super().stopTest(test)
        seconds = time.monotonic() - self._started
        detail = "\n".join(self._details)
        self.tell("end", id=_id_of(test), outcome=self._outcome, detail=detail, seconds=seconds)

    def addError(self, test: unittest.TestCase | object, err: Any) -> None:
        if isinstance(test, unittest.TestCase):
            self._fail(test, err)
        else:  # unittest reports a failed setUpClass or setUpModule under a stand-in for a test
            self.tell("broken", detail="".join(traceback.format_exception(*err)))

    def addFailure(self, test: unittest.TestCase, err: Any) -> None:
        self._fail(test, err)

    def addSubTest(self, test: unittest.TestCase, subtest: unittest.TestCase, err: Any) -> None:
        if err is not None:
            self._fail(subtest, err)

    def addSkip(self, test: unittest.TestCase, reason: str) -> None:
        self._outcome = "skip"
        self._details.append(reason)

    def _fail(self, test: unittest.TestCase, err: Any) -> None:
        self._outcome = "fail"
        self._details.append(f"{test}\n{''.join(traceback.format_exception(*err))}")


def _id_of(test: unittest.TestCase) -> str:
    return ".".join(test.id().split(".")[-2:])


def load_cases() -> Any:
    return importlib.import_module(f".{os.environ.get('MP_CASES', 'cases')}", __package__)


def list_cases() -> None:
    cases = load_cases()
    for case in cases.CASES:
        print(json.dumps(case._asdict()))


def run(descriptor: int, ids: list[str]) -> None:
    cases = load_cases()
    os.set_inheritable(descriptor, False)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a hang is ended with SIGABRT
    reporter = Reporter(descriptor)
    suite = unittest.TestSuite(unittest.defaultTestLoader.loadTestsFromNames(ids, cases))
    suite.run(reporter)
    reporter.tell("done", fallbacks=sorted(cases.FALLBACKS), missing=sorted(cases.MISSING))


if __name__ == "__main__":
    if sys.argv[1] == "list":
        list_cases()
    else:
        run(int(sys.argv[2]), sys.argv[3:])
