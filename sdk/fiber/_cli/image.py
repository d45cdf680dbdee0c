"""Command ``fiber image``: an image for workers, made from the program's environment."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import click

from fiber._cli import image_builders, image_packages, image_pip, image_requirements, image_settings
from fiber._cli.image_builders import Builder
from fiber._cli.image_context import BASE, emptied, write_context
from fiber._cli.image_packages import FIBER, Contents, canonical

_PART = r"[a-z0-9]+(?:(?:\.|_{1,2}|-+)[a-z0-9]+)*"
_TAG = re.compile(
    rf"(?:[A-Za-z0-9.-]+(?::\d+)?/)?{_PART}(?:/{_PART})*(?::\w[\w.-]{{0,127}})?(?:@sha256:\w+)?"
)


@click.group("image")
def command() -> None:
    """Build an image for workers from this environment.

    \b
    Examples:
      fiber image build --tag registry.example/worker:1
      fiber image build --file-only
    """


def _checked_tag(ctx: click.Context, param: click.Parameter, tag: str | None) -> str | None:
    if tag is not None and not _TAG.fullmatch(tag):
        raise click.BadParameter(
            f"{tag!r} is no name of an image, such as registry.example/worker:1", ctx, param
        )
    return tag


def _checked_names(
    ctx: click.Context, param: click.Parameter, names: tuple[str, ...]
) -> tuple[str, ...]:
    if FIBER in map(canonical, names):
        raise click.BadParameter(f"workers need {FIBER}", ctx, param)
    return names


@command.command("build")
@click.option(
    "--tag",
    metavar="REGISTRY/NAME",
    callback=_checked_tag,
    help="Name of the image.  Needed unless --file-only is given.",
)
@click.option("--push", is_flag=True, help="Push the image, so that nodes can pull it.")
@click.option(
    "--base",
    metavar="IMAGE",
    default=BASE,
    show_default=True,
    callback=_checked_tag,
    help="Image to begin with.",
)
@click.option(
    "--requirements",
    metavar="FILE",
    type=click.Path(dir_okay=False, path_type=Path),
    help="requirements.txt, pyproject.toml or uv.lock, in place of this environment's packages.",
)
@click.option(
    "--without",
    metavar="PACKAGE",
    multiple=True,
    callback=_checked_names,
    help="Package to leave out.",
)
@click.option("--platform", metavar="OS/ARCH", help="Platform of the nodes, as linux/amd64.")
@click.option(
    "--file-only",
    metavar="[FOLDER]",
    is_flag=False,
    flag_value="fiber-image",
    help="Write the build context to the folder, by default fiber-image, and build nothing.",
)
def build(
    tag: str | None,
    push: bool,
    base: str,
    requirements: Path | None,
    without: tuple[str, ...],
    platform: str | None,
    file_only: str | None,
) -> None:
    """Build an image for workers that has what this environment has.

    Packages have the exact versions of this environment, Fiber included.  Editable and other local
    packages are built as wheels.  The files of the program's folder are not in the image: a
    program sends them to its workers.

    \b
    Examples:
      fiber image build --tag registry.example/worker:1 --push
      fiber image build --tag registry.example/worker:1 --requirements requirements.txt
    """
    if tag is None and file_only is None:
        raise click.UsageError("Missing option '--tag'.  Only --file-only needs none.")
    contents = _contents(requirements, without)
    for note in contents.notes:
        click.echo(f"note: {note}", err=True)
    if file_only is not None:
        _write_only(Path(file_only), contents, base)
        return
    assert tag is not None
    builder = image_builders.choose()
    _build(builder, tag, contents, base, platform)
    click.echo(f"built {tag}")
    if push:
        builder.push(tag)
        click.echo(f"pushed {tag}")
    else:
        click.echo(f"nodes pull it once it is pushed: `{builder.name} push {tag}`, or --push")
    _remember(tag)


def _contents(requirements: Path | None, without: tuple[str, ...]) -> Contents:
    if requirements is None:
        return image_packages.of_environment(without)
    return image_requirements.of_file(requirements, without)


def _write_only(folder: Path, contents: Contents, base: str) -> None:
    write_context(emptied(folder), contents, base)
    click.echo(f"wrote the build context to {folder}")
    click.echo(f"build it: `docker build --tag REGISTRY/NAME {folder}`")
    click.echo("if pip needs settings to reach an index: --secret id=pip,src=PATH_OF_PIP.CONF")


def _build(builder: Builder, tag: str, contents: Contents, base: str, platform: str | None) -> None:
    with (
        tempfile.TemporaryDirectory(prefix="fiber-image-") as folder,
        image_pip.secrets() as options,
    ):
        write_context(Path(folder), contents, base)
        chosen = ["--platform", platform] if platform else []
        builder.build(Path(folder), tag, [*chosen, *options])


def _remember(tag: str) -> None:
    """Write the image into pyproject.toml, so that the next program uses it."""
    file = image_settings.nearest(Path.cwd())
    if file is None:
        click.echo(f"there is no pyproject.toml here: set FIBER_IMAGE={tag}")
        return
    try:
        image_settings.remember(file, tag)
    except (image_settings.CannotEdit, OSError) as error:
        click.echo(f"note: cannot set the image in {file}: {error}", err=True)
        click.echo(f'set FIBER_IMAGE={tag}, or image = "{tag}" in [tool.fiber]')
        return
    click.echo(f"programs below {file.parent} use it: image in [tool.fiber] of {file}")
    stronger = os.environ.get("FIBER_IMAGE")
    if stronger not in (None, tag):
        click.echo(f"note: FIBER_IMAGE={stronger} is stronger: unset it", err=True)
