"""Evaluation: rows do not depend on batch or workers.

Errors are failures; the summary has the promised keys.
"""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands.evaluate import summary_line
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, PhysicsError
from surgicai_vision.envs.bite_measures import BiteMeasures
from surgicai_vision.envs.visits import Visit
from surgicai_vision.evaluation import policy_spec, slot, storage
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import PolicyAgent, RandomAgent, ZeroAgent
from surgicai_vision.evaluation.metrics import (
    KINDS,
    EpisodeMetrics,
    as_table,
    failure_kind,
    summary,
)
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.statistics import clopper_pearson
from surgicai_vision.training.run_config import RunConfig

SHORT = TaskConfig("grasp", max_steps=12)
NEVER_MEASURED = {"mean": None, "std": None, "median": None, "n": 0}


class FakeEnv:
    """Counts steps; seed s succeeds after s steps, 97 cannot start, 98 diverges, 99 raises."""

    subtask = SimpleNamespace(name="grasp", arm="psm2")

    def __init__(self, config):
        self.config, self.closed = config, False

    def reset(self, seed):
        if seed == 97:
            raise PhysicsError("impossible start")
        self.seed, self.count = seed, 0
        return np.zeros(21, np.float32), self._info()

    @property
    def simulation(self):
        return SimpleNamespace(task_state=SimpleNamespace(steps=self.count))

    def step(self, action):
        self.count += 1
        if self.seed == 99 and self.count == 2:
            raise PhysicsError("diverged")
        info = self._info()
        ended = info["is_success"] or info["physics_error"]
        return np.zeros(21, np.float32), 0.0, ended, self.count >= self.config.max_steps, info

    def _info(self):
        return {
            "is_success": self.count == self.seed or (self.seed == 98 and self.count == 3),
            "physics_error": self.seed == 98 and self.count == 3,
            "contact": self.count % 2 == 1,
            "tip_path": 1e-3 * self.count,
            "d_trans": 2e-3,
            "d_angle": np.pi / 2,
        }

    def get_state(self):
        return np.array([self.seed, self.count], np.float64)

    def close(self):
        self.closed = True


class FakeMonitor:
    """Derives its measures from the fake env's step count."""

    def __init__(self, env):
        self.env = env
        self.clear()

    def clear(self):
        self.bite = BiteMeasures()
        self.force = 0.0
        self.slip = self.turn = self.tissue_force = self.tissue_impulse = np.nan
        self.tears = self.thread_drawn = np.nan
        self.paper_success = False

    def reset(self):
        self.clear()
        self.slip = self.turn = self.tissue_force = self.tissue_impulse = 0.0

    def is_held(self):
        return self.env._info()["contact"]

    def update(self, info):
        self.bite = BiteMeasures(entry_error=5e-4)
        self.tissue_impulse += 0.02
        self.paper_success |= info["is_success"]
        self.slip, self.turn, self.tissue_force = (
            1e-4 * self.env.count,
            np.pi / 180,
            0.1 * self.env.count,
        )


@pytest.fixture
def fake_envs(monkeypatch):
    made = []
    monkeypatch.setattr(slot, "EpisodeMonitor", FakeMonitor)

    def make(config, **_):
        made.append(FakeEnv(config))
        return made[-1]

    monkeypatch.setattr(envs, "make", make)
    return made


def rows_of(episodes):
    return [episode.row for episode in episodes]


def test_rows_are_in_the_order_of_seeds_for_any_batch(fake_envs):
    seeds = [5, 3, 11, 40, 97, 7, 98, 99, 2]
    wanted = rows_of(evaluate(ZeroAgent, SHORT, seeds, batch=1, workers=1))
    assert [row.seed for row in wanted] == seeds
    for batch in (2, 4, 20):
        # A distance that was never measured is NaN on both sides, so the text is compared.
        assert repr(rows_of(evaluate(ZeroAgent, SHORT, seeds, batch=batch, workers=1))) == repr(
            wanted
        )
    assert all(env.closed for env in fake_envs)


