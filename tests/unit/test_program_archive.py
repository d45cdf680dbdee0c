"""Packing the program's files, and unpacking them elsewhere."""

from __future__ import annotations

import ast
import io
import os
import re
import socket
import tarfile
import time
from pathlib import Path

import pytest

from fiber._backends import program_files, shipping
from fiber._backends.program_files import Why
from fiber.errors import ProgramTooLarge
from unit.shipping_site import files, layout, packed, tree, unpacked, write


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write(tmp_path / "es", main_py="import es", data__weights_npy=b"\0\1")


def test_packed_files_are_unpacked_unchanged(folder: Path, tmp_path: Path) -> None:
    (folder / "out").mkdir()
    (folder / "run").write_text("#!/bin/sh")
    (folder / "run").chmod(0o755)
    there = unpacked(packed(folder), tmp_path / "there")
    assert tree(there) == {"es": None} | {f"es/{name}": v for name, v in tree(folder).items()}
    assert os.access(there / "es/run", os.X_OK)
    assert (there / "es/main.py").stat().st_mode & 0o777 == 0o600
    assert there.stat().st_mode & 0o777 == 0o700


def test_the_same_files_are_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    copy = write(tmp_path / "other" / "es", data__weights_npy=b"\0\1", main_py="import es")
    os.utime(copy / "main.py", (1, 1))
    (copy / "main.py").chmod(0o600)
    assert packed(copy) == packed(folder)
    write(copy, main_py="import os")
    assert packed(copy) != packed(folder)


def test_several_folders_keep_their_names(folder: Path, tmp_path: Path) -> None:
    library = write(tmp_path / "lib", tools__init_py="", single_py="")
    there = unpacked(packed(folder, library), tmp_path / "there")
    assert (there / "es/main.py").exists()
    assert (there / "lib/tools/init.py").exists()


# Excluded files


def names(folder: Path) -> set[str]:
    return {name.partition("/")[2] for name, entry in files(folder).items() if entry.size}


def test_ignore_files_are_respected(folder: Path) -> None:
    write(folder, a_log="x", keep_log="x", runs__1_npy="x", deep__runs__1_npy="x", deep__b_log="x")
    (folder / ".gitignore").write_text("*.log\n!keep.log\n/runs/\n!\n\\\n# comment\n")
    assert names(folder) == {
        ".gitignore",
        "main.py",
        "data/weights.npy",
        "keep.log",
        "deep/runs/1.npy",
    }


def test_the_nearest_ignore_file_decides(folder: Path) -> None:
    write(folder, deep__a_log="x", deep__b_txt="x", a_log="x")
    (folder / ".gitignore").write_text("*.log\n")
    (folder / "deep/.gitignore").write_text("!a.log\n*.txt\n")
    assert names(folder) >= {"deep/a.log"}
    assert names(folder).isdisjoint({"a.log", "deep/b.txt"})


def test_fiberignore_is_stronger_than_gitignore(folder: Path) -> None:
    write(folder, generated_py="x", tests__big_npy="x")
    (folder / ".gitignore").write_text("generated.py\n")
    (folder / ".fiberignore").write_text("!generated.py\ntests/\n")
    assert "generated.py" in names(folder)
    assert "tests/big.npy" not in names(folder)


def test_the_repositorys_rules_hold_for_a_folder_in_it(folder: Path) -> None:
    (folder.parent / ".git").mkdir()
    (folder.parent / ".gitignore").write_text("/es/data/\n")
    assert names(folder) == {"main.py"}


def test_rules_around_a_folder_that_is_no_part_of_a_repository_are_not_its(folder: Path) -> None:
    (folder.parent / ".gitignore").write_text("/es/data/\n")
    assert names(folder) == {"main.py", "data/weights.npy"}


def test_a_program_in_a_folder_that_git_ignores_is_sent(folder: Path) -> None:
    (folder.parent / ".git").mkdir()
    (folder.parent / ".gitignore").write_text("es/\n*.npy\n")
    assert names(folder) == {"main.py", "data/weights.npy"}


def test_an_imported_file_is_sent_even_if_it_is_ignored(folder: Path, tmp_path: Path) -> None:
    imported = write(folder, build__fast_so="x", build__slow_so="x") / "build/fast.so"
    (folder / ".gitignore").write_text("build/\n")
    there = unpacked(packed(folder, files=(imported,)), tmp_path / "there")
    assert os.listdir(there / "es/build") == ["fast.so"]


