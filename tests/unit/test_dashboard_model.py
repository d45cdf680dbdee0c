"""The model of the live page: snapshots that are merged, samples, and shares of processors."""

from __future__ import annotations

import copy
import itertools
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._cli import dashboard_model
from fiber._cli.dashboard_model import ProgramModel, SampleHistory
from fiber._engine.activity import Activity, WorkReport

NOTHING: dict[str, Any] = {"pools": [], "children": [], "deaths": []}


class Played:
    """Program whose activity is recorded, and the model that follows it."""

    def __init__(self, spans: int = 20_000) -> None:
        self.now = 0.0
        self.activity = Activity(0.0, spans)
        self.children = [self.activity.add_child(f"w{number}", 0.0) for number in range(3)]
        self.model = ProgramModel()
        self.model.program = {"name": "played"}
        self.since = 0

    def work(self, number: int, function: str, seconds: float) -> None:
        begin, self.now = self.now, self.now + seconds
        report = WorkReport(function, begin, self.now, seconds, 1, int(function == "g"))
        self.activity.worked(self.children[number], report)

    def snapshot(self, since: int) -> dict[str, Any]:
        found = {"start": 5.0, **self.activity.snapshot(self.now, since)}
        return dict(json.loads(json.dumps(found)))

    def look(self) -> None:
        found = self.snapshot(self.since)
        self.since = found["revision"]
        self.model.merge_activity(found)
        self.model.merge_state(copy.deepcopy(NOTHING))

    def check(self) -> None:
        """Compare the merged model with a complete snapshot."""
        self.look()
        expected = self.snapshot(0)
        merged = self.model.complete()["activity"]
        for each in (expected, merged):
            del each["revision"]
            each["children"].sort(key=lambda child: child["id"])
        assert merged == expected


WORK = st.tuples(
    st.integers(0, 2), st.sampled_from("fg"), st.sampled_from([1e-4, 1e-2, 1.0]), st.booleans()
)


@given(st.lists(WORK, max_size=80), st.sampled_from([8, 20_000]))
def test_merged_snapshots_are_a_complete_one(work: list[Any], spans: int) -> None:
    played = Played(spans)
    for number, function, seconds, looks in work:
        played.work(number, function, seconds)
        if looks:
            played.check()
    played.check()


def test_a_new_record_of_the_program_replaces_the_model() -> None:
    played = Played()
    played.work(0, "f", 1.0)
    played.look()
    anew = Played().snapshot(0)
    played.model.merge_activity({**anew, "start": 60.0, "now": 0.5})
    played.model.merge_state(copy.deepcopy(NOTHING))
    found = played.model.complete()
    assert found["activity"]["tasks"] == 0
    assert [sample["at"] for sample in found["samples"]] == [0.5]


def test_a_page_that_is_opened_before_the_first_answer_gets_nothing() -> None:
    assert ProgramModel().complete() == {}


# Samples


def test_the_number_of_samples_is_bounded_and_they_span_the_run() -> None:
    history = SampleHistory()
    for second in range(10_000):
        history.add({"at": float(second)})
        assert history.all()[-1]["at"] == second
    times = [sample["at"] for sample in history.all()]
    assert dashboard_model._MOST_SAMPLES / 3 < len(times) <= dashboard_model._MOST_SAMPLES
    assert times[0] == 0
    gaps = [later - earlier for earlier, later in itertools.pairwise(times[:-1])]
    assert max(gaps) <= 4 * min(gaps)


def child(**facts: Any) -> dict[str, Any]:
    return {"name": "w", "host": "h", "pid": 7, "state": "busy", **facts}


def sample_of(model: ProgramModel, now: float, *children: dict[str, Any]) -> dict[str, Any]:
    model.merge_activity({"start": 5.0, "now": now, "complete": False, "children": []})
    pools = [{"waiting": 3, "held": 2}, {"waiting": 1, "held": 0}]
    return model.merge_state({"pools": pools, "children": list(children), "deaths": []})


def test_a_sample_has_the_figures_of_all_pools_and_children() -> None:
    model = ProgramModel()
    children = [child(memory=100, cpu=2.0), child(pid=8, state="idle", memory=50, cpu=None)]
    first = sample_of(model, 1.0, *children)
    assert first == {
        "at": 1.0,
        "waiting": 4,
        "held": 2,
        "states": {"busy": 1, "idle": 1},
        "memory": 150,
        "share": None,  # it takes two readings
    }
    second = sample_of(model, 3.0, child(cpu=3.0), child(pid=8), child(pid=9, cpu=100.0))
    assert second["share"] == 0.5
    assert second["memory"] is None


@pytest.mark.parametrize("facts", [{}, {"memory": None, "cpu": None}])
def test_memory_and_processor_time_may_be_unknown(facts: dict[str, Any]) -> None:
    model = ProgramModel()
    sample = sample_of(model, 1.0, child(**facts))
    assert (sample["memory"], sample["share"]) == (None, None)