def test_errors_are_failures_and_counted(fake_envs):
    rows = {
        row.seed: row for row in rows_of(evaluate(ZeroAgent, SHORT, [3, 97, 98, 99], workers=1))
    }
    assert rows[3].success
    for seed in (97, 98, 99):
        assert not rows[seed].success
        assert rows[seed].error
    # A start that cannot be made is not a divergence of the physics.
    assert [rows[seed].failure for seed in (97, 98, 99)] == ["error", "physics", "physics"]
    result = summary(list(rows.values()))
    assert (result["successes"], result["errors"], result["failures"]) == (
        1,
        3,
        {"physics": 2, "error": 1},
    )


def test_an_action_that_is_not_finite_is_an_error(fake_envs):
    class Broken(Agent):
        name = "broken"

        def reset(self, slot, env, seed):
            pass

        def act(self, slots, envs, observations):
            return np.full((len(slots), 7), np.nan, np.float32)

    row = evaluate(Broken, SHORT, [3], workers=1)[0].row
    assert not row.success
    assert "not finite" in row.error


def test_an_episode_ends_at_success_or_at_the_limit(fake_envs):
    rows = {row.seed: row for row in rows_of(evaluate(ZeroAgent, SHORT, [5, 40], workers=1))}
    assert (rows[5].success, rows[5].steps, rows[5].trajectory_length_mm) == (
        True,
        5,
        pytest.approx(5.0),
    )
    assert (rows[40].success, rows[40].steps) == (False, SHORT.max_steps)
    assert rows[5].d_trans_mm == pytest.approx(2.0)
    assert rows[5].d_angle_deg == pytest.approx(90.0)


def test_film_keeps_first_and_last_state(fake_envs):
    film = evaluate(ZeroAgent, SHORT, [11], workers=1)[0].film
    assert film.steps[0] == 0
    assert film.steps[-1] == 11
    np.testing.assert_array_equal(film.states[:, 1], film.steps)


def test_progress_ends_at_the_total(fake_envs):
    calls = []
    evaluate(
        ZeroAgent,
        SHORT,
        [3, 4, 40],
        batch=2,
        workers=1,
        progress=lambda *numbers: calls.append(numbers),
    )
    assert calls[-1] == (3 * SHORT.max_steps, 3 * SHORT.max_steps)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)


FAR = 99999999999999999999


@pytest.mark.parametrize("seeds", [[], [1, 1], [-1], [2**63], range(FAR, FAR + 2)])
def test_seeds_are_checked(seeds):
    with pytest.raises(InputError, match=r"[Ss]tart seeds"):
        evaluate(ZeroAgent, SHORT, seeds)


def test_summary_has_the_promised_keys(fake_envs):
    result = summary(rows_of(evaluate(ZeroAgent, SHORT, [3, 5, 40], workers=1)))
    promised = (
        "task policy episodes successes success_rate ci95 trajectory_length_mm time_steps grasp"
        " errors"
    )
    assert set(promised.split()) <= set(result)
    assert result["successes"] == 2
    assert result["time_steps"]["mean"] == 4.0
    assert set(result["trajectory_length_mm"]) == {"mean", "std"}
    assert result["grasp"] == "friction"
    assert result["first_seed"] == 3


def test_rows_and_summary_hold_what_was_measured(fake_envs, tmp_path):
    episodes = evaluate(ZeroAgent, SHORT, [3, 40, 97], workers=1)
    rows = {row.seed: row for row in rows_of(episodes)}
    assert (rows[3].entry_mm, rows[3].slip_mm, rows[3].slip_deg) == pytest.approx((0.5, 0.3, 1.0))
    assert rows[40].tissue_force_n == pytest.approx(1.2)
    assert rows[40].tissue_impulse_ns == pytest.approx(0.24)
    assert (rows[3].paper_success, rows[40].paper_success) == (True, False)
    # An episode that could not start has no values, nor those of the episode before.
    assert np.isnan([rows[97].entry_mm, rows[3].exit_mm, rows[97].slip_mm]).all()
    result = storage.write_evaluation(tmp_path, episodes, RunConfig(policy="zero"), {})
    half, zero = pytest.approx(0.5), pytest.approx(0.0)
    assert result["entry_mm"] == {"mean": half, "std": zero, "median": half, "n": 2}
    assert result["exit_mm"] == NEVER_MEASURED
    assert result["tissue_force_n"]["n"] == 2
    assert result["paper_successes"] == 1
    assert result["tears"] == result["thread_mm"] == NEVER_MEASURED
    assert json.loads((tmp_path / storage.MARKER).read_text())["summary"] == result
    assert repr(storage.read_rows(tmp_path)) == repr(as_table(rows_of(episodes)))


