"""Configuration from elsewhere: from the parent process, and from uber's Fiber.

A child keeps its parent's configuration pickled until it is asked for.  Most children never ask,
and importing ``fiber.config`` takes longer than their start.

Uber's Fiber has a package of the same name, and a file of settings that this one does not read.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping

_configuration: bytes | None = None


def keep(pickled: bytes) -> None:
    """Keep the pickled ``Config`` of the parent, in a child."""
    global _configuration
    _configuration = pickled


def configuration() -> bytes | None:
    """Return the pickled ``Config`` of the parent; None in a program."""
    return _configuration


FILE = ".fiberconfig"

_NO_LONGER = "There is nothing to set"

REPLACEMENTS: Mapping[str, str] = {
    "cpu_per_job": "Decorate the function with fiber.meta(cpu=…)",
    "debug": "Set {log_level} to 'DEBUG'",
    "default_backend": "Set {backend}",
    "default_image": "Set {image}",
    "ipc_active": f"{_NO_LONGER}: agents connect to the program",
    "ipc_admin_master_port": "Set {listen_port}",
    "ipc_admin_worker_port": f"{_NO_LONGER}: agents connect to the program, at {{listen_port}}",
    "kubernetes_namespace": "Set {namespace}",
    "log_file": "Give the logger 'fiber' a logging.FileHandler; without one it writes to stderr",
    "mem_per_job": "Decorate the function with fiber.meta(memory=…)",
    "merge_output": f"{_NO_LONGER}: the output of all processes comes to the program's",
    "use_bash": _NO_LONGER,
    "use_push_queue": "Use fiber.queues.SimpleQueuePush",
}
"""Keys of the original that Fiber has not.  Names in braces are Fiber's keys, as a source spells
them."""


def replacement(key: str, spelling: Callable[[str], str] = str) -> str | None:
    """Return what to do in place of setting a key of the original; None for other keys."""
    advice = REPLACEMENTS.get(key)
    if advice is None:
        return None
    names = ("backend", "image", "listen_port", "log_level", "namespace")
    return advice.format_map({name: spelling(name) for name in names})


def file_error(directory: str) -> str | None:
    """Return the error for the original's file in ``directory``; None if there is no such file."""
    path = os.path.join(directory, FILE)
    if not os.path.isfile(path):
        return None
    path = os.path.abspath(path)
    return (
        f"{path} is a file of the original Fiber, and its settings would not take effect. "
        f"Move them to [tool.fiber] of pyproject.toml and remove the file:\n{_translated(path)}"
    )


def _translated(path: str) -> str:
    import configparser

    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read(path, encoding="utf-8")
        settings = dict(parser["default"])
    except (configparser.Error, KeyError, OSError, ValueError) as error:
        return f"They cannot be read: {error}."
    advice = (replacement(key) or f"Set {key} to {value!r}" for key, value in settings.items())
    return "\n".join(f"{key}: {each}." for key, each in zip(settings, advice, strict=True))
