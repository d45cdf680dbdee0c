"""Helm for the tests of the chart."""

from __future__ import annotations

import os

import pytest

from chart.helm import Helm, find_helm
from cluster import places


@pytest.fixture(scope="session")
def helm(tmp_path_factory: pytest.TempPathFactory) -> Helm:
    program = find_helm()
    if program is None:
        missing = f"no helm on the PATH or in {places.programs()}: the chart is not tested"
        if os.environ.get("CI") == "true":
            pytest.fail(f"{missing}, and CI=true", pytrace=False)
        pytest.skip(missing)
    return Helm(program, tmp_path_factory.mktemp("helm"))
