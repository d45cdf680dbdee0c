"""Reference pages, written from the sources: modules, errors, configuration, FiberPool, command."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import click
import griffe

import fiber
from docsite import ROOT, SiteError, staging
from fiber import config, errors
from fiber._cli.main import _group
from fiber_api import names
from fiber_api.schema import schema

MODULES = sorted({*fiber._SUBMODULES, "joblib"} - {"errors"})
"""Modules with a page of their names. Errors have a page with more."""

_UNSEARCHED = ("fiber.config", "fiber.profiling")
"""Pages that the search leaves out: guides describe the same names in the words of a question."""

_HEAD = "<!-- Written by python -m docsite. -->\n\n"


def write(folder: Path) -> None:
    """Write all pages of the reference into a folder that this function makes."""
    folder.mkdir()
    package = load()
    pages = {
        "fiber": names_page(package),
        "errors": errors_page(package),
        "configuration": configuration_page(),
        "fiberpool": fiberpool_page(),
        "commands": commands_page(),
        **{f"fiber.{name}": module_page(package, name) for name in MODULES},
    }
    for name, text in pages.items():
        head = staging.EXCLUDED + _HEAD if name in _UNSEARCHED else _HEAD
        (folder / f"{name}.md").write_text(head + text, encoding="utf-8")


# ---- modules --------------------------------------------------------------------------------


class Definition(NamedTuple):
    """Public name of a module, and where its definition is."""

    name: str
    path: str
    """Full name of the definition, such as ``fiber.results.MapResult``."""

    @property
    def module(self) -> str:
        """Public module of the definition, or "" for one of another package."""
        package, _, rest = self.path.partition(".")
        return rest.partition(".")[0] if package == "fiber" else ""


def load() -> griffe.Module:
    """Return what the sources of the package define, without importing them."""
    package = griffe.load("fiber", search_paths=[ROOT / "sdk"])
    assert isinstance(package, griffe.Module)
    return package


def public(module: griffe.Module) -> list[str]:
    """Return the public names of a module: those in ``__all__``, or those that it defines."""
    if module.exports is not None:
        return sorted(str(name) for name in module.exports)
    return sorted(
        name
        for name, member in module.members.items()
        if not name.startswith("_") and not member.is_alias and not member.is_module
    )


def definitions(package: griffe.Module, module: str) -> list[Definition]:
    """Return the definitions of a module's public names."""
    found = package[module]
    return [Definition(name, _path(package, found, name)) for name in public(found)]


def _path(package: griffe.Module, module: griffe.Module, name: str) -> str:
    """Follow imports from a name to its definition."""
    member = module.members.get(name)
    while isinstance(member, griffe.Alias):
        target = member.target_path
        if not target.startswith("fiber."):
            return target
        member = _lookup(package, target.removeprefix("fiber."))
        if member is None:
            return f"{module.path}.{name}"
    return member.path if member is not None else f"{module.path}.{name}"


def _lookup(package: griffe.Module, path: str) -> griffe.Object | griffe.Alias | None:
    try:
        found: griffe.Object | griffe.Alias = package[path]
    except KeyError:
        return None
    return found


def names_page(package: griffe.Module) -> str:
    """Return the page of the names of ``fiber`` itself: one line and a link for each."""
    rows = [f"| {_link(package, name)} | {_summary(name)} |" for name in sorted(fiber.__all__)]
    return (
        "# Names of the package\n\n"
        "`import fiber as mp` has these names. Each link leads to the signature with its types.\n\n"
        "| name | what it is |\n|---|---|\n" + "\n".join(rows) + "\n"
    )


def _link(package: griffe.Module, name: str) -> str:
    home = fiber._HOMES.get(name)
    if name == "reducer":
        return "[`reducer`](fiber.reduction.md)"
    path = f"fiber.context.BaseContext.{name}"
    if home is not None:
        path = _path(package, package[home], name)
    if not path.startswith("fiber."):
        return f"`{name}`"
    return f"[`{name}`][{path}]"


def _summary(name: str) -> str:
    """Return the first sentence of the docstring of a name, and its origin if that is Python's."""
    value = getattr(fiber, name)
    if isinstance(value, int):
        return f"Level {value} of the logger."
    first = " ".join((value.__doc__ or "").split("\n\n")[0].split())
    if not first:
        return f"multiprocessing's `{name}`."
    sentence = re.split(r"(?<=[.;:])\s", first)[0].rstrip(";:").replace("|", "\\|")
    ours = str(getattr(value, "__module__", "fiber")).startswith("fiber")
    return sentence if ours else f"multiprocessing's: {sentence}"


