"""Command of a release: ``python -m release`` with one of the words of ``--help``."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

from fiber._backends.kubernetes.published import OPERATOR, chart_version
from release import ROOT, ReleaseError, changelog, images, packages, trial, versions

DRY_REGISTRY = "registry.example/fiber"


def prepare(version: str, date: str, root: Path = ROOT) -> None:
    """Write the version into the checkout; for a release also the changelog's section."""
    before = versions.current(root)
    versions.write(root, version)
    if versions.is_development(version):
        print(f"the version is {version}, after {before}: commit this")
        return
    changelog.collect(root, version, date)
    print(f"the version is {version}: commit this, and tag it v{version} once it is on main")


def build(out: Path, registry: str, tag: str | None) -> None:
    """Make and check all files of a release in ``out``; without a tag it is a dry run."""
    version = versions.current(ROOT)
    notes = _notes(version, registry, tag)
    shutil.rmtree(out, ignore_errors=True)
    for folder in ("assets", "pypi"):
        (out / folder).mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix="fiber-release-") as temporary:
        made = _files(out / "assets", version, registry, Path(temporary))
    for file in made:
        shutil.copy2(file, out / "pypi")
    (out / "notes.md").write_text(notes, encoding="utf-8")
    kind = f"the release {tag}" if tag else "the dry run of a release"
    print(f"{kind} is in {out}: version {version}, images and chart at {registry}")


def _notes(version: str, registry: str, tag: str | None) -> str:
    if tag is None and versions.is_development(version):
        news = changelog.unreleased(ROOT)
    else:
        news = changelog.section(ROOT, version)
    if tag is not None:
        versions.check_tag(tag, version)
    chart = f"oci://{registry}/charts/{OPERATOR} --version {chart_version(version)}"
    head = (
        "```console\n"
        f"$ pip install 'fiberpool[kubernetes]=={version}'\n"
        f"$ helm install {OPERATOR} {chart} --namespace fiber-system --create-namespace\n"
        "```\n\n"
    )
    return head + changelog.absolute_links(ROOT, news, tag or f"v{version}")


def _files(assets: Path, version: str, registry: str, temporary: Path) -> tuple[Path, Path]:
    """Make the files of a release; return the sdist and the wheel."""
    helm = packages.find_helm()
    sources = packages.stamped_sources(registry, temporary)
    sdist, wheel = packages.sdist_and_wheel(sources, assets)
    chart = packages.chart_archive(helm, registry, sources, assets, temporary)
    shutil.copy2(sources / packages.DEFINITION, assets)
    named = {trial.run(wheel, version, temporary)}
    named |= packages.chart_images(helm, chart, registry, temporary)
    agree(
        version,
        packages.wheel_version(wheel),
        packages.chart_metadata(helm, chart, temporary),
        named,
        [reference for image in images.plan(registry, version) for reference in image.references],
    )
    packages.write_sums(assets)
    return sdist, wheel


def agree(
    version: str, wheel: str, chart: tuple[str, str], named: set[str], published: list[str]
) -> None:
    """Raise ReleaseError unless all parts of a release have one version.

    ``named`` are the images that wheel and chart name, ``published`` those that are pushed.
    """
    wanted = chart_version(version), version
    if wheel != version or chart != wanted:
        raise ReleaseError(
            f"the versions differ: the checkout has {version}, the wheel {wheel}, the chart "
            f"{chart[0]} with the appVersion {chart[1]}. Write one to all files with `make "
            "release-prepare VERSION=...`"
        )
    missing = sorted(named - set(published))
    if missing or len(named) < 2:
        raise ReleaseError(
            f"wheel and chart name the images {sorted(named)}, and the release pushes "
            f"{published}. Each image that they name must be one of these: see release/images.py"
        )


def push_image(registry: str, name: str, sdist_folder: Path) -> None:
    """Build, try and push one image from the sdist of this release."""
    (archive,) = sdist_folder.glob("*.tar.gz")
    version = archive.name.removesuffix(".tar.gz").partition("-")[2]
    image = images.named(images.plan(registry, version), name)
    with tempfile.TemporaryDirectory(prefix="fiber-release-") as temporary:
        shutil.unpack_archive(archive, temporary, filter="data")
        (sources,) = Path(temporary).iterdir()
        digest = images.push(image, version, sources)
    _tell(image.repository, digest)


def push_chart(registry: str, assets: Path) -> None:
    """Push the packaged chart of this release."""
    (chart,) = assets.glob(f"{OPERATOR}-*.tgz")
    digest = packages.push_chart(packages.find_helm(), chart, registry)
    _tell(f"{registry}/charts/{OPERATOR}", digest)


def _tell(repository: str, digest: str) -> None:
    """Print what was pushed; tell it to the next step of a workflow, too."""
    print(f"pushed {repository}@{digest}")
    if "GITHUB_OUTPUT" in os.environ:
        with open(os.environ["GITHUB_OUTPUT"], "a", encoding="utf-8") as file:
            file.write(f"repository={repository}\ndigest={digest}\n")


def _arguments(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m release", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("prepare", help="write a version into the checkout")
    command.add_argument("version")
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    command.add_argument("--date", default=today, help="date of the release; default: today")
    command = commands.add_parser("build", help="make and check the files of a release")
    command.add_argument("--out", type=Path, default=ROOT / "build" / "release")
    command.add_argument("--registry", default=DRY_REGISTRY)
    command.add_argument("--tag", help="tag of the release; without it, this is a dry run")
    command = commands.add_parser("images", help="print the names of the images, as JSON")
    command = commands.add_parser("push-image", help="build, try and push one image")
    command.add_argument("name")
    command.add_argument("--registry", required=True)
    command.add_argument("--sdist", type=Path, required=True, help="folder with the sdist")
    command = commands.add_parser("push-chart", help="push the packaged chart")
    command.add_argument("--registry", required=True)
    command.add_argument("--assets", type=Path, required=True, help="folder with the chart")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    """Run one command; return its exit status."""
    given = _arguments(words)
    try:
        match given.command:
            case "prepare":
                prepare(given.version, given.date)
            case "build":
                build(given.out.resolve(), images.checked_registry(given.registry), given.tag)
            case "images":
                plan = images.plan(DRY_REGISTRY, versions.current(ROOT))
                print(json.dumps([image.name for image in plan]))
            case "push-image":
                push_image(images.checked_registry(given.registry), given.name, given.sdist)
            case "push-chart":
                push_chart(images.checked_registry(given.registry), given.assets)
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
