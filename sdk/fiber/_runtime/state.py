"""Process-wide state of Fiber: the loop, the backend, the hub.

The first process, pool or shared handle makes it, and it ends at interpreter exit.  A process that
was forked without Fiber (``os.fork``, multiprocessing) has none, and makes one when it needs it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import sys
import threading
import weakref
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import process as mp_process
from multiprocessing import spawn, util
from typing import TYPE_CHECKING, Any

from fiber import _config_sources, _logs, config, reduction
from fiber._agent import child
from fiber._agent.interface import ChildHandle, ChildSpec
from fiber._backends.main_module import main_file
from fiber._engine.activity import Activity
from fiber._hub import client as hub_client
from fiber._hub.handles import collecting_grants
from fiber._hub.hub import Hub
from fiber._monitor.server import AnswerLines, MonitorServer
from fiber._output_files import program_name, usable
from fiber._runtime import start_methods
from fiber._runtime.children import Child, ChildOwner, Children
from fiber._runtime.pool_state import WatchedPool
from fiber._transport.channels import naming_the_limit
from fiber._transport.loop import Loop
from fiber._wire.memory_files import Blob
from fiber.errors import FiberError, StartError
from fiber.resources import resources_of

if TYPE_CHECKING:
    from fiber._agent.interface import Backend
    from fiber._backends.shipping import PackedProgram, Shipping
    from fiber._runtime.dashboard import DashboardProcess
    from fiber._runtime.metrics import MetricsServer
    from fiber._runtime.records import RecordReader
    from fiber._runtime.timeline import TimelineAtEnd

_WORTH_SHARING = 1 << 16
"""Bytes of a pickle from which on it is sent once for all processes."""

_EXIT_PRIORITY = -100  # after multiprocessing has ended daemons and joined the other children


class Runtime:
    """State of a program that runs processes: one loop thread and one backend."""

    def __init__(self) -> None:
        self.config = _usable(config.current())
        _logs.show(self.config.log_level)
        child.write_whole_lines()
        self.loop = Loop()
        self.host = child.host or "local"
        self.hub: Hub | None = None
        self.activity = Activity(self.loop.now())
        """Record of what the children did."""
        self.children = Children(self.activity, self.loop.now)
        self.pools: weakref.WeakSet[WatchedPool] = weakref.WeakSet()
        """Executors with workers.  Only the loop thread adds and removes them."""
        self.timeline: TimelineAtEnd | None = None
        """Timeline that is written at the end of the program."""
        self._monitor: MonitorServer | None = None
        self.metrics: MetricsServer | None = None
        """Server of the program's metrics, if it was asked for."""
        self._dashboard: DashboardProcess | None = None
        self._news: _logs.OutputWriter | None = None
        self._can_be_watched = not child.host
        """True until the loop has opened the monitor, or has found that it cannot."""
        self._records: RecordReader | None = None
        """Reader of the children's log records, if they were asked for."""
        try:
            self._records = self._make_records()
            self.hub = self._make_hub()
            self.backend: Backend = _make_backend(self)
            self._shipping = _make_shipping(self.backend)
            reduction.readers_lack_main(not self.backend.same_host and main_file() is None)
            self.loop.start_thread("fiber-io")
            self._serve_metrics()
            _logs.debug("%s on host %s", type(self.backend).__name__, self.host)
        except BaseException:
            self._close_hub()
            self.loop.stop()
            self._close_records()
            raise

    def _serve_metrics(self) -> None:
        """Serve the metrics, if this process is a program."""
        if self.config.metrics_port is None or not _is_program():
            return
        from fiber._runtime import metrics  # rarely needed

        def sample() -> metrics.ProgramSample:
            return metrics.take_sample(self.activity, self.children, self.pools, self.loop.now())

        self.metrics = metrics.serve(self.config, self.loop, sample, self.backend.name)

    def _make_records(self) -> RecordReader | None:
        if self.config.log_records is None:
            return None
        from fiber._runtime import records  # it imports logging

        return records.reader_for(self.config.log_records)

    def _record_calls(self) -> list[Any]:
        """Return the call that makes a child send its log records, if they were asked for."""
        if self._records is not None:
            return list(self._records.calls())
        if self.config.log_records is None:
            return []
        from fiber._runtime import records

        return list(records.passed_on())

    def _output_calls(self) -> list[Any]:
        """Return the call that makes a child of this host keep its output, if that is wanted."""
        folder = self.config.log_to
        if folder is None or not self.backend.same_host:
            return []
        from fiber._agent import output_tee

        passed = (
            output_tee.passed if child.host else (folder, program_name(), self.config.log_times)
        )
        return [] if passed is None else [(output_tee.install, passed)]

    def _close_records(self) -> None:
        if self._records is not None:
            self._records.close()

    def _make_hub(self) -> Hub | None:
        # One hub for each host: a process that Fiber started uses its agent's.
        if hub_client.inherited_address() is not None:
            return None
        return Hub(self.loop, self.host, self.config.runtime_directory)

    def _close_hub(self) -> None:
        if _runtime is None:  # otherwise another runtime has the hub of this process
            hub_client.set_local_hub(None)
        if self.hub is not None:
            self.hub.close()

    @property
    def elastic(self) -> bool:
        """True if hosts are made for new processes."""
        return self.backend.elastic

    def start(
        self,
        process: mp_process.BaseProcess,
        owner: ChildOwner,
        *,
        tasks: bool = False,
        method: str = "fork",
        shared: SharedArguments | None = None,
    ) -> ChildHandle:
        """Start ``process`` as a child, and return at once; ``tasks`` makes it a pool worker.

        ``shared``: the arguments of ``process``, if several processes have them.

        The loop calls the owner's ``begin`` first, and then reports what happens to the child.  An
        error in pickling is raised here.  If the caller is interrupted, either no child starts, or
        ``begin`` is called, before any request that the caller makes later.
        """
        same_host = self.backend.same_host
        preparation, program = self._preparation(process, anew=not tasks)
        arguments = None if shared is None else shared.blob(same_host=same_host)
        if arguments is not None:
            process._args = ()  # type: ignore[attr-defined]  # they go beside it
        with collecting_grants(reusable=False) as grants:
            payload, fds = reduction.dump_process(process, same_host=same_host)
        observer = Child(self.children, owner, grants)
        spec = ChildSpec(
            name=process.name,
            method=method,
            preparation=preparation,
            payload=payload,
            fds=tuple(fds),
            tasks=tasks,
            executable=spawn.get_executable() if same_host else None,
            program=program and program.archive,
            arguments=arguments,
            resources=resources_of(getattr(process, "_target", None) or process.run),
        )
        made = self.backend.child(spec, observer)
        if self._can_be_watched:
            self.loop.call_soon(self._listen_to_monitors)
        self.loop.call_soon(observer.begin, made)
        return made

    def _listen_to_monitors(self) -> None:
        """Open the socket of the monitor, with the first child.  A program runs without it, too.

        Runs on the loop thread: once that has ended, nothing makes the hub's directory again.
        """
        if self.hub is None or not self._can_be_watched:
            return
        self._can_be_watched = False
        try:
            address = self.hub.address_or_problem if self._cleans_up() else self.hub.known_address
            if address is not None and (directory := os.path.dirname(address.path)):
                name = program_name()
                self._monitor = MonitorServer(self.loop, directory, name, self._answer_monitor)
            if self.config.dashboard and _is_program():
                self._open_dashboard()
        except (OSError, FiberError) as error:
            _logs.debug("this program cannot be watched: %s", error)
            if self.config.dashboard and _is_program():
                self._news = _logs.OutputWriter()
                self._news.write("fiber", f"this program has no dashboard: {error}")

    def _open_dashboard(self) -> None:
        from fiber._runtime.dashboard import DashboardProcess  # rarely needed
        from fiber._runtime.monitoring import program_facts

        if self._monitor is None:
            raise FiberError("this process has no directory for its socket")
        name = program_facts()["name"]
        self._dashboard = DashboardProcess(self.loop, self._monitor.path, name)

    def _cleans_up(self) -> bool:
        """Return whether the hub's directory goes when this program is killed.

        Zygotes and agents of this host remove it, or the process of the dashboard, or it goes with
        the pod of the program.
        """
        return not self.elastic or self.config.dashboard or "KUBERNETES_SERVICE_HOST" in os.environ

    def _answer_monitor(self, request: dict[str, Any]) -> Iterator[AnswerLines]:
        from fiber._runtime.monitoring import Monitor  # rarely needed

        monitor = Monitor(
            self.loop, self.activity, self.children, self.pools, self.backend.name, self.config
        )
        return monitor.answer(request)

    def _preparation(self, process: Any, *, anew: bool) -> tuple[bytes, PackedProgram | None]:
        """Return the preparation data of a child, and its files; ``anew`` as in ``Shipping``."""
        data = self._spawn_data(f"process {process.name!r}")
        data["authkey"] = bytes(data["authkey"])
        # A child's children run on its host.
        data["calls"] = [
            (_config_sources.keep, (pickle.dumps(replace(self.config, backend="local")),)),
            (start_methods.inherit, (start_methods.chosen, start_methods.preload)),
            *self._record_calls(),
            *self._output_calls(),
        ]
        if self.backend.same_host:
            data["environ"] = dict(os.environb)
            data["preload"] = [*start_methods.preload, *_modules_of(process)]
        else:
            data["preload"] = ["cloudpickle", *start_methods.preload, *_modules_of(process)]
        program = None
        if self._shipping is not None:
            program = self._shipping.program(data, anew=anew)
            data["program"] = program.paths
        return pickle.dumps(data), program

    def _spawn_data(self, who: str) -> dict[str, Any]:
        """Return the preparation data that multiprocessing gives every child."""
        # Under pdb the main module has no __spec__, which multiprocessing expects.
        vars(sys.modules["__main__"]).setdefault("__spec__", None)
        try:
            data = spawn.get_preparation_data("")
        except FileNotFoundError as error:
            reason = "this program's working directory was deleted. Change it by os.chdir() first"
            raise StartError(who, reason) from error
        del data["start_method"], data["name"]
        if reduction.main_is_out_of_reach():
            data.pop("init_main_from_name", None)
            data.pop("init_main_from_path", None)
        return data

    def look_at_program(self) -> None:
        """Send the program's files as they are now to the children that start from now on."""
        if self._shipping is not None:
            self._shipping.program(self._spawn_data("a pool"), anew=True)

    def read_activity(self) -> dict[str, Any]:
        """Return a snapshot of the activity.  Runs on any thread."""
        from fiber._runtime.activity_reading import read_activity  # rarely needed

        return read_activity(self.loop, self.activity, self.children)

    def end(self) -> None:
        """Close, and write the timeline if there is to be one."""
        if self.timeline is None:
            self.close()
        else:
            with self.timeline.writing(self.read_activity):
                self.close()

    def close(self) -> None:
        """End every child, agent and thread.  Runs on any thread but the loop's."""
        _logs.debug("ending all processes and agents")
        with contextlib.ExitStack() as parts:  # each ends, also if Ctrl-C comes meanwhile
            parts.callback(self._close_hub)
            parts.callback(self._close_records)
            if self._monitor is not None:
                parts.callback(self._monitor.close)
            if self._news is not None:
                parts.callback(self._news.close)
            parts.callback(self.loop.stop)
            if self.metrics is not None:
                parts.callback(self.metrics.close)
            parts.callback(self.backend.close)
            if self._dashboard is not None:
                parts.callback(self._dashboard.close)

    def forget(self) -> None:
        """Close what a forked copy of this process must not hold."""
        if self._dashboard is not None:
            self._dashboard.forget()
        if self._monitor is not None:
            with contextlib.suppress(OSError):
                self._monitor.forget()
        if self.metrics is not None:
            with contextlib.suppress(OSError):
                self.metrics.forget()
        if self._records is not None:
            self._records.forget()


