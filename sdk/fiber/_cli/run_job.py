"""Job of a program: a pod like those of workers, with the launcher in it."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import secrets
import sys
from typing import Any

from fiber import config, resources
from fiber._backends.kubernetes.template import (
    ImageMissing,
    PodShape,
    names_secret,
    pod_template,
)
from fiber._cli.failures import USAGE, CommandError, no_image
from fiber._cli.run_source import FOLDER, Source
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.rest import JOBS, Body

_FILES_WITHIN = 600
"""Seconds that a pod waits for the program's files."""

_KEPT = 3600
"""Seconds that a program that has ended is kept, with its log."""

METRICS_PORT = "metrics"
"""Name of the port at which a program serves its metrics."""

_GROUP = 65532
"""Group of the user of Fiber's images."""

_LONGEST_COMMAND = 4096
"""Characters of the command line that are shown."""

_VARIABLE = re.compile("[-._a-zA-Z][-._a-zA-Z0-9]*")

_NAME = re.compile("[a-z]([-a-z0-9]{0,48}[a-z0-9])?")


def name_of(wanted: str | None, source: Source) -> str:
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


def job_of(name: str, source: Source, options: dict[str, Any], settings: config.Config) -> Body:
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
            "annotations": {
                names.ANNOTATION_COMMAND: source.words[:_LONGEST_COMMAND],
                names.ANNOTATION_RUN: secrets.token_hex(8),
            },
        },
        "spec": spec,
    }


def _template(source: Source, options: dict[str, Any], settings: config.Config) -> Body:
    """Return the pod template: that of a worker with these resources, and the launcher in it."""
    template = _worker_template(options, settings)
    spec = template["spec"]
    workers = [c for c in spec["containers"] if c["name"] == names.WORKER_CONTAINER]
    if not workers:
        raise CommandError(
            "the program's pod cannot be made",
            f"the configured template has no container {names.WORKER_CONTAINER!r}",
            "leave that container in it",
            USAGE,
        )
    _make_launcher(workers[0], source, options)
    _mount(spec, workers[0], options["volume"])
    spec["restartPolicy"] = "Never"
    spec.setdefault("securityContext", {}).setdefault("runAsNonRoot", True)
    spec["securityContext"].setdefault("seccompProfile", {"type": "RuntimeDefault"})
    return template


def _worker_template(options: dict[str, Any], settings: config.Config) -> Body:
    wishes = {key: options[key] for key in ("cpu", "memory", "gpu") if options[key] is not None}
    try:
        wished = resources.wished("fiber run", **wishes)
        shape = PodShape.of(settings).with_resources(wished)
        if options["image"]:
            shape = dataclasses.replace(shape, image=options["image"])
        return pod_template(shape, None, "", sys.executable)
    except ImageMissing as error:
        raise no_image() from error
    except (ConfigError, TypeError, ValueError) as error:
        raise CommandError(
            "the program's pod cannot be made",
            str(error),
            "correct the option, or the configuration that the message names",
            USAGE,
        ) from error


def _make_launcher(container: Body, source: Source, options: dict[str, Any]) -> None:
    """Make the program's container of a worker's."""
    wanted = variables_of(options["env"])
    _refuse_secrets(wanted)
    container["name"] = names.PROGRAM_CONTAINER
    container["command"] = ["python", "-m", "fiber.launcher"]
    container.pop("args", None)
    given = {
        "PYTHONUNBUFFERED": "1",
        "FIBER_IMAGE": str(container.get("image", "")),
        **wanted,
        "FIBER_LAUNCHER_COMMAND": json.dumps(source.command),
        "FIBER_LAUNCHER_FOLDER": FOLDER,
        "FIBER_LAUNCHER_PORT": str(names.LAUNCHER_PORT),
        "FIBER_LAUNCHER_WAIT": str(_FILES_WITHIN),
    }
    variables = {variable["name"]: variable for variable in container.get("env") or ()}
    for name, value in given.items():
        # The kubelet replaces $(NAME) by a variable, and $$ by $.
        variables[name] = {"name": name, "value": value.replace("$", "$$")}
    container["env"] = list(variables.values())
    if (port := wanted.get("FIBER_METRICS_PORT", "")).isdecimal() and int(port):
        metrics = {"name": METRICS_PORT, "containerPort": int(port)}
        container["ports"] = [*(container.get("ports") or ()), metrics]
    added = [{"secretRef": {"name": name}} for name in options["secret"]]
    if added:
        container["envFrom"] = [*(container.get("envFrom") or ()), *added]
    context = container.setdefault("securityContext", {})
    context.setdefault("allowPrivilegeEscalation", False)
    context.setdefault("capabilities", {"drop": ["ALL"]})


def variables_of(given: tuple[str, ...]) -> dict[str, str]:
    """Return the variables; one without a value has the value that it has here."""
    found = {}
    for word in given:
        name, equals, value = word.partition("=")
        if not _VARIABLE.fullmatch(name):
            raise CommandError(
                f"{word!r} names no variable",
                "a name has letters, digits and '_'",
                "--env NAME=VALUE",
                USAGE,
            )
        found[name] = value if equals else _value_here(name)
    return found


def _refuse_secrets(variables: dict[str, str]) -> None:
    for name, value in variables.items():
        if value and names_secret(name):
            raise CommandError(
                f"the variable {name!r} looks like a secret",
                "everybody who may read Jobs and pods would see its value",
                f"put it into a Secret, `kubectl create secret generic NAME "
                f"--from-literal={name}=...`, and name that with --secret NAME",
                USAGE,
            )


def _value_here(name: str) -> str:
    if name not in os.environ:
        raise CommandError(
            f"the variable {name!r} has no value",
            "this environment does not have it",
            f"--env {name}=VALUE",
            USAGE,
        )
    return os.environ[name]


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
        mounts = container.setdefault("volumeMounts", [])
        if any(other.get("mountPath") == path for other in mounts):
            raise CommandError(
                f"two volumes are mounted at {path}",
                f"{word!r} and another --volume, or the template, name this path",
                "choose another path",
                USAGE,
            )
        mounts.append(mount)
        if mode != "ro":
            _let_write(spec.setdefault("securityContext", {}))


def _let_write(context: Body) -> None:
    """Let the user of Fiber's images write to the volumes, unless the template says who may."""
    if "fsGroup" not in context:
        context |= {"fsGroup": _GROUP, "fsGroupChangePolicy": "OnRootMismatch"}
