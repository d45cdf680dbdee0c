"""Configuration: four sources in order, and errors that name key, value and source."""

from __future__ import annotations

import dataclasses
import inspect
import os
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fiber import _config_sources, config
from fiber._agent import main as agent
from fiber.config import Config, load
from fiber.errors import ConfigError, FiberError
from patience import PATIENCE


@pytest.fixture(autouse=True)
def _bare_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No configuration in force, none in the environment, none above the directory."""
    monkeypatch.setattr(config, "_current", {})
    monkeypatch.setattr(config, "_in_use", bool)
    monkeypatch.setattr(config, "_used", False)
    for name in [name for name in os.environ if name.startswith("FIBER_")]:
        monkeypatch.delenv(name)
    (tmp_path / "pyproject.toml").write_text("")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def pyproject(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "pyproject.toml"
        path.write_text(text)
        return path

    return write


class TestSources:
    def test_the_default_configuration_has_the_documented_values(self) -> None:
        assert load() == Config()
        assert Config().backend == "auto"
        assert Config().retries == 3
        assert Config().lost_after == 15

    def test_each_source_wins_over_the_one_before(
        self, pyproject: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        pyproject("[tool.fiber]\nagents = 3\nretries = 4\nbackend = 'loopback'")
        monkeypatch.setenv("FIBER_RETRIES", "5")
        monkeypatch.setenv("FIBER_LISTEN_PORT", "5000")
        found = load({"listen_port": 6000})
        assert (found.backend, found.agents) == ("loopback", 3)
        assert (found.retries, found.listen_port) == (5, 6000)

    def test_pyproject_is_found_upward(
        self, pyproject: Callable[[str], Path], tmp_path: Path
    ) -> None:
        pyproject("[tool.fiber]\nagents = 7")
        inner = tmp_path / "a" / "b"
        inner.mkdir(parents=True)
        assert load(directory=str(inner)).agents == 7

    def test_the_nearest_pyproject_hides_those_above(
        self, pyproject: Callable[[str], Path], tmp_path: Path
    ) -> None:
        pyproject("[tool.fiber]\nagents = 7")
        (tmp_path / "inner").mkdir()
        (tmp_path / "inner" / "pyproject.toml").write_text("[project]\nname = 'x'\n")
        assert load(directory=str(tmp_path / "inner")).agents == Config().agents

    def test_a_deleted_working_directory_has_no_pyproject(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        gone = tmp_path / "gone"
        gone.mkdir()
        monkeypatch.chdir(gone)
        gone.rmdir()
        assert load() == Config()

    @pytest.mark.parametrize(
        ("variable", "text", "key", "value"),
        [
            ("FIBER_BACKEND", "loopback", "backend", "loopback"),
            ("FIBER_AGENTS", "8", "agents", 8),
            ("FIBER_START_TIMEOUT", "2.5", "start_timeout", 2.5),
            ("FIBER_LISTEN_HOST", "::1", "listen_host", "::1"),
            ("FIBER_ADVERTISED_HOST", "192.0.2.7", "advertised_host", "192.0.2.7"),
            ("FIBER_BACKEND", "Kubernetes", "backend", "kubernetes"),
            ("FIBER_NAMESPACE", "team-a", "namespace", "team-a"),
            ("FIBER_IMAGE", "registry.example.com/es:1", "image", "registry.example.com/es:1"),
            ("FIBER_POOL", "warm", "pool", "warm"),
            ("FIBER_CONTEXT", "kind kind", "context", "kind kind"),
            ("FIBER_PROCESSES_PER_POD", "8", "processes_per_pod", 8),
            ("FIBER_MAX_PODS", "50", "max_pods", 50),
            ("FIBER_IDLE_TIMEOUT", "5", "idle_timeout", 5.0),
            ("FIBER_LOG_LEVEL", "debug", "log_level", "DEBUG"),
            ("FIBER_CPU_REQUEST", "250m", "cpu_request", 0.25),
            ("FIBER_CPU_REQUEST", "0", "cpu_request", 0),
            ("FIBER_MEMORY_REQUEST", "512", "memory_request", 512),
            ("FIBER_SHM", "2Gi", "shm", 2048),
            ("FIBER_NODE_SELECTOR", "disk=ssd,a/b=", "node_selector", {"disk": "ssd", "a/b": ""}),
            (
                "FIBER_TOLERATIONS",
                "spot,team=a:NoSchedule",
                "tolerations",
                (
                    {"key": "spot", "operator": "Exists"},
                    {"effect": "NoSchedule", "key": "team", "operator": "Equal", "value": "a"},
                ),
            ),
        ],
    )
    def test_text_of_the_environment_becomes_the_keys_type(
        self, variable: str, text: str, key: str, value: object
    ) -> None:
        found = getattr(load(environ={variable: text}), key)
        assert found == value
        assert type(found) is type(value)

    def test_whole_seconds_become_floats(self, pyproject: Callable[[str], Path]) -> None:
        pyproject("[tool.fiber]\nstart_timeout = 3")
        assert isinstance(load().start_timeout, float)

    def test_a_directory_is_a_path_object_or_a_text(self, tmp_path: Path) -> None:
        environ = {"FIBER_RUNTIME_DIRECTORY": str(tmp_path)}
        assert load(environ=environ).runtime_directory == str(tmp_path)
        assert load({"runtime_directory": tmp_path}).runtime_directory == str(tmp_path)

    def test_a_template_is_a_dict_or_a_path(self, tmp_path: Path) -> None:
        template = {"spec": {"priorityClassName": "low"}}
        found = load({"template": template}).template
        assert found == template
        template["spec"]["priorityClassName"] = "high"
        assert found == {"spec": {"priorityClassName": "low"}}
        assert load({"template": tmp_path / "pod.yaml"}).template == str(tmp_path / "pod.yaml")

    def test_a_relative_path_starts_where_it_is_written(
        self, pyproject: Callable[[str], Path], tmp_path: Path
    ) -> None:
        pyproject("[tool.fiber]\ntemplate = 'pods/gpu.yaml'")
        inner = tmp_path / "inner"
        inner.mkdir()
        assert load(directory=str(inner)).template == str(tmp_path / "pods" / "gpu.yaml")
        environ = {"FIBER_TEMPLATE": "cpu.yaml"}
        assert load(environ=environ, directory=str(inner)).template == str(tmp_path / "cpu.yaml")

    def test_a_template_stands_in_pyproject_itself(self, pyproject: Callable[[str], Path]) -> None:
        pyproject("[tool.fiber.template.spec]\npriorityClassName = 'low'")
        assert load().template == {"spec": {"priorityClassName": "low"}}

    @pytest.mark.parametrize(
        "entry",
        [entry for entry in dataclasses.fields(Config) if entry.default is None],
        ids=lambda entry: entry.name,
    )
    def test_none_gives_a_key_its_default(
        self, entry: dataclasses.Field[object], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv(f"FIBER_{entry.name.upper()}", "/tmp")
        assert load({entry.name: None}, environ={}) == Config()

    def test_the_variables_of_an_agent_are_not_configuration(self) -> None:
        environ = dict.fromkeys(config.AGENT_VARIABLES, "x") | {"OTHER": "y"}
        assert load(environ=environ) == Config()

    def test_the_variables_of_an_agent_are_all_known(self) -> None:
        named = {value for value in vars(agent).values() if str(value).startswith("FIBER_AGENT_")}
        assert named <= config.AGENT_VARIABLES
        assert named

    def test_kubernetes_service_variables_are_not_configuration(self) -> None:
        environ = {
            "FIBER_OPERATOR_SERVICE_HOST": "10.0.0.1",
            "FIBER_OPERATOR_SERVICE_PORT": "443",
            "FIBER_OPERATOR_SERVICE_PORT_HTTPS": "443",
            "FIBER_OPERATOR_PORT": "tcp://10.0.0.1:443",
            "FIBER_OPERATOR_PORT_443_TCP": "tcp://10.0.0.1:443",
            "FIBER_OPERATOR_PORT_443_TCP_ADDR": "10.0.0.1",
            "FIBER_SERVICE_HOST": "10.0.0.2",
            "FIBER_PORT": "tcp://10.0.0.2:80",
        }
        assert load(environ=environ) == Config()

    def test_a_port_variable_without_its_service_is_a_mistake(self) -> None:
        with pytest.raises(ConfigError, match="FIBER_LISTEN_PORT"):
            load(environ={"FIBER_PORT": "5000"})


class TestUnknownKeys:
    def test_an_unknown_key_in_init_is_named(self) -> None:
        with pytest.raises(ConfigError) as caught:
            load({"agent": 3})
        text = str(caught.value)
        assert "unknown key 'agent' in fiber.init()" in text
        assert "Did you mean 'agents'?" in text
        assert all(entry.name in text for entry in dataclasses.fields(Config))

    def test_an_unknown_key_in_the_environment_is_named(self) -> None:
        with pytest.raises(ConfigError) as caught:
            load(environ={"FIBER_BAKEND": "local"})
        text = str(caught.value)
        assert "environment variable FIBER_BAKEND" in text
        assert "Did you mean 'FIBER_BACKEND'?" in text

    @pytest.mark.parametrize(
        ("variable", "meant"),
        [("FIBER_AGENT_ADRESS", "FIBER_AGENT_ADDRESS"), ("FIBER_AGENT_COUNT", "FIBER_AGENTS")],
    )
    def test_misspelt_variables_of_an_agent_get_suggestions(
        self, variable: str, meant: str
    ) -> None:
        with pytest.raises(ConfigError, match=f"{variable}. Did you mean '{meant}'?"):
            load(environ={variable: "4"})

    def test_an_unknown_key_in_pyproject_is_named(self, pyproject: Callable[[str], Path]) -> None:
        path = pyproject("[tool.fiber]\nlisten-port = 1")
        with pytest.raises(ConfigError) as caught:
            load()
        text = str(caught.value)
        assert "unknown key 'listen-port'" in text
        assert str(path) in text
        assert "Did you mean 'listen_port'?" in text

    def test_an_unfamiliar_name_gets_no_suggestion(self) -> None:
        with pytest.raises(ConfigError) as caught:
            load({"zzz": 3})
        assert "Did you mean" not in str(caught.value)
        with pytest.raises(ConfigError) as caught:
            load(environ={"FIBER_QUIET": "3"})  # the prefix that it shares with all others is long
        assert "Did you mean" not in str(caught.value)

    def test_a_config_error_is_a_value_error_and_a_fiber_error(self) -> None:
        with pytest.raises(ValueError, match="zzz"):
            load({"zzz": 3})
        assert issubclass(ConfigError, FiberError)


class TestBadValues:
    @pytest.mark.parametrize(
        ("key", "value", "expected"),
        [
            ("backend", "lokal", "one of 'local', 'loopback'"),
            ("backend", 3, "one of 'local', 'loopback'"),
            ("agents", 0, "a whole number of at least 1"),
            ("agents", 2.0, "a whole number of at least 1"),
            ("agents", True, "a whole number of at least 1"),
            ("agents", "3", "a whole number of at least 1"),
            ("retries", -1, "a whole number of at least 0"),
            ("listen_port", 65536, "a whole number from 0 to 65535"),
            ("listen_port", True, "a whole number from 0 to 65535"),
            ("listen_port", "9009-9000", "a range of ports such as '9000-9009'"),
            ("listen_port", "0-9", "a range of ports"),
            ("listen_host", " ", "a host name or address"),
            ("listen_host", "two words", "a host name or address"),
            ("backend", "k8s", "'kubernetes', 'auto'"),
            ("agents", None, "a whole number of at least 1"),
            ("namespace", "Team", "the name of a namespace"),
            ("namespace", "a.b", "the name of a namespace"),
            ("namespace", "a" * 64, "the name of a namespace"),
            ("image", "", "the name of an image"),
            ("image", "two words", "the name of an image"),
            ("template", "", "the path of a YAML or JSON file with a pod template"),
            ("template", 3, "or a dict of one"),
            ("pool", "1st", "the name of a FiberPool"),
            ("pool", "a" * 51, "the name of a FiberPool"),
            ("pool", 3, "the name of a FiberPool"),
            ("context", " ", "the name of a context"),
            ("processes_per_pod", 0, "a whole number from 1 to 1024"),
            ("max_pods", 0, "a whole number from 1 to 100000"),
            ("idle_timeout", 0, "a number of seconds above 0"),
            ("cpu_request", -1, "CPUs"),
            ("memory_request", "2GB", "MiB"),
            ("shm", 0, "MiB above 0"),
            ("node_selector", {"a b": "c"}, "a dict of the labels of nodes"),
            ("tolerations", ["a:Never"], "a list of tolerations"),
            ("start_timeout", 0, "a number of seconds above 0"),
            ("start_timeout", float("nan"), "a number of seconds above 0"),
            ("start_timeout", float("inf"), "a number of seconds above 0"),
            ("start_timeout", True, "a number of seconds above 0"),
            ("log_level", "LOUD", "one of 'DEBUG'"),
            ("runtime_directory", "relative", "the absolute path of a directory"),
            ("runtime_directory", "/does/not/exist", "the absolute path of a directory"),
            ("runtime_directory", 7, "the absolute path of a directory"),
        ],
    )
    def test_a_bad_value_in_init_is_named(self, key: str, value: object, expected: str) -> None:
        with pytest.raises(ConfigError) as caught:
            load({key: value})
        text = str(caught.value)
        assert f"bad value {value!r} for {key!r} in fiber.init()" in text
        assert expected in text

    @pytest.mark.parametrize(
        ("variable", "text"),
        [
            ("FIBER_BACKEND", "typo"),
            ("FIBER_AGENTS", "two"),
            ("FIBER_AGENTS", ""),
            ("FIBER_START_TIMEOUT", "1m"),
        ],
    )
    def test_a_bad_value_in_the_environment_is_named(self, variable: str, text: str) -> None:
        with pytest.raises(ConfigError) as caught:
            load(environ={variable: text})
        assert f"bad value {text!r}" in str(caught.value)
        assert f"environment variable {variable}" in str(caught.value)

    def test_a_bad_value_in_pyproject_is_named(self, pyproject: Callable[[str], Path]) -> None:
        path = pyproject("[tool.fiber]\nretries = 'three'")
        with pytest.raises(ConfigError, match="bad value 'three' for 'retries'") as caught:
            load()
        assert str(path) in str(caught.value)

    def test_a_weaker_source_is_checked_too(self) -> None:
        with pytest.raises(ConfigError, match="FIBER_AGENTS"):
            load({"agents": 3}, environ={"FIBER_AGENTS": "0"})

    @pytest.mark.parametrize("text", ["[tool.fiber", "\xff"])
    def test_a_broken_pyproject_is_named(self, tmp_path: Path, text: str) -> None:
        path = tmp_path / "pyproject.toml"
        path.write_bytes(text.encode("latin-1"))
        with pytest.raises(ConfigError, match="cannot read") as caught:
            load()
        assert str(path) in str(caught.value)

    def test_a_fiber_entry_that_is_no_table(self, pyproject: Callable[[str], Path]) -> None:
        pyproject("[tool]\nfiber = 3")
        with pytest.raises(ConfigError, match="expected a table"):
            load()

    def test_liveness_times_out_of_order_name_both_and_their_sources(self) -> None:
        with pytest.raises(ConfigError) as caught:
            load(environ={"FIBER_LOST_AFTER": "4"})
        text = str(caught.value)
        assert "lost_after must be longer than suspect_after" in text
        assert "environment variable FIBER_LOST_AFTER" in text
        assert "5 s (default)" in text

    def test_a_directory_that_cannot_be_written_to(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # Root, as whom a container runs tests, may write to any: so the kernel does not decide.
        monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)
        with pytest.raises(ConfigError, match="a directory that exists and can be written to"):
            load({"runtime_directory": tmp_path})


class TestCurrent:
    def test_the_current_configuration_is_read_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        first = config.current()
        monkeypatch.setenv("FIBER_AGENTS", "9")
        assert config.current() is first

    def test_threads_get_the_same_current_configuration(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        all_there = threading.Barrier(4, timeout=PATIENCE)

        def load_at_the_same_time() -> Config:
            all_there.wait()
            return load()

        monkeypatch.setattr(config, "load", load_at_the_same_time)
        with ThreadPoolExecutor(4) as threads:
            found = list(threads.map(lambda _: config.current(), range(4)))
        assert all(one is found[0] for one in found)
        assert config.current() is found[0]

    def test_a_handler_may_ask_while_its_thread_reads(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        inner = []

        def interrupted_load() -> Config:
            monkeypatch.setattr(config, "load", load)
            inner.append(config.current())
            return load()

        monkeypatch.setattr(config, "load", interrupted_load)
        found: list[Config] = []
        thread = threading.Thread(target=lambda: found.append(config.current()), daemon=True)
        thread.start()
        thread.join(PATIENCE)
        assert not thread.is_alive(), "deadlock"
        assert found[0] is inner[0] is config.current()

    def test_a_bad_source_is_reported_again_at_the_next_use(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("FIBER_BACKEND", "typo")
        for _ in range(2):
            with pytest.raises(ConfigError, match="typo"):
                config.current()

    def test_a_fork_while_another_thread_reads_does_not_block_the_child(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        reading, forked = threading.Event(), threading.Event()

        def slow_load() -> Config:
            reading.set()
            assert forked.wait(PATIENCE)
            return load()

        monkeypatch.setattr(config, "load", slow_load)
        thread = threading.Thread(target=config.current)
        thread.start()
        assert reading.wait(PATIENCE)
        pid = os.fork()
        if pid == 0:
            signal.alarm(10)
            config.install(Config(agents=5))
            os._exit(config.current().agents)
        forked.set()
        thread.join()
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 5

    def test_install_hands_over_a_parents_configuration(self) -> None:
        parents = pickle.loads(pickle.dumps(Config(backend="loopback", agents=4)))
        config.install(parents)
        assert config.current() == Config(backend="loopback", agents=4)

    def test_a_child_has_its_parents_once_it_asks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(_config_sources, "_configuration", None)
        _config_sources.keep(pickle.dumps(Config(agents=7)))
        assert config.current() == Config(agents=7)
        config.init(agents=8)
        assert config.current().agents == 8


class TestInit:
    def test_sets_and_returns_the_configuration(self) -> None:
        assert config.init(agents=4) is config.current()
        assert config.current().agents == 4

    def test_starts_anew_each_time(self) -> None:
        config.init(agents=4)
        config.init(retries=1)
        assert config.current() == Config(retries=1)

    def test_a_refused_call_changes_no_setting(self) -> None:
        config.init(agents=4)
        with pytest.raises(ConfigError):
            config.init(agents=0)
        assert config.current().agents == 4

    def test_another_backend_once_the_runtime_is_in_use(self) -> None:
        config.init(backend="local")
        config.guard(lambda: True)
        with pytest.raises(ConfigError) as caught:
            config.init(backend="loopback")
        text = str(caught.value)
        assert "too late for backend='loopback'" in text
        assert "backend='local'" in text
        assert "Call fiber.init() before" in text
        assert "FIBER_BACKEND" in text
        assert config.current().backend == "local"

    def test_another_backend_once_something_was_built_on_it(self) -> None:
        assert config.use() == Config()
        with pytest.raises(ConfigError, match="too late for backend='loopback'"):
            config.init(backend="loopback")
        assert config.init(retries=1).retries == 1

    def test_a_configuration_that_cannot_be_read_is_not_in_use(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("FIBER_BACKEND", "typo")
        with pytest.raises(ConfigError, match="typo"):
            config.use()
        monkeypatch.delenv("FIBER_BACKEND")
        config.current()
        assert config.init(backend="loopback").backend == "loopback"

    def test_a_child_that_was_handed_one_has_not_used_it(self) -> None:
        config.use()
        config.install(Config())
        assert config.init(backend="loopback").backend == "loopback"

    def test_init_may_change_keys_for_later_calls_while_fiber_is_in_use(self) -> None:
        config.init(backend="loopback")
        config.guard(lambda: True)
        config.init(backend="loopback", retries=0, start_timeout=5, log_level="info")  # type: ignore[arg-type]  # any case
        assert config.current().retries == 0

    def test_any_backend_while_not_in_use(self) -> None:
        config.init(backend="loopback")
        config.guard(lambda: False)
        assert config.init(backend="local").backend == "local"


class TestConfig:
    def test_a_configuration_is_frozen(self) -> None:
        with pytest.raises(dataclasses.FrozenInstanceError):
            Config().agents = 3  # type: ignore[misc]

    @pytest.mark.parametrize("entry", dataclasses.fields(Config), ids=lambda entry: entry.name)
    def test_every_key_is_documented(self, entry: dataclasses.Field[object]) -> None:
        star = "*" if entry.metadata["fixed"] else ""
        assert f"\n{entry.name}{star}: " in (inspect.getdoc(Config) or "")

    @pytest.mark.parametrize("entry", dataclasses.fields(Config), ids=lambda entry: entry.name)
    def test_every_default_passes_its_own_rule(self, entry: dataclasses.Field[object]) -> None:
        if entry.default is not None:
            assert load({entry.name: entry.default}) == Config()


class TestKeysOfTheOriginal:
    """Users of uber's Fiber hear what to write in place of what they have."""

    def test_a_file_of_the_original_fiber_is_an_error_with_replacements(
        self, tmp_path: Path
    ) -> None:
        text = "[default]\nbackend=kubernetes\nlog_file=stdout\nkubernetes_namespace=rl\n"
        (tmp_path / ".fiberconfig").write_text(text)
        with pytest.raises(ConfigError) as caught:
            load()
        first, *lines = str(caught.value).splitlines()
        assert f"{tmp_path}/.fiberconfig is a file of the original Fiber" in first
        assert "[tool.fiber] of pyproject.toml" in first
        assert lines[0] == "backend: Set backend to 'kubernetes'."
        assert lines[1].startswith("log_file: Give the logger 'fiber'")
        assert lines[2] == "kubernetes_namespace: Set namespace."

    @pytest.mark.parametrize("text", ["no section", "[other]\nbackend=local", "\0"])
    def test_an_unreadable_file_of_the_original_fiber_is_an_error(
        self, text: str, tmp_path: Path
    ) -> None:
        (tmp_path / ".fiberconfig").write_text(text)
        with pytest.raises(ConfigError, match="They cannot be read"):
            load()

    @pytest.mark.parametrize("key", sorted(_config_sources.REPLACEMENTS))
    def test_each_key_of_the_original_fiber_is_an_error_in_each_source(
        self, key: str, pyproject: Callable[[str], Path]
    ) -> None:
        variable = f"FIBER_{key.upper()}"
        with pytest.raises(ConfigError, match=f"{variable!r} in .* of the original Fiber") as env:
            load(environ={variable: "1"})
        assert "Did you mean" not in str(env.value)
        with pytest.raises(ConfigError, match=rf"{key!r} in fiber.init\(\) is a key of the orig"):
            config.init(**{key: 1})  # type: ignore[arg-type]  # no such key
        pyproject(f"[tool.fiber]\n{key} = 1")
        with pytest.raises(ConfigError, match=f"{key!r} in .*pyproject.toml is a key of the orig"):
            load()

    def test_advice_spells_keys_as_its_source_does(self) -> None:
        with pytest.raises(ConfigError, match=r"Set FIBER_LOG_LEVEL to 'DEBUG'\.$"):
            load(environ={"FIBER_DEBUG": "1"})
        with pytest.raises(ConfigError, match=r"Set log_level to 'DEBUG'\.$"):
            load({"debug": True})

    def test_keys_are_set_as_attributes_of_the_module(self) -> None:
        config.init(agents=3)
        vars_before = set(vars(config))
        setattr(config, "backend", "loopback")  # noqa: B010 - mypy
        setattr(config, "retries", 7)  # noqa: B010
        assert set(vars(config)) == vars_before
        assert config.current() == dataclasses.replace(
            Config(), agents=3, backend="loopback", retries=7
        )
        assert getattr(config, "backend") == "loopback"  # noqa: B009

    @pytest.mark.parametrize(
        ("key", "value", "words"),
        [
            ("backend", "docker", "bad value 'docker' for 'backend' in fiber.config"),
            ("cpu_per_job", 2, r"'cpu_per_job' in fiber.config is .*fiber\.meta\(cpu=…\)"),
            ("lost_after", 1.0, "lost_after must be longer"),
        ],
    )
    def test_a_bad_attribute_changes_no_setting(self, key: str, value: object, words: str) -> None:
        with pytest.raises(ConfigError, match=words):
            setattr(config, key, value)
        assert config.current() == Config()

    def test_an_attribute_that_comes_too_late(self) -> None:
        config.use()
        with pytest.raises(ConfigError, match="too late for backend='loopback'"):
            setattr(config, "backend", "loopback")  # noqa: B010
        setattr(config, "retries", 7)  # noqa: B010
        assert config.current().retries == 7

    def test_reading_an_old_key_names_its_replacement(self) -> None:
        with pytest.raises(AttributeError, match=r"original Fiber alone\. Set backend"):
            getattr(config, "default_backend")  # noqa: B009
        with pytest.raises(AttributeError, match=r"no attribute 'no_such_key'$"):
            getattr(config, "no_such_key")  # noqa: B009
