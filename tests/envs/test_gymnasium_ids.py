"""The gymnasium ids: registered by the package alone, with their limit, for RL libraries."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.env_checker import check_env

from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.tasks import env_id
from surgicai_vision.core.video import read_video


def run(code, tmp_path):
    """Return what a fresh interpreter in another folder prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("obs_type", names.OBS_TYPES)
@pytest.mark.parametrize("task", names.TASKS)
def test_stable_baselines_accepts_every_env(task, obs_type):
    chosen = {"cameras": ("front", "back"), "image_size": 36} if "pixels" in obs_type else {}
    env = gymnasium.make(env_id(task), obs_type=obs_type, **chosen)
    # A gymnasium wrapper hides `compute_reward`, by which a goal env is recognised.
    for checked in (env, env.unwrapped) if obs_type != "goal" else (env.unwrapped,):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(checked)
    env.close()


def test_importing_the_package_registers_the_ids_and_loads_no_simulator(tmp_path):
    code = (
        "import sys, surgicai_vision, gymnasium\n"
        "assert 'mujoco' not in sys.modules and 'surgicai_vision.envs' not in sys.modules\n"
        "print(*(name for name in gymnasium.registry if name.startswith('surgicai_vision/')))"
    )
    assert run(code, tmp_path).split() == list(map(env_id, names.TASKS))


def test_an_id_that_names_the_package_needs_no_import(tmp_path):
    code = (
        "import gymnasium\n"
        "env = gymnasium.make('surgicai_vision:surgicai_vision/Grasp-v0')\n"
        "print(*env.reset(seed=0)[0].shape)"
    )
    assert run(code, tmp_path) == "21"


@pytest.mark.parametrize("task", names.TASKS)
def test_the_spec_says_the_limit(task):
    limit = TaskConfig(task).max_steps
    assert gymnasium.spec(env_id(task)).max_episode_steps == limit
    assert gymnasium.make(env_id(task)).spec.max_episode_steps == limit


@pytest.mark.parametrize("limit", [None, 3, 230])
def test_an_episode_ends_at_the_limit_that_its_spec_says(limit):
    env = gymnasium.make(env_id("grasp"), max_episode_steps=limit)
    env.reset(seed=0)
    action = np.zeros(7, np.float32)
    steps, truncated = 0, False
    while not truncated:
        *_, terminated, truncated, _ = env.step(action)
        assert not terminated
        steps += 1
    assert steps == env.spec.max_episode_steps == (limit or 200)
    remade = gymnasium.make(env.spec)
    assert remade.spec.max_episode_steps == steps


@pytest.mark.parametrize("workers", [0, 2])
def test_an_episode_of_a_vector_env_has_as_many_actions(workers):
    arguments = {"max_episode_steps": 6, "action_repeat": 2}
    envs = gymnasium.make_vec(env_id("grasp"), 2, workers=workers, **arguments)
    try:
        envs.reset(seed=0)
        actions = np.zeros((2, 7), np.float32)
        ends = [envs.step(actions)[3].tolist() for _ in range(6)]
    finally:
        envs.close()
    assert ends == [[False, False]] * 5 + [[True, True]]


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_two_limits_are_refused(make):
    with pytest.raises(InputError, match="max_episode_steps=7"):
        make(env_id("grasp"), max_steps=7)


def test_gymnasium_records_videos(tmp_path):
    pytest.importorskip("moviepy", reason="no moviepy here: it comes with the extra video")
    env = gymnasium.make(env_id("handoff"), render_mode="rgb_array")
    filmed = RecordVideo(env, str(tmp_path), name_prefix="random")
    filmed.reset(seed=0)
    shown = [filmed.render()]
    for _ in range(5):
        filmed.step(np.zeros(7, np.float32))
        shown.append(filmed.render())
    filmed.close()
    video = read_video(tmp_path / "random-episode-0.mp4")
    assert video.shape == (6, *shown[0].shape)
    assert np.abs(video.astype(int) - np.stack(shown)).mean() < 6
