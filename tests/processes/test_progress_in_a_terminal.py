"""Bars of maps in a real terminal: what a person sees at the end, and beside other output."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from terminal import Terminal

BEGIN = """
import sys, threading
import fiber

def square(number):
    return number * number

def wait_for(file):
    import os, time
    while not os.path.exists(file):
        time.sleep(0.01)
    return file

def say(number):
    print("line of task", number, flush=True)
    return number

def fail(number):
    raise ValueError(number)
"""
"""Functions of the programs."""

HIDES = {"tqdm": "", "rich": "sys.modules['tqdm'] = None\n"}
"""Statement that leaves a view alone in the program, so that it is chosen."""


@pytest.fixture(params=["local", "loopback"])
def backend(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture(params=HIDES)
def view(request: pytest.FixtureRequest) -> str:
    if request.param == "tqdm":
        pytest.importorskip("tqdm", reason="tqdm is optional, as for users")
    return str(request.param)


def run(folder: Path, body: str, *, view: str, functions: str = "", **settings: str) -> Terminal:
    """Run a program in a terminal.  ``settings`` are keys of the configuration."""
    lines = "".join(f"    {line}\n" for line in body.strip().splitlines())
    program = f"{BEGIN}{functions}{HIDES[view]}if __name__ == '__main__':\n{lines}"
    (folder / "program.py").write_text(program)
    variables = {f"FIBER_{key.upper()}": value for key, value in settings.items()}
    environment = {**os.environ, "TERM": "xterm", **variables}
    return Terminal([sys.executable, "program.py"], folder, environment)


def bars(window: Terminal, name: str) -> list[str]:
    return [line for line in window.lines() if line.startswith(name)]


def test_the_last_state_of_a_map_stays(tmp_path: Path, backend: str, view: str) -> None:
    body = """
with fiber.Pool(2) as pool:
    pool.map(square, range(50), progress="first")
    print("between")
    list(pool.imap(square, iter(range(50)), progress="second"))
    print("after", flush=True)
    pool.map_async(square, range(50), progress="third").get()
print("the end")
"""
    with run(tmp_path, body, view=view, backend=backend) as window:
        assert window.ends() == 0, window.lines()
    lines = [line for line in window.lines() if line]
    assert [line.split(":")[0].split()[0] for line in lines] == [
        "first",
        "between",
        "second",
        "after",
        "third",
        "the",
    ]
    assert all("50/50" in line for line in lines[::2][:3])


def test_several_bars_at_once(tmp_path: Path, view: str) -> None:
    body = """
with fiber.Pool(3) as pool:
    first = pool.map_async(wait_for, ["a"], progress="first")
    second = pool.map_async(wait_for, ["b"], progress="second")
    print("both run", file=sys.__stdout__, flush=True)
    second.get()
    pool.map(square, range(9), progress="third")
    open("a", "w").close()
    first.get()
print("the end")
"""
    with run(tmp_path, body, view=view, backend="local") as window:
        window.shows("both run")
        (tmp_path / "b").touch()
        assert window.ends() == 0, window.lines()
    for name, count in (("first", "1/1"), ("second", "1/1"), ("third", "9/9")):
        assert count in bars(window, name)[-1]
    assert window.lines()[-2] == "the end"


def test_lines_of_workers_elsewhere_are_above_the_bar(tmp_path: Path, view: str) -> None:
    body = """
with fiber.Pool(1) as pool:
    result = pool.map_async(wait_for, ["a"], progress="slow")
    print(end="begun", file=sys.__stdout__, flush=True)
    pool.map(square, range(9), progress=False)
    result.get()
    pool.map(say, range(3), progress="said")
"""
    with run(tmp_path, body, view=view, backend="loopback", agents="1") as window:
        window.shows("begun")
        (tmp_path / "a").touch()
        assert window.ends() == 0, window.lines()
    said = [line for line in window.lines() if "line of task" in line]
    assert [line.split("] ")[1] for line in said] == [f"line of task {n}" for n in range(3)]
    assert "3/3" in bars(window, "said")[-1]


def print_beside_a_bar(folder: Path, statement: str, *, view: str, begin: str = "") -> list[str]:
    """Run a statement while there is a bar, and return the lines of the terminal."""
    body = f"""{begin}
with fiber.Pool(1) as pool:
    result = pool.map_async(wait_for, ["end"], progress="slow")
    wait_for("drawn")
    {statement}
    open("end", "w").close()
    result.get()
