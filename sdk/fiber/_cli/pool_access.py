"""FiberPools as the commands read and change them: by name, with errors that name the nearest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

from fiber._cli.failures import CommandError, explained, not_found
from fiber._cli.session import SECONDS, Session, check_name, connect
from fiber_api import names
from fiber_api.names import ConditionType
from fiber_api.rest import POOLS, Body, Conflict, Invalid, NotFound

_ATTEMPTS = 20
"""Attempts to change a pool whose status the operator writes meanwhile."""


def opened(context: str | None, namespace: str | None) -> Session:
    """Connect, until the command ends."""
    session = connect(context, namespace)
    click.get_current_context().call_on_close(session.api.close)
    return session


def path_of(session: Session, name: str) -> str:
    """Return the path of a FiberPool; CommandError if none can have this name."""
    check_name("FiberPool", name)
    return POOLS.path(session.namespace, name)


def pools(session: Session) -> list[Body]:
    """Return the FiberPools of the namespace."""
    with explained("list the FiberPools"):
        return session.items(POOLS)


def absent(session: Session, name: str) -> CommandError:
    """Return the error for a FiberPool that does not exist."""
    existing = (str(pool["metadata"]["name"]) for pool in pools(session))
    return not_found("FiberPool", name, existing, session.where)


def find(session: Session, name: str) -> Body | None:
    """Return a FiberPool; None if there is none of this name."""
    with explained(f"read the FiberPool {name!r}"):
        try:
            return session.api.get(path_of(session, name), timeout=SECONDS)
        except NotFound:
            return None


def get(session: Session, name: str) -> Body:
    """Return a FiberPool."""
    found = find(session, name)
    if found is None:
        raise absent(session, name)
    return found


def patch(session: Session, name: str, spec: Body, doing: str) -> Body:
    """Merge ``spec`` into a FiberPool, and return the result.

    ``doing`` is the verb for the error, as "scale".
    """
    with refusals(f"{doing} the FiberPool {name!r}"):
        return _send(session, name, {"spec": spec})


def change(session: Session, name: str, spec_of: Callable[[Body], Body], doing: str) -> Body:
    """Merge ``spec_of(pool)`` into the FiberPool that it was made for, and return the result."""
    with refusals(f"{doing} the FiberPool {name!r}"):
        for _ in range(_ATTEMPTS):
            found = get(session, name)
            metadata = {"resourceVersion": found["metadata"]["resourceVersion"]}
            try:
                return _send(session, name, {"metadata": metadata, "spec": spec_of(found)})
            except Conflict:
                pass  # the operator wrote its status, or a program attached
    raise CommandError(
        f"cannot {doing} the FiberPool {name!r}",
        "it changed during each attempt",
        "see who changes it with `kubectl get fiberpool --watch`, then try again",
    )


def _send(session: Session, name: str, body: Body) -> Body:
    try:
        return session.api.merge_patch(
            path_of(session, name), body, manager=names.COMMAND_MANAGER, timeout=SECONDS
        )
    except NotFound:
        raise absent(session, name) from None


@contextmanager
def refusals(doing: str) -> Iterator[None]:
    """Turn errors into a ``CommandError``, with advice if the API server refuses the content."""
    with explained(doing):
        try:
            yield
        except Invalid as error:
            raise CommandError(
                f"cannot {doing}",
                one_line(error.message),
                "correct the named fields; `kubectl explain fiberpool.spec` describes each",
            ) from error


def one_line(text: str) -> str:
    """Return ``text`` with one space for each gap."""
    return " ".join(text.split())


def program_of(pool: Body) -> str | None:
    """Return the identity of the program that uses a pool; None if there is none."""
    master = pool["spec"].get("master")
    return None if master is None else str(master.get("identity") or master.get("host"))


def condition(pool: Body, kind: str) -> dict[str, Any]:
    """Return a condition of the pool's status; empty if it is not there."""
    status = pool.get("status") or {}
    found = (each for each in status.get("conditions") or () if each.get("type") == kind)
    return next(found, {})


def account_of_program(pool: Body) -> str:
    """Return the program that uses a pool and whether it lives, in words."""
    alive = condition(pool, ConditionType.MASTER_ALIVE)
    since = f" since {alive['lastTransitionTime']}" if alive.get("lastTransitionTime") else ""
    words = {"True": f"alive{since}", "False": f"lost{since}"}
    return f"{program_of(pool)} ({words.get(str(alive.get('status')), 'not known to be alive')})"


def is_of_program(pool: Body) -> bool:
    """Return whether a program made the pool for itself."""
    labels = pool["metadata"].get("labels") or {}
    return labels.get(names.LABEL_MANAGED_BY) == names.SDK_MANAGER
