"""Subtasks in a bag: found by labels, or by what happens to the needle."""

import dataclasses
import itertools

import numpy as np
import pytest
from bag_writer import shown, streams, write_bag

import surgicai_vision.envs as envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.imports.rosbag import reader, segments
from surgicai_vision.demos.imports.rosbag.config import BagConfig
from surgicai_vision.demos.imports.rosbag.importer import import_bags
from surgicai_vision.demos.imports.rosbag.resample import resample
from surgicai_vision.demos.store import read_demo
from surgicai_vision.scene.holes import PAIRS

WHOLE = BagConfig(drop_pauses=False)
PAIR = PAIRS["simple"][0]


def recorded(path, config=WHOLE):
    return resample(reader.read(path, config.all_topics), config, "400006")


def test_events_find_the_five_subtasks_of_a_stitch(tmp_path):
    motion = shown("suture")
    recording = recorded(write_bag(tmp_path / "trial", "mcap", streams(motion, labels=False)))
    found = segments.segments(recording, PAIR, WHOLE, None)
    assert [segment.task for segment in found] == list(names.SUBTASKS)
    assert all(one.stop == other.start for one, other in itertools.pairwise(found))
    for phase, segment in enumerate(found):
        inside = motion.phase[segment.start : segment.stop] == phase
        assert inside.mean() > 0.8, segment
    grasp, _, insert, handoff, pullout = found
    first, second = (segments.holds(recording, arm) for arm in names.ARMS)
    passed = segments.holes_passed(recording.needle, PAIR)
    assert not second[: grasp.stop].any()
    assert second[grasp.stop]
    assert (passed[insert.start - 1], passed[insert.start], passed[insert.stop]) == (0, 1, 2)
    assert not first[: handoff.stop].any()
    assert first[handoff.stop]
    assert passed[pullout.stop] == 3
    moved = np.linalg.norm(
        recording.needle[handoff.start, :3, 3] - recording.needle[handoff.stop, :3, 3]
    )
    assert moved <= segments.ARRIVED


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_events_know_a_single_subtask(tmp_path, task):
    motion = shown(task, 3)
    bag = write_bag(tmp_path / "trial", "mcap", streams(motion, labels=False))
    (made,) = import_bags([bag], task=None, out=tmp_path / "demos")
    assert (made.task, made.succeeded) == (task, 1)
    assert len(read_demo(made.paths[0])) > 0.9 * (len(motion) - 1)


def test_events_find_a_second_stitch(tmp_path):
    motion = shown("suture")
    twice = dataclasses.replace(
        motion,
        **{
            key: {arm: np.concatenate([a, a]) for arm, a in getattr(motion, key).items()}
            for key in ("tip", "jaw")
        },
        needle=np.concatenate([motion.needle] * 2),
        phase=np.tile(motion.phase, 2),
    )
    recording = recorded(write_bag(tmp_path / "trial", "mcap", streams(twice, labels=False)))
    found = [segment.task for segment in segments.segments(recording, PAIR, WHOLE, None)]
    assert found == [*names.SUBTASKS, *names.SUBTASKS]


def test_noise_of_a_tracker_leaves_the_subtasks_as_they_are(tmp_path):
    motion = shown("suture")
    rng = np.random.default_rng(0)
    needle = motion.needle.copy()
    needle[:, :3, 3] += rng.normal(0, 0.00005, (len(needle), 3))
    tip = {arm: poses_.copy() for arm, poses_ in motion.tip.items()}
    for poses_ in tip.values():
        poses_[:, :3, 3] += rng.normal(0, 0.00005, (len(needle), 3))
    noisy = dataclasses.replace(motion, tip=tip, needle=needle)
    clean, other = (
        segments.segments(
            recorded(write_bag(tmp_path / name, "mcap", streams(some, labels=False))),
            PAIR,
            WHOLE,
            None,
        )
        for name, some in (("clean", motion), ("noisy", noisy))
    )
    assert [segment.task for segment in other] == list(names.SUBTASKS)
    assert all(abs(a.stop - b.stop) <= 10 for a, b in zip(clean, other, strict=True))


def test_labels_of_other_systems_are_translated_and_unknown_ones_named(tmp_path):
    found = streams(shown("suture"))
    times, _ = found["label"]
    found["label"] = times, ["Approach", "S2", "", "Regrasp", "idle"]
    bag = write_bag(tmp_path / "trial", "mcap", found)
    with pytest.raises(InputError, match=r"label 'S2'.*labels:"):
        import_bags([bag], task=None, out=tmp_path / "demos")
    made = import_bags(
        [bag], task=None, out=tmp_path / "demos", config=BagConfig(labels={"s2": "place"})
    )
    assert [row.task for row in made] == ["grasp", "place", "handoff"]


@pytest.mark.parametrize("task", ["place", "insert", "handoff"])
def test_without_a_needle_it_lies_where_the_task_puts_it(tmp_path, task):
    found = streams(shown(task))
    del found["needle"]
    bag = write_bag(tmp_path / "trial", "mcap", found)
    (made,) = import_bags([bag], task=task, out=tmp_path / "demos")
    demo = read_demo(made.paths[0])
    env = envs.make(demo.config)
    env.set_state_vector(demo.state[-1])
    assert env.measure()["d_trans"] < 0.006


def test_nothing_to_segment_by_is_said(tmp_path):
    found = streams(shown("place"), labels=False)
    del found["needle"]
    bag = write_bag(tmp_path / "trial", "mcap", found)
    with pytest.raises(InputError, match=r"neither labels nor a needle pose.*--task"):
        import_bags([bag], task=None, out=tmp_path / "demos")
    with pytest.raises(InputError, match="need the needle's pose"):
        import_bags(
            [bag], task=None, out=tmp_path / "demos", config=BagConfig(segmentation="events")
        )
    with pytest.raises(InputError, match="/subtask"):
        import_bags(
            [bag], task=None, out=tmp_path / "demos", config=BagConfig(segmentation="labels")
        )
