"""Connection of a command to the cluster, and the options that choose cluster and namespace."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import click

from fiber import config
from fiber._backends.kubernetes.api import Api
from fiber._cli.failures import USAGE, CommandError, explained
from fiber_api.rest import Body, ResourceType

F = TypeVar("F", bound=Callable[..., Any])


_NAME = re.compile("[a-z0-9]([-a-z0-9.]*[a-z0-9])?")

SECONDS = 5.0
"""Seconds that the API server may take for a call."""


class Session(NamedTuple):
    """Connection to one namespace of a cluster."""

    api: Api
    namespace: str

    @property
    def where(self) -> str:
        """Namespace and cluster, for messages."""
        return f"the namespace {self.namespace!r} of the cluster at {self.api.server}"

    def items(self, kind: ResourceType, labels: str = "") -> list[Body]:
        """Return the namespace's objects of a kind, with these labels; ``ApiError``."""
        selector = {"labelSelector": labels} if labels else {}
        listing = self.api.list(kind.path(self.namespace), selector, timeout=SECONDS)
        return list(listing.get("items") or ())


def connect(context: str | None, namespace: str | None) -> Session:
    """Connect as a program with this configuration would.  No call is made."""
    with explained("connect to a cluster"):
        settings = config.load()
        api = Api.connect(context or settings.context)
        if namespace:
            check_name("namespace", namespace)
        return Session(api, namespace or settings.namespace or api.namespace)


def check_name(kind: str, name: str) -> None:
    """Raise CommandError if no object can have this name.  It becomes a part of a path."""
    if not _NAME.fullmatch(name):
        raise CommandError(
            f"{name!r} cannot be the name of a {kind}",
            "a name has lower-case letters, digits, '-' and '.'",
            f"correct the name of the {kind}",
            USAGE,
        )


def cluster_options(command: F) -> F:
    """Add ``--namespace`` and ``--context`` to a command."""
    command = click.option(
        "--context", metavar="NAME", help="Context of the kubeconfig.  Default: the current one."
    )(command)
    return click.option(
        "-n",
        "--namespace",
        metavar="NAME",
        help="Namespace.  Default: that of pyproject.toml, FIBER_NAMESPACE, or the context.",
    )(command)


def output_option(command: F) -> F:
    """Add ``--output`` to a command that lists."""
    return click.option(
        "-o",
        "--output",
        type=click.Choice(["table", "json"]),
        default="table",
        help="Form of the output.",
    )(command)
