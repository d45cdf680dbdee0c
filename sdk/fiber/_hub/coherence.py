"""When memory of another host, of which this host has a copy, is made to agree with it.

``release`` before this process says anything that others may take as news of what it wrote: before
a message, the release of a lock, the setting of an event, its end.  ``acquire`` after it has heard
such a thing.  A process that uses no memory of another host has nothing to do in either.
"""

from __future__ import annotations


def release() -> None:
    """What this process wrote before is there for whoever hears of it."""


def acquire() -> None:
    """What others wrote before this process heard of it is there."""
