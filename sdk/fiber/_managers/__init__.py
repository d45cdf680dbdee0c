"""Connections between a manager's proxies and its server, over Fiber's channels.

Proxies and managers are multiprocessing's classes.  They look up how to connect in a table of
multiprocessing, by the name of a serializer.  This package adds one entry to that table.  A process
that unpickles the address of a manager imports this package.
"""

from multiprocessing import managers as _mp

from fiber._managers.client import connect
from fiber._managers.server import ManagerListener

SERIALIZER = "fiber"

_mp.listener_client[SERIALIZER] = (ManagerListener, connect)  # type: ignore[attr-defined]
