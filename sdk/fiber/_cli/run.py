"""``fiber run``: run a program in a pod, and follow it as if it ran here."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import Any

import click

from fiber._cli import following
from fiber._cli.failures import NO_RIGHT, USAGE, CommandError, ProgramEnded, explained
from fiber._cli.programs import find_job
from fiber._cli.run_job import job_of, name_of, variables_of
from fiber._cli.run_source import command_of, program_file, source_of
from fiber._cli.session import SECONDS, Session, cluster_options, connect
from fiber.launcher import FAILED, NO_COMMAND, NOT_EXECUTABLE
from fiber_api import names
from fiber_api.rest import ACCOUNTS, ROLE_BINDINGS, ROLES, Body, Conflict, Forbidden, NotFound


class _RunCommand(click.Command):
    """Command whose options end with the module or before the script: the rest is the program's."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the options of ``fiber run``, and leave the program's as they are."""
        end = self._end_of_options(args)
        if end <= len(args):  # else the last option lacks its value
            args = [*args[:end], "--", *args[end:]]
        return super().parse_args(ctx, args)

    def _end_of_options(self, args: list[str]) -> int:
        takes_value = {
            word
            for option in self.params
            if isinstance(option, click.Option) and not option.is_flag
            for word in option.opts
        }
        at = 0
        while at < len(args) and args[at] != "--" and args[at].startswith("-"):
            word = args[at]
            if word.startswith("-m"):
                return at + (2 if word == "-m" else 1)
            at += 2 if word in takes_value else 1
        return at


@click.command("run", cls=_RunCommand)
@click.option("-m", "module", metavar="MODULE", help="Run a module, as `python -m` does.")
@click.option("--name", help="Name of the program.  Default: the script's, and five digits.")
@click.option("--image", help="Image of the program and its workers.")
@click.option("--cpu", metavar="CPUS", help="CPUs of the program's pod, as 0.5 or 500m.")
@click.option("--memory", help="Memory of the program's pod, as 2Gi.")
@click.option("--gpu", type=int, help="GPUs of the program's pod.")
@click.option("--env", multiple=True, metavar="NAME[=VALUE]", help="Variable of the environment.")
@click.option(
    "--secret", multiple=True, metavar="NAME", help="Secret, whose entries are variables."
)
@click.option(
    "--volume", multiple=True, metavar="CLAIM:PATH[:ro]", help="Claim, and where to mount it."
)
@click.option("--service-account", metavar="NAME", help="Account of the program.")
@click.option("--timeout", type=click.IntRange(1), metavar="SECONDS", help="Longest run time.")
@click.option("--detach", is_flag=True, help="Return once the program runs.")
@click.option("--attach", metavar="NAME", help="Follow a program that runs, and start none.")
@click.option("--local", is_flag=True, help="Run on this machine, with local processes.")
@cluster_options
@click.argument("words", nargs=-1, type=click.UNPROCESSED, metavar="[--] SCRIPT|COMMAND [ARGS]...")
def command(namespace: str | None, context: str | None, **options: Any) -> int:
    """Run a program in a pod of the cluster.

    The program's folder is sent as it is for workers.  Output and exit status are the program's.
    Ctrl-C interrupts the program, and a second one ends it.  If this command is killed, the program
    goes on: `fiber ps` shows it, and `fiber run --attach NAME` follows it again.

    \b
    Examples:
      fiber run train.py --workers 8
      fiber run --cpu 2 --memory 4Gi --env SEED=1 -m package.train
    """
    _check(options)
    try:
        if options["local"]:
            _run_here(options)
        if options["attach"] is not None:
            session = connect(context, namespace)
            return following.attach(session, find_job(session, options["attach"]))
        return _run(context, namespace, options)
    except ProgramEnded:
        raise
    except CommandError as error:
        if error.status != USAGE:
            error.status = FAILED
        raise
    except OSError as error:  # for example, the working directory is gone
        raise CommandError(
            "cannot run the program", str(error), "mend that and try again", FAILED
        ) from error


def _check(options: dict[str, Any]) -> None:
    starts = options["module"] or options["words"] not in ((), ("--",))
    if options["attach"] is not None:
        for given, what in (
            (starts, "a script is named"),
            (options["local"], "--local is given"),
            (options["detach"], "--detach is given"),
        ):
            if given:
                remedy = "leave one of them out"
                raise CommandError("--attach starts no program", f"{what}, too", remedy, USAGE)
    elif not starts:
        raise CommandError("nothing to run", "no script is named", "fiber run SCRIPT", USAGE)
    elif options["local"] and options["detach"]:
        raise CommandError(
            "--local runs the program in this place",
            "--detach is given, too",
            "leave one out",
            USAGE,
        )


def _run(context: str | None, namespace: str | None, options: dict[str, Any]) -> int:
    with explained("read the configuration"):
        from fiber import config

        settings = config.load()
    source = source_of(options)
    name = name_of(options["name"], source)
    job = job_of(name, source, options, settings)
    session = connect(context, namespace)
    account = options["service_account"] or _ensure_account(session)
    job["spec"]["template"]["spec"]["serviceAccountName"] = account
    return following.start(session, job, source.archive, source.layout, detach=options["detach"])


def _run_here(options: dict[str, Any]) -> None:
    """Become the program; does not return."""
    program_file(options)
    os.environ["FIBER_BACKEND"] = "local"
    os.environ.update(variables_of(options["env"]))
    words = command_of(options, sys.executable)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # the interpreter ignores them
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(words[0], words)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        status = NO_COMMAND if missing else NOT_EXECUTABLE
        raise ProgramEnded(
            f"cannot run {words[0]!r}", str(error.strerror).lower(), "name a command", status
        ) from error


def _ensure_account(session: Session) -> str:
    """Return the account of programs, made with the role fiber-user if it does not exist."""
    name, namespace = names.PROGRAM_ACCOUNT, session.namespace
    metadata = {"name": name, "labels": {names.LABEL_MANAGED_BY: names.SDK_MANAGER}}
    try:
        with explained("find the account of programs"):
            try:
                session.api.get(ACCOUNTS.path(namespace, name), timeout=SECONDS)
                return name
            except NotFound:
                pass
            except Forbidden:
                return name  # the API server will say if it does not exist
            # The account last: the next program finds it, and does not look for its rights.
            with contextlib.suppress(Conflict):
                session.api.create(ROLE_BINDINGS.path(namespace), _binding(session, metadata))
            with contextlib.suppress(Conflict):
                session.api.create(ACCOUNTS.path(namespace), {"metadata": metadata})
    except CommandError as error:
        if error.status != NO_RIGHT:
            raise
        error.remedy = (
            "name an account that has the role fiber-user with --service-account, or ask an "
            f"administrator: `kubectl create serviceaccount {name} -n {namespace}` and `kubectl "
            f"create rolebinding {name} --clusterrole fiber-user --serviceaccount "
            f"{namespace}:{name} -n {namespace}`"
        )
        raise
    return name


def _binding(session: Session, metadata: Body) -> Body:
    """Return the binding that gives the account of programs the role fiber-user."""
    return {
        "metadata": metadata,
        "roleRef": {
            "apiGroup": "rbac.authorization.k8s.io",
            "kind": _kind_of_role(session),
            "name": "fiber-user",
        },
        "subjects": [
            {
                "kind": "ServiceAccount",
                "name": names.PROGRAM_ACCOUNT,
                "namespace": session.namespace,
            }
        ],
    }


def _kind_of_role(session: Session) -> str:
    """Return Role if the chart was installed with ``scope=namespaced``, else ClusterRole."""
    try:
        session.api.get(ROLES.path(session.namespace, "fiber-user"), timeout=SECONDS)
    except (NotFound, Forbidden):  # a person who may not read roles mostly has a ClusterRole
        return "ClusterRole"
    return "Role"
