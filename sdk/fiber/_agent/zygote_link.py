"""Link of an agent to a zygote, the process that forks the agent's children."""

from __future__ import annotations

import os
import pickle
import subprocess
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from fiber._agent import zygote, zygote_process
from fiber._agent.child import StartRequest, lineage
from fiber._agent.preload import Imports
from fiber._transport.channels import Outbox, naming_the_limit
from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber._wire.memory_files import Blob

_QUIT_TIMEOUT = 10.0


class ZygoteLink:
    """Link of an agent to one zygote process."""

    def __init__(
        self,
        loop: Loop,
        progress_table: int,
        cleanup_directory: Callable[[], str | None],
        *,
        on_reply: Callable[[ZygoteLink, tuple[Any, ...]], None],
        on_exit: Callable[[ZygoteLink], None],
        imports: Imports | None,
        program: Blob | None = None,
        folder: str | None = None,
    ) -> None:
        """Start the zygote's process.

        ``imports``: as in ``zygote.Zygote``.  ``program``: files that the zygote unpacks to
        ``folder``, for its children.  ``on_reply`` gets the zygote's packets about children.
        ``on_exit`` is called once, and last: the zygote and its children are dead.  Both run on the
        loop thread.
        """
        self.program = program
        self.folder = folder
        self.retired = False
        """True once the zygote gets no further children."""
        self.children = 0
        """Number of children that the zygote has or was asked for."""
        self._on_reply = on_reply
        self._on_exit = on_exit
        self._loop = loop
        self._gone = threading.Event()
        self._has_replied = False
        self._asked: deque[int] = deque()
        """Children that the zygote has not answered for yet, in the order of its answers."""
        with naming_the_limit("starting the zygote"):
            fds = [os.dup(progress_table)]  # the outbox closes what it sends
            try:
                if program is not None:
                    fds.append(os.dup(program.fileno()))
                self._process, self._sock = zygote_process.launch()
            except BaseException:
                zygote.close_all(fds)
                raise
        self._sock.setblocking(False)
        self._outbox = Outbox(loop, self._sock)
        # The directory is made at the last moment: from here on the zygote removes it if the agent
        # is killed.
        setup = (zygote.SETUP, lineage(), imports, cleanup_directory(), folder)
        self._outbox.send(pickle.dumps(setup), fds=fds)
        loop.register(self._sock.fileno(), self._receive)

    def start(self, child: int, request: StartRequest, fds: list[int]) -> None:
        """Request a child that gets ``fds``, which this object closes."""
        self._asked.append(child)
        while len(fds) > packet.MAX_DESCRIPTORS:
            some, fds = fds[: packet.MAX_DESCRIPTORS], fds[packet.MAX_DESCRIPTORS :]
            self._outbox.send(pickle.dumps((zygote.DESCRIPTORS, child)), fds=some)
        self._outbox.send(pickle.dumps((zygote.START, child, tuple(request)), protocol=5), fds=fds)

    def retire(self) -> None:
        """End the zygote, which has no children, and request no more children from it."""
        self.retired = True
        self.send(zygote.QUIT)

    def send(self, *request: Any) -> None:
        """Send another request.  Runs on the loop thread, as ``start``."""
        self._outbox.send(pickle.dumps(request))

    def quit(self) -> None:
        """End the zygote and its children, and wait.  Must not be called on the loop thread."""
        if self._has_replied:
            self._loop.call_soon(self.send, zygote.QUIT)
            if not self._loop.running:
                self.send(zygote.QUIT)
        else:
            # The zygote has no child yet, and may import the program's main module for ever.
            self._process.kill()
        try:
            self._process.wait(_QUIT_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._loop.running:
            # The zygote's last packets report the ends of its children.
            self._gone.wait(_QUIT_TIMEOUT)
        else:
            self._outbox.close()
            self._sock.close()

    def _receive(self) -> None:
        try:
            reply = packet.loads(packet.receive(self._sock))
        except BlockingIOError:
            return
        except (EOFError, ConnectionError):
            self._loop.unregister(self._sock.fileno())
            self._outbox.close()
            self._sock.close()
            self._process.wait()
            self._on_exit(self)
            self._gone.set()
            return
        self._has_replied = True
        self._on_reply(self, self._completed(reply))

    def _completed(self, reply: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return ``reply`` with the child that it is about, if the zygote could not name it."""
        kind, child, *rest = reply
        if kind != zygote.EXITED and self._asked and child in (None, self._asked[0]):
            child = self._asked.popleft()
        return kind, child, *rest