def test_a_damaged_evaluation_is_refused_in_one_line(fake_envs, tmp_path):
    episodes = evaluate(ZeroAgent, SHORT, [3], workers=1)
    storage.write_evaluation(tmp_path, episodes, RunConfig(policy="zero"), {})
    stored = json.loads((tmp_path / storage.MARKER).read_text())
    for key in ("run", "summary", "about"):
        rest = {other: value for other, value in stored.items() if other != key}
        (tmp_path / storage.MARKER).write_text(json.dumps(rest))
        with pytest.raises(BadFile, match=f"no table '{key}'"):
            storage.read_evaluation(tmp_path)
    reads = {
        storage.EPISODES: lambda: storage.read_rows(tmp_path),
        storage.FILMS: lambda: storage.read_film(tmp_path, 3),
    }
    for name, read in reads.items():
        read()
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-20])
        with pytest.raises(BadFile, match=f"{name} is damaged") as refused:
            read()
        assert "\n" not in str(refused.value)


def test_visits_of_an_earlier_evaluation_go_with_it(fake_envs, tmp_path):
    episodes = evaluate(ZeroAgent, SHORT, [3], workers=1)
    visited = [replace(episodes[0], visits=(Visit(0, 0, 3, 1, 2, False),))]
    storage.write_evaluation(tmp_path, visited, RunConfig(policy="zero"), {})
    assert (tmp_path / storage.VISITS).is_file()
    storage.write_evaluation(tmp_path, episodes, RunConfig(policy="zero"), {})
    assert not (tmp_path / storage.VISITS).exists()


def test_kinds_of_failure():
    assert [failure_kind("x", diverged, True, True, True) for diverged in (True, False)] == [
        "physics",
        "error",
    ]
    assert failure_kind("", False, touched=False, wrong_hole=False, held=False) == "missed"
    assert failure_kind("", False, touched=True, wrong_hole=True, held=False) == "wrong_hole"
    assert failure_kind("", False, touched=True, wrong_hole=False, held=False) == "dropped"
    assert failure_kind("", False, touched=True, wrong_hole=False, held=True) == "time"
    assert KINDS == ("missed", "dropped", "wrong_hole", "time", "physics", "error")


def test_each_subtask_counts_with_all_before_it():
    rows = [row_with_stages(seed, stages) for seed, stages in enumerate((0, 2, 2, 5))]
    subtasks = summary(rows)["subtasks"]
    assert [(stage["subtask"], stage["k"]) for stage in subtasks] == [
        ("grasp", 3),
        ("place", 3),
        ("insert", 1),
        ("handoff", 1),
        ("pullout", 1),
    ]
    assert (subtasks[0]["low"], subtasks[0]["high"]) == clopper_pearson(3, 4)


def test_what_was_measured_has_a_median_over_the_episodes_that_have_it():
    rows = [replace(row_with_stages(seed, 5), entry_mm=mm) for seed, mm in enumerate(ENTRIES)]
    entry = summary(rows)["entry_mm"]
    assert (entry["mean"], entry["median"], entry["n"]) == (pytest.approx(1.4), 0.7, 3)
    assert summary(rows)["exit_mm"] == NEVER_MEASURED


def test_a_needle_that_was_never_held_has_no_slip():
    rows = [
        replace(row_with_stages(0, 5), slip_mm=0.4),
        replace(row_with_stages(1, 0), success=False, failure="missed"),
    ]
    assert summary(rows)["slip_mm"] == {"mean": 0.4, "std": None, "median": 0.4, "n": 1}