def module_page(package: griffe.Module, module: str) -> str:
    """Return the page of a module: its docstring, its definitions, the names that it shares."""
    found = package[module]
    here: list[Definition] = []
    shared: list[Definition] = []
    for one in definitions(package, module):
        defined_here = one.module == module or one.module.startswith("_")
        (here if defined_here else shared).append(one)
    text = [f"# fiber.{module}", _docstring(found)]
    text += [f"::: {one.path}" for one in here]
    if shared:
        text += ["## Names from other modules", "\n".join(_shared(shared))]
    return "\n\n".join(text) + "\n"


def _docstring(module: griffe.Module) -> str:
    return module.docstring.value if module.docstring else ""


def _shared(shared: list[Definition]) -> Iterator[str]:
    for one in shared:
        documented = one.module in MODULES or one.module == "errors"
        target = f"[`{one.path}`][{one.path}]" if documented else f"`{one.path}`"
        yield f"* `{one.name}` is {target}."


# ---- errors ---------------------------------------------------------------------------------


def errors_page(package: griffe.Module) -> str:
    """Return the page of the errors: their tree, what each means, and advice by reason."""
    found = package["errors"]
    here = [one for one in definitions(package, "errors") if one.module == "errors"]
    shown = [one for one in here if one.name in found.members]
    advice = [
        f"| `{word}` | {text[0].upper()}{text[1:]} |"
        for word, text in sorted(errors._ADVICE_BY_WORD.items())
    ]
    classes = [f"::: {one.path}" for one in shown if one.name != "MaybeEncodingError"]
    return "\n\n".join(
        [
            "# Errors, one by one",
            "The message of an error says what happened, why, and what to do. `except` clauses of "
            "multiprocessing's programs catch Fiber's errors, too.",
            _docstring(found),
            *classes,
            "## Errors of multiprocessing",
            "Fiber raises them where multiprocessing does.",
            *(f"### {name}\n\n{text}" for name, text in _MULTIPROCESSINGS.items()),
            "## Reasons of a WorkerDied",
            "`WorkerDied.reason` begins with one of these words if Fiber or Kubernetes knows why.",
            "| reason | what to do |\n|---|---|\n" + "\n".join(advice) + "\n",
            "## Reasons of a FiberPoolError",
            "`FiberPoolError.reason` is one of these, a word of Kubernetes (`Unschedulable`), "
            "or `NoOperator`, `InUse`, `Unreachable`. [Failures](../failures.md) and "
            "[FiberPools](../fiberpools.md#when-it-does-not-work) say more.",
            "| reason | what it means |\n|---|---|\n" + "\n".join(_pool_reasons()) + "\n",
        ]
    )


_MULTIPROCESSINGS = {
    "ProcessError": "When: never itself. It is the base of the three below, and of Fiber's errors.",
    "TimeoutError": "When: `get(timeout=)` and other waits end without a result, and a task runs "
    "for longer than `timeout=` or `task_timeout=`. It is multiprocessing's class, and not the "
    "builtin one: write `except fiber.TimeoutError`.\n\nWhat to do: the worker of a task over its "
    "time limit has been replaced. The error shows where the task was. After a wait, the task "
    "still runs: wait again.",
    "BufferTooShort": "When: `recv_bytes_into()` gets more than fits.\n\nWhat to do: the message "
    "is `error.args[0]`. Give a larger buffer.",
    "AuthenticationError": "When: the two sides of a link have different keys, or the `authkey` of "
    "a `Listener`, `Client` or manager's address is wrong.\n\nWhat to do: give both sides the same "
    "key. On a cluster, start the program again.",
    "MaybeEncodingError": "When: the result or the exception of a task cannot be pickled, or "
    "cannot be rebuilt in the program.\n\nWhat to do: return plain data, or give the class a "
    "`__reduce__` method. The error shows the value as text.",
}
"""Meanings of the errors that are multiprocessing's own classes."""


def _pool_reasons() -> Iterator[str]:
    """Yield a row for each problem of a FiberPool that is no word of Kubernetes' own."""
    described = griffe.load("fiber_api", search_paths=[ROOT / "crds"])["names.Reason"].members
    for reason in names.Reason:
        if reason is names.Reason.AS_EXPECTED:  # reasons of conditions and events follow
            return
        if docstring := described[reason.name].docstring:
            text = " ".join(docstring.value.split()).replace("``", "`")
            yield f"| `{reason}` | {text} |"


