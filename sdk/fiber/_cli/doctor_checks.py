"""Checks of ``fiber doctor``: functions of facts, which return a verdict.  They are pure."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import fiber
from fiber._backends.kubernetes.published import install_command
from fiber._backends.kubernetes.template import ImageMissing
from fiber._cli.display import counted
from fiber._cli.doctor_capacity import refusing_quota, refusing_range, requests_of, room
from fiber._cli.doctor_facts import Answer, Facts, FirstAnswer, NoPlace, Place
from fiber._cli.doctor_rights import (
    ACCOUNT_RIGHTS,
    PROGRAM_RIGHTS,
    ROLE,
    RUN_RIGHTS,
    RUNNER_ROLE,
    SCHEMA_NAME,
    SPEC_OF_PROGRAMS,
    Right,
)
from fiber._cli.doctor_verdicts import State, Verdict, fault, note, ok, unknown
from fiber._cli.failures import no_image
from fiber._cli.pool_access import account_of_program, condition, is_of_program, program_of
from fiber.config import Config
from fiber.errors import ConfigError
from fiber.resources import GPU
from fiber_api.names import PROGRAM_ACCOUNT, SERVING_LEASE, ConditionType
from fiber_api.rest import ApiError, Body, Forbidden, NotFound, NotServed, Unauthorized
from fiber_api.times import format_time, parse_time

MOST_SKEW = 60.0
"""Seconds that two clocks may differ.  Leases and certificates compare them."""

INSTALL = f"`{install_command()}`, or choose another cluster with --context"


class Check(NamedTuple):
    """Check, and the checks whose faults hide what it looks at."""

    name: str
    judge: Callable[[Facts], Iterable[Verdict]]
    needs: tuple[str, ...] = ()
    blocks: bool = False
    """True if the trial cannot succeed after a fault."""


def examine(facts: Facts) -> list[Verdict]:
    """Return the verdicts of all checks, in order."""
    found: list[Verdict] = []
    failed: set[str] = set()
    for check in CHECKS:
        cause = next((name for name in check.needs if name in failed), None)
        if cause is not None:
            verdicts = [hidden(check.name, cause)]
            failed.add(check.name)
        else:
            verdicts = [verdict._replace(check=check.name) for verdict in check.judge(facts)]
        if any(verdict.state is State.FAULT for verdict in verdicts):
            failed.add(check.name)
        found += verdicts
    return found


def hidden(check: str, cause: str) -> Verdict:
    """Return the verdict of a check that an earlier fault hides."""
    return unknown(f"not checked, because of the fault above ({cause})")._replace(check=check)


def obstacle(verdicts: Iterable[Verdict]) -> str | None:
    """Return the name of the first check whose fault keeps any trial from success."""
    blocking = {check.name for check in CHECKS if check.blocks}
    for verdict in verdicts:
        if verdict.state is State.FAULT and verdict.check in blocking:
            return verdict.check
    return None


# ---- the way to the cluster -----------------------------------------------------------------


def _kubeconfig(facts: Facts) -> Iterator[Verdict]:
    if isinstance(facts.configuration, ConfigError):
        yield fault(
            "the configuration cannot be read",
            str(facts.configuration),
            "correct the named key; docs/kubernetes.md lists all",
        )
        return
    place = facts.place
    if isinstance(place, NoPlace):
        yield _no_place(place)
    elif place is not None:
        context = f"context {place.context!r} of" if place.context else "current context of"
        source = f"{context} {place.kubeconfig}" if place.kubeconfig else "this pod's account"
        yield ok(f"{source}, namespace {place.namespace!r}")


def _no_place(place: NoPlace) -> Verdict:
    found = re.search(r"cannot be used: (.*?)\. Set KUBECONFIG", place.error)
    why = found[1] if found else place.error
    if "not installed" in why:
        return fault(
            "a package is missing", why, f"`{sys.executable} -m pip install fiberpool[kubernetes]`"
        )
    if not place.kubeconfig:
        return fault(
            "this pod has no account for the cluster",
            why,
            "give the pod an account with the role fiber-user (serviceAccountName), and do not set "
            "automountServiceAccountToken to false",
        )
    if not place.exists:
        return fault(
            "there is no kubeconfig",
            f"{place.kubeconfig} does not exist",
            "set KUBECONFIG to the kubeconfig of your cluster, or copy it to ~/.kube/config",
        )
    if place.context is not None and "context" in why:
        return fault(
            f"there is no context {place.context!r}",
            f"{place.kubeconfig}: {why}",
            "choose one of `kubectl config get-contexts` with --context, FIBER_CONTEXT or "
            "context in [tool.fiber]",
        )
    return fault(
        "the kubeconfig cannot be used",
        f"{place.kubeconfig}: {why}",
        "check it with `kubectl config view`",
    )


def _server(facts: Facts) -> Iterator[Verdict]:
    name = facts.place.server if isinstance(facts.place, Place) else ""
    match facts.server:
        case FirstAnswer(version, seconds, _):
            yield ok(f"{name} runs Kubernetes {version} and answers in {seconds * 1000:.0f} ms")
        case Unauthorized() as error:
            yield fault(
                "the login is not accepted",
                f"{name} says: {error.message}",
                "log in again (`kubectl auth whoami` shows the account), or choose another "
                "context with --context",
            )
        case NotServed() as error:
            yield fault(
                "no API server answers there",
                f"{name} says: {_short(error.message)}",
                "check the server's address in the kubeconfig with `kubectl config view --minify`",
            )
        case ApiError() as error:
            yield fault(
                "the API server does not answer",
                f"{name}: {_short(error.message)}",
                "check the network, a VPN for instance, and the address in the kubeconfig with "
                "`kubectl cluster-info`",
            )


def _clock(facts: Facts) -> Iterator[Verdict]:
    ahead = facts.server.ahead if isinstance(facts.server, FirstAnswer) else None
    if ahead is None:
        yield unknown("the API server's answers have no time")
    elif abs(ahead) < MOST_SKEW:
        yield ok(f"agrees with the API server's within {max(1.0, abs(ahead)):.0f} s")
    else:
        yield fault(
            f"this machine's clock is {abs(ahead):.0f} s {'ahead' if ahead > 0 else 'behind'}",
            "certificates and Leases have times, which other machines compare with their clocks",
            "set the clock: `timedatectl set-ntp true`",
        )


def _namespace(facts: Facts) -> Iterator[Verdict]:
    assert isinstance(facts.place, Place)
    name = facts.place.namespace
    match facts.namespace:
        case NotFound():
            yield fault(
                f"there is no namespace {name!r}",
                "the cluster has none of this name",
                f"`kubectl create namespace {name}`, or name another one with --namespace, "
                "FIBER_NAMESPACE or namespace in [tool.fiber]",
            )
        case ApiError() as error:
            yield unknown(f"cannot see whether {name!r} exists: {_short(error.message)}")
        case found:
            labels = ((found or {}).get("metadata") or {}).get("labels") or {}
            level = labels.get("pod-security.kubernetes.io/enforce")
            secured = f", with the pod security standard {level!r}" if level else ""
            yield ok(f"{name!r} exists{secured}")


# ---- the operator ---------------------------------------------------------------------------


def _definition(facts: Facts) -> Iterator[Verdict]:
    match facts.resources:
        case NotServed() | NotFound():
            yield fault(
                "the cluster knows no FiberPools",
                "the CustomResourceDefinition fiberpools.fiber.dev is not installed",
                f"install the operator: {INSTALL}",
            )
            return
        case ApiError() as error:
            yield unknown(f"cannot see the API's resources: {_short(error.message)}")
            return
    known = _fields(facts.schema)
    missing = sorted(SPEC_OF_PROGRAMS - known)
    if not known:
        yield ok("FiberPools are served; their fields may not be read")
    elif missing:
        yield fault(
            f"the definition of FiberPools lacks spec.{', spec.'.join(missing)}",
            f"it is older than this program, fiberpool {fiber.__version__}",
            "upgrade the operator with the chart and its CRD (`helm upgrade`, and "
            "`kubectl apply --server-side -f crds/fiberpools.yaml` if the chart does not install "
            "it), or install that version of fiberpool here",
        )
    else:
        yield ok("FiberPools are served, with all fields that this program writes")


def _fields(schema: Answer | None) -> frozenset[str]:
    """Return the fields of a FiberPool's spec; empty if they are not known."""
    if schema is None or isinstance(schema, ApiError):
        return frozenset()
    found: Body = ((schema.get("components") or {}).get("schemas") or {}).get(SCHEMA_NAME) or {}
    return frozenset(((found.get("properties") or {}).get("spec") or {}).get("properties") or ())


