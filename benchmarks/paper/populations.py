"""Populations that grow and shrink, on a cluster: pods that follow the work, and a static peak.

    PYTHONPATH=tests python -m benchmarks.paper.populations --set-up

`make paper-populations` runs this. A run is played once with each allocation, by a program in its
own process and in its own namespace. Pods are watched from here.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import machine
from benchmarks.command import share_of
from benchmarks.contenders import ON_PODS
from benchmarks.operator_scale import preparation
from benchmarks.operator_scale.command import guarded, open_api
from benchmarks.operator_scale.installed import CannotMeasure, find_operator, server_version
from benchmarks.paper import page, populations_picture
from benchmarks.paper import populations_results as results
from benchmarks.paper.populations_plan import Phase, Plan, plans
from benchmarks.paper.populations_results import DYNAMIC, STATIC, Results, Trace
from benchmarks.paper.recording import BadRecording
from benchmarks.rounds import say
from benchmarks.session import ROOT

from cluster import images
from e2e.gpus import RESOURCE, gpus
from e2e.kube import Kube, path_of
from e2e.scene import Scene

PROGRAM = Path(__file__).with_name("populations_program.py")
CPU_REQUEST = 0.05
IDLE_WORKER, IDLE_POD = 4.0, 1.0
"""Seconds after which an idle worker ends, and after which a pod without workers is removed."""
_LIMIT = 600.0
_PATIENCE = 90.0
_QUICK_SIZE = 0.1
_WARM_UP = [Phase(gpu=False, waves=[[0.0, 0.0]])]


def main(arguments: Sequence[str]) -> int:
    """Return 0 if all was measured, 1 if something is missing, 130 after Ctrl-C."""
    options = _parse(arguments)
    try:
        chosen = plans(options.size)
    except BadRecording as error:
        say(str(error))
        return 1
    words = shlex.join(["python", "-m", "benchmarks.paper.populations", *arguments])
    return guarded(lambda stack: _measure(stack, chosen, options, f"PYTHONPATH=tests {words}"))


def _measure(
    stack: contextlib.ExitStack, chosen: dict[str, Plan], options: argparse.Namespace, command: str
) -> Callable[[], None]:
    image = "" if options.set_up else _image()
    kubeconfig = (
        stack.enter_context(preparation.own_cluster(0))
        if options.set_up
        else preparation.kubeconfig()
    )
    kube = stack.enter_context(open_api(kubeconfig))
    needed = max(phase.peak for plan in chosen.values() for phase in plan if phase.gpu)
    if options.set_up:
        stack.enter_context(preparation.operator(kube))
        stack.enter_context(_pretended_gpus(kube, needed))
        image = images.bring_images()[images.WORKER.name]
    find_operator(kube)
    check_gpus(kube.items(path_of("nodes")), needed)
    variables = _variables(kubeconfig, image)
    about = _about(kube, command, options.size)
    say("warm-up")
    _play(kube, variables, DYNAMIC, _WARM_UP)
    traces: dict[str, dict[str, Trace]] = {}
    for name, plan in chosen.items():
        traces[name] = {}
        for allocation in (DYNAMIC, STATIC):
            say(f"{results.TITLES[name]}, {allocation}")
            traces[name][allocation] = trace = _play(kube, variables, allocation, plan)
            say(f"  {trace.wall:.1f} s, {trace.processor_seconds:.1f} processor-seconds")
    return lambda: _write(options.output, Results(about, traces))


def _image() -> str:
    """Return the image that FIBER_IMAGE names."""
    if image := os.environ.get("FIBER_IMAGE"):
        return image
    raise CannotMeasure(
        "FIBER_IMAGE is not set, so pods have no image: set it to an image for workers that the "
        'nodes have, or run eval "$(make -s cluster)" first, or let --set-up build one'
    )


def check_gpus(nodes: Sequence[results.Body], needed: int) -> None:
    """Raise CannotMeasure unless the nodes have so many GPUs."""
    there = sum(int(node["status"].get("allocatable", {}).get(RESOURCE, 0)) for node in nodes)
    if there < needed:
        found = f"the nodes have {there}" if there else f"no node has a GPU ({RESOURCE})"
        raise CannotMeasure(
            f"{found}, and {needed} are needed: add nodes with GPUs and their device plugin, or "
            "let --set-up bring up the cluster of tests/cluster, whose nodes pretend to have some"
        )


@contextlib.contextmanager
def _pretended_gpus(kube: Kube, count: int) -> Iterator[None]:
    """Let a node advertise so many GPUs meanwhile."""
    nodes = [node for node in kube.items(path_of("nodes")) if not node["spec"].get("taints")]
    name = nodes[0]["metadata"]["name"]
    with gpus(kube, {name: count}):
        deadline = time.monotonic() + _PATIENCE
        # The kubelet makes the capacity allocatable when it writes its status next.
        while not _has_gpus(kube, count) and time.monotonic() < deadline:
            time.sleep(0.5)
        yield


def _has_gpus(kube: Kube, count: int) -> bool:
    try:
        check_gpus(kube.items(path_of("nodes")), count)
    except CannotMeasure:
        return False
    return True


def _variables(kubeconfig: Path, image: str) -> dict[str, str]:
    """Return the environment of a program, but for its namespace."""
    others = {name: value for name, value in os.environ.items() if not name.startswith("FIBER_")}
    return {
        **others,
        "KUBECONFIG": str(kubeconfig),
        "FIBER_BACKEND": "kubernetes",
        "FIBER_IMAGE": image,
        "FIBER_CPU_REQUEST": f"{CPU_REQUEST:g}",
        "FIBER_IDLE_TIMEOUT": f"{IDLE_POD:g}",
    }


def _about(kube: Kube, command: str, size: float) -> dict[str, Any]:
    return {
        **machine.about((ON_PODS,), command, 1, size),
        "kubernetes": server_version(kube),
        "nodes": len(kube.items(path_of("nodes"))),
        "cpu_request": CPU_REQUEST,
    }


def _play(kube: Kube, variables: dict[str, str], allocation: str, plan: Plan) -> Trace:
    """Let the program play the plan in a new namespace, and return what was seen."""
    in_use, before = machine.in_use(), os.getloadavg()[0]
    with _namespace(kube) as scene:
        events = _run(plan, allocation, {**variables, "FIBER_NAMESPACE": scene.namespace})
        scene.wait("the last pod is gone", lambda: not scene.now["pods"], _PATIENCE)
        begin, wall, opened = results.demand(events)
        changes = [
            (moment.at, moment.name, None if moment.gone else results.held(moment.object))
            for moment in list(scene.moments)
        ]
    seen = results.samples(changes, begin)
    return Trace(
        wall=wall,
        bound=round(sum(phase.bound for phase in plan), 3),
        until=seen[-1].at,
        work=round(sum(phase.work for phase in plan), 3),
        demand=opened,
        samples=seen,
        load_before=round(before, 2),
        in_use=round(in_use, 3),
    )


@contextlib.contextmanager
def _namespace(kube: Kube) -> Iterator[Scene]:
    """Make a namespace and watch its pods; delete it at the end."""
    body = {"metadata": {"generateName": "fiber-populations-"}}
    name = kube.create(path_of("namespaces"), body)["metadata"]["name"]
    try:
        scene = Scene(kube, name, ("pods",))
        try:
            account = scene.path("serviceaccounts", "default")  # all pods use it; it comes later
            scene.wait("the namespace has its account", lambda: kube.get(account), poll=0.2)
            yield scene
        finally:
            scene.close()
    finally:
        kube.delete(path_of("namespaces", name=name))


def _run(plan: Plan, allocation: str, variables: dict[str, str]) -> list[tuple[str, float, int]]:
    """Run the program, and return the events that it printed."""
    phases = [{"gpu": each.gpu, "peak": each.peak, "waves": each.waves} for each in plan]
    request = {"allocation": allocation, "idle": IDLE_WORKER, "phases": phases}
    done = subprocess.run(
        [sys.executable, str(PROGRAM)],
        input=json.dumps(request),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env=variables,
        timeout=_LIMIT,
    )
    if done.returncode:
        raise CannotMeasure(
            f"the program with the {allocation} allocation ended with {done.returncode}: its "
            "error is above"
        )
    return [(name, at, number) for name, at, number in map(json.loads, done.stdout.splitlines())]


def _write(folder: Path, found: Results) -> None:
    results.write(folder, found)
    populations_picture.draw(found, folder)
    say(f"written to {page.write(folder, page.load(folder))}")


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        "benchmarks.paper.populations",
        description="Measure pods that follow the work beside a static allocation of the peak.",
    )
    parser.add_argument(
        "--set-up",
        action="store_true",
        help="bring up the cluster of tests/cluster with the operator and pretended GPUs meanwhile "
        "(root, Linux, Go); otherwise KUBECONFIG and FIBER_IMAGE name what to use",
    )
    parser.add_argument("--size", type=share_of, help="share of the full amount of work, default 1")
    parser.add_argument("--quick", action="store_true", help="a tiny trial, written to build/paper")
    parser.add_argument("--output", type=Path, help="folder to write to, default docs/paper")
    options = parser.parse_args(arguments)
    options.size = options.size or (_QUICK_SIZE if options.quick else 1.0)
    options.output = options.output or (ROOT / "build" / "paper" if options.quick else page.FOLDER)
    options.output = options.output.resolve()
    return options


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
