"""Configuration of a program: one frozen object.

From the weakest source to the strongest: defaults, `[tool.fiber]` in the nearest
pyproject.toml upward from the working directory, environment variables (`FIBER_BACKEND` for
`backend`, and so on), `fiber.init()`. All four have the same keys, those of `Config`. An
unknown key or a value that does not fit raises ConfigError, with its source.

Variables `FIBER_AGENT_*` are not configuration: backends and pods set them for agents (see
`fiber.agent`).
"""

from __future__ import annotations

import itertools
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack, get_args

from fiber import _config_rules as rules
from fiber import _config_sources, resources
from fiber._config_types import Backend, LogLevel, PassOn, Progress, Relay
from fiber.errors import ConfigError

if TYPE_CHECKING:
    from fiber._config_types import ConfigKeywords

__all__ = ["Config", "current", "guard", "init", "install", "load", "use"]


_LABEL = "[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?"


def _key(default: Any, rule: rules.KeyRule, *, fixed: bool = False) -> Any:
    """Return the field of a key; `fixed`: read once, when the runtime starts."""
    return field(default=default, metadata={"rule": rule, "fixed": fixed})


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """Configuration of a program.  The signature has the type and default of each key.

    Keys marked * are read when the first process, pool, pipe, queue, event or semaphore is
    made, and cannot change after that. The others hold for objects that are made next.

    A key whose default is None accepts None, as if it were not given.

    backend*: where processes run. "local" starts them on this machine as children of the
        program. "loopback" starts them under agents, separate processes with encrypted nng
        links to the program, as on other machines. "kubernetes" runs them in pods, which
        Fiber's operator makes. "auto" is "kubernetes" in a pod whose service account may
        create FiberPools, if the cluster has this resource and a living operator for the
        namespace, and "local" everywhere else.
    agents*: number of agents that the loopback backend starts.
    processes_per_agent*: largest number of processes of one agent. When all agents are full,
        starting a process raises StartError. 0 means no limit.
    namespace*: the Kubernetes namespace of the program's FiberPools; None means the kubeconfig
        context's, or in a pod the pod's own.
    context*: the context of the kubeconfig to use; None means the current one, or in a pod the
        pod's service account.
    image*: the image that workers run; None means in a pod the program's own, elsewhere
        Fiber's worker image of this version.
    template*: additions and changes to the pods of workers: a pod template as in a Deployment
        ({"spec": …}), or the path of a YAML or JSON file with one. It is merged over Fiber's
        template as kubectl would do it, containers by their names. The container that runs the
        processes is called "worker".
    pool*: the name of an existing FiberPool to use instead of making one.
    processes_per_pod*: number of processes of one pod. The pod requests as many times the
        resources that `fiber.meta` wishes for each.
    cpu_request*: CPUs that one process requests without a wish of `fiber.meta`, in the same
        form: 0.5 or "500m"; 0 requests none.
    memory_request*: memory, likewise: 512 or "512Mi"; 0 requests none.
    shm*: the size of /dev/shm in each pod, as 2048 or "2Gi". It is added to the pod's request
        and limit of memory. None means the container runtime's default, mostly 64 MiB.
    node_selector*: labels of the nodes of all pods, as in `fiber.meta`, which adds to them.
    tolerations*: taints that these nodes may have, likewise.
    max_pods*: largest number of pods of one FiberPool of the program.
    pod_timeout*: seconds within which the first pod must start, with the download of its image;
        otherwise the wait for it ends with an error.
    idle_timeout*: seconds after which an idle pod is released.
    listen_host*: the address at which the program listens for agents. None means the loopback
        address for agents on this machine. For pods it means the address at which they reach
        the program, which Fiber finds out.
    listen_port*: the port at this address, for all agents of the program. 0 takes a free port.
        A range such as "9000-9009" takes the first free one: for several programs on one host.
    advertised_host*: the address that pods dial if it is not the one above, as behind NAT or
        port forwarding. The port is the same. None means the address above.
    relay*: whether pods connect to a relay, a pod that the program reaches through the API server:
        "always", "never", or "auto", which means if no pod reaches the program within seconds.
    pass_on*: whether agents pass large initial arguments, functions, broadcasts and program files
        on to each other, so that the program sends them to a few agents only: "always", "never",
        or "auto", which means on Kubernetes. Pods do it at port 7073. If they do not reach each
        other there, the program sends all copies.
    start_timeout: seconds that a process or an agent may take to start.
    heartbeat_interval*: seconds between two heartbeats of an agent.
    suspect_after*: seconds of silence after which an agent gets no new work.
    lost_after*: seconds of silence after which an agent counts as lost, and its tasks run
        elsewhere.
    retries: how many times a task runs again after its worker died.
    disruptions: how many times a task runs again after the cluster ended its worker, as by a drain
        or an eviction. That uses up no retry. If `retries` is 0, no task runs twice. It also bounds
        how often in a row a vector environment makes its environments again for that reason.
    log_level: the least severe level that is shown on stderr, in children, too, as by
        `fiber.log_to_stderr()`. "DEBUG" shows each start and end of workers, agents and links.
    progress: whether maps without `progress=` show their progress: "always", "never", or "auto",
        which means in a terminal or a notebook. They show it once they have run for half a second.
        Children do not.
    dashboard*: start the program's live page at its first process, and print the page's address.
        See `fiber dashboard`.
    timeline*: write the program's timeline at its end to this file. The suffix chooses the form, as
        in `fiber.timeline`. `%p` stands for the process id. If another program has written the file
        since this one began, this one adds its process id to the name. The program's processes
        write none. If it cannot be written, a line on stderr says why.
    metrics_port*: serve the program's metrics for Prometheus at this port of `metrics_host`. 0
        takes a free port, and prints the address. None serves none. It needs prometheus-client.
    metrics_host*: the address at which the metrics are served. In a pod, a scraper needs "0.0.0.0".
    log_to*: also write the output of each worker, and of each other process, to a separate file
        in this folder. See "Where is my print?" in the documentation.
    log_times*: put the time before each line of output of a process on another host, and before
        each line in the files of `log_to`.
    log_records*: the least severe level of `logging` records that children send to the program's
        handlers. None sends none.
    runtime_directory*: where Fiber makes its private directory for sockets and credentials.
        None means `tempfile.gettempdir()`. Choose a short path: paths of sockets have a limit.
    """

    backend: Backend = _key("auto", rules.choice(*get_args(Backend)), fixed=True)  # noqa: RUF009 - a field
    agents: int = _key(2, rules.whole(1), fixed=True)
    processes_per_agent: int = _key(0, rules.whole(0), fixed=True)
    namespace: str | None = _key(None, rules.word("the name of a namespace", _LABEL), fixed=True)
    context: str | None = _key(None, rules.word("the name of a context", r"\S(.*\S)?"), fixed=True)
    image: str | None = _key(None, rules.word("the name of an image"), fixed=True)
    template: str | Mapping[str, Any] | None = _key(None, rules.template(), fixed=True)
    pool: str | None = _key(None, rules.pool(), fixed=True)
    processes_per_pod: int = _key(1, rules.whole(1, 1024), fixed=True)
    cpu_request: float = _key(
        0.05, rules.amount("CPUs, as 0.5 or '500m'", resources.read_cpus, or_none=True), fixed=True
    )
    memory_request: int = _key(
        64,
        rules.amount("MiB, or a text as '512Mi'", resources.read_mebibytes, or_none=True),
        fixed=True,
    )
    shm: int | None = _key(
        None,
        rules.amount("MiB above 0, or a text as '2Gi'", resources.read_mebibytes, or_none=False),
        fixed=True,
    )
    node_selector: Mapping[str, str] | None = _key(None, rules.node_selector(), fixed=True)
    tolerations: Sequence[str | Mapping[str, Any]] | None = _key(
        None, rules.tolerations(), fixed=True
    )
    max_pods: int = _key(1000, rules.whole(1, 100_000), fixed=True)
    pod_timeout: float = _key(600.0, rules.seconds(), fixed=True)
    idle_timeout: float = _key(60.0, rules.seconds(), fixed=True)
    listen_host: str | None = _key(None, rules.word("a host name or address"), fixed=True)
    listen_port: int | str = _key(0, rules.ports(), fixed=True)
    advertised_host: str | None = _key(None, rules.word("a host name or address"), fixed=True)
    relay: Relay = _key("auto", rules.choice(*get_args(Relay)), fixed=True)  # noqa: RUF009 - a field
    pass_on: PassOn = _key("auto", rules.choice(*get_args(PassOn)), fixed=True)  # noqa: RUF009 - a field
    start_timeout: float = _key(60.0, rules.seconds())
    heartbeat_interval: float = _key(1.0, rules.seconds(), fixed=True)
    suspect_after: float = _key(5.0, rules.seconds(), fixed=True)
    lost_after: float = _key(15.0, rules.seconds(), fixed=True)
    retries: int = _key(3, rules.whole(0))
    disruptions: int = _key(20, rules.whole(0))
    log_level: LogLevel = _key("WARNING", rules.choice(*get_args(LogLevel)))  # noqa: RUF009 - a field
    progress: Progress = _key("never", rules.choice(*get_args(Progress)))  # noqa: RUF009 - a field
    dashboard: bool = _key(False, rules.switch(), fixed=True)
    timeline: str | None = _key(None, rules.path(), fixed=True)
    metrics_port: int | None = _key(None, rules.whole(0, 65535), fixed=True)
    metrics_host: str = _key("127.0.0.1", rules.word("a host name or address"), fixed=True)
    log_to: str | None = _key(None, rules.path(), fixed=True)
    log_times: bool = _key(False, rules.switch(), fixed=True)
    log_records: LogLevel | None = _key(  # noqa: RUF009 - a field
        None, rules.choice(*get_args(LogLevel)), fixed=True
    )
    runtime_directory: str | None = _key(None, rules.directory(), fixed=True)