# ---- configuration --------------------------------------------------------------------------

_KEY = re.compile(r"^(\w+)\*?: ", re.MULTILINE)


def key_texts() -> dict[str, str]:
    """Return what the docstring of `Config` says about each key."""
    parts = _KEY.split(re.sub(r"^    ", "", config.Config.__doc__ or "", flags=re.MULTILINE))
    texts = zip(parts[1::2], parts[2::2], strict=True)
    return {key: " ".join(text.split()) for key, text in texts}


def configuration_page() -> str:
    """Return the page of the configuration's keys."""
    texts = key_texts()
    keys = [field.name for field in dataclasses.fields(config.Config)]
    if missing := set(keys) ^ set(texts):
        raise SiteError(f"Config and its docstring differ in {sorted(missing)}. Describe each key.")
    return "\n\n".join(
        [
            "# Configuration",
            "The sources, the later ones first: `fiber.init(key=…)`, the variable `FIBER_KEY`, and "
            "`key = …` under `[tool.fiber]` in the nearest pyproject.toml. A key that is marked "
            "*fixed* cannot change once the first process, pool, pipe or queue is made.",
            *(_key(field, texts[field.name]) for field in dataclasses.fields(config.Config)),
        ]
    )


def _key(field: dataclasses.Field[Any], text: str) -> str:
    fixed = ", fixed" if field.metadata["fixed"] else ""
    expects = field.metadata["rule"].expects
    return (
        f"## {field.name}\n\n{text[0].upper()}{text[1:]}\n\n"
        f"* Type: `{field.type}`{fixed}\n* Default: `{field.default!r}`\n"
        f"* Value: {expects}\n* Variable: `FIBER_{field.name.upper()}`"
    )


# ---- FiberPool ------------------------------------------------------------------------------


def fiberpool_page() -> str:
    """Return the page of the fields of a FiberPool, from the schema of its definition."""
    properties = schema()["properties"]
    parts = [
        f"# FiberPool\n\n`apiVersion: {names.API_VERSION}`, `kind: {names.KIND}`. The API server "
        "refuses a FiberPool whose fields do not fit. [FiberPools](../fiberpools.md) explains "
        "how to use them.",
    ]
    for name in ("spec", "status"):
        rows = "\n".join(_rows(properties[name], name))
        table = f"| field | type | meaning |\n|---|---|---|\n{rows}"
        parts.append(f"## {name}\n\n{properties[name].get('description', '')}\n\n{table}")
    return "\n\n".join(parts) + "\n"


def _rows(document: Mapping[str, Any], path: str) -> Iterator[str]:
    for name, value in document.get("properties", {}).items():
        place = f"{path}.{name}"
        meaning = " ".join([value.get("description", ""), *_bounds(value)]).replace("|", "\\|")
        yield f"| `{place}` | {_type(value)} | {meaning.strip()} |"
        yield from _rows(value, place)
        if isinstance(value.get("items"), dict):
            yield from _rows(value["items"], f"{place}[]")


def _type(value: Mapping[str, Any]) -> str:
    kind = str(value.get("type", "any"))
    if kind == "array":
        return f"list of {value['items'].get('type', 'any')}"
    return kind


def _bounds(value: Mapping[str, Any]) -> Iterator[str]:
    for word, key in (("Default", "default"), ("Least", "minimum"), ("Most", "maximum")):
        if key in value:
            yield f"{word}: `{value[key]}`."
    if "enum" in value:
        yield f"One of {', '.join(f'`{one}`' for one in value['enum'])}."


# ---- command --------------------------------------------------------------------------------


def commands_page() -> str:
    """Return the page of the command, with the help that each command prints."""
    group = _group()
    parts = [
        "# The command's help\n\n[The command fiber](../command.md) explains what it is for.",
        *_helps(group, group.make_context("fiber", [], resilient_parsing=True)),
    ]
    return "\n\n".join(parts) + "\n"


def _helps(command: click.Command, context: click.Context) -> Iterator[str]:
    yield f"## {context.command_path}\n\n```text\n{command.get_help(context)}\n```"
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            assert inner is not None
            yield from _helps(inner, click.Context(inner, info_name=name, parent=context))
