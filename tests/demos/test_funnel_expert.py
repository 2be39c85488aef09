"""Going in gradually: handoffs whose labels change no faster than what is seen."""

from itertools import pairwise

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import (
    ALIGNED,
    ALIGNED_ANGLE,
    HANDOFF_BACK,
    OPEN_HANDOFF,
    Expert,
    Offset,
    WorldState,
    approach_and_grasp,
    before,
    handoff_goal,
)
from surgicai_vision.demos.funnel_expert import (
    WIDE,
    WIDE_ANGLE,
    FunnelExpert,
    _target,
    misalignment,
)
from surgicai_vision.demos.rollout import rollout

SEEDS = range(names.VALIDATION_SEED, names.VALIDATION_SEED + 6)


@pytest.mark.parametrize("seed", SEEDS)
def test_it_hands_over(seed: int) -> None:
    env = envs.make(TaskConfig("handoff"))
    result = rollout(env, FunnelExpert(env), seed, "funnel")
    assert result.success and result.demo.success[-1]


@pytest.mark.parametrize("task", [task for task in names.SUBTASKS if task != "handoff"])
def test_elsewhere_it_is_the_expert(task: str) -> None:
    env = envs.make(TaskConfig(task))
    env.reset(seed=SEEDS[0])
    expert, funnel = Expert(env), FunnelExpert(env)
    for _ in range(5):
        action = funnel.action()
        np.testing.assert_array_equal(action, expert.action())
        env.step(action)


def test_how_far_it_stays_away_grows_with_how_far_it_is_out_of_line() -> None:
    assert misalignment(Offset(-0.01, ALIGNED, ALIGNED_ANGLE)) == 0.0
    assert misalignment(Offset(0.0, WIDE, 0.0)) == misalignment(Offset(0.0, 0.0, WIDE_ANGLE)) == 1.0
    for limit, place in ((2 * WIDE, 1), (2 * WIDE_ANGLE, 2)):
        steps = np.linspace(0.0, limit, 500)
        offsets = [[0.0, 0.0, 0.0] for _ in steps]
        for offset, step in zip(offsets, steps, strict=True):
            offset[place] = step
        found = [misalignment(Offset(*offset)) for offset in offsets]
        assert all(0.0 <= after - one < 0.01 for one, after in pairwise(found))


def test_its_target_does_not_jump_where_the_experts_does() -> None:
    """Jaws 4 mm before the grasp, ever further beside it: where they are sent, step by step."""
    env = envs.make(TaskConfig("handoff"))
    env.reset(seed=SEEDS[1])
    world = WorldState(env)
    goal = handoff_goal(world)
    sent: dict[str, list[np.ndarray]] = {"funnel": [], "expert": []}
    for beside in np.arange(0.0, 1.5 * WIDE, 5e-5):
        world.tip = before(goal, 0.004)
        world.tip[:3, 3] += beside * goal[:3, 0]
        sent["funnel"].append(_target(world).tip[:3, 3])
        sent["expert"].append(
            approach_and_grasp(world, goal, HANDOFF_BACK, OPEN_HANDOFF).tip[:3, 3]
        )
    jumps = {
        name: max(float(np.linalg.norm(b - a)) for a, b in pairwise(places))
        for name, places in sent.items()
    }
    assert jumps["funnel"] < 0.0002 < HANDOFF_BACK <= jumps["expert"] + 1e-9
    for places in sent.values():
        np.testing.assert_allclose(places[0], goal[:3, 3])
        np.testing.assert_allclose(places[-1], before(goal, HANDOFF_BACK)[:3, 3])
