"""Pacer: the requested pace, the pace reached, and changes of pace."""

import pytest
from told_clock import Clock

from surgicai_vision.core.pacer import MEMORY_TICKS, Pacer


def run(pacer, clock, cost, ticks):
    for _ in range(ticks):
        clock.now += cost
        pacer.wait()


@pytest.mark.parametrize(
    ("pace", "cost", "reached"), [(1.0, 0.005, 1.0), (0.5, 0.005, 0.5), (1.0, 0.08, 0.25)]
)
def test_the_pace_is_kept_where_the_work_allows_and_said_where_not(pace, cost, reached):
    pacer = Pacer(pace, clock := Clock(), clock.sleep)
    run(pacer, clock, cost, 10 * MEMORY_TICKS)
    assert pacer.reached == pytest.approx(reached, rel=1e-3)


def test_another_pace_holds_from_the_next_tick_on():
    pacer = Pacer(1.0, clock := Clock(), clock.sleep)
    run(pacer, clock, 0.001, 50)
    before = clock.now
    pacer.set_pace(4.0)
    run(pacer, clock, 0.001, 200)
    assert clock.now - before == pytest.approx(200 / 200, abs=0.03)


@pytest.mark.parametrize("patience", [2, 7])
def test_an_image_is_due_after_so_many_late_ticks(patience):
    pacer = Pacer(1.0, clock := Clock(), clock.sleep, patience=patience)
    drawn = []
    for _ in range(5 * patience):
        clock.now += 0.05
        drawn.append(pacer.can_draw())
        pacer.wait()
    assert [index for index, due in enumerate(drawn) if due] == [
        patience * (count + 1) - 1 for count in range(5)
    ]