AFTER_THE_START = (
    "slip_mm",
    "slip_deg",
    "tissue_force_n",
    "tissue_impulse_ns",
    "tears",
    "thread_mm",
)
"""Columns of largest values and sums."""


def test_nothing_was_measured_where_the_start_could_not_be_made(fake_envs):
    (row,) = [made.row for made in evaluate(ZeroAgent, SHORT, [97], batch=1)]
    assert row.error and all(math.isnan(getattr(row, name)) for name in AFTER_THE_START)


def test_the_line_about_an_evaluation_ends_with_the_medians_of_its_stitches():
    rows = [
        replace(row_with_stages(seed, 5), entry_mm=mm, exit_mm=0.25, tissue_force_n=1.9)
        for seed, mm in enumerate(ENTRIES)
    ]
    assert summary_line(summary(rows)).endswith(
        "medians: entry 0.70 mm and exit 0.25 mm from the marks, largest force on the tissue 1.9 N"
    )
    assert "medians" not in summary_line(summary([row_with_stages(0, 5)]))


ENTRIES = (0.5, 0.7, 3.0, math.nan)


def row_with_stages(seed, stages):
    return EpisodeMetrics(
        task="suture",
        policy="x",
        seed=seed,
        success=stages == 5,
        steps=9,
        trajectory_length_mm=1.0,
        d_trans_mm=1.0,
        d_angle_deg=1.0,
        contact=True,
        error="",
        grasp="friction",
        failure="" if stages == 5 else "time",
        stages=stages,
    )


def test_real_env_gives_the_same_rows_for_any_batch_and_workers():
    seeds = list(range(names.TEST_SEED, names.TEST_SEED + 4))
    one = evaluate(RandomAgent, SHORT, seeds, batch=1, workers=1)
    many = evaluate(RandomAgent, SHORT, seeds, batch=4, workers=1)
    spread = evaluate(RandomAgent, SHORT, seeds, batch=2, workers=2)
    for other in (many, spread):
        assert repr(rows_of(other)) == repr(rows_of(one))
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_array_equal(mine.film.states, theirs.film.states)


def pixel_agent():
    """A policy that turns real features of a real encoder into actions."""
    from surgicai_vision.features.encoders import load_encoder

    encoder = load_encoder("imagenet-lite")
    weights = np.random.default_rng(0).normal(0, 0.05, (2 * encoder.dim + 7, 7))

    def act(features, agent_pos):
        inputs = np.concatenate([features, agent_pos], axis=1).astype(np.float64)
        return np.tanh(np.einsum("bi,ia->ba", inputs, weights)).astype(np.float32)

    return PolicyAgent("probe", SimpleNamespace(act=act), encoder, ("front", "back"), 96)


def test_a_policy_with_images_gives_the_same_rows_for_any_batch():
    seeds, config = range(names.TEST_SEED, names.TEST_SEED + 3), TaskConfig("grasp", max_steps=5)
    one = evaluate(pixel_agent, config, seeds, batch=1, workers=1)
    many = evaluate(pixel_agent, config, seeds, batch=3, workers=1)
    assert repr(rows_of(one)) == repr(rows_of(many))
    assert one[0].row.trajectory_length_mm > 0


def test_expert_solves_held_out_starts():
    spec = policy_spec.open_policy("expert")
    rows = rows_of(
        evaluate(
            spec.make_agent,
            spec.config,
            range(names.TEST_SEED, names.TEST_SEED + 3),
            workers=1,
        )
    )
    assert all(row.success for row in rows), rows


@pytest.mark.parametrize(("action_repeat", "limit"), [(1, 4), (2, 5), (3, 10)])
def test_steps_are_control_steps_however_long_an_action_is_held(action_repeat, limit):
    config = TaskConfig("grasp", max_steps=limit, action_repeat=action_repeat)
    assert evaluate(ZeroAgent, config, [names.TEST_SEED], workers=1)[0].row.steps == limit


def test_zero_fails():
    row = evaluate(ZeroAgent, SHORT, [names.TEST_SEED], workers=1)[0].row
    assert (row.success, row.failure, row.steps) == (False, "missed", SHORT.max_steps)
