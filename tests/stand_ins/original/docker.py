"""Stands in for the package docker in tests that only ask which containers run."""

from __future__ import annotations


class _Client:
    @property
    def containers(self) -> _Client:
        return self

    def list(self) -> list[object]:
        return []


def from_env() -> _Client:
    return _Client()
