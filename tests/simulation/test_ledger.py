"""The ledger keeps its promises through all faults of workers, hosts and links."""

from __future__ import annotations

import pytest

from simulation.suites import PARTS, examine_part


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_the_ledger_keeps_its_promises(part: int) -> None:
    examine_part("ledger", part)