def _operator(facts: Facts) -> Iterator[Verdict]:
    states = {place: _serving(lease, facts.now) for place, lease in facts.leases.items()}
    fresh = next((place for place, why in states.items() if why == ""), None)
    if fresh is not None:
        yield ok(f"one serves this namespace: its Lease in {fresh!r} is fresh")
        return
    said = "; ".join(f"in {place!r} it {why}" for place, why in states.items())
    if any(isinstance(lease, Forbidden) for lease in facts.leases.values()):
        yield unknown(f"cannot see its Lease {SERVING_LEASE}: {said}. A trial shows more")
    elif any(isinstance(lease, dict) for lease in facts.leases.values()):
        yield fault(
            "the operator does not run any more",
            f"its Lease {SERVING_LEASE} shows that: {said}",
            "see `kubectl get deployments,pods --all-namespaces -l "
            "app.kubernetes.io/component=operator` and the log of its pod",
        )
    else:
        yield fault(
            "no operator serves this namespace",
            f"there is no sign of one: the Lease {SERVING_LEASE} {said}".replace(" it ", " "),
            f"install it: {INSTALL}. If one runs, let it serve this namespace (the chart's value "
            "namespaces)",
        )


def _serving(lease: Answer, now: float) -> str:
    """Return why a Lease does not show a living operator; empty if it does."""
    match lease:
        case NotFound() | NotServed():
            return "does not exist"
        case ApiError() as error:
            return f"may not be read ({_short(error.message)})"
    spec = lease.get("spec") or {}
    try:
        renewed = parse_time(str(spec.get("renewTime")))
    except ValueError:
        return "has no time"
    fresh = now < renewed + int(spec.get("leaseDurationSeconds") or 0)
    return "" if fresh else f"was last renewed at {format_time(renewed)}"


