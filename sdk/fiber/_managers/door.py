"""Inbox of a manager's server for new clients, and its address."""

from __future__ import annotations

import errno
import os
import pickle
import struct
import time
from multiprocessing.process import current_process
from typing import Any, NamedTuple

from fiber._hub import handles
from fiber._hub.handles import GrantSet, HubHandle
from fiber._hub.local import LocalChannel
from fiber._hub.protocol import ObjectKind
from fiber._transport.base import Channel

NUMBER = struct.Struct("<Q")
"""Before each call on a line: its number, which its answer has, too.  Numbers that a line skips are
of calls that were interrupted as they were sent.
"""

TAKE_BACK = "take_back"
"""Asked of the server by whoever was interrupted: that others get what the last call got."""

_UNTIL_FILES_CLOSE = 0.05
"""Seconds between attempts of a process that may open no more files."""


class ManagerAddress(NamedTuple):
    """Value of ``manager.address`` where none was chosen.  Any process of the program may use it.

    Whoever has it may use every object of the manager, so it is not shown.
    """

    server: str
    """The process, in words."""
    door: HubHandle

    def __repr__(self) -> str:
        return f"<address of {self.server}>"


class Door:
    """Listener of a manager: a channel that every process with the address may reach."""

    def __init__(self, address: object = None, backlog: int = 0) -> None:
        self._inbox, outbox = LocalChannel.pair()
        self._grants = GrantSet()
        handle = self._grants.for_local(ObjectKind.CHANNEL, outbox.fileno())
        outbox.close()
        self.address = ManagerAddress(
            f"manager {current_process().name!r} (pid {os.getpid()} on host {handle.home.host!r})",
            handle,
        )

    def accept(self) -> tuple[str, str, Channel]:
        """Return the next client: a word, its name, and the end of a channel to it."""
        invitation: tuple[str, str, Channel] = received(self._inbox)
        return invitation

    def close(self) -> None:
        """Admit no more clients."""
        self._grants.release()
        self._inbox.close()


def received(channel: Channel) -> Any:
    """The next thing said on a channel; left out is what came from who has gone by now."""
    while True:
        said = channel.recv().tobytes()
        while True:
            try:
                return pickle.loads(said)
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    break
                time.sleep(_UNTIL_FILES_CLOSE)  # who sent it waits for an answer
            except Exception:
                break


def knock(address: ManagerAddress) -> Any:
    """The channel on which a client is let in; ``Unreachable`` if its manager is gone."""
    return handles.channel(address.door)
