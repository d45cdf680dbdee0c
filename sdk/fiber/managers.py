"""Managers as in multiprocessing; their server is a Fiber process that any process can reach.

The proxies, ``RemoteError``, ``Token`` and ``Namespace`` are multiprocessing's classes.

Differs from multiprocessing when a process is killed.  Objects to which only it referred are
dropped, and the locks that it held are released: the locks of a manager are Fiber's own.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import weakref
from collections.abc import Callable, Iterable
from multiprocessing import managers as mp_managers
from multiprocessing.context import ProcessError
from multiprocessing.managers import (
    BaseProxy,
    DictProxy,
    ListProxy,
    Namespace,
    RemoteError,
    Token,
    ValueProxy,
)
from multiprocessing.util import Finalize
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from fiber._hub import client as hub_client
from fiber._managers import SERIALIZER, client
from fiber._managers.asynchronous import AsyncBaseProxy, AsyncProxyResult
from fiber._managers.client import ManagerAddress
from fiber._managers.server import Server
from fiber._runtime.state import runtime
from fiber.connection import Connection, Pipe
from fiber.process import Process
from fiber.resources import Resources, largest, merged, resources_of, with_resources
from fiber.shared_memory import ShareableList, SharedMemory

if TYPE_CHECKING:
    from fiber.pool import Pool as _Pool

__all__ = [
    "AcquirerProxy",
    "ArrayProxy",
    "AsyncBaseProxy",
    "AsyncManager",
    "AsyncProxyResult",
    "AutoProxy",
    "BarrierProxy",
    "BaseManager",
    "BaseProxy",
    "ConditionProxy",
    "DictProxy",
    "EventProxy",
    "IteratorProxy",
    "ListProxy",
    "MakeProxyType",
    "Namespace",
    "NamespaceProxy",
    "PoolProxy",
    "ProcessError",
    "RemoteError",
    "SharedMemoryManager",
    "SyncManager",
    "Token",
    "ValueProxy",
]

_T = TypeVar("_T", int, float, bool, str, bytes, None)
_mp: Any = mp_managers  # typeshed has part of it
AcquirerProxy = _mp.AcquirerProxy
ArrayProxy = _mp.ArrayProxy
AutoProxy = _mp.AutoProxy
BarrierProxy = _mp.BarrierProxy
ConditionProxy = _mp.ConditionProxy
EventProxy = _mp.EventProxy
IteratorProxy = _mp.IteratorProxy
MakeProxyType = _mp.MakeProxyType
NamespaceProxy = _mp.NamespaceProxy
PoolProxy = _mp.PoolProxy
State = _mp.State


def _make_server(registry: Any, address: Any, authkey: bytes, serializer: str) -> Any:
    kind = Server if serializer == SERIALIZER else _mp.Server
    return kind(registry, address, authkey, serializer)


class BaseManager(mp_managers.BaseManager):
    """multiprocessing's manager, with its server in a Fiber process: on a cluster, in a pod.

    Without an ``address`` only processes of this program can use the manager and its proxies.  Send
    them ``address``, and they can ``connect``.  With an address the server has multiprocessing's
    listener there, and other programs can ``connect`` with the same ``authkey``.

    The server's process has the resources that ``fiber.meta`` wishes for the class, and at least
    the largest that it wishes for a registered callable.  ``pool`` names the FiberPool to use.
    """

    _Server = staticmethod(_make_server)

    if TYPE_CHECKING:  # attributes of multiprocessing's class that typeshed lacks
        _registry: dict[str, tuple[Callable[..., Any] | None, Any, Any, Any]]
        _state: Any
        _authkey: bytes
        _serializer: str
        _shutdown_timeout: float
        _Client: Any
        _process: Process
        _run_server: Callable[..., None]
        shutdown: Finalize

    def __init__(
        self,
        address: Any = None,
        authkey: bytes | None = None,
        serializer: str = "pickle",
        ctx: Any = None,
        *,
        shutdown_timeout: float = 1.0,
        pool: str | None = None,
    ) -> None:
        self._pool = pool
        self._starting: Connection | None = None
        self._session: client.ManagerSession | None = None
        if serializer == "pickle" and (address is None or isinstance(address, ManagerAddress)):
            serializer = SERIALIZER
        super().__init__(address, authkey, serializer, ctx, shutdown_timeout=shutdown_timeout)
        self._process_type = Process if ctx is None else ctx.Process

    @property
    def _address(self) -> Any:
        self._wait_for_server()
        return self._known_address

    @_address.setter
    def _address(self, address: Any) -> None:
        self._known_address = address

    def start(
        self, initializer: Callable[..., object] | None = None, initargs: Iterable[Any] = ()
    ) -> None:
        """Start the server's process.

        EOFError if its ``initializer`` raises.  On Kubernetes this does not wait for a pod.  The
        first use of the manager waits.
        """
        self._check_initial()
        if initializer is not None and not callable(initializer):
            raise TypeError("initializer must be a callable")
        reader, writer = Pipe(duplex=False)
        settings = self._registry, self._known_address, self._authkey, self._serializer
        process = self._process_type(
            target=with_resources(type(self)._run_server, self._wishes()),
            args=(*settings, writer, initializer, tuple(initargs)),
        )
        ident = ":".join(str(number) for number in process._identity)
        process.name = f"{type(self).__name__}-{ident}"
        self._process = process
        process.start()
        writer.close()
        self._starting = reader
        self._state.value = State.STARTED
        known: list[Any] = []
        self._tell = known.append
        self.shutdown = Finalize(
            self,
            type(self)._end,
            args=(process, known, self._authkey, self._state, self._Client, self._shutdown_timeout),
            exitpriority=0,
        )
        if not runtime().elastic:
            self._wait_for_server()

    def _wishes(self) -> Resources:
        makers = [make for make, *_ in self._registry.values() if make is not None]
        wishes = merged(largest(map(resources_of, makers)), resources_of(type(self)))
        return merged(wishes, Resources(pool=self._pool))

    def _wait_for_server(self) -> None:
        if self._starting is None:
            return
        reader = self._starting
        try:
            address = reader.recv()
        except EOFError:
            self._process.join()
            self._state.value = State.INITIAL
            raise
        self._known_address = address
        self._starting = None
        self._tell(address)
        reader.close()
        self._hold_session()

    def _hold_session(self) -> None:
        if self._serializer == SERIALIZER:
            self._session = client.session(self._known_address)
            process = getattr(self, "_process", None)
            if process is not None:
                self._session.process = weakref.ref(process)

    def connect(self) -> None:
        """Use the running server at the manager's address."""
        if self._known_address is None:
            raise ValueError("connect() needs the address of a running manager: pass address=")
        super().connect()
        self._hold_session()

    def _create(self, typeid: str, /, *args: Any, **kwds: Any) -> tuple[Token, Any]:
        token, exposed = _mp.BaseManager._create(self, typeid, *args, **kwds)
        if self._serializer == SERIALIZER:
            token = client.TravellingToken(token.typeid, token.address, token.id)
        return token, exposed

    def get_server(self) -> mp_managers.Server:
        """Return a server for this process, with ``serve_forever`` and ``address``."""
        self._check_initial()
        server: mp_managers.Server = self._Server(
            self._registry, self._address, self._authkey, self._serializer
        )
        return server

    def _check_initial(self) -> None:
        state = self._state.value
        if state == State.STARTED:
            raise ProcessError("Already started server")
        if state == State.SHUTDOWN:
            raise ProcessError("Manager has shut down")

    @staticmethod
    def _end(process: Process, known: list[Any], *rest: Any) -> None:
        """End the server: in ``shutdown``, at the program's end, or from the garbage collector."""
        if sys.is_finalizing():
            # Ctrl-C ended the exit functions.  The loop thread no longer runs, so no wait for the
            # server would end.  The server ends with the program.
            return
        if runtime().loop.on_thread():  # the loop must not wait for itself
            threading.Thread(target=BaseManager._end, args=(process, known, *rest)).start()
            return
        address = known[0] if known else None
        try:
            if address is None:
                process.terminate()
            _mp.BaseManager._finalize_manager(process, address, *rest)
        except BaseException:  # interrupted: the server may not know that it must end
            process.kill()
            raise
        if isinstance(address, ManagerAddress):
            client.forget(address)


