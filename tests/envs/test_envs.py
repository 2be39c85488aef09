"""The environments' contract: gymnasium's checks, determinism, the complete state, refusals."""

import hashlib
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from episodes import actions, flat, make, play, same
from gymnasium.utils.env_checker import check_env

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.tasks import env_id

# -- gymnasium -------------------------------------------------------------------------------------


@pytest.mark.parametrize("obs_type", names.OBS_TYPES)
@pytest.mark.parametrize("task", names.TASKS)
def test_gymnasium_accepts_every_env(task, obs_type):
    chosen = {"cameras": ("back",), "image_size": 32} if "pixels" in obs_type else {}
    env = gymnasium.make(env_id(task), obs_type=obs_type, **chosen)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*space (min|max)imum value is -?infinity.*")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_render_gives_an_image():
    env = gymnasium.make(env_id("grasp"), render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8 and image.std() > 10
    env.close()
    assert make("grasp").render() is None


@pytest.mark.parametrize(("held", "fps"), [(1, 50), (2, 25), (3, 16)])
def test_a_video_of_held_actions_runs_in_real_time(held, fps):
    env = gymnasium.make(env_id("grasp"), action_repeat=held, render_mode="rgb_array")
    assert env.metadata["render_fps"] == fps
    assert envs.SuturingEnv.metadata["render_fps"] == names.FPS
    env.close()


def test_the_habits_of_mujoco_env_hold():
    env = make("grasp")
    env.reset(seed=0)
    assert env.model is env.unwrapped.model and env.frame_skip == 10
    assert env.dt == pytest.approx(0.02) and env.control_dt == env.dt
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    qpos[env.scene.needle_qpos.start] += 0.002
    env.set_state(qpos, qvel)
    assert np.array_equal(env.data.qpos, qpos)
    assert env.needle_pose()[0] == np.float32(qpos[env.scene.needle_qpos.start])
    with pytest.raises(InputError, match=r"\(3,\).*needs \(23,\) and \(22,\)"):
        env.set_state(np.zeros(3), qvel)


@pytest.mark.parametrize("task", names.TASKS)
def test_an_episode_ends_at_its_limit_and_not_before(task):
    env = make(task, max_steps=7)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]


# -- determinism -----------------------------------------------------------------------------------

TRAJECTORIES = """
import sys
sys.path[:0] = sys.argv[1:]
from test_envs import fingerprint
print(fingerprint())
"""


def fingerprint():
    """Hash of all tasks' trajectories under the same seeds and actions."""
    total = hashlib.sha256()
    for task in names.TASKS:
        env = make(task)
        rows = [
            env.reset(seed=11)[0],
            *(env.step(action)[0] for action in actions(25)),
            env.get_state(),
        ]
        total.update(b"".join(row.tobytes() for row in rows))
    return total.hexdigest()


def test_same_seed_same_trajectory_in_this_and_in_another_process(root):
    first = fingerprint()
    assert fingerprint() == first
    command = [
        sys.executable,
        "-c",
        TRAJECTORIES,
        str(root / "tests" / "envs"),
        str(root / "tests" / "helpers"),
    ]
    assert (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == first
    )


@pytest.mark.parametrize("task", names.TASKS)
def test_a_used_env_repeats_a_seed(task):
    env = make(task)

    def rollout():
        rows = [env.reset(seed=5)[0], *(env.step(action)[0] for action in actions(20))]
        return np.array(rows)

    first = rollout()
    env.reset(seed=6)
    play(env, 10)
    assert np.array_equal(rollout(), first)
    env.reset()  # without a seed the generator goes on
    assert not np.array_equal(env.reset()[0], first[0])


@pytest.mark.parametrize("task", names.TASKS)
def test_a_restored_state_has_the_same_future(task):
    """From the middle of an episode: same observation, same future, bit for bit."""
    steps = {"grasp": 50, "place": 30, "insert": 48, "handoff": 86, "pullout": 40, "suture": 345}[
        task
    ]
    env, other = make(task), make(task)
    env.reset(seed=3)
    play(env, steps)
    assert env.data.ncon > 0
    state, seen, info = env.get_state(), env.observe(), env.measure()
    future, done = play(env, 12)
    after = env.get_state()
    other.reset(seed=4)
    for restored in (env, other):
        restored.set_state_vector(state)
        assert same(restored.observe(), seen)
        assert same(restored.measure(), info)
        assert np.array_equal(restored.get_state(), state)
        assert all(
            same(restored.step(action)[0], row) for action, row in zip(done, future, strict=True)
        )
        assert np.array_equal(restored.get_state(), after)


def test_a_restored_state_has_the_same_images():
    env = make("insert", obs_type="pixels_agent_pos")
    env.reset(seed=3)
    play(env, 30)
    state, seen = env.get_state(), env.observe()
    play(env, 5)
    assert not same(env.observe(), seen)
    env.set_state_vector(state)
    assert same(env.observe(), seen)


