"""Robustness: strength 0 is plain, strengths are paired, an axis changes only what it names."""

import json
from contextlib import contextmanager, nullcontext
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.corruption import CORRUPTIONS, Moment
from surgicai_vision.core.errors import InputError, OutputExists, UnknownName
from surgicai_vision.envs.randomisation import LOOKS
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.evaluation.robustness import (
    ALL,
    AXES,
    CURVES,
    SHIFTS,
    SINGLE,
    axes_of,
    curves,
    shifted,
)
from surgicai_vision.evaluation.robustness.corrupted_agent import CorruptedAgent
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.statistics import clopper_pearson, mcnemar
from surgicai_vision.evaluation.storage import MARKER, read_rows
from surgicai_vision.scene import build_scene, needle
from surgicai_vision.training.run_config import OWN, RunConfig

SEEDS = range(names.TEST_SEED, names.TEST_SEED + 2)
SHORT = TaskConfig("grasp", max_steps=4)
WORLD = [name for name, axis in AXES.items() if axis.world]


def seeing(image_size=48):
    """A policy whose actions depend on every pixel of two views."""

    def encode(frames):
        return frames.reshape(len(frames), -1).astype(np.float64)

    encode.fingerprint = "pixels"

    def act(features, agent_pos):
        weights = np.random.default_rng(0).normal(size=(features.shape[1], 7)) / features.shape[1]
        return np.tanh(features @ weights / 30).astype(np.float32)

    return PolicyAgent(
        "seeing", SimpleNamespace(act=act), encode, ("front", "wrist_psm2"), image_size
    )


def seeing_spec(config=SHORT):
    run = RunConfig(config, OWN, ("front", "wrist_psm2"), policy="seeing")
    return PolicySpec(run, seeing)


def played(chosen, batch=8):
    return evaluate(chosen.make_agent, chosen.config, SEEDS, batch=batch, workers=1)


def rows_of(episodes):
    return [repr(episode.row) for episode in episodes]


@contextmanager
def silent(title, unit):
    yield lambda *numbers: None


@pytest.mark.parametrize("axis", AXES)
def test_strength_0_is_the_plain_evaluation_row_by_row(axis):
    plain, zero = played(seeing_spec()), played(shifted(seeing_spec(), axis, 0.0))
    assert rows_of(zero) == rows_of(plain)
    for one, other in zip(zero, plain, strict=True):
        np.testing.assert_array_equal(one.film.states, other.film.states)


@pytest.mark.parametrize("axis", AXES)
def test_an_axis_changes_what_a_seeing_policy_does_and_not_where_it_starts(axis):
    plain, half, full = (
        played(shifted(seeing_spec(), axis, strength)) for strength in (0.0, 0.5, 1.0)
    )
    for one, other in ((half, plain), (full, half)):
        for mine, theirs in zip(one, other, strict=True):
            # An episode may draw no distractors, or some that its views do not show.
            assert axis == "distractors" or repr(mine.row) != repr(theirs.row)
    needles = [
        [needle_at_start(episode) for episode in episodes] for episodes in (plain, half, full)
    ]
    # A needle's frame is at the centre of its arc, so it moves with the radius.
    near = needle.RADIUS * 0.2 + 1e-6 if "needle_size" in AXES[axis].world else 1e-6
    np.testing.assert_allclose(needles[1], needles[0], atol=near)
    np.testing.assert_allclose(needles[2], needles[0], atol=near)


def needle_at_start(episode):
    """The needle's pose at the start of an episode: qpos follows the clock in MuJoCo's state."""
    model = envs.make(SHORT)
    first = model.scene.needle_qpos
    return episode.film.states[0][1 + first.start : 1 + first.stop]


@pytest.mark.parametrize("axis", WORLD)
def test_an_episode_keeps_its_direction_and_grows_with_the_strength(axis):
    drawn = {}
    for strength in (0.5, 1.0):
        env = envs.make(shifted(seeing_spec(), axis, strength).config)
        drawn[strength] = env.reset(seed=5)[1]["randomisation"]
    assert set(drawn[0.5]) == set(drawn[1.0]) == set(AXES[axis].world)
    for name, values in drawn[1.0].items():
        half = drawn[0.5][name]
        if name in LOOKS:  # first the amount of a look, then which look
            assert 0 <= half[0] <= values[0]
            assert half[0] == 0 or (half[1:] == values[1:]).all()
        elif name != "latency":
            np.testing.assert_allclose(half, values / 2)
            assert np.abs(values).max() > 0


