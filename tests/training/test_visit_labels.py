"""Visits: the subtask that is due, and the progress within the present one."""

import numpy as np
import pytest

from surgicai_vision.core import names
from surgicai_vision.core.config import DWELL
from surgicai_vision.core.errors import InputError
from surgicai_vision.training.visits import AHEAD, UNKNOWN, find_visits, progress, stages

Columns = dict[str, np.ndarray]


def episode(*visits: tuple[int, int], success: int = 1) -> Columns:
    """Return an episode of (phase, control steps) visits; its last `success` steps met the task."""
    phase = np.concatenate([np.full(steps, phase) for phase, steps in visits])
    steps = np.arange(len(phase))
    return {
        names.PHASE: phase,
        names.SUCCESS: steps >= len(phase) - success,
        "timestamp": steps.astype(np.float32) / np.float32(names.FPS),
    }


def joined(*episodes: Columns) -> tuple[Columns, np.ndarray]:
    """Return the columns of several episodes, and the episode number of every row."""
    index = np.repeat(np.arange(len(episodes)), [len(one[names.PHASE]) for one in episodes])
    return {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}, index


def thinned(columns: Columns, index: np.ndarray, stride: int) -> tuple[Columns, np.ndarray]:
    position = np.arange(len(index)) - np.searchsorted(index, index)
    kept = position % stride == 0
    return {key: values[kept] for key, values in columns.items()}, index[kept]


PROCEDURE = episode(*((phase, 40 + 10 * phase) for phase in range(5)))
RECOVERY = episode((0, 40), (1, 30), (0, 50), (1, 35), (2, 60), (3, 40), (4, 30))
"""The needle is lost 30 steps into placing, and grasped again."""


def test_progress_rises_from_0_to_1_where_the_success_first_held() -> None:
    columns, index = joined(PROCEDURE, PROCEDURE)
    share = stages(columns, index)[:, 1]
    found = find_visits(columns[names.PHASE], index)
    assert len(found.first) == 10 and found.is_finished.all()
    for visit, (first, last) in enumerate(zip(found.first, found.last, strict=True)):
        mine = share[first : last + 1]
        assert mine[0] == 0.0
        steps = np.diff(mine)
        assert (steps >= 0).all()
        rising = steps[steps > 0]
        np.testing.assert_allclose(rising, rising[0], atol=1e-5)
        if not found.ends_episode[visit]:
            assert (mine == 1).sum() == DWELL - 1, "the frames that show a success that is held"
        else:
            assert mine[-1] == pytest.approx(1 - 1 / len(mine)), "the last frame precedes it"


def test_going_back_is_due_from_the_loss_on_and_not_from_where_it_is_noticed() -> None:
    columns, index = joined(RECOVERY)
    plain = stages(columns, index)
    held = np.ones(len(index), bool)
    held[58:70] = False  # the last twelve steps of the placing that was broken off
    held[20:24] = False  # a grasp that flickers; it was not broken off
    lost = stages(columns | {names.CONTACT: held}, index)
    assert (lost[58:70, 0] == 0).all() and (plain[58:70, 0] == 1).all()
    np.testing.assert_array_equal(
        np.delete(lost, np.s_[58:70], 0), np.delete(plain, np.s_[58:70], 0)
    )
    never = stages(columns | {names.CONTACT: np.zeros(len(index), bool)}, index)
    np.testing.assert_array_equal(never, plain)


def test_an_env_holds_a_success_as_long_as_progress_says() -> None:
    """Count the steps as `envs.suture` does: the step that fills the dwell is the visit's last."""
    length = 40
    succeeds = 20  # the step after which the success is first measured
    dwell, phase = 0, []
    for step in range(length):
        phase.append(int(dwell >= DWELL))
        dwell = dwell + 1 if step >= succeeds and dwell < DWELL else dwell
    recorded = np.array(phase)
    steps = np.arange(length)
    share = progress(recorded, steps, np.zeros(length, int), np.zeros(length, bool))
    assert np.flatnonzero(share == 1)[0] == succeeds + 1, "the first frame that shows it"


def test_frames_after_the_success_of_an_episode_are_at_1() -> None:
    columns, index = joined(episode((0, 60), success=21))
    share = stages(columns, index)[:, 1]
    assert share[39] < 1 and (share[40:] == 1).all() and len(share[40:]) == 20
    np.testing.assert_allclose(share[:41], np.arange(41) / 40, atol=1e-6)


def test_a_visit_that_was_broken_off_has_no_progress() -> None:
    columns, index = joined(RECOVERY)
    target = stages(columns, index)
    broken = slice(40, 70)
    assert (target[broken, 1] == UNKNOWN).all()
    others = np.delete(target[:, 1], np.arange(40, 70))
    assert (others >= 0).all() and (others <= 1).all()
    assert target[70, 1] == 0.0, "grasping begins anew"


def test_labels_are_ahead_but_never_tell_what_nothing_shows() -> None:
    columns, index = joined(RECOVERY, PROCEDURE)
    due = stages(columns, index)[:, 0]
    phase = columns[names.PHASE]
    assert (due[40 - AHEAD : 40] == 1).all() and due[39 - AHEAD] == 0
    assert (due[40:70] == 1).all(), "before the upset nothing shows it"
    assert due[70] == 0, "after it the label is at once what was returned to"
    assert (due[120 - AHEAD : 120] == 1).all()
    last = np.searchsorted(index, index, side="right") - 1
    assert (due[index == 0][-AHEAD:] == 4).all(), "not the next episode's first phase"
    whole = index == 1
    later = np.minimum(np.arange(len(index)) + AHEAD, last)
    np.testing.assert_array_equal(due[whole], phase[later][whole])


def test_a_label_ahead_does_not_pass_over_a_short_visit_that_was_broken_off() -> None:
    columns, index = joined(episode((0, 40), (1, 4), (0, 40), (1, 40)))
    due = stages(columns, index)[:, 0]
    assert (due[40 - AHEAD : 44] == 1).all() and due[44] == 0


def test_thinned_frames_have_the_labels_of_their_time() -> None:
    columns, index = joined(RECOVERY, PROCEDURE)
    whole = stages(columns, index)
    few, few_index = thinned(columns, index, 5)
    target = stages(few, few_index)
    position = np.arange(len(index)) - np.searchsorted(index, index)
    kept = whole[position % 5 == 0]
    np.testing.assert_array_equal(target[:, 0], kept[:, 0])
    np.testing.assert_array_equal(target[:, 1] < 0, kept[:, 1] < 0)
    # The end of a visit is known only from the next kept frame.
    assert np.abs(target[:, 1] - kept[:, 1]).max() <= 5 / (30 - DWELL)


def test_what_has_no_subtasks_is_refused() -> None:
    columns, index = joined(PROCEDURE)
    with pytest.raises(InputError, match="phases from -1"):
        stages({**columns, names.PHASE: columns[names.PHASE] - 1}, index)
    restarted = np.tile(np.arange(len(index) // 2), 2) / names.FPS
    with pytest.raises(InputError, match="--subtask"):
        stages({**columns, "timestamp": restarted}, index)
