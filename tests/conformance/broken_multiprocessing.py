"""A module under test with one fault, so that the harness can be seen to find it.

``$BROKEN`` chooses what ``SimpleQueue.close`` does: hang, crash, or leave (a process behind).
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.queues
import os
import subprocess
import sys
import threading
from multiprocessing import *  # noqa: F403 - it is multiprocessing but for one method


class SimpleQueue(multiprocessing.queues.SimpleQueue):  # type: ignore[no-redef, type-arg]
    """The standard one with a fault in close."""

    def __init__(self) -> None:
        super().__init__(ctx=multiprocessing.get_context())

    def close(self) -> None:
        match os.environ["BROKEN"]:
            case "hang":
                for lock in (self._rlock, self._wlock):  # type: ignore[attr-defined]
                    print("semaphore", lock._semlock.name, flush=True)
                threading.Event().wait()
            case "crash":
                os._exit(3)
            case "leave":
                # A separate session, as a daemon has it: no signal to the group reaches it.
                script = "import threading; threading.Event().wait()"
                subprocess.Popen([sys.executable, "-c", script], start_new_session=True)
        super().close()
