"""Errors of the command, and its exit statuses.

====== ======================================================================
status meaning
====== ======================================================================
0      success
1      the command failed, or ``fiber doctor`` found a fault
2      the command line has a mistake
3      there is no such program, worker or pool
4      the cluster does not answer, or the login is not accepted
5      this account lacks a right
130    interrupted by Ctrl-C
====== ======================================================================

``fiber run`` ends with the status of the program.  Its own errors have the status 125, as those of
``docker run`` have, except mistakes of the command line.  A program that cannot be started has 126
or 127, as in a shell, and one whose output nobody reads any longer has 141.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from fiber._backends.kubernetes.published import SET_IMAGE, install_command, reason_for_no_image
from fiber.errors import ConfigError, FiberError
from fiber_api.rest import ApiError, Forbidden, NotServed, Transient, Unauthorized

FAILED = 1
USAGE = 2
NOT_FOUND = 3
NO_ANSWER = 4
NO_RIGHT = 5
INTERRUPTED = 130


class CommandError(Exception):
    """Error that ends the command: what happened, why, and what to do, in one line each."""

    def __init__(self, what: str, why: str = "", remedy: str = "", status: int = FAILED) -> None:
        super().__init__(what)
        self.what = what
        self.why = why
        self.remedy = remedy
        self.status = status

    def __str__(self) -> str:
        lines = [f"fiber: {self.what}"]
        if self.why:
            lines.append(f"  why:  {self.why}")
        if self.remedy:
            lines.append(f"  do:   {self.remedy}")
        return "\n".join(lines)


class ProgramEnded(CommandError):
    """End of a program that ``fiber run`` follows.  Its status is the program's."""


def not_found(kind: str, name: str, existing: Iterable[str], where: str) -> CommandError:
    """Return the error for a name that does not exist, with the nearest one that does."""
    names = sorted(existing)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        remedy = f"did you mean {close[0]!r}?"
    elif names:
        remedy = f"choose one of {', '.join(names[:10])}"
    else:
        remedy = f"none exists there; name another namespace with --namespace, or make the {kind}"
    return CommandError(
        f"there is no {kind} {name!r}", f"{where} has none of this name", remedy, NOT_FOUND
    )


def no_image() -> CommandError:
    """Return the error for pods without an image."""
    return CommandError(
        "there is no image for workers",
        reason_for_no_image(),
        f"name one with --image, or {SET_IMAGE}",
        USAGE,
    )


@contextmanager
def explained(doing: str) -> Iterator[None]:
    """Turn errors of the API server and of the configuration into a ``CommandError``.

    ``doing`` is what failed, in words that follow "cannot".
    """
    try:
        yield
    except Unauthorized as error:
        raise CommandError(
            f"cannot {doing}",
            f"the API server does not accept this login: {error.message}",
            "log in to the cluster again, or choose another context with --context",
            NO_ANSWER,
        ) from error
    except Forbidden as error:
        raise CommandError(
            f"cannot {doing}",
            error.message,
            "ask an administrator for the roles fiber-user and, for `fiber run`, fiber-runner",
            NO_RIGHT,
        ) from error
    except NotServed as error:
        raise CommandError(
            f"cannot {doing}",
            "the cluster knows no FiberPools",
            f"install the operator: `{install_command()}`",
        ) from error
    except Transient as error:
        raise CommandError(
            f"cannot {doing}",
            f"the API server does not answer: {' '.join(error.message.split())}",
            "check the network and the kubeconfig (`kubectl cluster-info`), then try again",
            NO_ANSWER,
        ) from error
    except ApiError as error:
        raise CommandError(f"cannot {doing}", error.message) from error
    except (ConfigError, FiberError) as error:
        raise CommandError(f"cannot {doing}", str(error), status=NO_ANSWER) from error