class SharedArguments:
    """Arguments that several processes share, pickled when the first one starts.

    If several threads start processes at once, each may pickle them: equal bytes are one blob.
    """

    def __init__(self, args: tuple[Any, ...]) -> None:
        self.args = args
        self._blob: Blob | None = None
        self._tried = False

    def blob(self, *, same_host: bool) -> Blob | None:
        """Return their pickle; None if each process gets a separate pickle."""
        if not self._tried:
            data = reduction.dump_shared(self.args, same_host=same_host)
            if data is not None and len(data) >= _WORTH_SHARING:
                self._blob = Blob(data)
            self._tried = True
        return self._blob


def _make_backend(runtime: Runtime) -> Backend:
    from fiber._agent.agent import LocalBackend

    loop, hub, settings = runtime.loop, runtime.hub, runtime.config
    if not _may_link:
        return LocalBackend(loop, runtime.host, hub)
    if hub is not None and settings.backend == "loopback":
        from fiber._backends.loopback import LoopbackBackend

        return LoopbackBackend(loop, hub, settings)
    if hub is not None and (settings.backend == "kubernetes" or _is_on_cluster(settings)):
        from fiber._backends.kubernetes.backend import KubernetesBackend

        return KubernetesBackend(loop, hub, settings)
    return LocalBackend(loop, runtime.host, hub)


