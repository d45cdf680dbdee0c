"""The dispatcher: gives the work of one pool to its workers and takes their results.

::

    caller's thread            loop's thread                     worker
    submit ─┐                                                      │
            ├─ ledger.assign ── send ────────────────────────────► │ run
    pump ───┘        ▲                                             │
                     └── ledger.receive ◄── heard ◄─────────────── │ answer
                               │
                               └─► sink.put, sink.end ──► results, iterators, callbacks

Who touches what: ``_ledger``, ``_crew``, ``_unsent`` and the flags are guarded by ``_lock``.  Work is
assigned under it by whichever thread found that there is some, and sent after it is released.
``heard``, ``recalled``, ``lost`` and ``_expired`` run on the loop's thread, which must not run any of
the user's code: a batch that pickles with it goes to the pump, values that unpickle with it stay
``Encoded``.  A batch that is assigned but not yet sent is in ``_unsent``: nobody can have run it.
"""

from __future__ import annotations

import pickle
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from fiber import reduction
from fiber._agent.port import ExitReport
from fiber._engine.chunks import Pace
from fiber._engine.ledger import Batch, Job, Ledger, Receipt, Span
from fiber._runtime.outcome import Encoded, Failure, outcomes
from fiber._runtime.pump import Pump
from fiber._runtime.requests import Call, Function, Request, Sink, encode, is_plain, name_of
from fiber._runtime.state import runtime
from fiber._runtime.workers import Crew, Link, dismiss
from fiber._transport.loop import Timer
from fiber._wire import packet, work
from fiber._wire.packet import Message
from fiber.errors import TimeoutError, WorkerDied
