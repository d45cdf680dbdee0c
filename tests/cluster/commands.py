"""The commands that people type: what they print, and to whom."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from cluster import build, fake_nodes, faults, images, lifecycle, network, places, preparation
from cluster.daemons import all_daemons
from cluster.shell import say

if TYPE_CHECKING:
    _Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def parser() -> argparse.ArgumentParser:
    """All commands; each parsed one has a function `run` of what was parsed."""
    top = argparse.ArgumentParser(prog="python -m cluster")
    top.formatter_class = argparse.RawDescriptionHelpFormatter
    commands = top.add_subparsers(metavar="COMMAND", required=True)
    _add_lifecycle(commands)
    _add_images(commands)
    _add_faults(commands)
    return top


def _add_lifecycle(commands: _Commands) -> None:
    up = commands.add_parser("up", help="start it, or what of it does not run; print how to use it")
    up.add_argument("--nodes", type=int, default=2)
    up.add_argument("--images", action="store_true", help="with Fiber's images, built and loaded")
    up.set_defaults(run=_up)
    down = commands.add_parser("down", help="stop it and delete its state")
    down.set_defaults(run=lambda _: lifecycle.down())
    status = commands.add_parser("status", help="which cluster is up, and what of it runs")
    status.set_defaults(run=_status)
    environment = commands.add_parser("env", help="print how to use it")
    environment.set_defaults(run=lambda _: _print_environment(images.brought(images.WORKER_RL)))
    fakes = commands.add_parser(
        "fake-nodes", help="have this many nodes that only pretend to run pods"
    )
    fakes.add_argument("count", type=int)
    fakes.set_defaults(run=lambda given: fake_nodes.set_count(given.count))


def _add_images(commands: _Commands) -> None:
    programs = commands.add_parser("build", help="build the programs, Kubernetes and others")
    programs.set_defaults(run=lambda _: build.build())
    ahead = commands.add_parser("prepare", help="do ahead of the tests what takes them minutes")
    ahead.set_defaults(run=lambda _: preparation.prepare())
    ours = commands.add_parser("images", help="build Fiber's images where their inputs changed")
    ours.set_defaults(run=lambda _: print(*images.build_images().values(), sep="\n"))
    one = commands.add_parser("bring", help="build an image on the worker's, and import it as well")
    on_worker = {image.name: image for image in (images.SEARCH, images.PUBLISHED)}
    one.add_argument("name", choices=on_worker)
    one.set_defaults(run=lambda given: print(images.bring(on_worker[given.name])))
    load = commands.add_parser("load", help="import an archive of images into every node")
    load.add_argument("archive", type=Path)
    load.set_defaults(run=lambda given: images.load(given.archive))


def _add_faults(commands: _Commands) -> None:
    for name, act, purpose in (
        ("cut", faults.cut, "cut a node off from the network"),
        ("restore", faults.restore, "connect a node again"),
        ("stop", faults.stop, "kill a daemon: apiserver, node-2-kubelet, …"),
        ("start", faults.start, "start a daemon again"),
    ):
        command = commands.add_parser(name, help=purpose)
        command.add_argument("name")
        command.set_defaults(run=lambda given, act=act: act(given.name))


def _up(given: argparse.Namespace) -> None:
    lifecycle.up(given.nodes)
    _print_environment(_bring_images() if given.images else images.brought(images.WORKER_RL))


def _bring_images() -> str:
    """Bring them to the nodes and say their names; the one that programs of the examples need."""
    references = images.bring_images()
    for image in images.IMAGES:
        say(f"the nodes have {references[image.name]}, also as {image.released(places.CHECKOUT)}")
    return references[images.WORKER_RL.name]


def _print_environment(image: str | None) -> None:
    """Lines for a shell, and nothing else: people evaluate what this prints."""
    print(f"export KUBECONFIG={places.KUBECONFIG}")
    print(f"export PATH={places.programs()}:$PATH")
    if image is not None:
        print(f"export FIBER_IMAGE={image}")


def _status(_: argparse.Namespace) -> None:
    found = lifecycle.find()
    if found is None:
        print("no cluster is up")
        return
    print(found.description)
    for index in places.nodes():
        if not network.is_plugged_in(index):
            print(f"  {places.node_name(index)} is cut off")
    for daemon in all_daemons():
        print(f"  {daemon.name}: {'runs' if daemon.runs() else 'does not run'}; {daemon.log}")
