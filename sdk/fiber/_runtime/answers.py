"""Messages of pool workers, checked before anything believes them.

A task can write to the channel of its own worker, by mistake or because it was taken over.  The
form of the messages is in ``fiber._wire.work``.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any, TypeAlias

from fiber._engine.ledger import WrongAnswer
from fiber._runtime.outcome import outcomes
from fiber._wire import work
from fiber._wire.packet import Message

Words: TypeAlias = tuple[Any, ...]
"""Content of a worker's message.  Results are (seq, offset, kept, seconds, values, mixed, size):
among the values, if they are mixed, are ``Pickled`` ones; ``size`` is that of the message."""

OTHER = object()
"""Mark in place of a result: the message is something else."""


def single(message: Message, seq: int) -> Any:
    """Return the result of the call that was sent alone as ``seq``, or OTHER."""
    try:
        number, offset, kept, _, values, odd = pickle.loads(message.payload)
        if number == seq and offset == 0 and kept is None and len(values) == 1:
            return outcomes(values, odd, message.buffers)[0] if odd else values[0]
    except Exception:  # any bytes may be there
        pass
    return OTHER


def read(message: Message) -> Words:
    """Read a message; anything but results stays as ``fiber._wire.work`` has it.

    Raises WrongAnswer for what no worker sends.  The message can be read again until its release.
    """
    try:
        words = pickle.loads(message.payload)
        if type(words[0]) is not int:
            if type(words) is tuple and _FORMS[words[0]](*words[1:]):
                return words
            raise ValueError("it has another form")
        seq, offset, kept, seconds, values, odd = words
        if (
            type(offset) is not int
            or offset < 0
            or not (kept is None or type(kept) is int)
            or type(seconds) is not float
            or not 0.0 <= seconds < math.inf
            or type(values) is not list
        ):
            raise ValueError("a field has an impossible value")
        size = len(message.payload)
        if odd:
            size += sum([buffer.nbytes for buffer in message.buffers])
            outcomes(values, odd, message.buffers)
        return seq, offset, kept, seconds, values, bool(odd), size
    except Exception as error:  # any bytes may be there
        raise WrongAnswer(f"it sent a malformed message ({error!r})") from None


_FORMS: dict[str, Callable[..., bool]] = {
    work.READY: lambda: True,
    work.INIT_FAILED: lambda text: type(text) is str,
    work.UNKNOWN: lambda seq: type(seq) is int,
    work.BROKEN: lambda seq, error: type(seq) is int and type(error) is bytes,
    work.UNREADABLE: lambda seq, error: type(seq) is int and type(error) is bytes,
}