_KEYS = {entry.name: entry for entry in fields(Config)}

# ---- the configuration in force -------------------------------------------------------------


# One configuration, or none yet.  No lock: if a signal handler makes a pipe while its thread reads
# the sources, it would wait for itself.  If several threads read the sources, the first one counts.
_current: dict[str, Config] = {}
_in_use: Callable[[], bool] = bool  # returns False until there is a runtime
_used = False  # True once an object outside of the runtime, such as a pipe, depends on it


def current() -> Config:
    """Return the configuration in force.  The first call reads the sources, or the parent's."""
    config = _current.get("config")
    if config is None:
        pickled = _config_sources.configuration()
        read = pickle.loads(pickled) if pickled is not None else load()
        config = _current.setdefault("config", read)
    return config


def use() -> Config:
    """Return `current()` for an object that depends on it: a later `init()` respects that."""
    global _used
    config = current()
    _used = True
    return config


def init(**settings: Unpack[ConfigKeywords]) -> Config:
    """Set keys of `Config` for this program, and return the configuration that results.

    Each call starts again from the other sources: keys of an earlier call are forgotten. Call
    it before the first process, pool, pipe or queue. A later call may not change the keys that
    are marked * in `Config`.
    """
    global _current
    config = load(settings)
    if _current and (_used or _in_use()):
        _refuse_late_change(current(), config)
    _current = {"config": config}
    return config


