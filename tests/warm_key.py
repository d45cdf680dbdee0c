"""Key of a warm pool: signs for agents as their init containers do, for masters as the operator."""

from __future__ import annotations

from fiber._transport.credentials import (
    Certificate,
    Credentials,
    WarmCredentials,
    make_certificate,
)
from fiber_api import identity, signatures


class WarmKey:
    """Key of one warm pool, a new one unless ``key`` is given."""

    def __init__(self, key: str | None = None, uid: str = "pool") -> None:
        self.signer = signatures.pool_signer(key or identity.new_key(), uid)

    def agent(self, name: str, uid: str, epoch: int = 0) -> Credentials:
        """Return the credentials of an agent that serves no master below ``epoch``."""
        secret = identity.new_key()
        key = signatures.Signer(secret).public_key
        signature = self.signer.sign(signatures.agent_statement(name, uid, key)).hex()
        pool = self.signer.public_key.hex()
        return Credentials(name, uid, secret, pool=pool, signature=signature, epoch=epoch)

    def unsigned(self, certificate: Certificate | None = None) -> WarmCredentials:
        """Return the credentials of a master for which the operator has not signed yet."""
        return WarmCredentials(self.signer.public_key, certificate or make_certificate())

    def sign(self, credentials: WarmCredentials, epoch: int) -> bool:
        """Sign as the operator does; return what ``take_signature`` returns."""
        return credentials.take_signature(epoch, self.signature(epoch, credentials.certificate))

    def signature(self, epoch: int, certificate: Certificate) -> bytes:
        """Return the operator's signature for the master of ``epoch``."""
        return self.signer.sign(signatures.master_statement(epoch, certificate.hash))

    def master(self, epoch: int, certificate: Certificate | None = None) -> WarmCredentials:
        """Return the credentials of the master of ``epoch``."""
        credentials = self.unsigned(certificate)
        assert self.sign(credentials, epoch)
        return credentials
