"""Rights that programs and ``fiber run`` need, one for each call."""

from __future__ import annotations

from typing import NamedTuple

from fiber_api import names
from fiber_api.rest import (
    ACCOUNTS,
    CLAIMS,
    EVENTS,
    JOBS,
    LEASES,
    PODS,
    POOLS,
    ROLE_BINDINGS,
    SECRETS,
    Body,
    ResourceType,
)


class Right(NamedTuple):
    """Right to make one kind of call in one namespace."""

    verb: str
    kind: ResourceType
    subresource: str = ""
    only: str = ""
    """Program or step that cannot do without it; empty: no program can."""

    @property
    def resource(self) -> str:
        """Resource as a role has it: ``pods/log``."""
        return f"{self.kind.plural}/{self.subresource}" if self.subresource else self.kind.plural

    @property
    def group(self) -> str:
        """API group; empty for that of pods."""
        return self.kind.api_version.rpartition("/")[0]

    def __str__(self) -> str:
        return f"{self.verb} {self.resource}"

    def review(self, namespace: str) -> Body:
        """Return the question to the API server whether this account has the right."""
        attributes = {
            "group": self.group,
            "resource": self.kind.plural,
            "verb": self.verb,
            "namespace": namespace,
            **({"subresource": self.subresource} if self.subresource else {}),
        }
        return {
            "apiVersion": "authorization.k8s.io/v1",
            "kind": "SelfSubjectAccessReview",
            "spec": {"resourceAttributes": attributes},
        }


def _all(verbs: str, kind: ResourceType, subresource: str = "", only: str = "") -> list[Right]:
    return [Right(verb, kind, subresource, only) for verb in verbs.split()]


PROGRAM_RIGHTS = (
    *_all("create delete get list patch watch", POOLS),
    *_all("create", SECRETS),
    *_all("create get patch update", LEASES),
    *_all("list watch", PODS),
    *_all("get", PODS, only="a program in a pod"),
    *_all("create get", PODS, "portforward", only="a program that pods do not reach"),
    *_all("get", CLAIMS, only="a program in a pod with volumes"),
)
"""Rights of the chart's role fiber-user."""

RUNNER_RIGHTS = (
    *_all("get", ACCOUNTS),
    *_all("create delete get list", JOBS),
    *_all("get", PODS, "log"),
    *_all("list", EVENTS),
)
"""Rights of the chart's role fiber-runner, for people who use ``fiber run``."""

RUN_RIGHTS = (
    *RUNNER_RIGHTS,
    *_all("get list", PODS),
    *_all("create get", PODS, "portforward"),
)
"""Rights of ``fiber run``, ``fiber logs`` and ``fiber stop``."""

ACCOUNT_RIGHTS = (
    *_all("create", ACCOUNTS),
    *_all("create", ROLE_BINDINGS),
)
"""Rights of the first ``fiber run`` in a namespace, which makes the account of programs."""

ROLE, RUNNER_ROLE = "fiber-user", "fiber-runner"

REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

SPEC_OF_PROGRAMS = frozenset(
    {"maxReplicas", "processesPerPod", "template", "scaleDown", "replicas", "master", "relay"}
)
"""Fields of a FiberPool's spec that programs write."""

SCHEMA = f"/openapi/v3/apis/{names.API_VERSION}"
SCHEMA_NAME = ".".join((*reversed(names.GROUP.split(".")), names.VERSION, names.KIND))
"""Place of the resource's fields, for accounts that may not read its definition."""
