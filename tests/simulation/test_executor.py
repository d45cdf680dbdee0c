"""The real executor keeps the pool's promises, on hosts near and far."""

from __future__ import annotations

import pytest

from simulation.suites import PARTS, examine_part


@pytest.mark.parametrize("part", range(PARTS))
def test_the_executor_keeps_the_promises_of_a_pool(part: int) -> None:
    examine_part("executor", part)


@pytest.mark.parametrize("part", range(PARTS))
def test_it_keeps_them_over_real_links_to_real_agent_services(part: int) -> None:
    examine_part("remote", part)
