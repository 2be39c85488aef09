"""Images that are rendered when they are first looked at: the same pixels, and only those."""

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import InputError

VIEWS = ("front", "back_psm2", "endo_left_psm1")
LOOKS = TaskConfig("suture", randomisation=RandomisationConfig(appearance="train", light=0.3))


def make(config: TaskConfig, **how: object) -> envs.SuturingEnv:
    return envs.make(config, "pixels_agent_pos", cameras=VIEWS, image_size=48, **how)


@pytest.mark.parametrize("config", [TaskConfig("suture"), LOOKS], ids=["plain", "looks"])
def test_what_is_looked_at_late_is_what_is_shown_at_once(config: TaskConfig) -> None:
    shown, later = make(config, depth=True), make(config, depth=True)
    later.defer_images()
    rng = np.random.default_rng(0)
    seen = [env.reset(seed=names.TEST_SEED)[0] for env in (shown, later)]
    for _ in range(3):
        plain, lazy = seen
        assert type(plain) is dict and list(plain) == list(lazy) and len(lazy) == 7
        for key in reversed(plain):
            np.testing.assert_array_equal(lazy[key], plain[key])
        action = rng.uniform(-1, 1, 7).astype(np.float32)
        for env in (shown, later):
            env.enter(3)  # another arm is active after the observation
        seen = [env.step(action)[0] for env in (shown, later)]


def test_only_what_is_looked_at_is_rendered_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(TaskConfig("suture"))
    env.defer_images()
    rendered = []
    render = env.image
    monkeypatch.setattr(
        env, "image", lambda view, *rest: rendered.append(view) or render(view, *rest)
    )
    observation, _ = env.reset(seed=names.TEST_SEED)
    assert "front" in observation and "back" not in observation and not rendered
    kept = observation["back_psm2"]
    assert observation["back_psm2"] is kept and rendered == ["back_psm2"]
    env.step(np.zeros(7, np.float32))
    assert observation["back_psm2"] is kept, "what was looked at stays"
    with pytest.raises(InputError, match="'front' of an observation is read for the first"):
        observation["front"]
    with pytest.raises(KeyError):
        observation["back"]


@pytest.mark.parametrize("move", ["reset", "set_state_vector", "set_state"])
def test_an_env_that_was_put_elsewhere_has_moved_on(move: str) -> None:
    env = make(TaskConfig("grasp"))
    env.defer_images()
    observation, _ = env.reset(seed=names.TEST_SEED)
    moves = {
        "reset": lambda: env.reset(seed=1),
        "set_state_vector": lambda: env.set_state_vector(env.get_state()),
        "set_state": lambda: env.set_state(env.data.qpos.copy(), env.data.qvel.copy()),
    }
    moves[move]()
    with pytest.raises(InputError, match="after the env has moved on"):
        observation["front"]


def test_an_action_that_is_held_is_rendered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """At its end, or where the episode ends before it: nothing else is seen."""
    env = make(TaskConfig("grasp", action_repeat=4, max_steps=6))
    twin = make(TaskConfig("grasp", max_steps=6))
    for each in (env, twin):
        each.reset(seed=names.TEST_SEED)
    rendered = []
    render = env._images.frames
    monkeypatch.setattr(
        env._images, "frames", lambda view, *rest: rendered.append(view) or render(view, *rest)
    )
    action = np.full(7, 0.5, np.float32)
    for steps in (4, 2):
        observation, _, _, truncated, _ = env.step(action)
        for _ in range(steps):
            plain = twin.step(action)[0]
        assert rendered == list(VIEWS) and truncated == (steps == 2)
        for key, frame in plain.items():
            np.testing.assert_array_equal(observation[key], frame)
        rendered.clear()
