"""Chunks of actions: their column, their policies, and how they are executed."""

import datetime
import importlib
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import final

import numpy as np
import pytest
import torch
from fake_dataset import DIM, FakeDataset, fake_procedures, features_of, recorded
from torch import nn

from policies.base import ACTIONS, Plugin, Recipe
from policies.bc import BC
from policies.bc_chunk import BC_CHUNK, BCChunkPolicy, BCChunkRecipe
from policies.chunks import ChunkPolicy, ChunkRecipe
from policies.lerobot import DIFFUSION, VQBET
from surgicai_vision.core import names
from surgicai_vision.core.config import FULL_SPEED, Pace, TaskConfig, clock
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.subset import of_subtask, with_frame_stride
from surgicai_vision.demos.record import record
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.chunk_agent import ChunkAgent
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.report.experiment_key import condition_of
from surgicai_vision.report.pairs import factor
from surgicai_vision.training.averages import MovingAverage
from surgicai_vision.training.chunks import earlier_rows, timeline_of, with_chunks
from surgicai_vision.training.loop import Training
from surgicai_vision.training.policies import POLICIES, load_policy, load_recipe, policy_plugin
from surgicai_vision.training.request import TrainingRequest
from surgicai_vision.training.run_config import RunConfig, of_training
from surgicai_vision.training.train import epochs_within, train

STEP = 0.5e-3
"""Way that an action of 1 commands in a control step [m]."""
QUICK = ChunkRecipe(epochs=8, batch_size=32, learning_rate=1e-2, chunk=4, execute=2, history=2)