def _make_timeline(path: str | None) -> TimelineAtEnd | None:
    if path is None:
        return None
    from fiber._runtime.timeline import timeline_at_end  # few programs want one

    return timeline_at_end(path)


def _usable(settings: config.Config) -> config.Config:
    """Return settings without a folder for output that cannot be written to, after a warning."""
    if settings.log_to is None or child.host:  # children write where the program says
        return settings
    return replace(settings, log_to=usable(settings.log_to))


def _is_on_cluster(settings: config.Config) -> bool:
    """Tell whether a program that chose no backend runs in a pod that may make others."""
    if settings.backend != "auto" or "KUBERNETES_SERVICE_HOST" not in os.environ:
        return False
    from fiber._backends.kubernetes.backend import serves_pools

    return serves_pools(settings.namespace)


def _make_shipping(backend: Backend) -> Shipping | None:
    if not backend.sends_program:
        return None
    from fiber._backends.shipping import Shipping

    return Shipping()


def _modules_of(process: Any) -> list[str]:
    """Return the modules that the zygote may import for all children."""
    target = getattr(process, "_target", None)
    names = {type(process).__module__, str(getattr(target, "__module__", ""))}
    names = {name for name in names if not name.startswith("fiber._runtime.")}  # not for children
    return sorted(names & sys.modules.keys() - {"__main__"}) + [
        name for name in _OURS if name in sys.modules
    ]


