"""Builds Kubernetes with its etcd, Helm and KWOK with Go, at the versions of the go.mod files.

Minutes the first time; the programs stay in a folder of the user's cache that bears their
versions, so that every later start and every other checkout finds them there.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

from cluster import places
from cluster.shell import ClusterError, locked, output, say

# A third of the time: no information for debuggers and, of Kubernetes' own packages, no inlining.
_COMPILER_FLAGS = ("-gcflags=all=-dwarf=false", "-gcflags=k8s.io/...=-dwarf=false -l")
_CPU_MINUTES = 7
"""Processor time that Kubernetes and Helm take to build where Go has compiled nothing yet."""


def build(names: Iterable[str] = places.SOURCES) -> None:
    """Build the missing ones of these; return at once if none is missing."""
    wanted = [name for name in names if missing(name)]
    if not wanted:
        return
    with locked(places.cache() / "lock", "builds the same programs"):
        for name in wanted:
            if missing(name):
                _build(name)


def missing(name: str) -> list[str]:
    """The programs of this source that are not built."""
    return [
        program
        for program in places.SOURCES[name].programs
        if not (places.programs() / program).exists()
    ]


def _build(name: str) -> None:
    go, source = find_go(), places.SOURCES[name]
    say(f"building {name} {places.version(name)} with {go}, once{_advice(name)}")
    began = time.monotonic()
    # Programs appear when they are whole: a build that is killed leaves no file that looks built.
    unfinished = places.cache() / "unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    environment = {**os.environ, "CGO_ENABLED": "0", "GOFLAGS": "-mod=readonly -buildvcs=false"}
    flags = (*_COMPILER_FLAGS, f"-ldflags={_linker_flags(name)}")
    output(
        *(go, "build", "-o", f"{unfinished}/", *flags, source.package),
        cwd=places.HERE / source.folder,
        env=environment,
    )
    places.programs().mkdir(exist_ok=True)
    (built,) = unfinished.iterdir()
    built.rename(places.programs() / built.name)
    for program in source.programs:
        if program != built.name:  # one program that does what it is called
            (places.programs() / program).unlink(missing_ok=True)
            (places.programs() / program).symlink_to(built.name)
    unfinished.rmdir()
    say(f"built {name} in {time.monotonic() - began:.0f} s, into {places.programs()}")


def minutes() -> int:
    """Return about how many minutes a whole build takes on an idle machine."""
    return math.ceil(_CPU_MINUTES / len(os.sched_getaffinity(0)))


def _advice(name: str) -> str:
    """Return the advice for a person who waits for minutes."""
    if name != "kubernetes":
        return ""
    return (
        f", for a real cluster on this machine. It takes about {minutes()} minutes where nothing "
        "else runs, and a download. "
        "To do without: set KUBECONFIG to a cluster that may be used, install kind and docker, or "
        "run what needs no cluster: make test-fast"
    )


def find_go() -> str:
    """Go, also where its usual folder is not on the PATH."""
    go = shutil.which("go") or shutil.which("go", path="/usr/local/go/bin:/usr/lib/go/bin")
    if go is None:
        raise ClusterError(
            "there is no go on the PATH, and Kubernetes is built with it: install Go 1.26 or newer "
            "(https://go.dev/dl), or name a cluster that runs with KUBECONFIG"
        )
    return go


def _linker_flags(name: str) -> str:
    """Small programs; those of Kubernetes also know their version, which clients ask for."""
    flags = ["-s", "-w"]
    if name == "kubernetes":
        version = places.version(name)
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


def module_sources(name: str) -> Path:
    """Return the folder in which Go keeps the sources of a module, with all files that came with
    them.
    """
    source = places.SOURCES[name]
    command = (find_go(), "mod", "download", "-json", source.module)
    found = json.loads(output(*command, cwd=places.HERE / source.folder))
    return Path(found["Dir"])
