"""Variants: one demonstration in several looks; recorded data stay, splits go by demonstration."""

import dataclasses

import numpy as np
import pytest

from policies.base import Recipe
from surgicai_vision import envs
from surgicai_vision.commands import render_demos as command
from surgicai_vision.commands.console import Console
from surgicai_vision.core import names, shifts
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset import check_dataset, open_dataset, render_demos, schema
from surgicai_vision.dataset.hub import dataset_card
from surgicai_vision.dataset.render_jobs import _Shown
from surgicai_vision.dataset.subset import first_episodes, with_frame_stride
from surgicai_vision.demos.rollout import EpisodeRecorder
from surgicai_vision.demos.store import list_demos, read_demo, write_demo, write_marker
from surgicai_vision.envs.randomisation import UNITS
from surgicai_vision.training.data import split

STEPS = 2
THREE = Variants("train", distractors=5, count=3)


def record(folder, config):
    """Write two short episodes of an arm that moves."""
    env = envs.make(config)
    folder.mkdir()
    for index, seed in enumerate((3, 4)):
        env.reset(seed=seed)
        recorder = EpisodeRecorder(env, seed, "expert")
        for _ in range(STEPS):
            recorder.step(np.array([0.5, 0.5, 0.5, 0, 0, 0, -1], np.float32))
        write_demo(folder, index, recorder.demo())
    write_marker(folder, "grasp", "expert")
    return folder


def render(demos, out, **more):
    return render_demos(demos, out, views=("front",), size=64, context=RunContext(0), **more)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return record(tmp_path_factory.mktemp("variants") / "demos", TaskConfig("grasp"))


@pytest.fixture(scope="module")
def dataset(demos):
    render(demos, demos.parent / "varied", variants=THREE)
    return open_dataset(demos.parent / "varied")


def test_what_was_recorded_is_the_same_in_every_variant_and_what_is_seen_is_not(demos, dataset):
    render(demos, demos.parent / "plain")
    plain = open_dataset(demos.parent / "plain")
    assert plain.variants == 1 and "variants" not in plain.meta
    columns = dataset.columns()
    for key in schema.columns(dataset.views):
        shape = (2, 3, STEPS, -1)
        varied = columns[key].reshape(shape)
        once = plain.columns()[key].reshape(2, 1, STEPS, -1)
        np.testing.assert_array_equal(varied, np.broadcast_to(once, varied.shape), err_msg=key)
    images = dataset.frames("front").reshape(2, 3, STEPS, -1).astype(int)
    own = plain.frames("front").reshape(2, 1, STEPS, -1).astype(int)
    assert (np.abs(images - own).mean(axis=-1) > 5).all()
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (np.abs(images[:, one] - images[:, other]).mean(axis=-1) > 5).all()
    assert dataset.config.randomisation == RandomisationConfig(appearance="train", distractors=5)
    assert check_dataset(dataset.path).ok


def test_a_corruption_of_its_own_lies_on_every_variant_and_on_nothing_else(demos, tmp_path):
    spoilt = Variants("train", distractors=5, count=3, corruption=0.5)
    render(demos, tmp_path / "clean", variants=THREE, depth=True)
    render(demos, tmp_path / "spoilt", variants=spoilt, depth=True)
    clean, dataset = open_dataset(tmp_path / "clean"), open_dataset(tmp_path / "spoilt")
    for key, column in clean.columns().items():
        np.testing.assert_array_equal(dataset.columns()[key], column, err_msg=key)
    np.testing.assert_array_equal(dataset.frames("front_depth"), clean.frames("front_depth"))
    seen, own = (d.frames("front").astype(int).reshape(6, STEPS, -1) for d in (dataset, clean))
    off = np.abs(seen - own).mean(axis=-1)
    assert (off > 1).all()
    assert np.unique(off.mean(axis=1)).size == 6  # each variant has its own strengths
    assert np.ptp(off.mean(axis=1)) > 3
    noise = (seen - own)[:, 0] - (seen - own)[:, 1]
    assert (np.abs(noise).mean(axis=-1) > 0).all()  # and each frame its own draw
    assert check_dataset(dataset.path).ok
    other = tmp_path / "by other code"
    other.mkdir()
    for index, path in enumerate(list_demos(demos)):
        write_demo(other, index, dataclasses.replace(read_demo(path), code_version="another"))
    write_marker(other, "grasp", "expert")
    again = render(other, tmp_path / "again", variants=spoilt, depth=True)
    assert again.digest == dataset.meta["digest"], "what was recorded decides, not its file"


def test_with_a_shift_what_the_arms_report_and_what_is_seen_are_off(demos, tmp_path):
    shifted = dataclasses.replace(THREE, shift=0.5)
    render(demos, tmp_path / "own", variants=THREE)
    render(demos, tmp_path / "off", variants=shifted)
    own, dataset = open_dataset(tmp_path / "own"), open_dataset(tmp_path / "off")
    reported = {names.STATE, names.SETPOINT, names.PRIVILEGED_STATE, names.BOTH_ARMS}
    for key in schema.columns(dataset.views):
        is_same = np.array_equal(dataset.columns()[key], own.columns()[key])
        assert is_same != (key in reported), key  # K and T_world_camera stay nominal
    off = np.abs(dataset.columns()[names.STATE] - own.columns()[names.STATE])[:, :3]
    assert (off.max(axis=1) > 1e-4).all() and off.max() < 0.03, "the pose, in metres"
    assert len(np.unique(off.reshape(6, -1)[:, 0])) == 6, "each variant has its own error"
    images, before = (d.frames("front").astype(int) for d in (dataset, own))
    assert (np.abs(images - before).mean(axis=(1, 2, 3)) > 5).all()
    assert dataset.config == own.config, "a policy is evaluated where nothing is off"
    assert check_dataset(dataset.path).ok


