"""What an agent may ask of a robot: a whole procedure with learned ends needs nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest
from procedures import expert_procedure

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.evaluation.agents import PolicyAgent
from surgicai_vision.evaluation.hierarchical import HierarchicalAgent
from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig

SEED = names.TEST_SEED


class OnlyRobot:
    """An env reduced to the members of `evaluation.agent.Robot`."""

    def __init__(self, env):
        self.agent_pos, self.both_arms = env.agent_pos, env.both_arms
        self.setpoint, self.enter = env.setpoint, env.enter

    def __getattr__(self, name):
        raise AssertionError(f"an agent asked its robot for '{name}'")


def policy(answers: np.ndarray, vector: tuple[str, ...]) -> PolicyAgent:
    """Return a policy without images that gives these answers in turn."""
    given = iter(answers)

    def act(features, vectors):
        assert vectors.shape[0] == 1 and np.isfinite(vectors).all()
        return next(given)[None]

    return PolicyAgent("played", SimpleNamespace(act=act), None, (), 32, vector)


def hierarchy(
    vector: tuple[str, ...] = (names.STATE, names.SETPOINT), **ends: object
) -> HierarchicalAgent:
    """Return policies that replay the expert's actions and its changes of subtask."""
    played = expert_procedure(SEED)
    phases = np.array(played.phases)
    low = [
        lambda own=played.actions[phases == subtask]: policy(own, vector)
        for subtask in range(len(names.SUBTASKS))
    ]
    logits = 9.0 * np.eye(len(names.SUBTASKS), dtype=np.float32)[phases]
    config = HierarchicalConfig("hlp", *names.SUBTASKS, **ends)
    return HierarchicalAgent(config, low, lambda: policy(logits, (names.BOTH_ARMS,)))


def sew(agent: HierarchicalAgent) -> dict[str, object]:
    """Run an episode; the agent has only a robot, and the env advances only when told."""
    env = envs.make(TaskConfig("suture", advance="told"))
    env.reset(seed=SEED)
    robot = OnlyRobot(env)
    agent.reset(0, robot, SEED)
    over = False
    while not over:
        _, _, terminated, truncated, info = env.step(agent.act([0], [robot], [None])[0])
        over = terminated or truncated
    env.close()
    return info


def test_a_whole_procedure_with_learned_ends_asks_a_robot_for_nothing_else() -> None:
    agent = hierarchy(patience=1, decide_every=1)
    assert not agent.privileged
    info = sew(agent)
    assert info["is_success"] and info["progress"] == 5


@pytest.mark.parametrize(
    ("asked", "made"),
    [
        ("phase", {"termination": "privileged"}),
        ("state_vector", {"vector": (names.PRIVILEGED_STATE,), "patience": 1, "decide_every": 1}),
    ],
)
def test_what_is_privileged_says_so_and_has_no_robot(asked: str, made: dict[str, object]) -> None:
    agent = hierarchy(**made)
    assert agent.privileged
    with pytest.raises(AssertionError, match=f"asked its robot for '{asked}'"):
        sew(agent)