class SharedMemoryManager(BaseManager):
    """Manager of named shared memory, which it removes when it is shut down.

    Its methods raise RuntimeError in a process that is not on the host of the manager's server.
    """

    def SharedMemory(self, size: int) -> SharedMemory:
        """Return a new block of ``size`` bytes; ValueError if the manager does not run."""
        names = self._names()
        memory = SharedMemory(create=True, size=size)
        names.append(memory.name)
        return memory

    def ShareableList(self, sequence: Iterable[_T] | None) -> ShareableList[_T]:
        """Return a new list; ValueError if the manager does not run."""
        names = self._names()
        made: ShareableList[_T] = ShareableList(sequence)
        names.append(made.shm.name)
        return made

    def _names(self) -> Any:
        if self._state.value != State.STARTED:
            raise ValueError("the manager does not run: start it, or use it in a with statement")
        names: Any = self._memory_names()  # type: ignore[attr-defined]  # registered below
        host = names.host()
        if host != hub_client.host():
            raise RuntimeError(
                f"the manager runs on host {host!r} and this process on {hub_client.host()!r}: "
                "named shared memory is for the processes of one host. Use fiber.Array or "
                "fiber.RawArray, whose memory is freed with its last user"
            )
        return names


class _MemoryNames:
    """Names that the server of a SharedMemoryManager removes when it ends."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def host(self) -> str:
        """Return the host of the server."""
        return hub_client.host()

    def append(self, name: str) -> None:
        """Add a name to remove."""
        if not self._names:
            Finalize(None, _unlink_all, (self._names,), exitpriority=10)
        self._names.append(name)


def _unlink_all(names: list[str]) -> None:
    for name in names:
        with contextlib.suppress(FileNotFoundError):
            memory = SharedMemory(name)
            memory.close()
            memory.unlink()


_names = _MemoryNames()


def _memory_names() -> _MemoryNames:
    return _names


SharedMemoryManager.register("_memory_names", _memory_names, exposed=("append", "host"))


class SyncManager(BaseManager, mp_managers.SyncManager):
    """A manager of lists, dicts, queues, locks and all other types that multiprocessing has."""

    if TYPE_CHECKING:
        Pool: ClassVar[type[_Pool]]  # type: ignore[assignment]  # it takes Fiber's options


def _pool(*args: Any, **options: Any) -> Any:
    from fiber.pool import Pool

    return Pool(*args, **options)


class AsyncManager(BaseManager):
    """A manager whose objects' methods return an ``AsyncProxyResult`` at once.

    Objects of different managers work in parallel.  Objects of one manager work in threads of its
    process.  The manager's method that makes an object waits until the object exists.  The class
    registers no types.  Other programs cannot connect to it.
    """

    def __init__(self, address: ManagerAddress | None = None, **options: Any) -> None:
        super().__init__(address, **options)
        if self._serializer != SERIALIZER:
            raise ValueError(
                f"an AsyncManager cannot serve at {address!r} or by serializer "
                f"{self._serializer!r}: leave them out, or use BaseManager"
            )

    @classmethod
    def register(
        cls, typeid: str, callable: Any = None, proxytype: Any = None, *args: Any, **options: Any
    ) -> None:
        """Register a type as ``BaseManager.register`` does; proxies are ``AsyncBaseProxy``."""
        super().register(typeid, callable, proxytype or AsyncBaseProxy, *args, **options)


_, _exposed, _typeids, _proxytype = _mp.SyncManager._registry["Pool"]
SyncManager.register("Pool", _pool, _proxytype, _exposed, _typeids, create_method=False)
