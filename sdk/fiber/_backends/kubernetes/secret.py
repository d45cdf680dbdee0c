"""The Secret that holds the key of a FiberPool."""

from __future__ import annotations

import base64

from fiber._backends.kubernetes.api_errors import Body
from fiber._backends.kubernetes.resources import SECRETS
from fiber._transport.credentials import MasterCredentials
from fiber_api import identity, names


def secret_body(
    name: str, credentials: MasterCredentials, owner: Body, labels: dict[str, str]
) -> Body:
    """The Secret that the init containers of pods mount.

    It names the master's certificate: who reads the key can pose as an agent, never as the master.
    """
    texts = {names.KEY_POOL: credentials.pool_key, names.KEY_MASTER: credentials.fingerprint}
    return {
        "apiVersion": SECRETS.api_version,
        "kind": SECRETS.kind,
        "metadata": {
            "name": name,
            "labels": {**labels, names.LABEL_MANAGED_BY: names.SDK_MANAGER},
            "ownerReferences": [owner],
        },
        "type": "Opaque",
        "data": {key: base64.b64encode(text.encode()).decode() for key, text in texts.items()},
    }


def pool_key_of(secret: Body) -> str:
    """Return the key in a Secret that the operator made; InvalidKey if it cannot serve."""
    return identity.key_in(secret.get("data") or {})
