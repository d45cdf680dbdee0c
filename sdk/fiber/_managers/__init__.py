"""Connections between a manager's proxies and its server, over Fiber's channels.

Proxies and managers are multiprocessing's own.  How they connect they look up in a table there,
by the name of a serializer; this adds one more.  Whoever unpickles an address imports this.
"""

from multiprocessing import managers as _mp

from fiber._managers.client import connect
from fiber._managers.door import Door

SERIALIZER = "fiber"

_mp.listener_client[SERIALIZER] = (Door, connect)  # type: ignore[attr-defined]