@pytest.mark.parametrize("strength", [0.2, 1.0])
def test_a_shift_goes_as_far_as_robustness_at_its_strength(demos, strength):
    demo = read_demo(list_demos(demos)[0])
    drawn = [_Shown.drawn(Variants(shift=strength), demo, variant).look for variant in range(40)]
    assert drawn[0].keys() == shifts.RENDERED.keys()
    for name, size in shifts.RENDERED.items():
        shares = np.array([look[name] for look in drawn]) / (size * np.array(UNITS[name]))
        assert np.abs(shares).max() <= strength
        assert np.abs(shares).max() > 0.8 * strength


def test_aimed_crops_are_drawn_about_the_jaws(demos, tmp_path):
    """In every env that a process keeps: a dataset without aimed crops is as it was before."""
    plain, aimed = Variants("train"), Variants("train", aimed=True)
    for name, looks in (("before", plain), ("aimed", aimed), ("after", plain)):
        render_demos(
            demos,
            tmp_path / name,
            views=("front_psm2", "front"),
            size=64,
            context=RunContext(0),
            variants=looks,
        )
    before, aimed, after = (open_dataset(tmp_path / name) for name in ("before", "aimed", "after"))
    assert before.meta["digest"] == after.meta["digest"] != aimed.meta["digest"]
    np.testing.assert_array_equal(aimed.frames("front"), before.frames("front"))
    assert (aimed.frames("front_psm2") != before.frames("front_psm2")).any()
    assert check_dataset(aimed.path).ok


def test_splits_and_counts_go_by_the_demonstration(dataset):
    np.testing.assert_array_equal(dataset.demonstration_index, np.repeat([0, 1], 3 * STEPS))
    assert len(dataset.bounds()) == 6
    for kind in ("episode", "transition"):
        recipe = Recipe(split=kind, validation=0.5)
        rows, held, episodes = split(dataset.episode_index, recipe, 0, dataset.demonstration_index)
        assert sorted([*rows, *held]) == list(range(dataset.length))
        seen = {(dataset.demonstration_index[row], row % STEPS) for row in rows}
        hidden = {(dataset.demonstration_index[row], row % STEPS) for row in held}
        assert not seen & hidden and len(seen) == len(hidden) == 2
        assert len(episodes) == (3 if kind == "episode" else 0)
    first = first_episodes(dataset, 1)
    assert (first.length, len(first.bounds())) == (3 * STEPS, 3)
    with pytest.raises(InputError, match="3 demonstrations were requested"):
        first_episodes(dataset, 3)
    strided = with_frame_stride(dataset, 2)
    np.testing.assert_array_equal(strided.demonstration_index, np.repeat([0, 1], 3))
    assert "Every 3 consecutive episodes show one demonstration" in dataset_card(dataset, "a/b")


def test_a_finished_rendering_does_nothing_and_takes_no_more_variants(demos, dataset, tmp_path):
    """Each variant is rendered by a separate job; equal digests mean equal datasets."""
    fewer = render(demos, tmp_path / "set", variants=dataclasses.replace(THREE, count=1))
    assert fewer.episodes == 2
    with pytest.raises(OutputExists):
        render(demos, tmp_path / "set", variants=THREE)
    again = render(demos, dataset.path, variants=THREE)
    assert again.digest == dataset.meta["digest"]
    np.testing.assert_array_equal(
        open_dataset(tmp_path / "set").frames("front")[:STEPS], dataset.frames("front")[:STEPS]
    )


def test_looks_that_were_recorded_are_drawn_anew_and_the_rest_is_kept(tmp_path):
    axes = RandomisationConfig(appearance="fat", phantom_shift=5.0, needle_size=0.1)
    demos = record(tmp_path / "demos", TaskConfig("grasp", randomisation=axes))
    render(demos, tmp_path / "set", variants=Variants("heldout", count=2))
    dataset = open_dataset(tmp_path / "set")
    assert dataset.config.randomisation == dataclasses.replace(axes, appearance="heldout")
    assert dataset.config.randomisation.shows_heldout, "train refuses it"
    env = envs.make(TaskConfig("grasp", randomisation=axes))
    env.set_state_vector(read_demo(list_demos(demos)[0]).state[0])
    seen = dataset.columns()[names.NEEDLE_POSE]
    np.testing.assert_array_equal(seen[0], env.needle_pose())
    np.testing.assert_array_equal(seen[STEPS], env.needle_pose())


def test_refuses_variants_without_a_look():
    with pytest.raises(InputError, match="without a look to draw"):
        Variants(count=2)
    with pytest.raises(InputError, match="at least 1"):
        Variants("train", count=0)
    with pytest.raises(InputError, match="appearance"):
        Variants("mud")
    for amount in (-0.1, 1.1):
        with pytest.raises(InputError, match="shift"):
            Variants(shift=amount)
    assert Variants(shift=0.5).name == "shift0.5-x1"
    assert Variants("train", corruption=0.5, shift=0.5, aimed=True).request == {
        "appearance": "train",
        "corruption": 0.5,
        "shift": 0.5,
        "aimed": True,
        "count": 1,
    }


def test_the_command_renders_variants(demos, tmp_path):
    options = command.Options(
        demos=(demos,),
        view=("front",),
        size=32,
        appearance="train",
        variants=2,
        workers=1,
        out=tmp_path / "set",
    )
    assert command.run(options, console=Console())["episodes"] == 4
    assert open_dataset(tmp_path / "set").meta["request"]["variants"] == {
        "appearance": "train",
        "count": 2,
    }
