"""Messages that this process has sent to other hosts, and that have not been confirmed yet.

A process goes on while a message is on its way to a channel of another host.  As in
multiprocessing, another process that sees a later action of this process must also find the
message.  So this process calls ``flush_all`` before it sends to a channel of its own host, closes
one, raises a counter, releases a lock, takes an item out of a bounded queue, forks, or makes a
request that changes an object of a hub.  The end of the process is seen after its messages, too:
its agent passes them on first.

An error that a signal's handler raises in the wait before a fork is printed, and does not stop the
fork: that is what Python does with errors of functions that run before a fork.
"""

from __future__ import annotations

import os
from typing import Protocol


class Sender(Protocol):
    """Sender whose messages may be on their way."""

    def flush(self) -> None:
        """Wait until its messages are confirmed, or the other host cannot be reached.

        It raises no error.
        """


unconfirmed: dict[tuple[Sender, int], None] = {}
"""Senders and numbers of the messages.  Callers look here first, as it is mostly empty."""


def flush_all(*, but: Sender | None = None) -> None:
    """Wait until the messages of all senders ``but`` one are confirmed."""
    for sender in {sender for sender, _ in unconfirmed.copy()}:
        if sender is not but:
            sender.flush()


os.register_at_fork(before=flush_all, after_in_child=unconfirmed.clear)
