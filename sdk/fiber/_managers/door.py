"""Where processes that want to talk to a manager's server knock, and how they find it."""

from __future__ import annotations

import os
from multiprocessing.process import current_process
from typing import Any, NamedTuple

from fiber._hub import handles
from fiber._hub.handles import GrantSet, HubHandle
from fiber._hub.local import LocalChannel
from fiber._hub.protocol import ObjectKind
from fiber._transport.base import Channel
from fiber._wire import packet


class ManagerAddress(NamedTuple):
    """What ``manager.address`` is where none was chosen: any process of the program may use it.

    Whoever has it may use every object of the manager, so it is not shown.
    """

    server: str
    """The process, in words."""
    door: HubHandle

    def __repr__(self) -> str:
        return f"<address of {self.server}>"


class Door:
    """A manager's Listener: a channel of which the hub lets in whoever has the address."""

    def __init__(self, address: object = None, backlog: int = 0) -> None:
        self._inbox, outbox = LocalChannel.pair()
        self._grants = GrantSet()
        handle = self._grants.for_local(ObjectKind.CHANNEL, outbox.fileno())
        outbox.close()
        self.address = ManagerAddress(
            f"manager {current_process().name!r} (pid {os.getpid()} on host {handle.home.host!r})",
            handle,
        )

    def accept(self) -> Channel:
        """The end of a channel that the next client keeps the other end of."""
        while True:
            message = self._inbox.recv()
            try:
                channel: Channel = packet.loads(message)
            except Exception:  # the client is gone already
                continue
            return channel

    def close(self) -> None:
        """Nobody can come in any more."""
        self._grants.release()
        self._inbox.close()


def knock(address: ManagerAddress) -> Any:
    """The channel on which a client is let in; ``Unreachable`` if its manager is gone."""
    return handles.channel(address.door)
