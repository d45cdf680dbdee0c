"""Shape of pods, by which the FiberPools of a program differ."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fiber.config import Config
from fiber.errors import ConfigError
from fiber.resources import Resources, merged, wished
from fiber_api import names


@dataclass(frozen=True, slots=True)
class Shape:
    """All that decides what a pod is like.  Equal shapes are served by one FiberPool."""

    image: str | None = None
    """None: that of the program's own pod, or of this version's worker."""
    resources: Resources = field(default_factory=Resources)
    """Resources that one process needs."""
    template: str = field(default="{}", repr=False)
    """The configured pod template, as JSON with sorted keys."""
    processes_per_pod: int = 1
    cpu_request: float = 0
    """CPUs to request for a process whose function wishes none."""
    memory_request: int = 0
    """MiB, likewise."""
    shm: int | None = None
    """MiB of memory at /dev/shm; None: what a container has by itself."""

    @classmethod
    def of(cls, config: Config) -> Shape:
        """The shape of a function without wishes.  Reads the template's file: a ConfigError names
        it where that cannot be.
        """
        template = read_template(config.template)
        try:
            text = json.dumps(template, sort_keys=True)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"bad value for 'template': {error}. A template holds what JSON can say: write a "
                "text that looks like a date in quotes."
            ) from error
        selector, tolerations = config.node_selector, config.tolerations
        return cls(
            config.image,
            wished("fiber.init", node_selector=selector, tolerations=tolerations),
            text,
            config.processes_per_pod,
            config.cpu_request,
            config.memory_request,
            config.shm,
        )

    def with_resources(self, resources: Resources) -> Shape:
        """The same for a function with these wishes, which win over those that are there."""
        return replace(self, resources=merged(self.resources, resources))


# ---- the configured template ----------------------------------------------------------------


def read_template(configured: str | Mapping[str, Any] | None) -> dict[str, Any]:
    """A pod template with nothing but ``metadata`` and ``spec``; ConfigError if it is none."""
    if configured is None:
        return {}
    if isinstance(configured, str):
        source, document = f"the file {configured}", _read(configured)
    else:
        source, document = "the dict", configured
    return _checked(document, f"bad value for 'template': {source}")


def _read(path: str) -> object:
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
        return json.loads(text) if path.endswith(".json") else _parse_yaml(text)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot read the pod template {path} (key 'template'): {error}. Name a YAML or JSON "
            "file that this program can read."
        ) from error


def _parse_yaml(text: str) -> object:
    try:
        import yaml  # comes with the Kubernetes client
    except ModuleNotFoundError:
        raise ValueError(
            "YAML needs PyYAML, which is not installed (pip install 'fiberpool[kubernetes]')"
        ) from None
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def _checked(document: object, what: str) -> dict[str, Any]:
    if not isinstance(document, Mapping):
        raise ConfigError(f"{what} is no object with metadata and spec, as in a Deployment")
    # A whole Pod is a template of itself.
    template = {key: part for key, part in document.items() if key not in ("apiVersion", "kind")}
    for key, part in template.items():
        if key not in ("metadata", "spec"):
            hint = ". What belongs to the pod goes under 'spec'" if "spec" not in template else ""
            raise ConfigError(f"{what} has {key!r} beside metadata and spec{hint}")
        if not isinstance(part, Mapping):
            raise ConfigError(f"{what} has a {key} that is no object")
    for container in template.get("spec", {}).get("containers") or ():
        _check_container(container, what)
    return template


def _check_container(container: object, what: str) -> None:
    name = container.get("name") if isinstance(container, Mapping) else None
    if not name:
        raise ConfigError(
            f"{what} has a container without a name; the one that runs the processes is called "
            f"{names.WORKER_CONTAINER!r}"
        )
    assert isinstance(container, Mapping)
    if name != names.WORKER_CONTAINER and not container.get("image"):
        raise ConfigError(
            f"{what} has a container {name!r} without an image. The one that runs the processes is "
            f"called {names.WORKER_CONTAINER!r}: give it that name, or give {name!r} an image to "
            "run it beside."
        )


# ---- names ----------------------------------------------------------------------------------


def program_name(path: str | None) -> str:
    """Return a name for the program with this ``__main__.__file__``, to show with its pools.

    None is one that has no file, such as an interactive session.
    """
    if not path:
        return _PROGRAM
    folder, file = os.path.split(os.path.abspath(path))
    stem = os.path.splitext(file)[0]
    # `main.py` says nothing; the folder that it is in does.
    return _label(stem if stem not in ("main", "__main__") else os.path.basename(folder))


def pool_name(program: str, shape: Shape, suffix: str) -> str:
    """The name of a FiberPool: the program's, what it wishes of a pod, and what is drawn by the
    caller so that no name is used twice.
    """
    end = "".join(f"-{word}" for word in (*_words(shape.resources), suffix))
    return f"{_label(program)[: names.MAX_POOL_NAME - len(end)].rstrip('-')}{end}"


_PROGRAM = "python"


def _label(name: str) -> str:
    """``name`` in the letters that a pool's name may have, from the first letter on."""
    label = re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")
    return re.sub("^[^a-z]+", "", label) or _PROGRAM


def _words(resources: Resources) -> list[str]:
    wishes = {
        "cpu": None if resources.cpu is None else quantity(resources.cpu),
        "mem": None if resources.memory is None else f"{resources.memory}mi",
        "gpu": resources.gpu,
    }
    return [f"{kind}{wish}" for kind, wish in wishes.items() if wish is not None]


def quantity(cpus: float) -> str:
    """CPUs as Kubernetes writes them, to the thousandth: ``2``, ``500m``."""
    thousandths = max(1, round(cpus * 1000))
    return f"{thousandths}m" if thousandths % 1000 else str(thousandths // 1000)
