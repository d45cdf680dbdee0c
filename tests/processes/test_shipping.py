"""Programs whose agents have not their files: loopback agents that are started elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from unit.shipping_site import write

pytestmark = pytest.mark.slow

ELSEWHERE = """
import os
import fiber
from fiber._backends import loopback

loopback.LoopbackBackend.elsewhere = os.environ["ELSEWHERE"]

def begin(**settings):
    fiber.init(backend="loopback", agents=1, runtime_directory=os.environ["ELSEWHERE"], **settings)
"""


class Site:
    """A folder for a program, a library on its path, and a directory for the agents."""

    def __init__(self, tmp_path: Path) -> None:
        self.program = tmp_path / "es"
        self.library = write(tmp_path / "lib", elsewhere_py=ELSEWHERE)
        self.agents = tmp_path / "agents"
        self.program.mkdir()
        self.agents.mkdir()

    def run(self, *arguments: str, program: str | None = None) -> subprocess.CompletedProcess[str]:
        """Run a program in its folder; no agent leaves anything."""
        if program is not None:
            write(self.program, main_py=program)
        done = subprocess.run(
            [sys.executable, *(arguments or ("main.py",))],
            cwd=self.program,
            env={**os.environ, "PYTHONPATH": str(self.library), "ELSEWHERE": str(self.agents)},
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert os.listdir(self.agents) == []
        return done

    def prints(self, *arguments: str, **options: Any) -> list[str]:
        """The lines of one that succeeds and does not complain."""
        done = self.run(*arguments, **options)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.splitlines()


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_a_script_finds_its_files_modules_and_itself(site: Site) -> None:
    write(site.program, helper_py="", lazy_py="", data_txt="data", generated_py="", notes_log="x")
    (site.program / ".gitignore").write_text("generated.py\n*.log\n")
    program = """
import os, sys
import elsewhere, fiber, generated, helper

class Local:
    pass

def look(_=None):
    import lazy
    here = os.getcwd()
    assert os.path.basename(here) == "es" and here != os.environ["PWD"], here
    assert sys.path[0] == here
    for module in (helper, lazy, generated, sys.modules["__main__"]):
        assert os.path.dirname(module.__file__) == here, module
    assert os.path.dirname(elsewhere.__file__) == os.path.join(os.path.dirname(here), "program")
    assert not os.path.exists("notes.log")
    assert __name__ == "__mp_main__"
    return open("data.txt").read(), Local()

if __name__ == "__main__":
    elsewhere.begin()
    os.environ["PWD"] = os.getcwd()
    with fiber.Pool(1) as pool:
        text, local = pool.apply(look)
        print(text, type(local) is Local)
    for method in ("fork", "spawn"):
        process = fiber.get_context(method).Process(target=look)
        process.start()
        process.join()
        print(process.exitcode)
"""
    assert site.prints(program=program) == ["data True", "0", "0"]


def test_a_module_that_is_run_by_name_finds_its_package(site: Site) -> None:
    write(
        site.program,
        pkg__tool_py="""
import elsewhere, fiber
from pkg import part
def look():
    return __name__, part.__name__
if __name__ == "__main__":
    elsewhere.begin()
    with fiber.Pool(1) as pool:
        print(*pool.apply(look))
""",
        pkg__part_py="",
    )
    assert site.prints("-m", "pkg.tool") == ["__mp_main__ pkg.part"]


def test_the_main_module_of_a_package_is_not_run_again(site: Site) -> None:
    write(site.program, pkg__part_py="def double(number): return 2 * number")
    (site.program / "pkg" / "__main__.py").write_text("""
import elsewhere, fiber
from .part import double
def look(number):
    return double(number)
elsewhere.begin()
with fiber.Pool(1) as pool:
    print(*pool.map(look, range(3)))
""")
    assert site.prints("-m", "pkg") == ["0 2 4"]


def test_a_pool_and_a_process_have_the_files_as_they_are_when_it_is_made(site: Site) -> None:
    write(site.program, value_py="VALUE = 1")
    program = """
import os
import elsewhere, fiber

def value():
    import value
    return value.VALUE, os.getcwd()

def tell(queue):
    queue.put(value())

