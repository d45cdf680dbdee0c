"""The file with an agent's credentials: a pod's first init container writes it for the agent.

Only the init container mounts the pool's key.  It makes the agent's key, writes it to a volume in
memory, and ends.  Each pod waits for it, so it imports little: cryptography only in a warm pool.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from fiber_api import identity, names, signatures


def write(environment: Mapping[str, str]) -> int:
    """Write the credentials of this pod's agent; return the exit status."""
    try:
        folder = Path(environment[names.ENV_KEY])
        name, uid = environment[names.ENV_NAME], environment[names.ENV_UID]
        key = identity.check_key((folder / names.KEY_POOL).read_text())
        pin = folder / names.KEY_MASTER
        values = {"name": name, "uid": uid, "epoch": int(environment.get(names.ENV_EPOCH, 0))}
        if pin.exists():
            values |= {"key": identity.agent_key(key, name, uid), "master": pin.read_text().strip()}
        else:
            values |= _signed(key, environment[names.ENV_POOL_UID], name, uid)
        _write(environment[names.ENV_CREDENTIALS], json.dumps(values).encode())
        _link_interpreter(Path(environment[names.ENV_CREDENTIALS]).parent)
    except KeyError as error:
        return _fail(f"the variable {error} is not set")
    except (OSError, ValueError) as error:
        return _fail(str(error))
    return 0


def _signed(pool_key: str, pool_uid: str, name: str, uid: str) -> dict[str, str]:
    """Return a new secret for the agent, and the pool's signature for its public key."""
    pool, secret = signatures.pool_signer(pool_key, pool_uid), identity.new_key()
    statement = signatures.agent_statement(name, uid, signatures.Signer(secret).public_key)
    signature = pool.sign(statement).hex()
    return {"key": secret, "pool": pool.public_key.hex(), "signature": signature}


def take(path: str) -> bytes:
    """Read the file and remove it."""
    data = Path(path).read_bytes()
    os.unlink(path)
    return data


def _write(path: str, data: bytes) -> None:
    # The init container may run a second time, if the node fails between the first and the agent.
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)


def _link_interpreter(folder: Path) -> None:
    """Put this interpreter where the pod's startup probe looks for one."""
    link = folder / names.PROBE_PROGRAM
    link.unlink(missing_ok=True)
    link.symlink_to(os.path.realpath(sys.executable))


def _fail(why: str) -> int:
    print(
        f"fiber agent: the credentials of this pod cannot be written: {why}. The operator "
        "sets this container up. Check the FiberPool's template for settings that prevent it.",
        file=sys.stderr,
    )
    return 1