def _version(facts: Facts) -> Iterator[Verdict]:
    found = _list(facts.operators)
    versions = sorted(
        {
            str((each["metadata"].get("labels") or {}).get("app.kubernetes.io/version", "unknown"))
            for each in found or ()
        }
    )
    if found is None:
        yield unknown("unknown: its Deployment may not be read")
    elif not versions:
        yield unknown("unknown: no Deployment has the labels of the chart")
    else:
        yield ok(f"{', '.join(versions)}; this program is {fiber.__version__}")


# ---- rights ---------------------------------------------------------------------------------


def _program_rights(facts: Facts) -> Iterator[Verdict]:
    wanted = [right for right in PROGRAM_RIGHTS if not right.only]
    yield from _rights(facts, wanted, "every program")


def _special_rights(facts: Facts) -> Iterator[Verdict]:
    wanted = [right for right in PROGRAM_RIGHTS if right.only]
    yield from _rights(facts, wanted, "a program in a pod, or out of the reach of pods,")


def _run_rights(facts: Facts) -> Iterator[Verdict]:
    yield from _rights(facts, RUN_RIGHTS, "only `fiber run`")


def _rights(facts: Facts, wanted: Sequence[Right], who: str) -> Iterator[Verdict]:
    assert isinstance(facts.place, Place)
    if facts.rights is None or isinstance(facts.rights, ApiError):
        why = "" if facts.rights is None else f": {_short(facts.rights.message)}"
        yield unknown(f"the API server does not say which rights this account has{why}")
        return
    missing = [right for right in wanted if not facts.rights.get(right, True)]
    judge = note if wanted is RUN_RIGHTS else fault
    for right in missing:
        yield judge(
            f"this account may not {right}",
            f"{right.only or who} needs this in the namespace {facts.place.namespace!r}",
            _remedy(facts.place.namespace, wanted),
        )
    if not missing:
        yield ok(f"this account has all {len(wanted)} rights that {who} needs")


