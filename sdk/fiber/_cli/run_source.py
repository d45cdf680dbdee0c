"""Program that ``fiber run`` sends: its command line, and the archive of its files."""

from __future__ import annotations

import difflib
import json
import os
import re
import shlex
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, NamedTuple

from fiber import spawn
from fiber._backends.kubernetes.template import program_name
from fiber._backends.program_files import UnsentFile, Why, select
from fiber._backends.program_layout import ProgramFile, find_layout
from fiber._backends.shipping import pack
from fiber._cli import streams
from fiber._cli.failures import USAGE, CommandError
from fiber.errors import ConfigError, ProgramTooLarge

FOLDER = "/tmp/fiber-program"
"""Folder of the program's files in the pod."""

_SHOWN = 10
"""Number of files that a notice lists."""


class Source(NamedTuple):
    """Command to run, and the files that it needs."""

    command: list[str]
    words: str
    """The command line, as the user typed it."""
    name: str
    archive: bytes
    layout: str
    """JSON for the launcher: working directory and search path."""


def source_of(options: dict[str, Any]) -> Source:
    """Return the program and its files."""
    words = command_of(options, "python")
    typed = shlex.join(words)
    program = program_file(options)
    preparation = spawn.get_preparation_data("")
    preparation.pop("init_main_from_path", None)
    try:
        layout = find_layout(preparation, frozenset(), program)
        files, left_out = select(layout)
        archive, torn = pack(layout, files)
    except ProgramTooLarge as error:
        raise CommandError("the program's folder is too large to send", str(error)) from error
    except ConfigError as error:
        raise CommandError("the program's folder cannot be sent", str(error)) from error
    _tell(left_out, torn)
    if program.file is not None and not options["module"]:
        words[1] = f"{FOLDER}/{layout.places.name_of(program.file)}"
    paths = layout.paths
    search = [*paths.before_library, *paths.before_installed]
    return Source(
        words,
        typed,
        program_name(program.file) if program.file else _word(words[0]),
        archive,
        json.dumps({"directory": paths.directory, "path": search}),
    )


def _tell(left_out: tuple[UnsentFile, ...], torn: list[str]) -> None:
    """Tell which files the program does not get as they are."""
    unexpected = [
        f"not sent: {left.path} ({left.detail}); `!{os.path.basename(left.path)}` in .fiberignore "
        "sends it"
        for left in left_out
        if left.why in (Why.SECRET, Why.LINK)
    ]
    lines = [*unexpected, *(f"changed while it was read: {path}" for path in torn)]
    for line in lines[:_SHOWN]:
        streams.say(f"[fiber] {line}")
    if len(lines) > _SHOWN:
        streams.say(f"[fiber] and {len(lines) - _SHOWN} more")


def command_of(options: dict[str, Any], python: str) -> list[str]:
    """Return the command line; ``python`` is the interpreter for scripts and modules."""
    words = list(options["words"])
    if options["module"]:
        return [python, "-m", options["module"], *words]
    if words[0] == "--":
        return words[1:]
    return [python, *words] if words[0].endswith(".py") else words


def program_file(options: dict[str, Any]) -> ProgramFile:
    """Return the script or module, and its folder; the working directory for other commands."""
    if module := options["module"]:
        return _module_file(module)
    word = options["words"][0]
    if not word.endswith(".py"):
        return ProgramFile(None, "")
    path = Path(word).resolve()
    if not path.is_file():
        raise _no_script(word, path)
    return ProgramFile(str(path), str(path.parent))


def _no_script(word: str, path: Path) -> CommandError:
    """Return the error for a script that does not exist, with the nearest one that does."""
    scripts = {script.name: script for script in path.parent.glob("*.py")}
    close = difflib.get_close_matches(path.name, sorted(scripts), n=1, cutoff=0.5)
    nearest = os.path.join(os.path.dirname(word), close[0]) if close else ""
    return CommandError(
        f"there is no script {word!r}",
        "the path is a folder"
        if path.is_dir()
        else "the path is relative to the working directory",
        f"did you mean {nearest!r}?" if close else "name an existing file",
        USAGE,
    )


def _module_file(module: str) -> ProgramFile:
    folder, search = os.getcwd(), [os.getcwd()]
    found = None
    for word in module.split("."):
        found = PathFinder.find_spec(word, search) if word else None
        if found is None:
            break
        search = list(found.submodule_search_locations or ())
    if found is not None and search:  # a package
        found = PathFinder.find_spec("__main__", search)
    if found is None or not found.origin:
        raise CommandError(
            f"there is no module {module!r} to run",
            f"{folder} does not have it, or it is a package without __main__.py",
            "run the command in the folder that has the package; `fiber run -- python -m MODULE` "
            "runs a module of the image",
            USAGE,
        )
    return ProgramFile(os.path.abspath(found.origin), folder)


def _word(command: str) -> str:
    return re.sub("[^a-z0-9]+", "-", os.path.basename(command).lower()).strip("-") or "program"
