"""Visits of subtasks: ends, false ends, delays, visits broken off."""

from types import SimpleNamespace

import pytest

from surgicai_vision.envs.success import Verdict
from surgicai_vision.envs.visits import LAST, Visit, VisitWatch
from surgicai_vision.evaluation.metrics import measured_ends


def visits_of(*script: tuple[int, int, str]) -> tuple[Visit, ...]:
    """Return the visits of an episode of (steps, phase, what holds): "m" met, "-" no needle."""
    state = SimpleNamespace(steps=0)
    now = {"holds": ""}
    env = SimpleNamespace(
        phase=0,
        judge=lambda phase: Verdict("m" in now["holds"], "m" in now["holds"]),
        simulation=SimpleNamespace(task_state=state, holds=lambda arm: "-" not in now["holds"]),
    )
    watch = VisitWatch(env)
    watch.begin()
    for steps, phase, holds in script:
        now["holds"] = holds
        for _ in range(steps):
            state.steps += 1
            watch.update({"phase": phase})
    return watch.visits()


def test_a_delay_is_from_the_first_success_to_the_end() -> None:
    grasp, place = visits_of((10, 0, ""), (5, 0, "m"), (5, 0, ""), (3, 1, ""))
    assert grasp == Visit(0, began=0, left=20, following=1, met=11, was_met=False)
    assert (grasp.is_end, grasp.is_false_end) == (True, False)
    assert grasp.delay == pytest.approx(9 / 50)
    assert place == Visit(1, 20, 23, LAST, None, False) and not place.is_end


def test_an_end_before_the_success_is_false_and_a_visit_broken_off_is_no_end() -> None:
    first, second, third, _ = visits_of((4, 0, ""), (4, 1, ""), (4, 0, "m"), (4, 1, ""))
    assert first.is_false_end and first.delay is None
    assert not second.is_end and not second.is_false_end and second.delay is None
    assert third.delay == pytest.approx(3 / 50) and not third.is_false_end


@pytest.mark.parametrize(("holds", "is_false"), [("", False), ("-", True)])
def test_what_was_met_counts_until_the_needle_is_dropped(holds: str, is_false: bool) -> None:
    _, insert, again, _ = visits_of((4, 0, "m"), (4, 2, holds), (4, 0, holds), (4, 1, holds))
    assert insert.following == 0
    assert (again.was_met, again.is_false_end) == (not is_false, is_false)


def test_ends_are_counted_for_each_subtask() -> None:
    visits = visits_of((4, 0, ""), (4, 1, "m"), (4, 2, "m"), (6, 3, ""), (4, 4, "m"))
    rows = {row["subtask"]: row for row in measured_ends(visits)}
    assert rows["grasp"] == {
        "subtask": "grasp",
        "ends": 1,
        "false_ends": 1,
        "median_delay_s": None,
    }
    assert [rows[name]["false_ends"] for name in ("place", "insert", "handoff")] == [0, 0, 1]
    assert rows["place"]["median_delay_s"] == pytest.approx(3 / 50)
    assert rows["pullout"]["ends"] == 0, "the episode ended; nobody ended the subtask"
