"""Files that look like secrets."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path

import pytest

from fiber._backends import program_files

BODY = base64.encodebytes(bytes(range(200))).decode()
CERTIFICATE = f"-----BEGIN CERTIFICATE-----\n{BODY}-----END CERTIFICATE-----\n"


def key(kind: str = "") -> str:
    return f"-----BEGIN {kind}PRIVATE KEY-----\n{BODY}-----END {kind}PRIVATE KEY-----\n"


def found(path: Path) -> str | None:
    status = path.stat()
    return program_files.secret_in_file(str(path), status.st_size, status.st_mtime_ns)


@pytest.mark.parametrize(
    "name",
    [
        ".env",
        ".env.local",
        "prod.env",
        ".ENV",
        ".netrc",
        ".npmrc",
        ".pypirc",
        ".git-credentials",
        "kubeconfig",
        "kubeconfig.yaml",
        "dev.kubeconfig",
        "server.pem",
        "server.key",
        "store.p12",
        "id_rsa",
        "id_ed25519",
        "id_ed25519_sk",
        "credentials.json",
        "client_secret_12.json",
        "service-account-prod.json",
        "secrets.toml",
        "credentials.yml",
        "secrets.ini",
        "AuthKey_ABC.p8",
        ".flaskenv",
        ".bash_history",
        "rclone.conf",
        "terraform.tfstate",
        "terraform.tfstate.backup",
        "prod.tfvars",
        "prod.auto.tfvars.json",
        ".docker/config.json",
        "gh/hosts.yml",
        "gcloud/credentials.db",
        "huggingface/token",
        ".env~",
        "prod.env.bak",
        ".netrc.old",
        "#.env#",
        "..env.swp",
    ],
)
def test_files_with_names_of_secrets_are_found(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("x")
    assert found(path)


@pytest.mark.parametrize(
    "name",
    [
        ".env.example",
        "environment",
        "id_rsa.pub",
        "config.json",
        "keys.txt",
        "monkey",
        "credentials.py",
        "credentials.md",
        "credentials.yml.example",
        "secrets.py",
        "main.tf",
        "terraform.tfvars.example",
        "history",
        "hosts.yml",
        "token",
        "tokens.txt",
        "tokenizer.json",
        "settings.xml",
        "environment.yml",
        "train_env.yaml",
        "gcloud.sh",
        "rclone.sh",
        "model.p8.onnx",
        "kubeconfig.py",
        "notes.txt~",
        "#",
    ],
)
def test_files_with_harmless_names_are_not_secret(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    assert found(tmp_path / name) is None


@pytest.mark.parametrize("name", [".aws", ".envs", ".ssh", ".Kube"])
def test_folders_with_names_of_secrets_are_found(name: str) -> None:
    assert program_files.secret_in_folder(name)


@pytest.mark.parametrize(
    "name", ["aws", "envs", "environments", "gcloud", "gh", "secrets", ".github"]
)
def test_folders_with_harmless_names_are_not_secret(name: str) -> None:
    assert program_files.secret_in_folder(name) is None


SECRETS = {
    "key": key(),
    "old key": key("RSA "),
    "key of ssh": key("OPENSSH "),
    "key after a certificate": CERTIFICATE + key("EC "),
    "key in one line": json.dumps({"key": key()}),
    "encrypted key": key("RSA ").replace("KEY-----\n", "KEY-----\nProc-Type: 4,ENCRYPTED\n\n", 1),
    "key of PuTTY": "PuTTY-User-Key-File-3: ssh-ed25519\n",
    "kubeconfig": "apiVersion: v1\nkind: Config\nusers:\n- user:\n    client-key-data: TFM=\n",
    "kubeconfig as JSON": json.dumps({"kind": "Config", "users": [{"user": {"token": "abc"}}]}),
    "credentials of AWS": f"[default]\naws_secret_access_key = {'aB3/' * 10}\n",
    "exported credentials of AWS": f"export AWS_SECRET_ACCESS_KEY='{'aB3+' * 10}'\n",
    "answer of AWS": json.dumps({"SecretAccessKey": "aB3/" * 10}),
    "user of Google Cloud": json.dumps({"type": "authorized_user", "refresh_token": "1//0e"}),
    "age": "AGE-SECRET-KEY-1" + "QPZRY9X8GF" * 5 + "2TVDW0S3",
    "GitHub": f"token: ghp_{'aB3d' * 9}\n",
    "GitHub, finely grained": f"github_pat_{'aB3d' * 5}aB_{'aB3d' * 14}aB3",
    "GitLab": f"glpat-{'aB3d' * 5}",
    "Hugging Face": f"HF_TOKEN=hf_{'aBcD' * 8}eF\n",
    "PyPI": f"password = pypi-AgEIcHlwaS5vcmc{'aB3d' * 15}",
    "npm": f"_authToken=npm_{'aB3d' * 9}\n",
    "Slack": f"xoxb-{'123' * 4}-{'123' * 4}-{'aB3d' * 6}",
    "Stripe": f"sk_live_{'aB3d' * 6}",
    "Anthropic": f"sk-ant-api03-{'aB3d' * 23}-AA",
    "OpenAI": f"sk-proj-{'aB3d' * 10}T3BlbkFJ{'aB3d' * 10}",
    "service account": json.dumps({"type": "service_account", "private_key": "..."}),
}


@pytest.mark.parametrize("name", SECRETS)
def test_files_with_secret_contents_are_found(tmp_path: Path, name: str) -> None:
    (tmp_path / "notes.txt").write_text(SECRETS[name])
    assert found(tmp_path / "notes.txt")
    (tmp_path / "module.py").write_text(SECRETS[name])
    assert found(tmp_path / "module.py") is None


@pytest.mark.parametrize(
    "text",
    [
        "write -----BEGIN PRIVATE KEY----- and so on",
        "kind: ConfigMap\ndata:\n  token: abc\n",
        "apiVersion: v1\nkind: Config\nclusters: []\n",
        "aws_secret_access_key = YOUR_KEY_HERE",
        '{"type": "service_account", "project": "x"}',
        '{"type": "authorized_user", "name": "x"}',
        f"ghp_YOUR_TOKEN glpat-xxxx hf_xxx sk_test_{'aB3d' * 6} sk-learn-T3BlbkFJ",
        f"from digest_{'aB3d' * 5}-ghp_{'aB3d' * 9}: not a word of its own",
        f"def hf_{'transformer' * 3}_model(): npm_config_registry",
        base64.b64encode(b"OpenAI" * 100).decode(),
        CERTIFICATE,
    ],
)
def test_files_with_harmless_contents_are_not_secret(tmp_path: Path, text: str) -> None:
    (tmp_path / "notes.txt").write_text(text)
    assert found(tmp_path / "notes.txt") is None


def test_certificates_alone_are_public(tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text(CERTIFICATE)
    assert found(tmp_path / "ca.pem") is None
    (tmp_path / "all.pem").write_text(CERTIFICATE + key())
    assert found(tmp_path / "all.pem")


def test_many_certificates_are_public(tmp_path: Path) -> None:
    many = CERTIFICATE * (2 * program_files._HEAD // len(CERTIFICATE))
    (tmp_path / "cacert.pem").write_text(many)
    assert found(tmp_path / "cacert.pem") is None
    (tmp_path / "all.pem").write_text(many + key())
    assert found(tmp_path / "all.pem")


def test_public_keys_are_public(tmp_path: Path) -> None:
    (tmp_path / "jwt.pem").write_text(key().replace("PRIVATE", "PUBLIC"))
    assert found(tmp_path / "jwt.pem") is None
    (tmp_path / "jwt.pem").write_text("x")
    assert found(tmp_path / "jwt.pem")


def test_only_heads_of_small_files_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "data.bin"
    path.write_bytes(bytes(program_files._HEAD) + key().encode())
    assert found(path) is None
    path.write_bytes(key().encode() + bytes(program_files._SMALL))
    monkeypatch.setattr(os, "open", lambda *_: pytest.fail("opened"))
    assert found(path) is None


def test_a_file_is_read_again_once_it_has_changed(tmp_path: Path) -> None:
    path = tmp_path / "data.txt"
    path.write_text(" " * len(key()))
    assert found(path) is None
    path.write_text(key())
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    assert found(path)
