"""Builds Kubernetes, etcd, Helm and KWOK with Go, at the versions that the go.mod files name.

Minutes the first time; the programs stay in a folder of the user's cache that bears their
versions, so that every later start and every other checkout finds them there.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

from cluster import places
from cluster.shell import ClusterError, locked, output, say

_RENAMED = {"server": "etcd"}
"""What Go would name after the folder of its source, and what everybody calls it."""


def build(folders: Iterable[str] = places.MODULES) -> None:
    """Build what is missing of these modules; returns at once when nothing is."""
    wanted = [folder for folder in folders if missing(folder)]
    if not wanted:
        return
    with locked(places.cache() / "lock", "builds the same programs"):
        for folder in wanted:
            if missing(folder):
                _build(folder)


def missing(folder: str) -> list[str]:
    """The commands of a module that are not built."""
    commands = places.MODULES[folder][1]
    return [name for name in commands if not (places.programs() / name).exists()]


def _build(folder: str) -> None:
    go = find_go()
    say(f"building {folder} {places.version(folder)} with {go} (minutes, once)")
    began = time.monotonic()
    # Programs appear when they are whole: a build that is killed leaves nothing that looks built.
    unfinished = places.cache() / "unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    environment = {**os.environ, "CGO_ENABLED": "0", "GOFLAGS": "-mod=readonly -buildvcs=false"}
    output(
        *(go, "build", "-o", f"{unfinished}/", "-ldflags", _linker_flags(folder), "tool"),
        cwd=places.HERE / folder,
        env=environment,
    )
    places.programs().mkdir(exist_ok=True)
    for file in unfinished.iterdir():
        file.rename(places.programs() / _RENAMED.get(file.name, file.name))
    unfinished.rmdir()
    say(f"built {folder} in {time.monotonic() - began:.0f} s, into {places.programs()}")


def find_go() -> str:
    """Go, also where its usual folder is not on the PATH."""
    go = shutil.which("go") or shutil.which("go", path="/usr/local/go/bin:/usr/lib/go/bin")
    if go is None:
        raise ClusterError(
            "there is no go on the PATH, and Kubernetes is built with it: install Go 1.26 or newer "
            "(https://go.dev/dl), or name a cluster that runs with KUBECONFIG"
        )
    return go


def _linker_flags(folder: str) -> str:
    """Small programs; those of Kubernetes also know their version, which clients ask for."""
    flags = ["-s", "-w"]
    if folder == "kubernetes":
        version = places.version(folder)
        major, minor = version.split(".")[:2]
        values = {
            "gitVersion": f"v{version}",
            "gitMajor": major,
            "gitMinor": minor,
            "gitTreeState": "clean",
        }
        for package in ("k8s.io/component-base/version", "k8s.io/client-go/pkg/version"):
            for key, value in values.items():
                flags += ["-X", f"{package}.{key}={value}"]
    return " ".join(flags)


def module_sources(folder: str) -> Path:
    """Where Go keeps the sources of a module, and all files that came with them."""
    command = (find_go(), "mod", "download", "-json", places.MODULES[folder][0])
    found = json.loads(output(*command, cwd=places.HERE / folder))
    return Path(found["Dir"])