def _remedy(namespace: str, wanted: Sequence[Right]) -> str:
    roles = f"roles {ROLE} and {RUNNER_ROLE}" if wanted is RUN_RIGHTS else f"role {ROLE}"
    role = RUNNER_ROLE if wanted is RUN_RIGHTS else ROLE
    return (
        f"ask an administrator for the {roles}: `kubectl create rolebinding NAME "
        f"--namespace {namespace} --clusterrole {role} --user YOU`"
    )


def _account(facts: Facts) -> Iterator[Verdict]:
    assert isinstance(facts.place, Place)
    name, namespace = PROGRAM_ACCOUNT, facts.place.namespace
    rights = facts.rights if isinstance(facts.rights, Mapping) else {}
    missing = [str(right) for right in ACCOUNT_RIGHTS if not rights.get(right, True)]
    match facts.account:
        case NotFound() if missing:
            yield note(
                f"there is no account {name!r}, as which `fiber run` runs programs",
                f"this account may not make it: it may not {', nor '.join(missing)}",
                f"ask an administrator: `kubectl create serviceaccount {name} -n {namespace}` and "
                f"`kubectl create rolebinding {name} --clusterrole {ROLE} --serviceaccount "
                f"{namespace}:{name} -n {namespace}`; or use `fiber run --service-account`",
            )
        case NotFound():
            yield ok(f"the first `fiber run` makes {name!r}")
        case ApiError() as error:
            yield unknown(f"cannot see whether {name!r} exists: {_short(error.message)}")
        case _:
            yield ok(f"{name!r} exists")


# ---- pods -----------------------------------------------------------------------------------


def _image(facts: Facts) -> Iterator[Verdict]:
    if isinstance(facts.image, ImageMissing):
        missing = no_image()
        yield fault(missing.what, missing.why, missing.remedy)
    elif isinstance(facts.image, ConfigError):
        yield fault(
            "the pod template cannot be made",
            str(facts.image),
            "correct the key template, or the file that it names",
        )
    elif facts.image is not None:
        yield ok(f"{facts.image[0] or 'none'} (from {facts.image[1]})")


def _quota(facts: Facts) -> Iterator[Verdict]:
    quotas, ranges = _list(facts.quotas), _list(facts.limits)
    full = refusing_quota(quotas or (), facts.template, ranges or ())
    outside = refusing_range(ranges or (), facts.template)
    if full:
        yield fault(
            "a quota refuses a worker",
            full,
            "end programs or delete objects that are not needed, ask for a larger quota, or set "
            "cpu_request and memory_request; `kubectl describe resourcequota` shows all",
        )
    if outside:
        yield fault(
            "a LimitRange refuses a worker",
            outside,
            "set cpu_request and memory_request, or 0 for its defaults, or resources in the "
            "template; `kubectl describe limitrange` shows the bounds",
        )
    unread = [kind for kind, found in (("quotas", quotas), ("limits", ranges)) if found is None]
    if unread and not (full or outside):
        yield unknown(f"this account may not list the {' and '.join(unread)} of the namespace")
    elif not (full or outside):
        both = counted(len(quotas or ()), "quota"), counted(len(ranges or ()), "LimitRange")
        yield ok(f"{' and '.join(both)}, none refuses a worker")


def _nodes(facts: Facts) -> Iterator[Verdict]:
    nodes, pods, ranges = _list(facts.nodes), _list(facts.pods), _list(facts.limits)
    if nodes is None:
        yield unknown("this account may not list nodes")
        return
    found = room(nodes, pods or (), facts.template, ranges or [])
    unsure = "" if pods is not None else "; their pods may not be listed, and are not counted"
    gpus = f"{found.free_gpus:f} of {found.gpus:f} GPUs are free" if found.gpus else "no GPUs"
    if requests_of(facts.template).get(GPU) and not found.gpus:
        yield fault(
            "no node has a GPU",
            f"a worker asks for {GPU}, which none of {found.nodes} nodes offers",
            "add a node with GPUs and the device plugin of their vendor, or ask for none in the "
            "template",
        )
    elif not found.fit:
        yield fault(
            "no node has room for a worker",
            f"of {found.nodes} nodes, {found.why or 'none is there'}",
            "add nodes, end other pods, or request less: cpu_request, memory_request, "
            "node_selector, tolerations. A cluster autoscaler may add nodes by itself",
        )
    else:
        yield ok(f"{found.fit} of {found.nodes} have room for a worker; {gpus}{unsure}")