def assign(key: str, value: object) -> None:
    """Set one key and keep the others: `fiber.config.retries = 5`, as in the original Fiber."""
    global _current
    old = current()
    changed: dict[str, Any] = {key: _checked(_Setting(key, value, "fiber.config"))}
    new = replace(old, **changed)
    _check_patience(new, {key: "fiber.config"})
    if _used or _in_use():
        _refuse_late_change(old, new)
    _current = {"config": new}


def install(config: Config) -> None:
    """Put a configuration in force, unchecked."""
    global _current, _used
    _current, _used = {"config": config}, False


def guard(in_use: Callable[[], bool]) -> None:
    """Set the function that says whether the runtime uses `current()`, which `init()` respects."""
    global _in_use
    _in_use = in_use


def _refuse_late_change(running: Config, wanted: Config) -> None:
    for name, entry in _KEYS.items():
        old, new = getattr(running, name), getattr(wanted, name)
        if entry.metadata["fixed"] and old != new:
            raise ConfigError(
                f"fiber.init() comes too late for {name}={new!r}: Fiber has been running with "
                f"{name}={old!r} since the first process, pool, pipe or queue was made. "
                f"Call fiber.init() before that, or set {_variable(name)} or {name} in "
                "[tool.fiber] of pyproject.toml."
            )