_OURS = (
    "fiber.connection",
    "fiber.queues",
    "fiber.synchronize",
    "fiber._agent.output_tee",
    "fiber._agent.records",
    "fiber._agent.worker",
)


_lock = threading.RLock()  # a finalizer may ask for the runtime while it is made
_runtime: Runtime | None = None
_may_link = True
"""True if this process may have agents on other hosts.  Their links need nng, which aborts in a
forked copy of a process that has used it.  Such a copy runs its processes on its host."""
_is_copy = False
"""True in a forked copy of a program."""


def _is_program() -> bool:
    """Return whether this process is a program, and no process or copy of one.

    Only a program has a dashboard, metrics and a timeline.
    """
    return not child.host and not _is_copy and mp_process.parent_process() is None


def runtime() -> Runtime:
    """Return the runtime of this process; the first call makes it."""
    if _runtime is None:
        with _lock:
            if _runtime is None:
                with naming_the_limit("starting Fiber"):
                    _make()
    assert _runtime is not None
    return _runtime


def _make() -> None:
    global _runtime
    made = None
    try:
        made = Runtime()
        if _runtime is None:  # else a finalizer has made one
            hub_client.set_local_hub(made.hub)
            made.timeline = _make_timeline(made.config.timeline) if _is_program() else None
            util.Finalize(None, shutdown, exitpriority=_EXIT_PRIORITY)
            _runtime = made
    finally:
        if made is not None and made is not _runtime:  # or the making was interrupted
            made.close()


def shutdown() -> None:
    """End the runtime and all processes that it started; the next use makes a new one."""
    global _runtime
    with _lock:
        ending, _runtime = _runtime, None
    if ending is not None:
        ending.end()


def read_activity() -> dict[str, Any]:
    """Return a snapshot of the program's activity, also before anything was started."""
    running = _runtime
    if running is not None:
        return running.read_activity()
    from fiber._runtime.activity_reading import no_activity

    return no_activity()


def _forget() -> None:
    """Forget the runtime after a fork without Fiber: the loop thread is not in the copy."""
    global _runtime, _lock, _may_link, _is_copy
    if _runtime is not None:
        _runtime.forget()
    _runtime, _lock = None, threading.RLock()
    _is_copy = True
    _may_link = _may_link and "fiber._transport.nng" not in sys.modules


os.register_at_fork(after_in_child=_forget)
hub_client.set_hub_starter(runtime)
config.guard(lambda: _runtime is not None)