def test_latency_is_in_whole_steps():
    steps = [
        shifted(seeing_spec(), "latency", strength).config.randomisation.latency
        for strength in (0, 0.25, 0.5, 1)
    ]
    assert steps == [0, 1, 3, 5]


def test_a_shift_comes_on_top_of_the_tasks_own_randomisation_up_to_what_is_possible():
    config = TaskConfig("grasp", randomisation=RandomisationConfig(light=0.3, friction=0.1))
    light = [
        shifted(seeing_spec(config), "light", s).config.randomisation.light for s in (0.0, 0.5, 1.0)
    ]
    assert light == pytest.approx([0.3, 0.7, 0.9])
    assert shifted(seeing_spec(config), "blur", 1.0).config == config


@pytest.mark.parametrize("kind", CORRUPTIONS)
def test_a_corruption_grows_with_its_strength_from_nothing(kind):
    image = np.random.default_rng(0).integers(60, 200, (64, 64, 3)).astype(np.uint8)
    before = image.copy()
    changed = [CORRUPTIONS[kind](image, s, Moment(1, 2, 0)) for s in (0.0, 0.25, 0.5, 1.0)]
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(changed[0], image)
    off = [np.abs(one.astype(float) - image).mean() for one in changed]
    assert off == sorted(off) and off[1] > 0.3
    assert all(one.shape == image.shape and one.dtype == np.uint8 for one in changed)
    np.testing.assert_array_equal(CORRUPTIONS[kind](image, 1.0, Moment(1, 2, 0)), changed[3])


def test_noise_is_new_each_step_and_view_and_smoke_drifts():
    image = np.full((64, 64, 3), 90, np.uint8)
    for kind in ("noise", "smoke"):
        moments = [Moment(1, 0, 0), Moment(1, 40, 0), Moment(1, 0, 1), Moment(2, 0, 0)]
        looks = [CORRUPTIONS[kind](image, 0.5, moment) for moment in moments]
        assert all(not np.array_equal(looks[0], other) for other in looks[1:])
    still, later = (CORRUPTIONS["smoke"](image, 0.5, Moment(1, step, 0)) for step in (0, 40))
    np.testing.assert_array_equal(np.roll(still, round(40 * 64 / 200), axis=1), later)


def test_noise_and_smoke_are_as_strong_as_said():
    grey = np.full((200, 200, 3), 128, np.uint8)
    assert CORRUPTIONS["noise"](grey, 0.5, Moment(0, 0, 0)).std() == pytest.approx(32.0, rel=0.02)
    hidden = CORRUPTIONS["smoke"](np.zeros_like(grey), 1.0, Moment(0, 0, 0)) / np.array(
        [196, 198, 202]
    )
    assert 0.39 < hidden.min() < hidden.max() < 0.91


@pytest.mark.parametrize("axis", ["noise", "smoke"])
def test_rows_do_not_depend_on_the_batch(axis):
    chosen = shifted(seeing_spec(), axis, 0.5)
    assert rows_of(played(chosen, 1)) == rows_of(played(chosen, 2))


class Watcher(Agent):
    """Records what it sees and the slots whose subtask restarted."""

    name, cameras, image_size, depth = "watcher", ("front",), 8, True

    def __init__(self):
        self.seen, self.restarted, self.shared = [], [], None

    def reset(self, slot, env, seed):
        pass

    def act(self, slots, envs, observations):
        self.seen.extend(observations)

    def restart(self, slot):
        self.restarted.append(slot)

    def share(self, features):
        self.shared = features


def test_a_corruption_leaves_the_env_and_everything_but_images_alone():
    agent = Watcher()
    wrapped = CorruptedAgent(agent, CORRUPTIONS["noise"], 1.0)
    wrapped.reset(3, None, 7)
    given = {"front": np.full((8, 8, 3), 100, np.uint8), "agent_pos": np.ones(7)}
    wrapped.act([3], [None], [given])
    wrapped.act([3], [None], [given])
    assert (given["front"] == 100).all()
    seen = agent.seen
    assert seen[0]["agent_pos"] is given["agent_pos"]
    assert not np.array_equal(seen[0]["front"], seen[1]["front"])