class Linear(ChunkPolicy):
    """A policy whose chunk is linear in its inputs, plus a random draw."""

    def __init__(self, recipe: ChunkRecipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(recipe, visual, "min_max")
        width = self.history * (self.heads.dim + self.inputs.width)
        self.layer = nn.Linear(width, self.chunk * ACTIONS)

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        seen = torch.cat([visual, vector], dim=2).flatten(1)
        chunk = self.layer(seen).unflatten(1, (self.chunk, ACTIONS))
        return chunk + 0.01 * torch.rand(())

    def chunk_loss(
        self,
        visual: torch.Tensor,
        vector: torch.Tensor,
        actions: torch.Tensor,
        is_pad: torch.Tensor,
    ) -> torch.Tensor:
        error = (self.plan_normalised(visual, vector) - actions) ** 2
        return (error * ~is_pad[..., None]).mean()


LINEAR = Plugin(
    "linear", ChunkRecipe, Linear, names.ACTION_CHUNK, lambda recipe: range(recipe.chunk)
)


@final
class Draws(Linear):
    """A policy that ignores its inputs: every row is drawn at random."""

    def plan_normalised(self, visual: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        assert len(visual) == len(vector)
        return torch.rand(len(vector), self.chunk, ACTIONS)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch):
    POLICIES.register("linear", LINEAR)
    yield
    POLICIES.unregister("linear")


def chunked(stride: int = 1) -> tuple[FakeDataset, Dataset]:
    whole = recorded()
    return whole, with_chunks(with_frame_stride(whole, stride), timeline_of(whole), range(4))


@pytest.mark.parametrize("offsets", [range(6), range(-2, 5)])
@pytest.mark.parametrize("stride", [1, 5])
def test_a_chunk_holds_the_actions_of_its_episode(offsets: range, stride: int) -> None:
    whole = recorded(3, 17)
    dataset = with_frame_stride(whole, stride)
    column = with_chunks(dataset, timeline_of(dataset), offsets).columns()[names.ACTION_CHUNK]
    actions = whole.columns()[names.ACTION]
    steps = [step for step in range(whole.length) if step % 17 % stride == 0]
    assert column.shape == (len(steps), len(offsets), ACTIONS + 1)
    for row, step in enumerate(steps):
        first = step // 17 * 17
        for place, offset in enumerate(offsets):
            inside = first <= step + offset < first + 17
            nearest = min(max(step + offset, first), first + 16)
            np.testing.assert_array_equal(column[row, place, :ACTIONS], actions[nearest])
            assert column[row, place, ACTIONS] == (not inside)


def test_a_chunk_ends_with_its_subtask() -> None:
    whole = fake_procedures(2, 10)
    part = of_subtask(whole, "insert")
    column = with_chunks(part, timeline_of(part), range(3)).columns()[names.ACTION_CHUNK]
    assert column[9, :, ACTIONS].tolist() == [0, 1, 1]
    assert column[7, :, ACTIONS].tolist() == [0, 0, 0]
    actions = whole.columns()[names.ACTION][20:30]
    np.testing.assert_array_equal(column[:8, 2, :ACTIONS], actions[2:])


def test_a_dataset_of_few_frames_has_its_actions_in_its_demonstrations(tmp_path: Path) -> None:
    record(TaskConfig("place"), episodes=2, out=tmp_path / "demos", context=RunContext(0))
    for stride, out in ((1, "whole"), (5, "few")):
        render_demos(
            tmp_path / "demos",
            tmp_path / out,
            views=("back",),
            size=16,
            frame_stride=stride,
            context=RunContext(0),
        )
    whole, few = (open_dataset(tmp_path / name) for name in ("whole", "few"))
    strided = with_frame_stride(whole, 5)
    expected = with_chunks(strided, timeline_of(strided), range(-1, 9)).columns()
    found = with_chunks(few, timeline_of(few), range(-1, 9)).columns()
    np.testing.assert_array_equal(found[names.ACTION_CHUNK], expected[names.ACTION_CHUNK])
    record(TaskConfig("place"), episodes=1, out=tmp_path / "others", context=RunContext(0))
    with pytest.raises(InputError, match="other demonstrations"):
        timeline_of(few, [tmp_path / "others"])
    with pytest.raises(InputError, match="--demos"):
        timeline_of(few, [tmp_path / "nowhere"])

    # One rendered from several folders has its actions in all of them, in that order.
    both = [tmp_path / "others", tmp_path / "demos"]
    options = {"views": ("back",), "size": 16, "frame_stride": 5}
    render_demos(both, tmp_path / "joined", **options, context=RunContext(0))
    joined = open_dataset(tmp_path / "joined")
    chunks = with_chunks(joined, timeline_of(joined, both), range(-1, 9)).columns()
    own = int(np.flatnonzero(joined.episode_index == 1)[0])
    np.testing.assert_array_equal(chunks[names.ACTION_CHUNK][own:], expected[names.ACTION_CHUNK])
    for wrong in (both[:1], both[::-1]):
        with pytest.raises(InputError, match="in the order in which they were rendered"):
            timeline_of(joined, wrong)


def test_a_dataset_of_held_actions_has_each_of_them_once(tmp_path: Path) -> None:
    held = TaskConfig("grasp", action_repeat=2)
    context = RunContext(0)
    record(held, episodes=2, out=tmp_path / "demos", context=context)
    render_demos(
        tmp_path / "demos",
        tmp_path / "set",
        views=("back",),
        size=16,
        frame_stride=5,
        context=context,
    )
    dataset = open_dataset(tmp_path / "set")
    timeline = timeline_of(dataset)
    actions = dataset.columns()[names.ACTION]
    np.testing.assert_array_equal(timeline.action[timeline.step], actions)
    render_demos(
        tmp_path / "demos", tmp_path / "elsewhere/set", views=("back",), size=16, context=context
    )
    every = open_dataset(tmp_path / "elsewhere/set")  # far from its demonstrations
    assert every.fps == names.FPS // 2
    np.testing.assert_array_equal(timeline_of(every).action, timeline.action)


def test_earlier_rows_stay_within_their_episode() -> None:
    dataset = with_frame_stride(recorded(2, 11), 5)
    rows = earlier_rows(dataset, 2, 5)
    assert rows.tolist() == [[0, 0], [0, 1], [1, 2], [3, 3], [3, 4], [4, 5]]


@pytest.mark.parametrize("stride", [9, 60])
def test_a_history_is_of_earlier_frames_at_every_stride(
    stride: int, tmp_path: Path, registered: None
) -> None:
    whole = recorded(5, 3 * stride)
    dataset = with_chunks(with_frame_stride(whole, stride), timeline_of(whole), range(4))
    recipe = replace(QUICK, frame_stride=stride)
    request = TrainingRequest(dataset, (), LINEAR, recipe, 0, RunConfig())
    training = Training(request, None, torch.device("cpu"))
    assert training.seen is not None
    assert training.seen[:6].tolist() == [[0, 0], [0, 1], [1, 2], [3, 3], [3, 4], [4, 5]]


def test_a_chunk_policy_trains_and_reads_back(tmp_path: Path, registered: None) -> None:
    recipe = replace(QUICK, frame_stride=5, ema=0.9, clip_gradient=1.0)
    whole, dataset = chunked(5)
    rows = np.flatnonzero(np.arange(whole.length) % 40 % 5 == 0)
    entry = features_of(whole).part(rows, dataset.fingerprint)
    checkpoint = train(dataset, [entry], LINEAR, recipe, out=tmp_path / "a")
    assert checkpoint.train_losses[-1] < checkpoint.train_losses[0]
    policy = load_policy(tmp_path / "a")
    features = np.random.default_rng(0).normal(size=(3, 2, DIM)).astype(np.float32)
    vectors = np.zeros((3, 2, 7), np.float32)
    chunk = policy.plan(features, vectors, 5)
    assert chunk.shape == (3, 4, 7) and chunk.dtype == np.float32 and np.abs(chunk).max() <= 1
    assert np.array_equal(chunk, policy.plan(features, vectors, 5)), "a seed's draw is its own"
    assert not np.array_equal(chunk, policy.plan(features, vectors, 6))
    actions = dataset.columns()[names.ACTION_CHUNK]
    kept = ~np.isin(dataset.episode_index, checkpoint.validation_episodes)
    held = actions[kept][actions[kept][..., ACTIONS] == 0][:, :ACTIONS]
    np.testing.assert_allclose(policy.action_centre, (held.min(0) + held.max(0)) / 2, atol=1e-6)
    np.testing.assert_allclose(policy.action_scale, np.ptp(held, axis=0) / 2, atol=1e-6)


def test_how_chunks_are_acted_is_changed_without_a_training(
    tmp_path: Path, registered: None
) -> None:
    whole, dataset = chunked()
    entry = features_of(whole).part(np.arange(whole.length), dataset.fingerprint)
    folder = tmp_path / "a"
    train(dataset, [entry], LINEAR, replace(QUICK, epochs=1), out=folder)
    trained = load_policy(folder)
    policy = load_policy(folder, {"execute": 1, "samples": 3, "ensemble": 0.5})
    assert isinstance(policy, ChunkPolicy) and isinstance(trained, ChunkPolicy)
    assert (policy.execute, policy.samples, policy.ensemble) == (1, 3, 0.5)
    assert (trained.execute, trained.samples, trained.ensemble) == (2, 1, None)
    assert all(
        torch.equal(policy.state_dict()[key], at) for key, at in trained.state_dict().items()
    )
    for change, error, said in (
        ({"execute": 9}, InputError, "1 to chunk, 4"),
        (
            {"chunk": 2},
            UnknownName,
            "clock_speed, denoise, ensemble, execute, jaw_speed, measure_delay, pinch_speed, "
            "retry_after, samples, speed",
        ),
        ({"excute": 1}, UnknownName, "Did you mean 'execute'"),
    ):
        with pytest.raises(error, match=said):
            load_policy(folder, change)


def test_an_evaluation_says_how_chunks_were_acted(tmp_path: Path, registered: None) -> None:
    whole, dataset = chunked()
    train(dataset, [], LINEAR, replace(QUICK, epochs=1), out=tmp_path / "a")
    plain = open_policy(tmp_path / "a")
    other = open_policy(tmp_path / "a", changes=("execute=1", "samples=3"))
    assert other.name == f"{plain.name}-acting+execute=1+samples=3"
    assert of_training(other.run) == plain.run
    seen = condition_of(other.run)
    assert "acting by execute=1 + samples=3" in seen.variant
    assert factor(condition_of(plain.run), seen) == "change in acting"
    with pytest.raises(InputError, match="execute is 0"):
        open_policy(tmp_path / "a", changes=("execute=0",))
    with pytest.raises(InputError, match="leave it out for expert"):
        open_policy("expert", task="grasp", changes=("execute=1",))
    train(whole, [], BC, Recipe(epochs=1), out=tmp_path / "b")
    assert open_policy(tmp_path / "b", changes=("speed=0.5",)).name.endswith("-acting+speed=0.5")
    with pytest.raises(InputError, match="'bc' answers with one action"):
        open_policy(tmp_path / "b", changes=("execute=1",))
    with pytest.raises(InputError, match="sees no images that could be averaged"):
        open_policy(tmp_path / "b", changes=("denoise=6",))


def test_a_broken_off_training_ends_the_same(tmp_path: Path, registered: None) -> None:
    recipe = replace(QUICK, ema=0.99, schedule="one_cycle")
    whole, dataset = chunked()
    entry = features_of(whole).part(np.arange(whole.length), dataset.fingerprint)
    train(dataset, [entry], LINEAR, recipe, out=tmp_path / "whole")

    def stop(epoch: int, _: dict[str, float]) -> None:
        if epoch == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(dataset, [entry], LINEAR, recipe, out=tmp_path / "broken", log=stop)
    train(dataset, [entry], LINEAR, recipe, out=tmp_path / "broken")
    one, other = (load_policy(tmp_path / name).state_dict() for name in ("whole", "broken"))
    assert all(torch.equal(one[key], other[key]) for key in one)


def test_a_budget_is_counted_in_epochs(registered: None) -> None:
    whole, dataset = chunked()
    entry = features_of(whole).part(np.arange(whole.length), dataset.fingerprint)
    short, long = (
        epochs_within(minutes, dataset, [entry], LINEAR, QUICK) for minutes in (0.0001, 1.0)
    )
    assert short == 1 and long > 10


def test_a_budget_is_measured_beyond_the_last_step_of_a_schedule() -> None:
    _, dataset = chunked()
    short = replace(QUICK, schedule="one_cycle", epochs=1)
    assert epochs_within(0.0001, dataset, [], LINEAR, short) == 1


def test_epochs_and_a_budget_are_not_both_given() -> None:
    with pytest.raises(InputError, match="epochs=3 and minutes=1 are given"):
        load_recipe("act", "act", {"epochs": 3, "minutes": 1})
    assert load_recipe("act", "act", {"epochs": 3, "minutes": 0}).epochs == 3


@pytest.mark.parametrize(
    ("policy", "settings"),
    [
        ("diffusion", {"num_inference_steps": 101}),
        ("diffusion", {"num_inference_steps": 0}),
        ("vqbet", {"bet_softmax_temperature": 0.0}),
    ],
)
def test_settings_with_which_a_policy_learns_but_cannot_plan_are_refused(
    policy: str, settings: dict[str, float]
) -> None:
    recipe = ChunkRecipe(settings=dict(settings))
    with pytest.raises(InputError, match=f"settings: {next(iter(settings))} is"):
        policy_plugin(policy).make(recipe, ())


def test_a_policy_of_lerobot_is_made_without_a_word_and_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """VQ-BeT prints its size, and stdout may be the JSON of `--json`."""

    def made(recipe: ChunkRecipe, visual: object) -> Linear:
        print("number of parameters: 0.89M")
        return Linear(recipe, ())

    def indexing(recipe: ChunkRecipe, visual: object) -> Linear:
        raise IndexError("tuple index out of range")

    adapter = SimpleNamespace(VqBet=made, Diffusion=indexing)
    monkeypatch.setattr(importlib, "import_module", lambda _: adapter)
    assert isinstance(VQBET.make(QUICK, ()), Linear)
    assert not capsys.readouterr().out
    with pytest.raises(InputError, match=r"Diffusion cannot be made .*tuple index"):
        DIFFUSION.make(QUICK, ())


def test_the_average_is_the_weighted_sum_of_all_weights() -> None:
    layer = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        layer.weight.fill_(1.0)
    average = MovingAverage(layer, 0.7)
    expected = 1.0
    for update, value in enumerate([2.0, -1.0, 4.0, 0.5, 3.0], 1):
        with torch.no_grad():
            layer.weight.fill_(value)
        average.update(layer)
        decay = min(0.7, 1 - (1 + update) ** -0.75)
        expected = decay * expected + (1 - decay) * value
    with average.applied(layer):
        assert layer.weight.item() == pytest.approx(expected)
    assert layer.weight.item() == 3.0


def acting(
    recipe: ChunkRecipe, action_repeat: int = 1, pace: Pace = FULL_SPEED
) -> tuple[ChunkAgent, list[float]]:
    """Return an agent of a policy without images, and the seeds it plans with."""
    policy = Linear(recipe, ())
    seeds: list[float] = []

    def plan(features: None, vectors: np.ndarray, seed: int) -> np.ndarray:
        seeds.append(seed)
        start = vectors[0, :, 0]
        steps = np.arange(recipe.chunk)[None, :, None]
        return (start[-1] * 100 + start[0] * 10 + steps * np.ones((1, 1, 7))).astype(np.float32)

    policy.plan = plan  # type: ignore[method-assign,assignment]
    senses = PolicyAgent("linear", policy, None, (), 32, action_repeat=action_repeat, pace=pace)
    return ChunkAgent(policy, senses, STEP), seeds


class Brightness:
    """An encoder: an image's mean."""

    fingerprint = "brightness"

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        return frames.reshape(len(frames), -1).mean(1, keepdims=True)


def moved(agent: ChunkAgent, steps: int) -> list[float]:
    """Return the first value of each action while the arm moves by 1 per step."""
    arm = SimpleNamespace(agent_pos=lambda: np.full(7, arm.step, np.float32), step=0)
    actions = []
    for arm.step in range(steps):
        actions.append(float(agent.act([0], [arm], [{}])[0, 0]))
    return actions


def test_the_beginning_of_a_chunk_is_executed_and_then_planned_anew() -> None:
    agent, seeds = acting(replace(QUICK, execute=3, frame_stride=2))
    agent.reset(0, None, 7)
    # Plans at 0, 3 and 6; the earlier observation is two steps back, or the first at the start.
    assert moved(agent, 7) == [0, 1, 2, 310, 311, 312, 640]
    assert len(set(seeds)) == 3
    agent.restart(0)
    assert moved(agent, 2) == [0, 1]
    agent.reset(0, None, 7)
    moved(agent, 7)
    assert seeds[:3] == seeds[-3:]


def test_actions_that_are_held_are_fewer_than_control_steps() -> None:
    agent, _ = acting(replace(QUICK, execute=3, frame_stride=4), action_repeat=2)
    agent.reset(0, None, 7)
    assert moved(agent, 7) == [0, 1, 2, 310, 311, 312, 640], "as with stride 2, none held"


def test_a_chunk_is_executed_at_the_policy_s_speed() -> None:
    agent, _ = acting(replace(QUICK, execute=3, frame_stride=2))
    agent.reset(0, None, 7)
    whole = moved(agent, 7)
    agent, _ = acting(replace(QUICK, execute=3, frame_stride=2), pace=Pace(speed=0.5))
    agent.reset(0, None, 7)
    assert moved(agent, 7) == [action / 2 for action in whole]


@pytest.mark.parametrize("execute", [1, 3])
@pytest.mark.parametrize("action_repeat", [1, 2])
@pytest.mark.parametrize("delay", range(5))
def test_where_actions_are_late_the_same_ones_are_sent(
    delay: int, action_repeat: int, execute: int
) -> None:
    """The policy knows from where the arm is what follows, and the arm follows late."""
    actions = np.random.default_rng(3).uniform(0.2, 1.0, 60).astype(np.float32)
    way = STEP * action_repeat * np.concatenate([[0.0], np.cumsum(actions)])
    recipe = replace(QUICK, chunk=8, execute=execute, history=1, clock=True, measure_delay=True)
    policy = Linear(recipe, ())
    clocks: list[np.ndarray] = []

    def plan(features: None, vectors: np.ndarray, seed: int) -> np.ndarray:
        at = int(np.abs(way - vectors[0, 0, 0]).argmin())
        clocks.append(vectors[0, 0, ACTIONS:])
        return np.repeat(actions[None, at : at + recipe.chunk, None], ACTIONS, axis=2)

    policy.plan = plan  # type: ignore[method-assign,assignment]
    inputs = (names.STATE, names.CLOCK)
    senses = PolicyAgent("late", policy, None, (), 32, inputs, action_repeat=action_repeat)
    agent = ChunkAgent(policy, senses, STEP)
    agent.reset(0, None, 0)
    sent: list[float] = []
    for step in range(40):
        moved = float(way[max(0, step - delay)])
        arm = SimpleNamespace(agent_pos=lambda moved=moved: np.full(7, moved, np.float32))
        sent.append(float(agent.act([0], [arm], [{}])[0, 0]))
    np.testing.assert_array_equal(sent, actions[:40])
    # The clock is that of the observation, which is late as well.
    seen = [max(0, step - delay) * action_repeat for step in range(0, 40, execute)]
    np.testing.assert_allclose(clocks, clock(np.array(seen)), atol=1e-6)


def test_an_arm_at_half_speed_is_half_as_far_ahead() -> None:
    recipe = replace(QUICK, chunk=8, execute=1, history=1, measure_delay=True)
    policy = Linear(recipe, ())
    steps = np.linspace(0.1, 0.8, 8, dtype=np.float32)
    policy.plan = lambda *_: np.tile(steps[None, :, None], (1, 1, 7))  # type: ignore[method-assign]
    senses = PolicyAgent("late", policy, None, (), 32, pace=Pace(speed=0.5))
    agent = ChunkAgent(policy, senses, STEP)
    agent.reset(0, None, 0)
    way = [0.0]
    for step in range(20):
        moved = STEP * way[max(0, step - 4)]
        arm = SimpleNamespace(agent_pos=lambda moved=moved: np.full(7, moved, np.float32))
        action = agent.act([0], [arm], [{}])[0, 0]
        way.append(way[-1] + float(action))
    assert action == pytest.approx(0.5 * steps[2]), "four steps late, two of the plan's"


@pytest.mark.parametrize(
    ("execute", "spacing", "history"), [(8, 5, 2), (3, 2, 3), (2, 5, 3), (4, 1, 1)]
)
def test_images_are_looked_at_while_they_can_be_shown(
    execute: int, spacing: int, history: int
) -> None:
    recipe = replace(QUICK, chunk=8, execute=execute, frame_stride=spacing, history=history)
    policy = Linear(recipe, ((1,),))
    planned: list[list[float]] = []

    def plan(features: np.ndarray, vectors: np.ndarray, seed: int) -> np.ndarray:
        assert np.array_equal(features[0, :, 0], vectors[0, :, 0])
        planned.append(features[0, :, 0].tolist())
        return np.zeros((1, recipe.chunk, ACTIONS), np.float32)

    policy.plan = plan  # type: ignore[method-assign,assignment]
    agent = ChunkAgent(policy, PolicyAgent("seeing", policy, Brightness(), ("front",), 4), STEP)
    agent.reset(0, None, 0)
    arm = SimpleNamespace(agent_pos=lambda: np.full(7, arm.step, np.float32), step=0)
    looked_at = []

    def image(step: int) -> np.ndarray:
        assert step == arm.step, "the env has moved on"
        looked_at.append(step)
        return np.full((4, 4, 3), step, np.uint8)

    for arm.step in range(20):
        agent.act([0], [arm], [LazyMapping({"front": partial(image, arm.step)}, {})])
    due = range(0, 20, execute)
    wanted = [
        [max(0, tick - back * spacing) for back in range(history - 1, -1, -1)] for tick in due
    ]
    assert planned == wanted
    # Only what some plan sees is looked at; the plans of the last steps lie beyond the end.
    ahead = range(0, 20 + spacing * history, execute)
    seen = {max(0, tick - back * spacing) for tick in ahead for back in range(history)}
    assert looked_at == sorted(step for step in seen if step < 20)


def test_bc_chunk_learns_every_planned_action_and_no_padding() -> None:
    recipe = BCChunkRecipe(hidden=(64,), batch_norm=False, chunk=3)
    torch.manual_seed(0)
    policy = BC_CHUNK.make(recipe, ((DIM,),))
    assert isinstance(policy, ChunkPolicy)
    observed = torch.randn(48, policy.inputs.dim)
    target = torch.cat([torch.rand(48, 3, ACTIONS) - 0.5, torch.zeros(48, 3, 1)], dim=2)
    padded = target.clone()
    padded[:, 2, ACTIONS] = 1.0
    padded[:, 2, :ACTIONS] = 9.0
    policy.measure(padded)
    errors = (policy._chunks(observed) - target[..., :ACTIONS]) ** 2
    assert policy.loss(observed, target).item() == pytest.approx(errors.mean().item())
    assert policy.loss(observed, padded).item() == pytest.approx(errors[:, :2].mean().item())
    optimiser = torch.optim.Adam(policy.parameters(), 1e-2)
    for _ in range(400):
        optimiser.zero_grad()
        policy.loss(observed, target).backward()
        optimiser.step()
    np.testing.assert_allclose(policy._chunks(observed).detach(), target[..., :ACTIONS], atol=0.15)


@pytest.mark.parametrize("given", [{"history": 2}, {"settings": {"dim_model": 64}}])
def test_bc_chunk_refuses_what_its_network_has_not(given: dict[str, object]) -> None:
    with pytest.raises(InputError, match="bc-chunk sees one observation"):
        BCChunkRecipe(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize("members", [0, 101])
def test_bc_chunk_has_1_to_100_networks(members: int) -> None:
    with pytest.raises(InputError, match=f"members is {members}; it must be at"):
        BCChunkRecipe(members=members)


def members_of(count: int) -> BCChunkPolicy:
    """A `bc-chunk` of `count` networks that see a feature map and the pose."""
    torch.manual_seed(0)
    recipe = BCChunkRecipe(hidden=(16,), chunk=3, map_head="keypoints", members=count)
    policy = BC_CHUNK.make(recipe, ((4, 6, 6),))
    assert isinstance(policy, BCChunkPolicy)
    return policy


def test_the_plan_of_several_networks_is_the_mean_of_theirs() -> None:
    several = members_of(3)
    state = several.state_dict()
    generator = torch.Generator().manual_seed(1)
    observed = torch.randn(5, several.inputs.dim, generator=generator)
    target = torch.rand(5, 3, ACTIONS + 1, generator=generator).round()
    alone: list[torch.Tensor] = []
    losses: list[torch.Tensor] = []
    for member in range(3):
        layers = "network." if member == 0 else f"others.{member - 1}."
        heads = f"heads.heads.{member}."
        renamed = {
            layers: "network.",
            heads: "heads.heads.0.",
            "input_": "input_",
            "action_": "action_",
        }
        own = {
            key.replace(old, new, 1): value
            for key, value in state.items()
            for old, new in renamed.items()
            if key.startswith(old)
        }
        one = members_of(1)
        one.load_state_dict(own)  # a policy of one network has the names it always had
        losses.append(one.loss(observed, target))
        alone.append(one.eval()._chunks(observed))
    torch.testing.assert_close(several.loss(observed, target), torch.stack(losses).mean())
    several.eval()
    mean = torch.stack(alone).mean(0)
    torch.testing.assert_close(several._chunks(observed), mean)
    taught = target[..., ACTIONS] == 0
    error = ((mean - target[..., :ACTIONS])[taught] ** 2).mean()
    torch.testing.assert_close(several.loss(observed, target), error)
    assert not torch.allclose(alone[0], alone[1])


def test_a_network_learns_from_its_own_errors_alone() -> None:
    """Its gradient has the direction that it has without the others, whatever they answer."""
    several = members_of(2)
    observed = torch.randn(6, several.inputs.dim, generator=torch.Generator().manual_seed(1))
    target = torch.zeros(6, 3, ACTIONS + 1)
    first = next(several.network.parameters())
    second = next(several.others.parameters())
    (before,) = torch.autograd.grad(several.loss(observed, target), first)
    with torch.no_grad():
        second.mul_(10.0)
    (after,) = torch.autograd.grad(several.loss(observed, target), first)
    torch.testing.assert_close(after, before)
    assert before.abs().max() > 0


@pytest.mark.parametrize("samples", [1, 3])
def test_a_plan_is_the_mean_of_the_samples_of_its_own_history(samples: int) -> None:
    policy = Draws(replace(QUICK, samples=samples), ((DIM,),))
    torch.manual_seed(7)
    drawn = torch.rand(2 * samples, QUICK.chunk, ACTIONS).numpy()
    features = np.zeros((2, QUICK.history, DIM), np.float32)
    vectors = np.zeros((2, QUICK.history, policy.inputs.width), np.float32)
    planned = policy.plan(features, vectors, seed=7)
    means = drawn.reshape(2, samples, QUICK.chunk, ACTIONS).mean(1)
    np.testing.assert_allclose(planned, means, rtol=1e-6)


def test_an_ensemble_is_the_weighted_mean_of_the_plans() -> None:
    agent, _ = acting(replace(QUICK, execute=2, chunk=4, ensemble=0.5, history=1))
    agent.reset(0, None, 0)
    actions = moved(agent, 4)
    older, newer = 2.0, 220.0  # made at 0, and at 2 where the arm stands at 2
    weight = np.exp(-0.5)
    assert actions[2] == pytest.approx((older + weight * newer) / (1 + weight), rel=1e-6)


@pytest.mark.parametrize(
    "change", [{"execute": 5}, {"history": 0}, {"ema": 1.0}, {"proprioception": False}]
)
def test_a_recipe_refuses_what_cannot_be(change: dict[str, object]) -> None:
    with pytest.raises(InputError):
        replace(QUICK, **change)


def test_a_change_may_be_one_entry_of_a_table(tmp_path: Path, registered: None) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text("settings: {width: 8, depth: 2}", encoding="utf-8")
    recipe = load_recipe("linear", path, {"settings.depth": 3, "settings.kind": "new", "chunk": 12})
    assert isinstance(recipe, ChunkRecipe)
    assert recipe.settings == {"width": 8, "depth": 3, "kind": "new"} and recipe.chunk == 12
    for key in ("chunk.depth", "settings."):
        with pytest.raises(InputError, match=f"'{key}'"):
            load_recipe("linear", path, {"chunk": 12, key: 3})
    with pytest.raises(UnknownName, match="settings"):
        load_recipe("linear", path, {"setings.depth": 3})


@pytest.mark.parametrize("value", [math.nan, [1.0, math.inf], datetime.date(2020, 1, 1), {1j: 2}])
def test_settings_that_no_file_can_hold_are_refused(value: object) -> None:
    with pytest.raises(InputError, match="dropout"):
        replace(QUICK, settings={"dropout": value})


def test_no_tensor_is_left_where_the_policy_was() -> None:
    policy = Linear(QUICK, ((DIM,),)).to("meta")
    observed = torch.empty(3, 2, policy.inputs.dim, device="meta")
    target = torch.empty(3, 4, ACTIONS + 1, device="meta")
    assert policy.loss(policy.normalise(observed), target).device.type == "meta"