if __name__ == "__main__":
    elsewhere.begin()
    seen = []
    for text in ("VALUE = 1", "VALUE = 2", "VALUE = 3"):
        with open("value.py", "w") as file:
            file.write(text)
        os.utime("value.py", (1, len(seen)))
        with fiber.Pool(1) as pool:
            seen.append(pool.apply(value))
    with open("value.py", "w") as file:
        file.write("VALUE = 4000")
    queue = fiber.SimpleQueue()
    process = fiber.Process(target=tell, args=(queue,))
    process.start()
    seen.append(queue.get())
    process.join()
    with fiber.Pool(1) as pool:
        seen.append(pool.apply(value))
    print(*(value for value, _ in seen), len({folder for _, folder in seen}))
"""
    assert site.prints(program=program) == ["1 2 3 4000 4000 4"]


SESSION = """
import os, elsewhere, fiber
elsewhere.begin()
def look():
    import helper
    return os.path.basename(os.getcwd()), os.path.dirname(helper.__file__) == os.getcwd()
with fiber.Pool(1) as pool:
    print(*pool.apply(look))
"""


def test_a_session_has_its_working_directory(site: Site) -> None:
    write(site.program, helper_py="")
    assert site.prints("-c", SESSION) == ["es True"]


def test_a_session_in_a_folder_that_is_too_large_sends_its_imported_modules(site: Site) -> None:
    write(site.program, helper_py="", large_npy=bytes(2 << 20))
    limit = "from fiber._backends import program_files; program_files.LIMIT = 1 << 20\n"
    done = site.run("-c", f"{limit}import helper\n{SESSION}")
    assert (done.returncode, done.stdout) == (0, "program True\n")
    assert done.stderr.count("RuntimeWarning") == 1
    assert f"{site.program}/large.npy" in done.stderr
    assert "only imported modules of the working directory" in done.stderr


def test_a_script_in_a_home_directory_sends_its_imported_modules(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(site.program))
    write(site.program, helper_py="", secret_key="secret")
    program = """
import os
import elsewhere, fiber, helper

def look():
    import helper
    return sorted(name for name in os.listdir() if name != "__pycache__")

if __name__ == "__main__":
    elsewhere.begin()
    for _ in range(2):
        with fiber.Pool(1) as pool:
            print(pool.apply(look))
"""
    done = site.run(program=program)
    assert done.stdout.splitlines() == ["['elsewhere.py', 'helper.py', 'main.py']"] * 2
    assert done.stderr.count("RuntimeWarning: the program is in") == 1
    assert "Move the program to a separate folder" in done.stderr


def test_secrets_and_links_that_are_left_out_are_said_once(site: Site, tmp_path: Path) -> None:
    write(site.program, server_key="x")
    (site.program / "link").symlink_to(tmp_path / "lib")
    program = """
import os
import elsewhere, fiber

def look():
    return sorted(name for name in os.listdir() if name != "__pycache__")

if __name__ == "__main__":
    elsewhere.begin()
    for name in ("a.txt", ".env"):
        open(name, "w").close()
        with fiber.Pool(1) as pool:
            print(pool.apply(look))
"""
    done = site.run(program=program)
    assert done.stdout.splitlines() == ["['a.txt', 'main.py']"] * 2
    for path in (
        "server.key (private keys)",
        ".env (environment variables)",
        f"link ({site.library})",
    ):
        assert done.stderr.count(f"  {site.program}/{path}") == 1
    assert f"write a line with its name into {site.program}/.fiberignore" in done.stderr
    assert "for example '!/server.key'. The line '/server.key' leaves it out" in done.stderr


def test_a_listing_shows_sent_and_left_out_files_with_reasons(site: Site) -> None:
    write(site.program, server_key="key", notes_log="log", data_txt="text")
    (site.program / ".gitignore").write_text("*.log\n")
    program = """
import elsewhere, fiber
if __name__ == "__main__":
    listing = fiber.shipping.listing()
    print(repr(listing))
    for file in (*listing.sent, *listing.left_out):
        if "/crds" not in file.path and "/operator" not in file.path and ".py" not in file.path:
            print(file.size, file.path, file.reason)
    print(str(listing).count("\\n"), listing.too_large, listing.size)