def test_wrong_states_are_refused():
    env = make("grasp")
    env.reset(seed=0)
    state = env.get_state()
    for wrong in (state[:-1], state[None], np.append(state, 0.0)):
        with pytest.raises(InputError, match=rf"\({len(state)},\)"):
            env.set_state_vector(wrong)
    with pytest.raises(InputError, match="finite"):
        env.set_state_vector(np.full_like(state, np.nan))
    # MuJoCo would answer such a position by resetting itself.
    qpos, qvel = env.data.qpos.copy(), env.data.qvel.copy()
    for wrong in (np.nan, 1e11):
        with pytest.raises(InputError, match=r"finite, or beyond ±1e\+10"):
            env.set_state_vector(np.where(np.arange(len(state)) == 2, wrong, state))
        for each in ((np.full_like(qpos, wrong), qvel), (qpos, np.full_like(qvel, wrong))):
            with pytest.raises(InputError, match=r"finite, or beyond ±1e\+10"):
                env.set_state(*each)
    assert np.array_equal(env.get_state(), state)


@pytest.mark.parametrize("task", ["grasp", "place", "handoff", "pullout"])
def test_a_state_of_another_subtask_is_not_taken_for_one_of_its_own(task):
    procedure, env = make(names.SUTURE), make(task)
    procedure.reset(seed=0)
    procedure.enter(names.SUBTASKS.index("insert"))
    env.reset(seed=0)
    env.set_state_vector(procedure.get_state())
    for use in (env.observe, env.measure, lambda: env.step(np.zeros(7))):
        with pytest.raises(InputError, match=f"subtask 2, which '{task}' does not have"):
            use()
    env.reset(seed=0)
    assert env.subtask.name == task


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectorised_envs_are_single_envs(mode):
    """Asynchronous ones with images: each worker makes its own OpenGL context."""
    chosen = (
        {"obs_type": "pixels_agent_pos", "cameras": ("back",), "image_size": 32}
        if mode == "async"
        else {}
    )
    kwargs = {"context": "spawn"} if mode == "async" else {}
    vector = gymnasium.make_vec(
        env_id("place"), 2, vectorization_mode=mode, vector_kwargs=kwargs, **chosen
    )
    singles = [gymnasium.make(env_id("place"), **chosen) for _ in range(2)]
    moves = actions(2 * 10).reshape(10, 2, 7)
    try:
        seen = [vector.reset(seed=[7, 8])[0], *(vector.step(move)[0] for move in moves)]
        for index, env in enumerate(singles):
            rows = [env.reset(seed=7 + index)[0], *(env.step(move[index])[0] for move in moves)]
            for row, batch in zip(rows, seen, strict=True):
                assert same(row, {key: part[index] for key, part in flat(batch).items()})
    finally:
        vector.close()


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", [np.zeros(6), np.zeros(8), np.full(7, np.nan), np.array([np.inf] + [0.0] * 6)]
)
def test_wrong_actions_are_refused(wrong):
    env = make("grasp")
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(InputError, match="7 finite numbers"):
        env.step(wrong)
    assert np.array_equal(env.get_state(), state)


def test_actions_beyond_the_box_are_clipped():
    env, rows = make("grasp"), []
    for size in (1.0, 5.0):
        env.reset(seed=0)
        rows.append(env.step(np.full(7, size))[0])
    assert np.array_equal(*rows)


@pytest.mark.parametrize(
    ("argument", "allowed"),
    [
        ({"task": "sew"}, names.TASKS),
        ({"obs_type": "pixel"}, names.OBS_TYPES),
        ({"cameras": ("front", "side")}, names.CAMERAS),
        ({"obs_type": "pixels", "cameras": ()}, names.CAMERAS),
        ({"cameras": ("front", "front")}, ("front",)),
        ({"reward": "shaped"}, ("sparse", "dense")),
        ({"tolerance": "papers"}, ("paper", "released")),
        ({"step": "big"}, ("paper", "released", "shipped")),
        ({"scene": {"layout": "complex"}}, names.LAYOUTS),
        ({"scene": "simple"}, ("scene", "table of keys", "str")),
        ({"randomisation": "world"}, ("randomisation", "table of keys", "str")),
        ({"randomisation": {"lihgt": 0.1}}, ("'lihgt'", "'light'")),
        ({"scene": {"layouts": "simple"}}, ("layout", "thread", "hole_pair")),
        ({"image_size": 8}, ("16", "960")),
        ({"image_size": (224,)}, ("height, width",)),
        ({"image_size": "big"}, ("'big'", "height, width")),
        ({"image_size": 224.0}, ("224.0", "height, width")),
        ({"cameras": "frnt"}, ("'frnt'", "'front'")),
        ({"render_mode": "ansi"}, ("human", "rgb_array")),
        ({"hold_jaw": "False"}, ("hold_jaw", "bool", "'False'")),
        ({"end_on_drop": 1}, ("end_on_drop", "bool", "1")),
        ({"action_repeat": 1.5}, ("action_repeat", "int", "1.5")),
        ({"max_steps": 2.5}, ("max_steps", "int", "2.5")),
        ({"obs_type": "pixels", "depth": "no"}, ("depth", "'no'", "True or False")),
    ],
)
def test_wrong_arguments_are_refused_with_what_exists(argument, allowed):
    with pytest.raises(SurgicaiError) as refusal:
        envs.make_task(**({"task": "grasp"} | argument))
    assert isinstance(refusal.value, InputError)
    assert all(name in str(refusal.value) for name in allowed)


def test_one_camera_may_be_named_alone():
    assert envs.make_task("grasp", cameras="back").view.cameras == ("back",)