def _pools(facts: Facts) -> Iterator[Verdict]:
    pools = _list(facts.pools)
    wanted = facts.configuration.pool if isinstance(facts.configuration, Config) else None
    if pools is None:
        yield unknown("this account may not list FiberPools")
        return
    warm = {str(pool["metadata"]["name"]): pool for pool in pools if not is_of_program(pool)}
    objection = _objection(wanted, {str(p["metadata"]["name"]): p for p in pools})
    if objection is not None:
        yield objection
    elif warm:
        said = (f"{name} ({_use(pool)})" for name, pool in sorted(warm.items()))
        chosen = f"; this configuration uses {wanted!r}" if wanted else ""
        yield ok(f"{', '.join(said)}{chosen}")
    else:
        yield ok("none, each program makes its own")


def _objection(wanted: str | None, pools: Mapping[str, Body]) -> Verdict | None:
    if wanted is None:
        return None
    if (pool := pools.get(wanted)) is None:
        return fault(
            f"there is no FiberPool {wanted!r}",
            "the key pool (FIBER_POOL) names it",
            f"`fiber pool warm {wanted} --workers 1` makes it; or choose one of "
            f"{', '.join(pools) or 'none'}, or unset the key",
        )
    if pool["spec"].get("suspend"):
        return fault(
            f"the FiberPool {wanted!r} is suspended",
            "its spec says so, and it has no workers",
            f"`fiber pool resume {wanted}`",
        )
    alive = condition(pool, ConditionType.MASTER_ALIVE).get("status")
    if program_of(pool) is not None and alive != "False":
        return fault(
            f"another program uses the FiberPool {wanted!r}",
            f"its master is {account_of_program(pool)}, and one program at a time uses it",
            "end that program or wait for its end, choose another FiberPool, or unset the key pool",
        )
    return None


def _use(pool: Body) -> str:
    ready = (pool.get("status") or {}).get("readyReplicas") or 0
    use = "free" if program_of(pool) is None else f"used by {account_of_program(pool)}"
    return f"{counted(ready, 'worker')} ready, {use}"


def _list(answer: Answer | None) -> list[Body] | None:
    """Return the items of a list; None if it may not be read."""
    if answer is None or isinstance(answer, ApiError):
        return None
    return list(answer.get("items") or ())


def _short(text: str) -> str:
    """Return ``text`` as one line of a readable length."""
    line = " ".join(text.split())
    return line if len(line) <= 200 else f"{line[:197]}..."


CHECKS = (
    Check("kubeconfig", _kubeconfig, blocks=True),
    Check("API server", _server, ("kubeconfig",), blocks=True),
    Check("clock", _clock, ("kubeconfig", "API server")),
    Check("namespace", _namespace, ("kubeconfig", "API server"), blocks=True),
    Check("FiberPools", _definition, ("kubeconfig", "API server"), blocks=True),
    Check("operator", _operator, ("kubeconfig", "API server", "FiberPools"), blocks=True),
    Check("operator's version", _version, ("kubeconfig", "API server", "FiberPools")),
    Check("rights", _program_rights, ("kubeconfig", "API server"), blocks=True),
    Check("special rights", _special_rights, ("kubeconfig", "API server")),
    Check("rights of fiber run", _run_rights, ("kubeconfig", "API server")),
    Check("account of fiber run", _account, ("kubeconfig", "API server", "namespace")),
    Check("image", _image, ("kubeconfig",), blocks=True),
    Check("quota", _quota, ("kubeconfig", "API server", "namespace", "image")),
    Check("nodes", _nodes, ("kubeconfig", "API server", "image")),
    Check("warm pools", _pools, ("kubeconfig", "API server", "FiberPools"), blocks=True),
)
