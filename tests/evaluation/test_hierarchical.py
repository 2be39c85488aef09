"""Hierarchical policies: high-level policy, low-level policies, terminations, limits."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from checkpoints import checkpoint

from surgicai_vision import envs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.agents import ExpertAgent, PolicyAgent
from surgicai_vision.evaluation.hierarchical import HierarchicalAgent
from surgicai_vision.evaluation.hierarchical_config import (
    HierarchicalConfig,
    hierarchical_yaml,
    read_hierarchical,
)
from surgicai_vision.evaluation.metrics import summary
from surgicai_vision.evaluation.policy_spec import hierarchical_policy, open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.evaluation.slot import Slot
from surgicai_vision.training.checkpoint import (
    StageErrors,
    read_checkpoint,
    read_tensors,
    write_checkpoint,
)
from surgicai_vision.training.run_config import TERMINATIONS

EXPERTS = dict.fromkeys(names.SUBTASKS, "expert")
PRIVILEGED = {**EXPERTS, "termination": "privileged"}


class Env:
    """Records the subtasks that a policy begins; a subtask succeeds after `length` steps."""

    def __init__(self, length: int = 3):
        self.length, self.phase, self.steps, self.begun = length, 0, 0, []

    @property
    def dwell(self) -> int:
        """Steps for which the success has held, which begins after two."""
        return max(0, self.steps - 2)

    def enter(self, phase: int) -> None:
        if phase != self.phase:
            self.begun.append(phase)
            self.phase, self.steps = phase, 0

    def step(self) -> None:
        self.steps += 1
        if self.steps == self.length and self.phase < 4:
            self.phase, self.steps = self.phase + 1, 0


class Constant(Agent):
    """Acts with one value; records the slots whose subtask restarted."""

    def __init__(self, value: float):
        self.value, self.restarted = value, []

    def reset(self, slot, env, seed):
        pass

    def act(self, slots, envs, observations):
        return np.full((len(slots), 7), self.value)

    def restart(self, slot):
        self.restarted.append(slot)


class Saying:
    """A high-level policy that names `classes` in turn, each with a probability of `sure`."""

    cameras = ()
    image_size = 224
    depth = False
    privileged = False
    action_mode = names.INCREMENTS

    def __init__(self, classes: list[int], sure: float = 0.9):
        self.said = iter(classes)
        self.logits = np.full((5, 5), np.log((1 - sure) / 4))
        np.fill_diagonal(self.logits, np.log(sure))

    def share(self, features):
        pass

    def answer(self, robots, observations):
        logits = self.logits[[next(self.said) for _ in robots]]
        progress = np.full((len(robots), 1), 9.0)  # appended to the logits, not one of them
        return np.concatenate([logits, progress], axis=1).astype(np.float32)


def agent(
    classes: list[int], sure: float = 0.9, action_repeat: int = 1, **changes: object
) -> HierarchicalAgent:
    """Return a policy whose high level names `classes` in turn; each low level plays its index."""
    made = HierarchicalAgent(
        HierarchicalConfig("hlp", **{**PRIVILEGED, **changes}),
        [ExpertAgent] * 5,
        lambda: Saying(classes, sure),
        action_repeat,
    )
    made._low = [Constant(index / 10) for index in range(5)]
    return made


def learned(classes: list[int], sure: float = 0.9, **changes: object) -> HierarchicalAgent:
    """Return the same with learned ends, which ask in every step by default."""
    how = {"termination": "learned", "decide_every": 1, "patience": 1, **changes}
    return agent(classes, sure, **how)


def roll(actor: HierarchicalAgent, env: Env, steps: int) -> list[int]:
    """Return which low-level policy acted in each step; 0 also where the arms hold still."""
    actor.reset(0, env, 0)
    acted = []
    for _ in range(steps):
        value = actor.act([0], [env], [None])[0, 0]
        acted.append(round(10 * float(value)))
        env.step()
    return acted


@pytest.mark.parametrize(
    ("held", "acted"), [(1, [0, 0, 0, 0, 1, 1, 1, 1, 2]), (2, [0, 0, 1, 1, 2]), (5, [0, 1, 2])]
)
def test_a_high_level_policy_is_asked_by_control_steps(held: int, acted: list[int]) -> None:
    actor = learned([0, 1, 2], decide_every=4, action_repeat=held)
    assert roll(actor, Env(99), len(acted)) == acted


@pytest.mark.parametrize(("held", "acted"), [(1, [0, 0, 0, 0, 1]), (2, [0, 0, 1]), (3, [0, 0, 1])])
def test_a_subtasks_limit_counts_control_steps(held: int, acted: list[int]) -> None:
    actor = agent([0, 1], steps=4, action_repeat=held)
    assert roll(actor, Env(99), len(acted)) == acted


def test_privileged_termination_asks_when_the_subtask_has_ended() -> None:
    env = Env(3)
    assert roll(agent([0, 1, 2, 3, 4]), env, 14) == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4]
    assert env.begun == []


def test_a_grasp_may_end_sooner_than_the_env_ends_it_and_nothing_else_may() -> None:
    env = Env(10)
    acted = roll(agent([0, 1, 2], grasp_hold=3), env, 17)
    assert acted == [0] * 5 + [1] * 10 + [2] * 2 and env.begun == [1]
    assert roll(learned([0] * 9, grasp_hold=3), Env(10), 8) == [0] * 8, (
        "a learned termination asks the high-level policy alone"
    )
    for wrong in (0, 16):
        with pytest.raises(InputError, match="grasp_hold is"):
            HierarchicalConfig("hlp", **EXPERTS, grasp_hold=wrong)
    for wrong in (-0.1, 1.0):
        with pytest.raises(InputError, match="confidence is"):
            HierarchicalConfig("hlp", **EXPERTS, confidence=wrong)


def test_a_choice_moves_its_own_arm() -> None:
    env = Env(3)
    assert roll(agent([0, 3, 1]), env, 7) == [0, 0, 0, 3, 3, 3, 1]
    assert env.begun == [3, 1]


def test_a_subtask_ends_after_its_steps_and_an_episode_after_its_decisions() -> None:
    acted = roll(agent([1, 2, 3, 4], steps=2, decisions=3), Env(100), 9)
    assert acted == [1, 1, 2, 2, 3, 3, 0, 0, 0], "after the third decision the arms hold still"


def test_a_policy_that_plans_ahead_forgets_its_plan_when_its_subtask_begins() -> None:
    actor = agent([0, 1, 2, 3, 4])
    roll(actor, Env(3), 8)
    assert [low.restarted for low in actor._low] == [[0], [0], [0], [], []]


def test_a_learned_end_waits_until_the_same_subtask_was_named_often_enough_in_a_row() -> None:
    said = [0] * 4 + [1] * 3 + [0] + [1, 1, 1, 2] + [1] * 20
    acted = roll(learned(said, patience=5), Env(2), 20)
    assert acted == [0] * 16 + [1] * 4, "the env's own success must not end a subtask"


def test_a_learned_end_waits_for_a_sure_high_level_policy() -> None:
    said = [0, 1, 1, 1, 1]
    assert roll(learned(said, sure=0.7, confidence=0.75), Env(2), 5) == [0] * 5
    assert roll(learned(said, sure=0.7, confidence=0.65), Env(2), 5) == [0, 1, 1, 1, 1]


def test_the_high_level_policy_is_asked_every_so_many_steps() -> None:
    actor = learned([0, 1, 1, 1], decide_every=4, patience=2)
    assert roll(actor, Env(2), 13) == [0] * 8 + [1] * 5
    assert list(actor._high.said) == [], "at steps 0, 4, 8, and 4 after the decision there"


def test_a_learned_subtask_that_took_all_its_steps_may_begin_anew() -> None:
    actor = learned([0, 0, 1, 2], sure=0.3, steps=3, decide_every=200)
    assert roll(actor, Env(99), 12) == [0] * 6 + [1] * 3 + [2] * 3
    assert [low.restarted for low in actor._low] == [[0, 0], [0], [0], [], []]


def test_experts_in_their_order_sew_and_count_their_stages() -> None:
    made = hierarchical_policy(
        HierarchicalConfig("order", **PRIVILEGED, max_steps=1000, grasp_hold=5)
    )
    assert made.config.advance == "success" and made.make_agent().privileged
    assert made.run.sees_goal
    assert made.config.task == "suture"
    row = evaluate(made.make_agent, made.config, [names.TEST_SEED], workers=1)[0].row
    assert row.success and row.stages == 5, row
    # A grasp ends after five steps, the others after fifteen; the first step is not a delay.
    assert (row.false_ends, row.end_delay_s) == (0, pytest.approx(0.28))
    assert summary([row])["reached"] == dict.fromkeys(names.SUBTASKS, 1)


def test_begin_changes_the_arm_and_earns_nothing() -> None:
    env = envs.make(TaskConfig("suture", max_steps=50))
    env.reset(seed=names.TEST_SEED)
    both, first = env.both_arms(), env.agent_pos()
    np.testing.assert_array_equal(both[7:], first)
    env.enter(4)
    np.testing.assert_array_equal(env.agent_pos(), both[:7])
    _, _, _, _, info = env.step(np.zeros(7, np.float32))
    assert (info["phase"], info["progress"], info["is_success"]) == (4, 0, False)
    with pytest.raises(InputError, match="no subtask 5"):
        env.enter(5)


def test_trained_policies_act_together_in_any_batch(tmp_path: Path) -> None:
    hlp = checkpoint(tmp_path / "hlp", "suture", "hlp")
    low = {subtask: checkpoint(tmp_path / subtask, subtask) for subtask in names.SUBTASKS}
    for termination in TERMINATIONS:
        made = hierarchical_policy(
            HierarchicalConfig(hlp, **low, termination=termination, steps=4, max_steps=12)
        )
        rows = [
            [
                e.row
                for e in evaluate(
                    made.make_agent, made.config, [900_000, 900_001], batch=batch, workers=1
                )
            ]
            for batch in (1, 2)
        ]
        assert repr(rows[0]) == repr(rows[1]) and rows[0][0].steps == 12  # NaN is unequal to itself
        assert made.config.advance == {"learned": "told", "privileged": "success"}[termination]
        assert made.make_agent().privileged == (termination == "privileged")
        assert not made.run.sees_goal
        assert hierarchical_policy(
            HierarchicalConfig(hlp, **{**low, "place": "expert"}, termination=termination)
        ).run.sees_goal
    spec = open_policy(written(tmp_path, hlp, low), env={"reward": "dense"})
    assert (spec.config.advance, spec.config.reward) == ("told", "dense")
    with pytest.raises(InputError, match="follows from the termination"):
        open_policy(written(tmp_path, hlp, low), env={"advance": "success"})


def test_a_part_by_another_recipe_is_another_policy(tmp_path: Path) -> None:
    """How a plan is acted out is a setting of the recipe; the weights are the same."""
    place = checkpoint(tmp_path / "place", "place")
    config = HierarchicalConfig("order", **{**PRIVILEGED, "place": place})
    before = hierarchical_policy(config).about
    card = read_checkpoint(Path(place))
    changed = replace(card, recipe={**card.recipe, "epochs": 99})
    write_checkpoint(Path(place), changed, read_tensors(card))
    assert read_checkpoint(Path(place)).policy_sha256 == card.policy_sha256
    assert hierarchical_policy(config).about != before


def test_policies_may_have_learned_in_worlds_that_vary_and_not_in_different_scenes(
    tmp_path: Path,
) -> None:
    moved = TaskConfig("grasp", randomisation=RandomisationConfig(phantom_shift=10))
    grasp = checkpoint(tmp_path / "grasp", "grasp", env=moved)
    place = checkpoint(tmp_path / "place", "place")
    low = {**PRIVILEGED, "grasp": grasp}
    alone = hierarchical_policy(HierarchicalConfig("order", **low))
    assert alone.config.randomisation == moved.randomisation
    both = hierarchical_policy(HierarchicalConfig("order", **{**low, "place": place}))
    assert both.config.randomisation == RandomisationConfig()
    fine = checkpoint(tmp_path / "fine", "place", env=TaskConfig("place", step="released"))
    with pytest.raises(InputError, match="different scenes or with different steps"):
        hierarchical_policy(HierarchicalConfig("order", **{**low, "place": fine}))


def written(folder: Path, hlp: str, low: dict[str, str]) -> Path:
    """Write the file of a hierarchical policy without a choice of ends."""
    path = folder / "hierarchical.yaml"
    path.write_text(f"hlp: {hlp}\n" + "".join(f"{name}: {low[name]}\n" for name in low))
    return path


def test_a_hierarchical_policy_counts_the_control_steps_of_the_env_it_is_given(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, "order", dict.fromkeys(EXPERTS, "zero"))
    path.write_text(path.read_text() + "termination: privileged\n")
    for held in (1, 5):
        spec = open_policy(path, env={"action_repeat": held})
        assert spec.config.action_repeat == spec.make()._action_repeat == held


def test_a_counted_high_level_policy_is_told_with_its_errors(tmp_path: Path) -> None:
    folder = Path(checkpoint(tmp_path / "hlp", "suture", "hlp"))
    config = HierarchicalConfig(str(folder), **EXPERTS)
    assert "high_level" not in hierarchical_policy(config).about
    plain = read_checkpoint(folder)
    errors = StageErrors(((3, 0, 0, 0, 0),) * 5, 0.25)
    write_checkpoint(folder, replace(plain, stage_errors=errors), read_tensors(plain))
    told = hierarchical_policy(config).about["high_level"]
    assert told["policy_sha256"] == plain.policy_sha256
    assert from_mapping(StageErrors, told["stage_errors"]) == errors


def test_low_level_policies_share_features() -> None:
    encoded: list[int] = []

    def encoder(frames: np.ndarray) -> np.ndarray:
        encoded.append(len(frames))
        return frames.reshape(len(frames), -1)[:, :2].astype(np.float32)

    encoder.fingerprint = "one"  # type: ignore[attr-defined]
    policy = SimpleNamespace(act=lambda features, vectors: np.tile(features[:, :1], 7))
    shared: dict = {}
    agents = [PolicyAgent("a", policy, encoder, ("back",), 4) for _ in range(2)]
    for one in agents:
        one.share(shared)
        for slot in range(3):
            one.reset(slot, None, 0)
    observations = [{"back": np.full((4, 4, 3), value, np.uint8)} for value in (1, 2, 3)]
    envs = [SimpleNamespace(agent_pos=lambda: np.zeros(7, np.float32))] * 3
    assert agents[0].act([0, 2], envs[:2], observations[::2])[:, 0].tolist() == [1, 3]
    assert agents[1].act([0, 1, 2], envs, observations)[:, 0].tolist() == [1, 2, 3]
    assert encoded == [2, 1]


def test_a_policy_that_sees_depth_is_shown_it() -> None:
    policy = SimpleNamespace(act=lambda features, vectors: np.zeros((len(vectors), 7)))

    def encoder(frames: np.ndarray) -> np.ndarray:
        return np.zeros((len(frames), 2), np.float32)

    encoder.fingerprint = "one"  # type: ignore[attr-defined]
    seeing = partial(PolicyAgent, "a", policy, encoder, ("front_depth",), 32)
    config = HierarchicalConfig("order", **PRIVILEGED)
    slot = Slot(0, HierarchicalAgent(config, [seeing] * 5), TaskConfig(names.SUTURE))
    slot.begin(0)
    assert slot.agent.act([0], [slot.env], [slot.observation]).tolist() == [[0.0] * 7]


def test_wrong_hierarchical_policies_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasp, hlp = (
        checkpoint(tmp_path / "grasp", "grasp"),
        checkpoint(tmp_path / "hlp", "suture", "hlp"),
    )
    with pytest.raises(InputError, match="not for 'place'"):
        hierarchical_policy(HierarchicalConfig("order", **{**PRIVILEGED, "place": grasp}))
    with pytest.raises(InputError, match="takes an 'hlp'"):
        hierarchical_policy(HierarchicalConfig(grasp, **EXPERTS))
    with pytest.raises(InputError, match="does not act"):
        hierarchical_policy(HierarchicalConfig("order", **{**PRIVILEGED, "grasp": hlp}))
    with pytest.raises(BadFile, match="not a checkpoint"):
        hierarchical_policy(HierarchicalConfig(str(tmp_path), **EXPERTS))
    itself = tmp_path / "itself.yaml"
    itself.write_bytes(
        hierarchical_yaml(HierarchicalConfig("order", **{**PRIVILEGED, "grasp": str(itself)}))
    )
    with pytest.raises(InputError, match=r"grasp: .*itself\.yaml is a hierarchical policy"):
        open_policy(itself)
    with pytest.raises(InputError, match="needs a high-level policy"):
        HierarchicalConfig("order", **EXPERTS)
    with pytest.raises(UnknownName, match="termination"):
        from_mapping(HierarchicalConfig, {"hlp": "order", **EXPERTS, "terminaton": "learned"})
    (tmp_path / "hierarchical.yaml").write_text("hlp: order\ngrasp: expert\n")
    assert main(["evaluate", str(tmp_path / "hierarchical.yaml")]) == 2
    assert "'place'" in capsys.readouterr().err


def test_the_documented_hierarchical_policy_is_one(root: Path, tmp_path: Path) -> None:
    text = (root / "docs" / "hierarchical.md").read_text(encoding="utf-8")
    path = tmp_path / "hierarchical.yaml"
    path.write_text(text.split("```yaml\n")[1].split("```")[0])
    made = read_hierarchical(path)
    assert made.termination in TERMINATIONS and all(
        f"{s}-of-suture-state" in getattr(made, s) for s in EXPERTS
    )
    changed = replace(made, confidence=0.65, grasp="released:grasp")
    path.write_bytes(hierarchical_yaml(changed))
    assert read_hierarchical(path) == changed
