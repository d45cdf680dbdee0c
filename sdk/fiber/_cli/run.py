"""``fiber run``: run a program in a pod, and follow it as if it ran here."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shlex
import sys
from pathlib import Path
from typing import Any, NamedTuple

import click

from fiber import config, resources, spawn
from fiber._backends.kubernetes.template import PodShape, pod_template, program_name
from fiber._backends.program_files import select
from fiber._backends.program_layout import ProgramFile, find_layout
from fiber._backends.shipping import pack
from fiber._cli.failures import USAGE, CommandError, explained
from fiber._cli.following import follow
from fiber._cli.programs import find_job
from fiber._cli.session import Session, cluster_options, connect
from fiber.errors import ConfigError, ProgramTooLarge
from fiber_api import names
from fiber_api.rest import (
    ACCOUNTS,
    JOBS,
    ROLE_BINDINGS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    NotFound,
)

_FOLDER = "/tmp/fiber-program"
"""Folder of the program's files in the pod."""

_FILES_WITHIN = 600
"""Seconds that a pod waits for the program's files."""

_KEPT = 3600
"""Seconds that a program that has ended is kept, with its log."""

_NAME = re.compile("[a-z]([-a-z0-9]{0,48}[a-z0-9])?")


class Source(NamedTuple):
    """Command to run, and the files that it needs."""

    command: list[str]
    words: str
    """The command line, as the user typed it."""
    name: str
    archive: bytes
    layout: str
    """JSON for the launcher: working directory and search path."""


