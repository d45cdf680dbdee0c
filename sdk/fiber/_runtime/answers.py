"""Messages of pool workers, checked before anything believes them.

A task can write to the channel of its own worker, by mistake or because it was taken over.  Their
form is in ``fiber._wire.work``.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from fiber._engine.ledger import WrongAnswer
from fiber._runtime.outcome import outcomes
from fiber._wire import work
from fiber._wire.packet import Message

Words: TypeAlias = tuple[Any, ...]


class Results(NamedTuple):
    """Results of the batch ``seq``, its tasks from ``offset`` on."""

    seq: int
    offset: int
    kept: int | None
    seconds: float
    values: list[Any]
    """Plain values; what is not plain is ``Pickled``."""
    mixed: bool
    """Whether any is."""
    size: int
    """Bytes of the message."""

    def is_single(self, seq: int) -> bool:
        """Whether they are the result of a call that was sent alone as ``seq``."""
        return self.seq == seq and not self.offset and self.kept is None and len(self.values) == 1


def read(message: Message) -> Results | Words:
    """Read a message; anything but results stays as ``fiber._wire.work`` has it.

    Raises WrongAnswer for what no worker sends.  The message can be read again until its release.
    """
    size = len(message.payload) + sum([buffer.nbytes for buffer in message.buffers])
    try:
        words = pickle.loads(message.payload)
        if type(words[0]) is int:
            return _results(message.buffers, size, *words)
        if type(words) is tuple and _FORMS[words[0]](*words[1:]):
            return words
    except Exception as error:  # any bytes may be there
        raise WrongAnswer(f"it sent a malformed message ({error!r})") from None
    raise WrongAnswer("it sent a malformed message")


def _results(
    buffers: list[memoryview],
    size: int,
    seq: int,
    offset: int,
    kept: int | None,
    seconds: float,
    values: list[Any],
    odd: Any,
) -> Results:
    if (
        type(offset) is not int
        or offset < 0
        or not (kept is None or type(kept) is int)
        or type(seconds) is not float
        or not 0 <= seconds < math.inf
        or type(values) is not list
    ):
        raise ValueError("a field has an impossible value")
    if odd:
        outcomes(values, odd, buffers)
    return Results(seq, offset, kept, seconds, values, bool(odd), size)


_FORMS: dict[str, Callable[..., bool]] = {
    work.READY: lambda: True,
    work.INIT_FAILED: lambda text: type(text) is str,
    work.UNKNOWN: lambda seq: type(seq) is int,
    work.BROKEN: lambda seq, error: type(seq) is int and type(error) is bytes,
    work.UNREADABLE: lambda seq, error: type(seq) is int and type(error) is bytes,
}
