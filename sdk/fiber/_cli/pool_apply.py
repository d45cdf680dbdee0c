"""Command ``fiber pool apply``: the FiberPools of a manifest, by server-side apply."""

from __future__ import annotations

import json
from typing import Any, TextIO

import click

from fiber._cli.failures import CommandError
from fiber._cli.pool_access import find, one_line, opened, path_of, refusals
from fiber._cli.session import SECONDS, Session, cluster_options
from fiber_api import names
from fiber_api.rest import Body, Conflict, NotFound


@click.command("apply")
@click.argument("file", type=click.File("r", encoding="utf-8"))
@click.option("--force", is_flag=True, help="Take over fields that another writer has set.")
@cluster_options
def apply(file: TextIO, force: bool, namespace: str | None, context: str | None) -> None:
    """Make or change the FiberPools of a YAML or JSON file; `-` reads the standard input.

    Fields that an earlier apply set and the file no longer has are removed.  Fields that programs
    write, such as spec.master, stay as they are.

    \b
    Examples:
      fiber pool apply warm.yaml
      fiber pool apply warm.yaml --force --namespace lab
    """
    source = str(getattr(file, "name", "<stdin>"))
    documents = [_checked(each, source) for each in _documents(file, source)]
    if not documents:
        raise CommandError(f"cannot apply {source}", "it has no document", "add a FiberPool")
    session = opened(context, namespace)
    for document in documents:
        _apply(_placed(session, document, namespace, source), document, source, force)


def _apply(session: Session, document: Body, file: str, force: bool) -> None:
    name = document["metadata"]["name"]
    there = find(session, name) is not None
    doing = f"apply the FiberPool {name!r} of {file}"
    body = {**document, "metadata": {**document["metadata"], "namespace": session.namespace}}
    body.pop("status", None)
    with refusals(doing):
        try:
            session.api.apply_manifest(path_of(session, name), body, force=force, timeout=SECONDS)
        except Conflict as error:
            raise _conflict(doing, error) from error
        except NotFound as error:
            raise CommandError(
                f"cannot {doing}",
                one_line(error.message),
                f"make the namespace: `kubectl create namespace {session.namespace}`",
            ) from error
    click.echo(f"the FiberPool {name!r} is {'changed' if there else 'made'}")


def _conflict(doing: str, error: Conflict) -> CommandError:
    return CommandError(
        f"cannot {doing}",
        one_line(error.message),
        "remove these fields from the file, or take them over with --force",
    )


def _placed(session: Session, document: Body, wanted: str | None, file: str) -> Session:
    """Return the session in the document's namespace."""
    own = document["metadata"].get("namespace")
    if own and wanted and own != wanted:
        raise CommandError(
            f"cannot apply {file}",
            f"it names the namespace {own!r}, and --namespace names {wanted!r}",
            "leave out one of the two",
        )
    return session._replace(namespace=own or session.namespace)


def _documents(file: TextIO, source: str) -> list[Any]:
    """Return the documents of the file that are not empty."""
    import yaml  # comes with the Kubernetes client

    try:
        text = file.read()
        found = [json.loads(text)] if source.endswith(".json") else [*yaml.safe_load_all(text)]
    except (ValueError, yaml.YAMLError) as error:
        raise CommandError(
            f"cannot read {source}",
            one_line(str(error)),
            "give a YAML or JSON file with a FiberPool, such as examples/manifests/warm.yaml",
        ) from error
    return [each for each in found if each is not None]


def _checked(document: Any, file: str) -> Body:
    """Return the document if it is a FiberPool with a name."""
    kind = document.get("kind") if isinstance(document, dict) else type(document).__name__
    if kind != names.KIND:
        raise CommandError(
            f"cannot apply {file}",
            f"it has a document of the kind {kind}, and this command makes FiberPools only",
            f"use `kubectl apply -f {file}` for other kinds",
        )
    version = document.get("apiVersion")
    if version != names.API_VERSION:
        raise CommandError(
            f"cannot apply {file}",
            f"its apiVersion is {version}, and this command knows {names.API_VERSION}",
            "correct it, or use the command of that version",
        )
    metadata, spec = document.get("metadata"), document.get("spec")
    if not isinstance(metadata, dict) or not isinstance(metadata.get("name"), str):
        raise CommandError(f"cannot apply {file}", "a FiberPool has no name", "set metadata.name")
    if not isinstance(spec, dict):
        raise CommandError(f"cannot apply {file}", f"{metadata['name']} has no spec", "add it")
    return {**document}