def test_a_wrapper_passes_on_every_member_of_the_agent():
    agent, table = Watcher(), {}
    wrapped = CorruptedAgent(agent, CORRUPTIONS["noise"], 1.0)
    wrapped.restart(3)
    wrapped.share(table)
    assert agent.restarted == [3] and agent.shared is table
    kept = ("name", "cameras", "image_size", "depth", "privileged")
    assert all(getattr(wrapped, member) == getattr(agent, member) for member in kept)


class Pretend:
    """Replaces `evaluate_into`: start s is solved up to strength s / 4; records its calls."""

    def __init__(self, real):
        self.real, self.calls = real, []

    def __call__(self, out, chosen, seeds, workers, progress):
        shift = chosen.run.shift
        self.calls.append((shift.axis, shift.strength))
        from surgicai_vision.evaluation.metrics import EpisodeMetrics
        from surgicai_vision.evaluation.slot import Episode, Film
        from surgicai_vision.evaluation.storage import write_evaluation

        film = Film(np.zeros(1, np.int64), np.zeros((1, 2)))
        rows = [
            EpisodeMetrics(
                "grasp",
                "seeing",
                seed,
                4 * shift.strength <= index,
                1,
                1.0,
                1.0,
                1.0,
                True,
                "",
                "friction",
                "",
            )
            for index, seed in enumerate(seeds)
        ]
        return write_evaluation(out, [Episode(row, film) for row in rows], chosen.run, {})


@pytest.fixture
def pretend(monkeypatch):
    fake = Pretend(curves.evaluate_into)
    monkeypatch.setattr(curves, "evaluate_into", fake)
    return fake


def test_curves_count_compare_and_are_stored(tmp_path, pretend):
    import pyarrow.parquet as pq

    seeds = range(900_000, 900_005)
    rows = curves.robustness(
        seeing_spec(), seeds, tmp_path, silent, ("light", "blur"), (0.0, 0.5, 1.0)
    )
    assert [(row["axis"], row["strength"], row["k"], row["n"]) for row in rows] == [
        ("light", 0.0, 5, 5),
        ("light", 0.5, 3, 5),
        ("light", 1.0, 1, 5),
        ("blur", 0.0, 5, 5),
        ("blur", 0.5, 3, 5),
        ("blur", 1.0, 1, 5),
    ]
    assert (rows[1]["low"], rows[1]["high"]) == clopper_pearson(3, 5)
    assert rows[0]["auc"] == pytest.approx(0.6) and rows[0]["auc_low"] < 0.6 < rows[0]["auc_high"]
    p = mcnemar([True] * 5, [False] * 4 + [True])
    assert (rows[0]["p"], rows[2]["p"], rows[2]["p_holm"]) == (None, p, min(1.0, 4 * p))
    assert pq.read_table(tmp_path / CURVES).to_pylist() == rows
    # The plain evaluation is made once, and kept for each axis under its own name.
    assert pretend.calls == [
        ("light", 0.0),
        ("light", 0.5),
        ("light", 1.0),
        ("blur", 0.5),
        ("blur", 1.0),
    ]
    stored = json.loads((tmp_path / "blur" / "0" / MARKER).read_text())
    assert stored["run"]["shift"] == {"axis": "blur", "strength": 0.0}
    assert repr(read_rows(tmp_path / "blur" / "0")) == repr(read_rows(tmp_path / "light" / "0"))


def test_running_again_does_only_what_is_missing(tmp_path, pretend):
    seeds = range(900_000, 900_003)
    first = curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light",), (0.0, 1.0))
    done = len(pretend.calls)
    assert (
        curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light",), (0.0, 1.0)) == first
    )
    assert len(pretend.calls) == done
    curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light", "smoke"), (0.0, 0.5, 1.0))
    assert pretend.calls[done:] == [("light", 0.5), ("smoke", 0.5), ("smoke", 1.0)]
    with pytest.raises(OutputExists, match="of another policy"):
        curves.robustness(seeing_spec(), range(5), tmp_path, silent, ("light",))