# ---- reading the sources --------------------------------------------------------------------


class _Setting(NamedTuple):
    key: str
    value: object
    source: str
    spelling: Callable[[str], str] = str  # how a key is written in this kind of source
    is_text: bool = False
    folder: str = ""  # of the file that has it


def load(
    settings: Mapping[str, object] | None = None,
    *,
    environ: Mapping[str, str] | None = None,
    directory: str | None = None,
) -> Config:
    """Read all sources; `settings` are the arguments of `init()`.

    By default the environment and the directory to start from are the process's.
    """
    environ = os.environ if environ is None else environ
    if message := _config_sources.file_error(directory or os.curdir):
        raise ConfigError(message)
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for setting in (
        *_from_pyproject(directory),
        *_from_environment(environ),
        *_from_init(settings or {}),
    ):
        values[setting.key] = _checked(setting)
        sources[setting.key] = setting.source
    config = Config(**values)
    _check_patience(config, sources)
    return config


def _checked(setting: _Setting) -> object:
    if setting.key not in _KEYS:
        raise ConfigError(_of_the_original(setting) or _unknown(setting))
    entry = _KEYS[setting.key]
    if setting.value is None and entry.default is None:
        return None
    rule: rules.KeyRule = entry.metadata["rule"]
    try:
        value = rule.from_text(str(setting.value)) if setting.is_text else setting.value
        if rule.is_path and isinstance(value, str) and value:
            value = os.path.join(setting.folder, value)
        return rule.check(value)
    except (ValueError, FileNotFoundError):  # a relative path in a folder that was deleted
        raise ConfigError(
            f"bad value {setting.value!r} for {setting.key!r} in {setting.source}: "
            f"expected {rule.expects}"
        ) from None


def _of_the_original(setting: _Setting) -> str | None:
    advice = _config_sources.replacement(setting.key, setting.spelling)
    if advice is None:
        return None
    written = setting.spelling(setting.key)
    return f"{written!r} in {setting.source} is a key of the original Fiber alone. {advice}."


def _unknown(setting: _Setting) -> str:
    import difflib  # only errors need it

    valid = [setting.spelling(key) for key in _KEYS]
    written = setting.spelling(setting.key)
    # An agent's variable configures no program: it is suggested only for a very similar name.
    close = difflib.get_close_matches(written, AGENT_VARIABLES, n=1, cutoff=0.9)
    if not close:  # without the prefix, which would make all names similar
        close = [
            setting.spelling(key) for key in difflib.get_close_matches(setting.key, _KEYS, 1, 0.58)
        ]
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"unknown key {written!r} in {setting.source}.{hint} Valid are: {', '.join(valid)}."


def _check_patience(config: Config, sources: Mapping[str, str]) -> None:
    order = ("heartbeat_interval", "suspect_after", "lost_after")
    for shorter, longer in itertools.pairwise(order):
        low, high = getattr(config, shorter), getattr(config, longer)
        if low >= high:
            raise ConfigError(
                f"{longer} must be longer than {shorter}, but {longer} is {high:g} s "
                f"({sources.get(longer, 'default')}) and {shorter} is {low:g} s "
                f"({sources.get(shorter, 'default')})"
            )


