"""Blocking socket to a port of a pod, through a port-forward of the API server."""

from __future__ import annotations

import select
import socket
import threading

from fiber._backends.kubernetes.port_forward import PortForward

_PIECE = 64 << 10
_FULL = 256 << 10
"""Bytes that the port-forward has left to send, above which the socket is not read."""


def open_socket(forward: PortForward) -> socket.socket:
    """Return a socket whose other end is ``forward``.  A thread moves the bytes."""
    near, far = socket.socketpair()
    pump = threading.Thread(target=_move, args=(forward, far), name="fiber-forward", daemon=True)
    pump.start()
    return near


def _move(forward: PortForward, sock: socket.socket) -> None:
    poller = select.poll()
    poller.register(forward.fileno(), select.POLLIN)
    poller.register(sock.fileno(), select.POLLIN)
    try:
        while True:
            ready = {fd for fd, _ in poller.poll()}
            if sock.fileno() in ready:
                data = sock.recv(_PIECE)
                if not data:
                    return
                forward.write(data)
            forward.flush()
            if not _pass_on(forward, sock):
                return
            waits = select.POLLOUT if forward.backlog else 0
            poller.modify(forward.fileno(), select.POLLIN | waits)
            poller.modify(sock.fileno(), 0 if forward.backlog > _FULL else select.POLLIN)
    except OSError:
        return  # the reader of the socket sees its end
    finally:
        forward.close()
        sock.close()


def _pass_on(forward: PortForward, sock: socket.socket) -> bool:
    """Pass on all bytes that have arrived; return False at the end."""
    while (piece := forward.receive()) is not None:
        if not piece:
            return False
        sock.sendall(piece)
    return True