def test_files_of_tools_are_sent_only_if_fiberignore_includes_them(folder: Path) -> None:
    write(folder, cache__x_pyc="x", node__x_js="x", venv__lib__x_py="x", venv__pyvenv_cfg="x")
    (folder / "cache").rename(folder / "__pycache__")
    (folder / "node").rename(folder / "node_modules")
    (folder / ".git").mkdir()
    write(folder / ".git", HEAD="x")
    assert names(folder) == {"main.py", "data/weights.npy"}
    (folder / ".fiberignore").write_text("!node_modules\n")
    assert "node_modules/x.js" in names(folder)


def test_only_files_folders_and_links_are_sent(folder: Path, tmp_path: Path) -> None:
    os.mkfifo(folder / "fifo")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / "socket"))
        there = unpacked(packed(folder), tmp_path / "there")
    assert sorted(os.listdir(there / "es")) == ["data", "main.py"]


def test_unreadable_files_are_left_out(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(path: str, *args: int) -> int:
        if path.endswith("weights.npy"):
            raise PermissionError(13, "Permission denied", path)
        return opening(path, *args)

    opening = os.open
    monkeypatch.setattr(os, "open", refusing)
    archive = packed(folder)
    monkeypatch.undo()
    assert tree(unpacked(archive, tmp_path / "there")) == {
        "es": None,
        "es/data": None,
        "es/main.py": b"import es",
    }


# Links


def test_links_within_the_folder_stay_links(folder: Path, tmp_path: Path) -> None:
    (folder / "latest").symlink_to("data")
    (folder / "data/up.py").symlink_to(folder / "main.py")
    there = unpacked(packed(folder), tmp_path / "there")
    assert os.readlink(there / "es/latest") == "data"
    assert os.readlink(there / "es/data/up.py") == "../main.py"
    assert (there / "es/data/up.py").read_text() == "import es"


def test_links_to_elsewhere_are_left_out_unless_they_are_asked_for(
    folder: Path, tmp_path: Path
) -> None:
    shared = write(tmp_path / "shared", tool_py="x", deep__y_py="y", deep__server_key="key")
    (shared / "deep/again").symlink_to(shared)
    (shared / "deep/on").symlink_to(tmp_path)
    (folder / "shared").symlink_to(shared)
    (folder / "one.py").symlink_to(shared / "tool.py")
    (folder / "gone").symlink_to(tmp_path / "nothing")
    assert set(reasons(folder)) == {"shared", "one.py"}
    assert names(folder) == {"main.py", "data/weights.npy"}
    (folder / ".fiberignore").write_text("!/shared\n!one.py\n")
    assert set(reasons(folder)) == {"shared/deep/on", "shared/deep/server.key"}
    there = tree(unpacked(packed(folder), tmp_path / "there"))
    assert there["es/one.py"] == there["es/shared/tool.py"] == b"x"
    assert there["es/shared/deep/y.py"] == b"y"
    assert not [name for name in there if "gone" in name or "again" in name]


def test_a_package_behind_a_link_is_sent_once_it_is_imported(folder: Path, tmp_path: Path) -> None:
    shared = write(tmp_path / "shared", tool_py="x", later_py="y")
    (folder / "shared").symlink_to(shared)
    there = unpacked(packed(folder, files=(folder / "shared/tool.py",)), tmp_path / "there")
    assert (there / "es/shared/later.py").read_text() == "y"


# Secrets

PRIVATE = "-----BEGIN PRIVATE KEY-----\n" + "A" * 64 + "\n"


def reasons(folder: Path, *others: Path) -> dict[str, tuple[Why, str]]:
    """Return the excluded files with the reasons."""
    return {
        os.path.relpath(left.path, folder): (left.why, left.detail)
        for left in program_files.select(layout(folder, *others)).left_out
    }


def test_secrets_are_left_out_and_named(folder: Path) -> None:
    (folder / ".aws").mkdir()
    (folder / ".aws/credentials").write_text("x")
    (folder / "server.pem").write_text("x")
    (folder / "data/.env").write_text("x")
    assert reasons(folder) == {
        ".aws": (Why.SECRET, "credentials of AWS"),
        "server.pem": (Why.SECRET, "private keys"),
        "data/.env": (Why.SECRET, "environment variables"),
    }
    assert names(folder) == {"main.py", "data/weights.npy"}


def test_secrets_that_fiberignore_includes_by_name_are_sent(folder: Path) -> None:
    for name in (".env", "data/.env", "a.pem", "b.pem"):
        (folder / name).write_text("x")
    (folder / ".kube").mkdir()
    (folder / ".kube/config").write_text("kind: Config\nusers: [{user: {token: x}}]")
    (folder / ".fiberignore").write_text("!data/\n!/.env\n!*.pem\n!.kube/\n")
    assert set(reasons(folder)) == {"data/.env"}  # not by the name of a folder around it
    (folder / "data/.gitignore").write_text("!.env\n")
    assert set(reasons(folder)) == {"data/.env"}  # what git has is not what workers need


def test_secrets_that_are_ignored_are_no_news(folder: Path) -> None:
    (folder / ".env").write_text("x")
    (folder / ".gitignore").write_text(".env\n")
    assert reasons(folder) == {".env": (Why.IGNORED, f"'.env' in {folder}/.gitignore")}


def test_a_secret_that_a_link_with_another_name_leads_to_is_left_out(
    folder: Path, tmp_path: Path
) -> None:
    home = write(tmp_path / "home", keys__id_rsa="x")
    (home / "keys").rename(home / ".ssh")
    (home / ".ssh/id.rsa").rename(home / ".ssh/id_rsa")
    (folder / "notes").symlink_to(home)
    (folder / ".fiberignore").write_text("!notes\n")
    assert reasons(folder) == {"notes/.ssh": (Why.SECRET, "private keys")}
    (home / "plain").symlink_to(home / ".ssh")
    assert set(reasons(folder)) == {"notes/.ssh", "notes/plain"}


def test_a_secret_that_was_imported_is_code(folder: Path) -> None:
    secret = write(folder, secrets_json="{}") / "secrets.json"
    sent = program_files.select(layout(folder, files=(secret,)))
    assert "es/secrets.json" in sent.files
    assert sent.left_out == ()


# Names and changes


def test_names_of_any_bytes_come_back(folder: Path, tmp_path: Path) -> None:
    odd = [b"\xff\xfe", "zwölf ☃".encode(), b"new\nline", b"-", b"x" * 250, b" blank "]
    for name in odd:
        Path(os.fsdecode(os.path.join(os.fsencode(folder), name))).write_bytes(name)
    there = unpacked(packed(folder), tmp_path / "there")
    found = {name: data for name, data in tree(there / "es").items() if isinstance(data, bytes)}
    assert {os.fsencode(name) for name in found} >= set(odd)
    assert found[os.fsdecode(odd[0])] == odd[0]


def test_rules_hold_for_names_with_line_breaks(folder: Path) -> None:
    odd = folder / "new\nline"
    write(odd, run__a_log="x", a_txt="x", server_key="x")
    (odd / "a.log\n").write_text("x")
    (folder / ".gitignore").write_text("*.log\n")
    assert names(folder) == {".gitignore", "main.py", "data/weights.npy", *(
        f"new\nline/{name}" for name in ("a.txt", "a.log\n")
    )}  # fmt: skip
    assert reasons(folder)["new\nline/server.key"] == (Why.SECRET, "private keys")


@pytest.mark.parametrize("name", ["new\nline.key", "a[1]*?!.key", "b .key ", "\udcff.key", "ä.key"])
def test_the_line_that_a_warning_advises_has_the_file_sent(folder: Path, name: str) -> None:
    secret = folder / name
    secret.write_text(PRIVATE)
    found = layout(folder)
    assert set(reasons(folder)) == {name}
    quoted = re.search(r"for example ('.*?'|\".*?\")\.", shipping._advice(found, str(secret)))
    assert quoted
    (folder / ".fiberignore").write_text(ast.literal_eval(quoted[1]) + "\n")
    assert reasons(folder) == {}


@pytest.mark.parametrize(
    ("changes", "text", "torn"),
    [(2, "it is whole now", []), (99, "the end of all: ", ["main.py"])],
)
def test_a_file_that_changes_while_it_is_read_is_read_again_and_else_named(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    changes: int,
    text: str,
    torn: list[str],
) -> None:
    found = files(folder)
    fstat, left = os.fstat, ["the end of all: "] * (changes - 1) + ["it is whole now"]

    def changing(fd: int) -> os.stat_result:
        status = fstat(fd)
        if left and status.st_ino == (folder / "main.py").stat().st_ino:
            (folder / "main.py").write_text(left.pop(0))
            os.utime(folder / "main.py", ns=(0, time.time_ns() + len(left)))
        return status

    monkeypatch.setattr(os, "fstat", changing)
    packed = shipping.pack(layout(folder), found)
    monkeypatch.undo()
    there = unpacked(packed.archive, tmp_path / "there")
    assert (there / "es/main.py").read_text() == text
    assert packed.torn == [str(folder / name) for name in torn]


def test_a_file_that_is_gone_when_it_is_read_is_left_out(folder: Path, tmp_path: Path) -> None:
    found = files(folder)
    (folder / "main.py").unlink()
    archive = shipping.pack(layout(folder), found).archive
    assert "es/main.py" not in tree(unpacked(archive, tmp_path / "there"))


# The bound


def test_a_program_that_is_too_large_is_an_error_with_its_largest_files_and_advice(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_files, "LIMIT", 3 << 20)
    write(folder, model_bin=bytes(2 << 20), data__more_npy=bytes(3 << 20))
    with pytest.raises(ProgramTooLarge) as caught:
        files(folder)
    largest = [f"{folder}/{name}" for name in ("data/", "model.bin", "main.py")]
    assert list(caught.value.largest) == largest
    said = str(caught.value)
    assert "it has 5.0 MiB, and at most 3.0 MiB are sent" in said
    assert f"3.0 MiB  {folder}/data/" in said
    assert f"{folder}/.fiberignore" in said
    (folder / ".fiberignore").write_text("model.bin\ndata/\n")
    assert names(folder) == {".fiberignore", "main.py"}


def test_a_file_that_grows_beyond_the_limit_during_packing_is_the_same_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_files, "LIMIT", 1 << 20)
    found = files(folder)
    write(folder, main_py=bytes(2 << 20))
    with pytest.raises(ProgramTooLarge, match="files that are growing"):
        shipping.pack(layout(folder), found)