def test_the_table_has_every_axis_and_strength_that_was_ever_measured(tmp_path, pretend):
    import pyarrow.parquet as pq

    seeds = range(900_000, 900_005)
    curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light",), (0.0, 1.0))
    rows = curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("blur",), (0.0, 1.0))
    assert pretend.calls == [("light", 0.0), ("light", 1.0), ("blur", 1.0)]
    stored = pq.read_table(tmp_path / CURVES).to_pylist()
    assert [(row["axis"], row["strength"]) for row in stored] == [
        ("blur", 0.0),
        ("blur", 1.0),
        ("light", 0.0),
        ("light", 1.0),
    ]
    assert rows == stored[:2]
    p = mcnemar([True] * 5, [False] * 4 + [True])
    assert stored[1]["p_holm"] == min(1.0, 2 * p)
    (_, middle, last) = curves.robustness(
        seeing_spec(), seeds, tmp_path, silent, ("light",), (0.5,)
    )
    assert (middle["strength"], middle["p"] is None, last["strength"]) == (0.5, False, 1.0)


def test_what_a_kill_left_beside_the_plain_evaluation_is_not_copied(tmp_path, pretend):
    seeds = range(900_000, 900_003)
    curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light",), (0.0, 1.0))
    (tmp_path / "light" / "0" / "finished").mkdir()
    curves.robustness(seeing_spec(), seeds, tmp_path, silent, ("light", "blur"), (0.0, 1.0))
    assert not (tmp_path / "blur" / "0" / "finished").exists()
    assert repr(read_rows(tmp_path / "blur" / "0")) == repr(read_rows(tmp_path / "light" / "0"))


def test_curves_of_another_scene_are_not_continued(tmp_path, pretend):
    curves.robustness(seeing_spec(), SEEDS, tmp_path, silent, ("light",), (0.0,))
    marker = tmp_path / "light" / "0" / MARKER
    stored = json.loads(marker.read_text())
    for scene, is_refused in ((build_scene(SHORT.scene).hash, False), ("0" * 64, True)):
        stored["about"]["scene_hash"] = scene
        marker.write_text(json.dumps(stored))
        refusal = pytest.raises(OutputExists, match="of scene 000000000000")
        with refusal if is_refused else nullcontext():
            curves.robustness(seeing_spec(), SEEDS, tmp_path, silent, ("light",), (0.0, 1.0))
    assert pretend.calls == [("light", 0.0), ("light", 1.0)]


@pytest.mark.parametrize("key", ["checkpoint", "dataset", "parts"])
def test_curves_of_what_was_made_anew_are_not_taken_for_its_own(tmp_path, pretend, key):
    for made in ("first", "first", "second"):
        spec = replace(seeing_spec(), about={key: {"policy_sha256": made}, "folder": made})
        if made == "second":
            with pytest.raises(OutputExists, match="of another policy"):
                curves.robustness(spec, SEEDS, tmp_path, silent, ("light",), (0.0,))
        else:
            curves.robustness(spec, SEEDS, tmp_path, silent, ("light",), (0.0,))
    assert len(pretend.calls) == 1


@pytest.mark.parametrize("left_out", SINGLE)
def test_an_ablation_shifts_everything_but_one_axis(left_out):
    everything, rest, one = (
        shifted(seeing_spec(), name, 0.5).config.randomisation
        for name in (ALL, f"{ALL}-but-{left_out}", left_out)
    )
    for axis in fields(everything):
        was, now = getattr(everything, axis.name), getattr(rest, axis.name)
        left_as_it_is = getattr(RandomisationConfig(), axis.name)
        assert now == (left_as_it_is if axis.name in one.on else was)
    images = SHIFTS[f"{ALL}-but-{left_out}"].images
    assert images == tuple(kind for kind in AXES[ALL].images if kind not in SINGLE[left_out].images)


def test_without_images_only_the_arm_can_shift(tmp_path):
    blind = open_policy("expert", env={"max_steps": 4})
    assert axes_of(blind) == ("latency", "kinematic_error", "needle", "robot_start", ALL)
    assert axes_of(seeing_spec()) == tuple(AXES)
    with pytest.raises(InputError, match="sees no images"):
        curves.robustness(blind, SEEDS, tmp_path, silent, ("blur",))
    asked = ("all-but-latency",)
    rows = curves.robustness(blind, SEEDS[:1], tmp_path, silent, asked, (0.0, 1.0))
    assert [(row["axis"], row["strength"]) for row in rows] == [(asked[0], 0.0), (asked[0], 1.0)]


