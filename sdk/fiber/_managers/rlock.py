"""The RLock of a manager: that of ``threading``, which can also be taken from its owner.

The thread of a dead client may wait in a queue for ever, with a lock that only it could release.
"""

from __future__ import annotations

import threading
from types import TracebackType

_acting = threading.local()


def act_as(owner: int) -> None:
    """Act as ``owner`` from now on: locks that this thread acquires belong to that owner."""
    _acting.owner = owner


def _me() -> int:
    owner: int = getattr(_acting, "owner", 0)
    return owner or threading.get_ident()


class RLock:
    """Reentrant lock with the methods of ``threading.RLock``."""

    def __init__(self) -> None:
        self._block = threading.Lock()
        self._mutex = threading.Lock()
        """Lock for the fields below.  A waiter never holds it."""
        self._owner: int | None = None
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Acquire the lock as in ``threading``."""
        me = _me()
        with self._mutex:
            if self._owner == me:
                self._count += 1
                return True
        if not self._block.acquire(blocking, timeout):
            return False
        with self._mutex:
            self._owner, self._count = me, 1
        return True

    def release(self) -> None:
        """Release the lock as in ``threading``."""
        with self._mutex:
            if self._owner != _me():
                raise RuntimeError("cannot release un-acquired lock")
            self._count -= 1
            if not self._count:
                self._owner = None
                self._block.release()

    def revoke(self, owner: int) -> bool:
        """Release it for the thread ``owner``, which has ended or as good as that; False if that
        has it not.
        """
        with self._mutex:
            if self._owner != owner:
                return False
            self._owner, self._count = None, 0
            self._block.release()
            return True

    def owned_by(self, owner: int) -> bool:
        """Tell whether ``owner`` holds the lock."""
        return self._owner == owner

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    # What threading.Condition asks of an RLock

    def _is_owned(self) -> bool:
        return self.owned_by(_me())

    def _release_save(self) -> int:
        count = self._count
        if not self.revoke(_me()):
            raise RuntimeError("cannot release un-acquired lock")
        return count

    def _acquire_restore(self, count: int) -> None:
        # Whoever acts for the same owner may have it meanwhile, if this wait was interrupted.
        self._block.acquire()
        with self._mutex:
            self._owner, self._count = _me(), count
        _acting.restored = count

    def undo_restore(self) -> None:
        """Release what this thread's last ``wait`` of a condition acquired."""
        with self._mutex:
            if self._owner != _me():
                return  # its client is gone, and it was revoked
            self._count -= _acting.restored
            if not self._count:
                self._owner = None
                self._block.release()


def condition(lock: object = None) -> threading.Condition:
    """A ``threading.Condition`` on such a lock."""
    return threading.Condition(RLock() if lock is None else lock)  # type: ignore[arg-type]
