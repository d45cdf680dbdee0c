"""Relay: a process in the cluster that both the agents and the master connect to.

A program on a laptop reaches the cluster, but pods do not reach the laptop.  Then the pool's
Service leads to the relay.  Agents connect to ``agents_port``, as they would connect to the master.
The master connects to ``master_port`` by a port-forward of the API server.  The relay carries the
bytes of each agent in a stream of its own over the master's connection (``multiplexer.py``).

The relay has no credentials.  TLS, proofs and sealed messages pass through it unread, so that a
relay in wrong hands can delay and break connections only.  ``master_port`` listens on the loopback
of the pod alone.  To reach it, an account needs the right to open port-forwards to the pod or to
run commands in it.

While there is no master, agents wait here, up to the bounds of ``Admission``.  They give up
and connect again by themselves.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping

from fiber._transport.acceptor import Admission
from fiber._transport.authentication import join_address
from fiber._transport.loop import Loop
from fiber._transport.multiplexer import Multiplexer, SocketCarrier
from fiber._wire.messages import ProtocolError
from fiber._wire.streams import StreamFrame, hello

_AGENTS_PORT, _MASTER_PORT = "FIBER_RELAY_AGENTS_PORT", "FIBER_RELAY_MASTER_PORT"

_BACKLOG = 1024
_TURN = 16
"""Connections accepted in one turn of the loop."""

_PAUSE = 0.2
"""Seconds without accepting after the process ran out of descriptors."""

_MOST_WAITING = 512
"""Agents that wait for a master, at most.  Half of them may come from one address.  The limit is
never more than a quarter of the descriptors that this process may have."""

_HELLO_WITHIN = 10.0
"""Seconds in which a master must have said which one it is."""

_MOST_NEWCOMERS = 64
"""Connections that have not said which master they are, at most."""


class Relay:
    """Relay of one pool.  Runs on the thread of ``loop``.

    Port 0 takes a free port; the attributes ``agents_port`` and ``master_port`` have the ports.
    """

    def __init__(
        self, loop: Loop, agents_port: int, master_port: int, log: Callable[[str], None]
    ) -> None:
        self._loop = loop
        self._log = log
        self._master: Multiplexer | None = None
        self._epoch = 0
        self._newcomers: dict[Multiplexer, None] = {}
        """Connections that have not said which master they are, or were refused; oldest first."""
        most = min(_MOST_WAITING, max(resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4, 2))
        self._admission = Admission(most, most // 2)
        self._waiting: dict[socket.socket, str] = {}
        """Agents that wait for a master, and their addresses."""
        self._spoken: set[socket.socket] = set()
        """Waiting agents that have sent something."""
        self._listeners: list[socket.socket] = []
        try:
            self._listen(_agents_listener(agents_port), self._add_agent)
            self._listen(socket.create_server(("127.0.0.1", master_port)), self._add_master)
        except BaseException:
            self.close()
            raise
        self.agents_port, self.master_port = (
            listener.getsockname()[1] for listener in self._listeners
        )

    def close(self) -> None:
        """Close all connections."""
        for listener in self._listeners:
            if listener.fileno() >= 0:
                self._loop.unregister(listener.fileno())
                listener.close()
        for one in (*self._newcomers, self._master):
            if one is not None:
                one.close()
        for sock in list(self._waiting):
            self._dismiss(sock)

    # -- Listeners

    def _listen(self, listener: socket.socket, take: Callable[[socket.socket, str], None]) -> None:
        listener.setblocking(False)
        self._listeners.append(listener)
        short = False

        def accept() -> None:
            nonlocal short
            for _ in range(_TURN):
                try:
                    sock, (host, port, *_) = listener.accept()
                except BlockingIOError:
                    return
                except OSError as error:
                    if not short:
                        self._log(
                            f"a connection could not be accepted: {error.strerror}. The relay "
                            "tries again all the time"
                        )
                    short = True
                    self._loop.unregister(listener.fileno())
                    self._loop.call_later(_PAUSE, resume)
                    return
                short = False
                with contextlib.suppress(OSError):
                    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                take(sock, join_address(host.removeprefix("::ffff:"), port))

        def resume() -> None:
            if listener.fileno() >= 0:
                self._loop.register(listener.fileno(), accept)

        resume()

    # -- Agents

    def _add_agent(self, sock: socket.socket, origin: str) -> None:
        if self._master is not None:
            self._master.open(sock, origin)
            return
        host = origin.rpartition(":")[0]
        admitted, leaves = self._admission.enter(sock, host, self._loop.now())
        if isinstance(leaves, socket.socket):
            self._dismiss(leaves)
        if not admitted:
            sock.close()
            return
        self._waiting[sock] = origin
        # Unread bytes stay with the kernel.  The loop notices an agent that has given up, unless it
        # has sent bytes.  Then it stays until there is a master, or until its place is needed.
        self._loop.register(sock.fileno(), lambda: self._look_at(sock))

    def _look_at(self, sock: socket.socket) -> None:
        if sock in self._spoken:  # its bytes are not waited for, so the connection is broken
            self._dismiss(sock)
            return
        try:
            peeked = sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            peeked = b""
        if not peeked:
            self._dismiss(sock)
        else:
            self._spoken.add(sock)
            self._loop.pause(sock.fileno())

    def _dismiss(self, sock: socket.socket) -> None:
        if sock in self._waiting:
            self._release(sock)
            sock.close()

    def _release(self, sock: socket.socket) -> str:
        """Stop watching an agent that waits; return its address."""
        self._spoken.discard(sock)
        self._admission.leave(sock)
        self._loop.unregister(sock.fileno())
        return self._waiting.pop(sock)

    # -- Masters

    def _add_master(self, sock: socket.socket, origin: str) -> None:
        newcomer: Multiplexer

        def take_hello(frame: StreamFrame) -> None:
            if self._take_hello(newcomer, frame):
                timer.cancel()

        def end(reason: str) -> None:
            timer.cancel()
            self._newcomers.pop(newcomer, None)
            if newcomer is self._master:
                self._master = None
                self._log(f"the connection to the master is gone: {reason}")

        def give_up() -> None:
            self._newcomers.pop(newcomer, None)
            newcomer.close()

        if len(self._newcomers) >= _MOST_NEWCOMERS:
            oldest = next(iter(self._newcomers))
            del self._newcomers[oldest]
            oldest.close()
        timer = self._loop.call_later(_HELLO_WITHIN, give_up)
        newcomer = Multiplexer(self._loop, SocketCarrier(sock), on_hello=take_hello, on_end=end)
        self._newcomers[newcomer] = None

    def _take_hello(self, newcomer: Multiplexer, frame: StreamFrame) -> bool:
        """Take a newcomer as the master, or refuse it; return whether it is the master now."""
        if newcomer is self._master:
            raise ProtocolError("the master said twice which one it is")
        try:
            content = frame.hello
            epoch, identity = int(content["epoch"]), str(content["identity"])
        except (ProtocolError, KeyError, TypeError, ValueError, OverflowError) as error:
            newcomer.send(hello(refused=f"the relay does not understand it: {error}"))
            return False
        if epoch < self._epoch:
            newcomer.send(hello(refused=f"the pool has a master with the epoch {self._epoch}"))
            return False
        self._newcomers.pop(newcomer, None)
        if self._master is not None:
            self._master.close()
        self._master, self._epoch = newcomer, epoch
        self._log(f"connected to the master {identity} with the epoch {epoch}")
        newcomer.send(hello())
        for sock in list(self._waiting):
            if _has_given_up(sock):
                self._dismiss(sock)
            else:
                newcomer.open(sock, self._release(sock))
        return True


def _has_given_up(sock: socket.socket) -> bool:
    """Tell whether an agent has closed its connection, also if it has sent bytes before."""
    poller = select.poll()
    poller.register(sock, select.POLLRDHUP)
    return bool(poller.poll(0))


def _agents_listener(port: int) -> socket.socket:
    """Return a listener on all addresses, of both IP families where the system has both."""
    if socket.has_dualstack_ipv6():
        with contextlib.suppress(OSError):  # the kernel has no IPv6
            return socket.create_server(
                ("", port), family=socket.AF_INET6, dualstack_ipv6=True, backlog=_BACKLOG
            )
    return socket.create_server(("", port), backlog=_BACKLOG)


def run(environment: Mapping[str, str]) -> int:
    """Relay until SIGTERM; return the exit status."""
    _raise_the_limit_of_descriptors()
    loop = Loop()
    try:
        agents_port, master_port = (
            _port(environment, name) for name in (_AGENTS_PORT, _MASTER_PORT)
        )
        relay = Relay(loop, agents_port, master_port, _print)
    except (ValueError, OSError) as error:
        print(f"fiber relay: it cannot begin: {_reason(error, environment)}", file=sys.stderr)
        loop.stop()
        return 1
    wake, woken = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(woken)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.call_soon(loop.stop))
    loop.register(wake, lambda: os.read(wake, 64))
    _print(f"listens at port {relay.agents_port} for agents, {relay.master_port} for the master")
    loop.run()
    relay.close()
    return 0


def _port(environment: Mapping[str, str], name: str) -> int:
    value = environment.get(name, "")
    if not value.isascii() or not value.isdecimal() or int(value) >= 1 << 16:
        raise ValueError(f"{name} is {value!r}. Set it to the number of a port, 0 to 65535")
    return int(value)


def _reason(error: ValueError | OSError, environment: Mapping[str, str]) -> str:
    if not isinstance(error, OSError):
        return str(error)
    wanted = ", ".join(f"{name}={environment[name]}" for name in (_AGENTS_PORT, _MASTER_PORT))
    return (
        f"it cannot listen ({wanted}): {os.strerror(error.errno or 0).lower()}. Choose ports that "
        "no other program uses, and that this user may bind"
    )


def _raise_the_limit_of_descriptors() -> None:
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _print(line: str) -> None:
    print(f"fiber relay: {line}", flush=True)