"""
    with run(folder, body, view=view, backend="local") as window:
        window.shows("slow")
        (folder / "drawn").touch()
        assert window.ends() == 0, window.lines()
    lines = [line for line in window.lines() if line]
    assert "1/1" in lines[-1]
    return lines[:-1]


def test_prints_of_the_program_are_above_a_bar_of_rich(tmp_path: Path) -> None:
    assert print_beside_a_bar(tmp_path, "print('printed')", view="rich") == ["printed"]


def test_output_to_a_file_stays_whole_beside_a_bar_of_rich(tmp_path: Path) -> None:
    to_file = "sys.stdout = open('output', 'w')\n"
    lines = print_beside_a_bar(tmp_path, "print('printed')", view="rich", begin=to_file)
    assert lines == []
    assert (tmp_path / "output").read_text() == "printed\n"


def test_write_of_tqdm_is_above_the_bar(tmp_path: Path) -> None:
    statement = "import tqdm; tqdm.tqdm.write('one'); tqdm.tqdm.write('two')"
    pytest.importorskip("tqdm", reason="tqdm is optional, as for users")
    assert print_beside_a_bar(tmp_path, statement, view="tqdm") == ["one", "two"]


# ---- the configuration


def test_the_configuration_shows_maps_unless_their_call_refuses(tmp_path: Path, view: str) -> None:
    body = """
with fiber.Pool(1) as pool:
    print("begun", flush=True)
    pool.map(wait_for, ["a"], progress=False)
    print("refused", flush=True)
    pool.map(wait_for, ["b"])
"""
    with run(tmp_path, body, view=view, backend="local", progress="auto") as window:
        window.shows("begun")
        (tmp_path / "a").touch()
        window.shows("refused")
        window.shows("wait_for")
        (tmp_path / "b").touch()
        assert window.ends() == 0, window.lines()
    (bar,) = bars(window, "wait_for")
    assert "1/1" in bar


def test_children_draw_no_bar(tmp_path: Path) -> None:
    body = """
with fiber.Executor(1) as executor:
    print(executor.submit(nested).result())
"""
    nested = """
def nested():
    with fiber.Pool(1) as pool:
        result = pool.map_async(wait_for, ["a"])
        open("a", "w").close()
        result.get()
        return pool.map(square, [2], progress="nested")
"""
    settings = {"backend": "local", "progress": "always"}
    with run(tmp_path, body, view="rich", functions=nested, **settings) as window:
        assert window.ends() == 0, window.lines()
    assert bars(window, "wait_for") == []
    (line,) = [line for line in window.lines() if "nested" in line]
    assert line.startswith("[fiber] nested: 1 of 1 tasks")


# ---- ends before the end


def test_ctrl_c_ends_the_bar(tmp_path: Path, backend: str, view: str) -> None:
    body = """
try:
    with fiber.Pool(1) as pool:
        pool.map(wait_for, ["never"], progress="slow")
except KeyboardInterrupt:
    print("interrupted")
"""
    with run(tmp_path, body, view=view, backend=backend) as window:
        window.shows("slow")
        window.press(window.CTRL_C)
        assert window.ends() == 0, window.lines()
    assert "0/1" in bars(window, "slow")[-1]
    assert "interrupted" in window.lines()


def test_terminate_ends_the_bar(tmp_path: Path, view: str) -> None:
    body = """
pool = fiber.Pool(1)
result = pool.map_async(wait_for, ["never"], progress="slow")
pool.terminate()
print("terminated", flush=True)
try:
    result.get()
except fiber.FiberError:
    print("no result")
pool.join()
print([t.name for t in threading.enumerate() if t.name == "fiber-progress"])
"""
    with run(tmp_path, body, view=view, backend="local") as window:
        assert window.ends() == 0, window.lines()
    lines = [line for line in window.lines() if line]
    assert "0/1" in lines[0]
    assert lines[1:3] == ["terminated", "no result"]


def test_a_program_that_ends_in_the_middle_ends_its_bar(tmp_path: Path, view: str) -> None:
    body = """
pool = fiber.Pool(1)
result = pool.map_async(wait_for, ["never"], progress="slow")
sys.exit(3)
"""
    with run(tmp_path, body, view=view, backend="local") as window:
        assert window.ends() == 3
    assert "0/1" in bars(window, "slow")[-1]


def test_a_closed_window_costs_only_the_bar(tmp_path: Path, view: str) -> None:
    body = """
import signal
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with fiber.Pool(1) as pool:
    pool.map(wait_for, ["a"], progress="slow")
    pool.map(square, range(9), progress="second")
sys.exit(5)
"""
    with run(tmp_path, body, view=view, backend="local") as window:
        window.shows("slow")
        (tmp_path / "a").touch()
    assert window.close() == 5