"""
    first, *lines, last = site.prints(program=program)
    size = len(program) + len(ELSEWHERE) + 10
    assert first.startswith(f"<Listing: 4 files of {size} B sent, ")
    assert lines == [
        f"6 {site.program}/.gitignore in the program's folder",
        f"4 {site.program}/data.txt in the program's folder",
        f"3 {site.program}/notes.log '*.log' in {site.program}/.gitignore",
        f"3 {site.program}/server.key looks like a secret: private keys",
        f"0 {site.library} on sys.path; what the program imported from it is sent",
    ]
    assert last.endswith(f"False {size}")


WITHOUT_RIGHTS = """
import ctypes, struct
# Root, too, may read only what the modes allow, once it has no capability.
assert ctypes.CDLL(None).capset(struct.pack("Ii", 0x20080522, 0), bytes(24)) == 0
"""


def test_a_listing_omits_unreadable_files(site: Site) -> None:
    write(site.program, data_txt="text", closed_txt="text", folder__in_txt="text", hidden__x="x")
    for name, mode in (("closed.txt", 0), ("folder", 0), ("hidden", 0o400)):
        (site.program / name).chmod(mode)
    program = f"""
{WITHOUT_RIGHTS}
import os, elsewhere, fiber
if __name__ == "__main__":
    listing = fiber.shipping.listing()
    print(sorted(os.path.basename(file.path) for file in listing.sent))
    for left in listing.left_out:
        if left.path.startswith(os.getcwd() + os.sep):
            print(left.size, os.path.basename(left.path), left.reason)
    print("not counted" in str(listing))
"""
    assert site.prints(program=program) == [
        "['data.txt', 'elsewhere.py', 'main.py']",
        "4 closed.txt this program may not read it",
        "None folder this program may not read it",
        "None hidden this program may not read it",
        "True",
    ]


def test_a_listing_has_a_line_for_each_path_whatever_its_name(site: Site) -> None:
    for name in ("new\nline.txt", "new\nline.key", "\udcff.txt"):
        (site.program / name).write_text("x")
    program = """
import elsewhere, fiber
if __name__ == "__main__":
    listing = fiber.shipping.listing()
    print(len(listing.sent) + len(listing.left_out) + 2 == len(str(listing).splitlines()))
    print(listing)
"""
    first, *table = site.prints(program=program)
    assert first == "True"
    for path in (r"new\nline.txt", r"new\nline.key", r"\udcff.txt"):
        assert [line for line in table if f"'{site.program}/{path}'" in line]


def test_files_that_are_being_written_are_named_once(site: Site) -> None:
    write(site.program, results_csv="1")
    program = """
import os
import elsewhere, fiber
from fiber._backends import shipping

def growing(descriptor):
    if os.readlink(f"/proc/self/fd/{descriptor}").endswith("results.csv"):
        with open("results.csv", "a") as file:
            file.write("1")
    return fstat(descriptor)

if __name__ == "__main__":
    elsewhere.begin()
    fstat, os.fstat = os.fstat, growing
    for _ in range(2):
        with fiber.Pool(1) as pool:
            print(pool.apply(len, ("a",)))
"""
    done = site.run(program=program)
    assert done.stdout == "1\n1\n"
    assert done.stderr.count("changed each time that they were read") == 1
    assert done.stderr.count(f"  {site.program}/results.csv") == 1


def test_a_script_whose_folder_is_too_large_fails_at_its_first_start(site: Site) -> None:
    write(site.program, large_npy=bytes(2 << 20))
    program = """
import elsewhere, fiber
from fiber._backends import program_files
program_files.LIMIT = 1 << 20
if __name__ == "__main__":
    elsewhere.begin()
    for start in (lambda: fiber.Pool(1), fiber.Process(target=print).start):
        try:
            start()
        except fiber.FiberError as error:
            print(type(error).__name__, error.largest)
"""
    path = f"{site.program}/large.npy"
    lines = site.prints(program=program)
    assert len(lines) == 2
    assert all(line.startswith(f"ProgramTooLarge {{'{path}': '2.0 MiB'") for line in lines)


def test_an_archive_that_cannot_be_unpacked_is_an_error_of_the_start(site: Site) -> None:
    program = """
import elsewhere, fiber
from fiber._backends import shipping
shipping.pack = lambda *_: shipping.Packed(b"no archive", [])
if __name__ == "__main__":
    elsewhere.begin()
    try:
        fiber.Process(target=print).start()
    except fiber.FiberError as error:
        print(error)
"""
    (line,) = site.prints(program=program)
    assert "the program's files could not be unpacked: not a gzip file" in line
