"""The delay of an arm's actions, measured from what was sent and what it reports."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import STEPS, RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import UnreachablePose
from surgicai_vision.demos.demonstrator import make_demonstrator
from surgicai_vision.evaluation.delay import DelayMeter

TRANSLATION = STEPS["paper"][0]
LONGEST = 7
FOUND = 6
"""Control steps of a motion after which the delay is known."""


@pytest.mark.parametrize("delay", range(LONGEST + 1))
def test_the_delay_is_known_at_once_whatever_the_arm_s_error(delay: int) -> None:
    rng = np.random.default_rng(delay)
    turn = np.linalg.qr(np.eye(3) + 0.04 * rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.diag(turn))  # the base turned by a few degrees
    offset = rng.normal(size=3) * 0.01
    meter = DelayMeter(TRANSLATION, LONGEST)
    sent = [np.zeros(3)]
    for step in range(30):
        reached = max(0.0, step - delay - 0.3)  # a servo's own lag is a third of a step
        whole = int(reached)
        ways = np.cumsum(sent, axis=0)
        tip = ways[whole] + (reached - whole) * (ways[min(whole + 1, len(ways) - 1)] - ways[whole])
        seven = np.concatenate([offset + turn @ tip, np.zeros(4)])
        meter.see(seven.astype(np.float32))
        assert meter.delay == min(delay, step), "as long as nothing has moved, all is late"
        action = np.concatenate([rng.uniform(0.3, 1.0, 3), np.zeros(4)])
        meter.send(action.astype(np.float32))
        sent.append(TRANSLATION * action[:3])


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("task", names.SUBTASKS)
def test_the_delay_of_an_env_is_found(task: str, delay: int) -> None:
    config = TaskConfig(task, randomisation=RandomisationConfig(latency=delay))
    with envs.make(config, obs_type="state") as env:
        env.reset(seed=names.VALIDATION_SEED)
        expert = make_demonstrator("expert", env)
        meter = DelayMeter(TRANSLATION, LONGEST)
        found = []
        for _ in range(4 * FOUND):
            meter.see(env.agent_pos())
            found.append(meter.delay)
            try:
                action = expert.action()
            except UnreachablePose:
                break
            meter.send(action)
            env.step(action)
    assert len(found) > FOUND
    assert set(found[FOUND:]) == {delay}