def _from_init(settings: Mapping[str, object]) -> Iterator[_Setting]:
    for key, value in settings.items():
        yield _Setting(key, value, "fiber.init()")


_PREFIX = "FIBER_"

AGENT_VARIABLES = frozenset(
    {
        "FIBER_AGENT_ADDRESS",
        "FIBER_AGENT_CREDENTIALS",
        "FIBER_AGENT_DIRECTORY",
        "FIBER_AGENT_INHERITS",
        "FIBER_AGENT_REPORT",
        "FIBER_AGENT_KEY",
        "FIBER_AGENT_LINKED",
        "FIBER_AGENT_SIGNALS",
        "FIBER_AGENT_LOST_GRACE",
        "FIBER_AGENT_NAME",
        "FIBER_AGENT_NAMESPACE",
        "FIBER_AGENT_TERMINATION_GRACE",
        "FIBER_AGENT_WAITS_UNTIL",
        "FIBER_AGENT_PARENT",
        "FIBER_AGENT_POOL",
        "FIBER_AGENT_PROCESSES",
        "FIBER_AGENT_TEMPLATE_HASH",
        "FIBER_AGENT_UID",
    }
)
"""Variables for agents, which a backend or a pod sets.  Their names are known to find typos."""


def _variable(key: str) -> str:
    return _PREFIX + key.upper()


def _from_environment(environ: Mapping[str, str]) -> Iterator[_Setting]:
    for name, value in environ.items():
        if not name.startswith(_PREFIX) or name in AGENT_VARIABLES:
            continue
        if _is_service_link(name, environ):
            continue
        key = name.removeprefix(_PREFIX).lower()
        yield _Setting(key, value, f"environment variable {name}", _variable, is_text=True)


_SERVICE_LINK = re.compile(r"(FIBER\w*?)_(SERVICE_HOST|SERVICE_PORT\w*|PORT(_\d+_[A-Z]+\w*)?)")


def _is_service_link(name: str, environ: Mapping[str, str]) -> bool:
    # For a Service fiber-x Kubernetes sets the variables FIBER_X_SERVICE_HOST, FIBER_X_PORT and
    # so on in every pod of its namespace.
    link = _SERVICE_LINK.fullmatch(name)
    return link is not None and f"{link[1]}_SERVICE_HOST" in environ


def _from_pyproject(directory: str | None) -> Iterator[_Setting]:
    path = _nearest_pyproject(directory)
    if path is None:
        return
    source = f"[tool.fiber] of {path}"
    table = _read_toml(path).get("tool", {}).get("fiber", {})
    if not isinstance(table, dict):
        raise ConfigError(f"bad value {table!r} for tool.fiber in {path}: expected a table")
    for key, value in table.items():
        yield _Setting(key, value, source, folder=os.path.dirname(path))


def _nearest_pyproject(directory: str | None) -> str | None:
    try:
        here = os.path.abspath(directory or os.getcwd())
    except FileNotFoundError:  # the working directory was deleted
        return None
    while True:
        path = os.path.join(here, "pyproject.toml")
        if os.path.isfile(path):
            return path
        parent = os.path.dirname(here)
        if parent == here:
            return None
        here = parent


def _read_toml(path: str) -> dict[str, Any]:
    import tomllib  # most programs have no pyproject.toml

    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path} for [tool.fiber]: {error}") from error


# ---- keys as attributes of this module ------------------------------------------------------


class _ConfigModule(ModuleType):
    """Class of this module.  Attributes with the names of keys are the configuration in force."""

    def __getattr__(self, name: str) -> object:
        if name in _KEYS:
            return getattr(current(), name)
        advice = _config_sources.replacement(name)
        hint = f": it is a key of the original Fiber alone. {advice}." if advice else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")

    def __setattr__(self, name: str, value: object) -> None:
        if name in _KEYS or name in _config_sources.REPLACEMENTS:
            assign(name, value)
        else:
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _ConfigModule
