"""The command ``fiber`` in this process, against an API server in this process."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest

from fakes.served import Served, served
from fiber._cli import main
from fiber_api import names
from unit.kubernetes_rig import NAMESPACE, OTHER, Body, kubeconfig, pool_body


class Outcome(NamedTuple):
    """Output of a command, and its exit status."""

    status: int
    out: str
    err: str


def run(*words: str, typed: str = "") -> Outcome:
    """Run ``fiber`` with these words and this standard input."""
    out, err = io.StringIO(), io.StringIO()
    status = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["fiber", *words])
        patch.setattr(sys, "stdin", io.StringIO(typed))
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main.main()
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else 1
    return Outcome(status, out.getvalue(), err.getvalue())


def examples_of(command: click.Command) -> Iterator[tuple[str, list[str]]]:
    """Yield each example in the help of a command and of its subcommands, as words."""
    text = (command.callback and command.callback.__doc__) or ""
    _, _, below = text.partition("Examples:\n")
    for line in below.splitlines():
        if found := re.match(r"\s+fiber (.+)", line):
            yield command.name or "", shlex.split(found[1])
    if isinstance(command, click.Group):
        for each in command.commands.values():
            yield from examples_of(each)


class Cluster:
    """An API server with one FiberPool ``warm``, and what a test does to it."""

    def __init__(self, server: Served) -> None:
        self.server = server
        body = pool_body("warm")
        body["spec"] |= {"minReplicas": 2, "maxReplicas": 8}
        self.add(body)

    def add(self, body: Body, plural: str = names.PLURAL) -> Body:
        found: Body = self.server.do(self.server.store.create, plural, NAMESPACE, body)
        return found

    def pool(self, name: str = "warm") -> Body:
        found: Body = self.server.do(self.server.store.get, names.PLURAL, NAMESPACE, name)
        return found

    def names(self) -> list[str]:
        return [pool["metadata"]["name"] for pool in self.server.objects(names.PLURAL)]

    def merge(self, patch: Body, name: str = "warm") -> None:
        self.server.do(self.server.store.merge, names.PLURAL, NAMESPACE, name, patch)

    def set_status(self, **status: Any) -> None:
        self.server.do(self.server.store.set_status, names.PLURAL, NAMESPACE, "warm", status)

    def attach(self, epoch: int = 3) -> None:
        """Let a program use the pool, which asks for nine workers."""
        self.merge({"spec": {"master": OTHER.spec("warm", epoch), "replicas": 9, "relay": True}})

    def add_pod(self, name: str, status: Body) -> None:
        labels = {names.LABEL_POOL_UID: self.pool()["metadata"]["uid"]}
        body = {"metadata": {"name": name, "labels": labels}, "spec": {"nodeName": "node-1"}}
        self.add(body, "pods")
        self.server.do(self.server.store.set_status, "pods", NAMESPACE, name, status)


@contextlib.contextmanager
def cluster(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """Yield a cluster, that of the kubeconfig; the working directory is ``folder``."""
    with served() as server:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(folder, server.api.url)))
        monkeypatch.setenv("FIBER_IMAGE", "worker:1")
        monkeypatch.setenv("FIBER_RUNTIME_DIRECTORY", str(folder))  # not those of other tests
        monkeypatch.chdir(folder)
        yield Cluster(server)