def test_a_program_with_too_many_files_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_files, "MOST_FILES", 3)
    with pytest.raises(ProgramTooLarge, match="more than 3 files"):
        files(folder)


# Refused archives


def archive_of(**members: dict[str, object]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, fields in members.items():
            member = tarfile.TarInfo(name)
            for field, value in fields.items():
                setattr(member, field, value)
            archive.addfile(member)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "members",
    [
        {"/etc/passwd": {}},
        {"../up": {}},
        {"a/../../up": {}},
        {"..": {"type": tarfile.DIRTYPE}},
        {"link": {"type": tarfile.SYMTYPE, "linkname": "/etc"}},
        {"link": {"type": tarfile.SYMTYPE, "linkname": "a/../../etc"}},
    ],
)
def test_paths_that_lead_out_of_the_folder_are_refused(
    members: dict[str, dict[str, object]], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="leads out of the folder"):
        unpacked(archive_of(**members), tmp_path / "there")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", [tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.LNKTYPE])
def test_other_kinds_of_members_are_refused(kind: bytes, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="neither a file nor a folder nor a link"):
        unpacked(archive_of(odd={"type": kind, "linkname": "x"}), tmp_path / "there")


def test_no_file_is_written_through_a_link(tmp_path: Path) -> None:
    members: dict[str, dict[str, object]] = {
        "a": {"type": tarfile.SYMTYPE, "linkname": "b"},
        "a/x": {},
    }
    with pytest.raises(FileNotFoundError):
        unpacked(archive_of(**members), tmp_path / "there")


def test_a_truncated_archive_leaves_no_file(folder: Path, tmp_path: Path) -> None:
    write(folder, random_bin=os.urandom(1 << 16))
    with pytest.raises((tarfile.ReadError, EOFError)):
        unpacked(packed(folder)[:-1000], tmp_path / "there")
    assert not (tmp_path / "there").exists()