def test_wrong_axes_and_strengths_are_refused(tmp_path):
    with pytest.raises(UnknownName, match="blur"):
        curves.robustness(seeing_spec(), SEEDS, tmp_path, silent, ("blurr",))
    for strengths in ((), (0.5, 0.5), (1.0, 0.0), (0.0, 1.5), (float("nan"),)):
        with pytest.raises(InputError, match="strengths"):
            curves.robustness(seeing_spec(), SEEDS, tmp_path, silent, ("blur",), strengths)


def test_a_world_that_is_impossible_at_the_largest_strength_is_refused_before_any_episode(
    tmp_path, pretend
):
    anywhere = RandomisationConfig(pair="any", phantom_shift=10.0)
    spec = seeing_spec(TaskConfig("handoff", randomisation=anywhere))
    axes = ("light", "needle")
    with pytest.raises(InputError, match=r"needle at strength 1: .* makes 'handoff' impossible"):
        curves.robustness(spec, SEEDS, tmp_path / "a", silent, axes, (0.0, 0.5, 1.0))
    assert pretend.calls == [] and not (tmp_path / "a").exists()
    curves.robustness(spec, SEEDS, tmp_path / "a", silent, axes, (0.0, 0.5))
    assert ("needle", 0.5) in pretend.calls


def test_the_verb_measures_the_expert_and_continues(tmp_path, capsys):
    make = [
        "robustness",
        "expert",
        "--axis",
        "latency",
        "--strength",
        "0,1",
        "--episodes",
        "1",
        "--workers",
        "1",
    ]
    make += ["--out", str(tmp_path / "out"), "--json"]
    assert main(make) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [row["strength"] for row in result["curves"]] == [0.0, 1.0]
    assert result["curves"][0]["k"] == 1
    assert main(make) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        (["--axis", "lihgt"], "light"),
        (["--strength", "0,x"], "unable to convert 'x' into float"),
        (["--strength", "0,2"], "from 0 to 1"),
        (["--axis", "blur"], "sees no images"),
        (["--axis", "light,light"], "twice"),
    ],
)
def test_wrong_options_end_with_one_line(more, wanted, tmp_path, capsys):
    assert main(["robustness", "expert", "--out", str(tmp_path / "out"), *more]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and wanted in error[0]
    assert not (tmp_path / "out").exists()


def test_all_is_every_axis_at_once_and_spoils_an_image_in_their_order():
    single = [axis for name, axis in AXES.items() if name != ALL]
    assert set(AXES[ALL].world) == {name for axis in single for name in axis.world}
    assert AXES[ALL].images == tuple(kind for axis in single for kind in axis.images)
    chosen = shifted(seeing_spec(), ALL, 0.5)
    each = [shifted(seeing_spec(), name, 0.5).config.randomisation for name in AXES if name != ALL]
    for axis in chosen.config.randomisation.on:
        values = {getattr(one, axis) for one in each} - {getattr(RandomisationConfig(), axis)}
        assert values == {getattr(chosen.config.randomisation, axis)}
    image = np.random.default_rng(0).integers(0, 256, (48, 48, 3), dtype=np.uint8)
    moment = Moment(SEEDS[0], 0, 0)
    by_hand = image
    for kind in AXES[ALL].images:
        by_hand = CORRUPTIONS[kind](by_hand, 0.5, moment)
    seen = []

    class Watching(Agent):
        name = "watching"
        cameras = ("front",)
        image_size = 48
        depth = False

        def reset(self, slot, env, seed):
            pass

        def act(self, slots, envs, observations):
            seen.append(observations[0]["front"])
            return np.zeros((len(slots), 7), np.float32)

    run = RunConfig(SHORT, OWN, ("front",), policy="watching")
    agent = shifted(PolicySpec(run, Watching), ALL, 0.5).make_agent()
    agent.reset(0, None, SEEDS[0])
    agent.act([0], [None], [{"front": image}])
    np.testing.assert_array_equal(seen[0], by_hand)


def test_a_policy_without_images_meets_all_by_its_arm_and_world_alone():
    run = RunConfig(SHORT, None, (), policy="blind")
    spec = PolicySpec(run, seeing)
    assert ALL in axes_of(spec)
    assert shifted(spec, ALL, 1.0).make is seeing
