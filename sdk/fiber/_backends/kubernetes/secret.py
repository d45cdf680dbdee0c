"""The credentials of a FiberPool: made here for a pool of our own, read for a warm one."""

from __future__ import annotations

import base64
import datetime

from fiber._backends.kubernetes.api_errors import Body
from fiber._backends.kubernetes.resources import SECRETS
from fiber._transport.credentials import MasterCredentials
from fiber_api import names
from fiber_api.certificates import RUN_VALIDITY, Certificates, make_certificates


def make_credentials(pool: str, namespace: str) -> MasterCredentials:
    """New ones, for one run of a program."""
    return MasterCredentials.of(
        make_certificates(
            names.server_name(pool, namespace),
            names.agent_server_name(pool, namespace),
            valid_for=RUN_VALIDITY,
        )
    )


def secret_body(name: str, credentials: MasterCredentials, owner: Body) -> Body:
    """The Secret that pods mount.

    It holds the agents' half alone: who may read it can pose as an agent, never as the master.
    """
    agent = credentials.agent_half()
    texts = {
        names.KEY_SERVER_NAME: agent.server_name,
        names.KEY_AUTHORITY: agent.authority,
        names.KEY_AGENT_CERTIFICATE: agent.certificate,
        names.KEY_AGENT_KEY: agent.key,
    }
    return {
        "apiVersion": SECRETS.api_version,
        "kind": SECRETS.kind,
        "metadata": {"name": name, "ownerReferences": [owner]},
        "type": "Opaque",
        "data": {key: base64.b64encode(text.encode()).decode() for key, text in texts.items()},
    }


def credentials_of(secret: Body, pool: str, namespace: str) -> MasterCredentials:
    """Those in the Secret that the operator made; InvalidCertificates if they cannot serve."""
    certificates = Certificates.from_secret(secret.get("data") or {})
    certificates.check(names.server_name(pool, namespace), datetime.datetime.now(datetime.UTC))
    return MasterCredentials.of(certificates)