@click.command(
    "run",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
@click.option("-m", "module", metavar="MODULE", help="Run a module, as `python -m` does.")
@click.option("--name", help="Name of the program.  Default: the script's, and five digits.")
@click.option("--image", help="Image of the program and its workers.")
@click.option("--cpu", type=float, help="CPUs of the program's pod, as 0.5.")
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
    if options["attach"]:
        return _attach(connect(context, namespace), options)
    if not options["words"] and not options["module"]:
        raise CommandError("nothing to run", "no script is named", "fiber run SCRIPT", USAGE)
    if options["local"]:
        _run_here(options)
    with explained("read the configuration"):
        settings = config.load()
    source = _source(options)
    session = connect(context, namespace)
    name = _name(options["name"], source)
    job = _job(name, source, options, settings)
    account = options["service_account"] or _ensure_account(session)
    job["spec"]["template"]["spec"]["serviceAccountName"] = account
    with explained(f"start the program {name!r}"):
        _create(session, name, job)
    return follow(session, name, source.archive, source.layout, detach=options["detach"])


def _attach(session: Session, options: dict[str, Any]) -> int:
    if options["words"] or options["module"]:
        raise CommandError(
            "--attach starts no program", "a script is named, too", "leave one of them out", USAGE
        )
    find_job(session, options["attach"])
    return follow(session, options["attach"])


def _run_here(options: dict[str, Any]) -> None:
    """Become the program; does not return."""
    os.environ["FIBER_BACKEND"] = "local"
    for variable, value in _variables(options["env"]).items():
        os.environ[variable] = value
    words = _command(options, sys.executable)
    try:
        os.execvp(words[0], words)
    except OSError as error:
        raise CommandError(f"cannot run {words[0]!r}", str(error.strerror).lower()) from error


# -- The program's files


def _source(options: dict[str, Any]) -> Source:
    """Return the program and its files."""
    words = _command(options, "python")
    typed = shlex.join(words)
    program = _program_file(options)
    preparation = spawn.get_preparation_data("")
    preparation.pop("init_main_from_path", None)
    try:
        layout = find_layout(preparation, frozenset(), program)
        files, _ = select(layout)
        archive, _ = pack(layout, files)
    except ProgramTooLarge as error:
        raise CommandError("the program's folder is too large to send", str(error)) from error
    except ConfigError as error:
        raise CommandError("the program's folder cannot be sent", str(error)) from error
    if program.file is not None and not options["module"]:
        sent = layout.places.name_of(program.file)
        assert sent is not None
        words[1] = f"{_FOLDER}/{sent}"
    paths = layout.paths
    search = [*paths.before_library, *paths.before_installed]
    return Source(
        words,
        typed,
        program_name(program.file) if program.file else _word(words[0]),
        archive,
        json.dumps({"directory": paths.directory, "path": search}),
    )


def _command(options: dict[str, Any], python: str) -> list[str]:
    words = list(options["words"])
    if options["module"]:
        return [python, "-m", options["module"], *words]
    if words[0] == "--":
        return words[1:]
    if words[0].endswith(".py"):
        return [python, *words]
    return words


def _program_file(options: dict[str, Any]) -> ProgramFile:
    if module := options["module"]:
        return _module_file(module)
    word = options["words"][0]
    if not word.endswith(".py"):
        return ProgramFile(None, "")
    path = Path(word).resolve()
    if not path.is_file():
        scripts = sorted(str(other) for other in Path(word).parent.glob("*.py"))
        from difflib import get_close_matches

        close = get_close_matches(word, scripts, n=1, cutoff=0.5)
        raise CommandError(
            f"there is no script {word!r}",
            "the path is relative to the working directory",
            f"did you mean {close[0]!r}?" if close else "name an existing file",
            USAGE,
        )
    return ProgramFile(str(path), str(path.parent))


def _module_file(module: str) -> ProgramFile:
    from importlib.machinery import PathFinder

    folder, search = os.getcwd(), [os.getcwd()]
    file = None
    for word in module.split("."):
        spec = PathFinder.find_spec(word, search)
        if spec is None:
            raise CommandError(
                f"there is no module {module!r}",
                f"{folder} does not have it",
                "run the command in the folder that has the package",
                USAGE,
            )
        search, file = list(spec.submodule_search_locations or ()), spec.origin
    return ProgramFile(os.path.abspath(file or os.path.join(search[0], "__main__.py")), folder)


def _word(command: str) -> str:
    return re.sub("[^a-z0-9]+", "-", os.path.basename(command).lower()).strip("-") or "program"


# -- The Job


def _name(wanted: str | None, source: Source) -> str:
    if wanted is None:
        stem = source.name.lstrip("0123456789-") or "program"
        return f"{stem[:40].rstrip('-')}-{secrets.token_hex(3)[:5]}"
    if not _NAME.fullmatch(wanted):
        raise CommandError(
            f"{wanted!r} cannot be the name of a program",
            "it becomes the name of a Job and of its pod",
            "use at most 50 lower-case letters, digits and '-', with a letter first",
            USAGE,
        )
    return wanted


def _job(name: str, source: Source, options: dict[str, Any], settings: config.Config) -> Body:
    labels = {names.LABEL_PROGRAM: name, names.LABEL_MANAGED_BY: names.SDK_MANAGER}
    template = _template(source, options, settings)
    metadata = template.setdefault("metadata", {})
    metadata["labels"] = {**(metadata.get("labels") or {}), **labels}
    spec: Body = {
        "backoffLimit": 0,
        "ttlSecondsAfterFinished": _KEPT,
        "template": template,
    }
    if options["timeout"]:
        spec["activeDeadlineSeconds"] = options["timeout"]
    return {
        "apiVersion": JOBS.api_version,
        "kind": JOBS.kind,
        "metadata": {
            "name": name,
            "labels": labels,
            "annotations": {names.ANNOTATION_COMMAND: source.words},
        },
        "spec": spec,
    }


def _template(source: Source, options: dict[str, Any], settings: config.Config) -> Body:
    """Return the pod template: that of a worker with these resources, and the launcher in it."""
    wishes = {key: options[key] for key in ("cpu", "memory", "gpu") if options[key] is not None}
    try:
        wished = resources.wished("fiber run", **wishes)
        shape = PodShape.of(settings).with_resources(wished)
        if options["image"]:
            shape = _with_image(shape, options["image"])
        template = pod_template(shape, None, "", sys.executable)
    except (ConfigError, TypeError, ValueError) as error:
        raise CommandError("the program's pod cannot be made", str(error), status=USAGE) from error
    spec = template["spec"]
    worker = next(c for c in spec["containers"] if c["name"] == names.WORKER_CONTAINER)
    worker["name"] = names.PROGRAM_CONTAINER
    worker["command"] = ["python", "-m", "fiber.launcher"]
    worker.pop("args", None)
    variables = {
        "PYTHONUNBUFFERED": "1",
        "FIBER_IMAGE": str(worker.get("image", "")),
        **_variables(options["env"]),
        "FIBER_LAUNCHER_COMMAND": json.dumps(source.command),
        "FIBER_LAUNCHER_FOLDER": _FOLDER,
        "FIBER_LAUNCHER_PORT": str(names.LAUNCHER_PORT),
        "FIBER_LAUNCHER_WAIT": str(_FILES_WITHIN),
    }
    added = [{"name": name, "value": value} for name, value in variables.items()]
    worker["env"] = [*(worker.get("env") or ()), *added]
    if options["secret"]:
        worker["envFrom"] = [{"secretRef": {"name": name}} for name in options["secret"]]
    _mount(spec, worker, options["volume"])
    spec["restartPolicy"] = "Never"
    spec.setdefault("securityContext", {}).setdefault("runAsNonRoot", True)
    spec["securityContext"].setdefault("seccompProfile", {"type": "RuntimeDefault"})
    worker.setdefault("securityContext", {}).setdefault("allowPrivilegeEscalation", False)
    worker["securityContext"].setdefault("capabilities", {"drop": ["ALL"]})
    return template


def _with_image(shape: PodShape, image: str) -> PodShape:
    from dataclasses import replace

    return replace(shape, image=image)


def _variables(given: tuple[str, ...]) -> dict[str, str]:
    """Return the variables; one without a value has the value that it has here."""
    found = {}
    for word in given:
        name, equals, value = word.partition("=")
        if not equals:
            if name not in os.environ:
                raise CommandError(
                    f"the variable {name!r} has no value",
                    "this environment does not have it",
                    f"--env {name}=VALUE",
                    USAGE,
                )
            value = os.environ[name]
        found[name] = value
    return found


def _mount(spec: Body, container: Body, volumes: tuple[str, ...]) -> None:
    for number, word in enumerate(volumes):
        claim, _, rest = word.partition(":")
        path, _, mode = rest.partition(":")
        if not claim or not path.startswith("/") or mode not in ("", "ro", "rw"):
            raise CommandError(
                f"{word!r} names no volume",
                "a volume is a claim and an absolute path",
                "--volume CLAIM:/PATH or --volume CLAIM:/PATH:ro",
                USAGE,
            )
        volume = f"volume-{number}"
        spec.setdefault("volumes", []).append(
            {"name": volume, "persistentVolumeClaim": {"claimName": claim}}
        )
        mount = {"name": volume, "mountPath": path, "readOnly": mode == "ro"}
        container.setdefault("volumeMounts", []).append(mount)


def _ensure_account(session: Session) -> str:
    """Return the account of programs, made with the role fiber-user if it does not exist."""
    name, namespace = names.PROGRAM_ACCOUNT, session.namespace
    metadata = {"name": name, "labels": {names.LABEL_MANAGED_BY: names.SDK_MANAGER}}
    binding = {
        "metadata": metadata,
        "roleRef": {
            "apiGroup": "rbac.authorization.k8s.io",
            "kind": "ClusterRole",
            "name": "fiber-user",
        },
        "subjects": [{"kind": "ServiceAccount", "name": name, "namespace": namespace}],
    }
    try:
        with explained("find the account of programs"):
            try:
                session.api.get(ACCOUNTS.path(namespace, name), timeout=5.0)
                return name
            except NotFound:
                pass
            except Forbidden:
                return name  # the API server will say if it does not exist
            with contextlib.suppress(Conflict):
                session.api.create(ACCOUNTS.path(namespace), {"metadata": metadata})
            with contextlib.suppress(Conflict):
                session.api.create(ROLE_BINDINGS.path(namespace), binding)
    except CommandError as error:
        error.remedy = (
            "name an account that has the role fiber-user with --service-account, or ask an "
            f"administrator: `kubectl create serviceaccount {name} -n {namespace}` and `kubectl "
            f"create rolebinding {name} --clusterrole fiber-user --serviceaccount "
            f"{namespace}:{name} -n {namespace}`"
        )
        raise
    return name


def _create(session: Session, name: str, job: Body) -> None:
    try:
        session.api.create(JOBS.path(session.namespace), job, strict=True)
    except Conflict as error:
        if not error.repeated:
            raise CommandError(
                f"there is a program {name!r} already",
                "a program that has ended keeps its name for an hour",
                f"choose another name, or `fiber stop {name}`",
            ) from error
    except ApiError:
        raise
