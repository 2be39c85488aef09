"""What the envs show: nothing shared, constant or privileged; starts; rewards from goals."""

import numpy as np
import pytest
from episodes import flat, make

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.scene import needle

GOAL_JAW = 13
"""The one constant of the 21 values: the goal's jaw is closed in every subtask (released code's
layout).
"""


# -- observations ----------------------------------------------------------------------------------


@pytest.mark.parametrize("obs_type", names.OBS_TYPES)
def test_observations_share_no_memory(obs_type):
    env = make("grasp", obs_type=obs_type)
    rows = [
        flat(env.reset(seed=0)[0]),
        flat(env.step(np.ones(7, np.float32))[0]),
        flat(env.observe()),
    ]
    buffers = [env.data.qpos, env.data.xpos, env.data.ctrl]
    for index, row in enumerate(rows):
        for part in row.values():
            others = [value for other in rows[index + 1 :] for value in other.values()]
            assert not any(np.shares_memory(part, other) for other in others + buffers)


@pytest.mark.parametrize("task", names.TASKS)
def test_no_element_of_an_observation_is_constant(task):
    env, states, tools = make(task), [], []
    for seed in range(3):
        states.append(env.reset(seed=seed)[0])
        tools.append(env.agent_pos())
        expert = Expert(env)
        for _ in range(80):
            seen, _, ended, _, _ = env.step(expert.action())
            states.append(seen)
            tools.append(env.agent_pos())
            if ended:
                break
    assert np.flatnonzero(np.ptp(states, axis=0) < 1e-4).tolist() == [GOAL_JAW]
    assert (np.ptp(tools, axis=0) > 1e-4).all()


def test_the_21_values_are_pose_goal_and_error():
    env = make("grasp")
    seen, info = env.reset(seed=0)
    tool = env.agent_pos()
    assert np.allclose(seen[:3], tool[:3] * 100, atol=1e-4) and np.allclose(
        seen[3:7], tool[3:], atol=1e-6
    )
    assert np.allclose(seen[14:17], seen[7:10] - seen[:3], atol=1e-4)
    assert np.linalg.norm(seen[17:20]) == pytest.approx(info["d_angle"], abs=1e-5)


@pytest.mark.parametrize(("depth", "segmentation"), [(False, False), (True, True)])
@pytest.mark.parametrize("obs_type", ["pixels", "pixels_agent_pos"])
def test_vision_holds_images_and_proprioception_only(obs_type, depth, segmentation):
    cameras = ("front", "wrist_psm2")
    config = TaskConfig("grasp")
    env = envs.make(config, obs_type, cameras, (24, 32), depth=depth, segmentation=segmentation)
    seen, _ = env.reset(seed=0)
    expected = dict.fromkeys(cameras, ((24, 32, 3), np.uint8))
    for group, dtype, chosen in (
        ("depth", np.float32, depth),
        ("segmentation", np.uint8, segmentation),
    ):
        expected |= {f"{camera}_{group}": ((24, 32, 1), dtype) for camera in cameras if chosen}
    if obs_type == "pixels_agent_pos":
        expected["agent_pos"] = ((7,), np.float32)
    assert {key: (part.shape, part.dtype.type) for key, part in flat(seen).items()} == expected
    assert set(flat(env.observation_space.sample())) == set(expected)
    assert env.observation_space.contains(seen)


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_proprioception_does_not_know_the_needle(task):
    """Needle and goals move, arms stay: images change, the tool's values do not."""
    env = make(task, obs_type="pixels_agent_pos")
    seen, _ = env.reset(seed=0)
    qpos = env.data.qpos.copy()
    qpos[env.scene.needle_qpos.start : env.scene.needle_qpos.start + 3] += (0.012, 0.004, 0.006)
    env.simulation.task_state.grasp_angle += 0.1
    env.set_state(qpos, env.data.qvel)
    moved = env.observe()
    assert np.array_equal(moved["agent_pos"], seen["agent_pos"])
    assert not np.array_equal(moved["back"], seen["back"])


# -- starts ----------------------------------------------------------------------------------------

TOUCHING = {
    "grasp": {("needle", "phantom")},
    "place": {
        ("needle", "psm2"),
        ("needle", "phantom"),
        ("phantom", "psm2"),
    },  # taken from the tissue
    "insert": {("needle", "psm2")},
    "handoff": {("needle", "psm2"), ("needle", "phantom")},
    "pullout": {("needle", "psm1"), ("needle", "phantom")},
    "suture": {("needle", "phantom")},
}
"""Task → what may touch what at the start."""


@pytest.mark.parametrize("task", names.TASKS)
def test_starts_are_physical_and_differ(task):
    env, first = make(task), []
    model, data = env.model, env.data
    dof = model.joint("needle").dofadr[0]
    for seed in range(40):
        seen, info = env.reset(seed=seed)
        first.append(seen)
        parts = [
            [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
            for contact in data.contact
        ]
        touching = {tuple(sorted(name.split("_")[0] for name in pair)) for pair in parts}
        assert touching <= TOUCHING[task]
        assert min(contact.dist for contact in data.contact) > -0.0004  # [m]: the jaws' soft grip
        assert np.linalg.norm(data.qvel[dof : dof + 3]) < 0.010
        assert not info["is_success"] and not info["physics_error"]
        assert info["contact"] == (task in ("place", "insert", "pullout"))
    assert len(np.unique(first, axis=0)) == 40


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_every_subtask_starts_with_a_thread(task):
    env = make(task, scene=SceneConfig(thread=10))
    for seed in range(4):
        seen, info = env.reset(seed=seed)
        assert np.isfinite(seen).all() and not info["is_success"]


def test_the_needle_starts_where_the_released_code_puts_it():
    env, rows = make("grasp"), []
    for seed in range(100):
        env.reset(seed=seed)
        pose = env.needle_pose().astype(np.float64)
        turn = 2 * np.arctan2(pose[6], pose[3])
        rows.append([*(pose[:2] - needle.HOME[:2]) * 1e3, np.degrees(turn)])
    rows = np.array(rows)
    half = np.array([3.0, 20.0, 30.0])  # mm, mm, degrees
    assert (np.abs(rows) < half + 0.2).all()
    assert (np.ptp(rows, axis=0) > 1.8 * half).all()
    assert (np.abs(rows.mean(axis=0)) < 0.25 * half).all()


# -- rewards ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", ["paper", "released"])
@pytest.mark.parametrize("reward", ["sparse", "dense"])
@pytest.mark.parametrize("task", names.SUBTASKS)
def test_compute_reward_is_the_reward(task, reward, tolerance):
    env = make(task, obs_type="goal", reward=reward, tolerance=tolerance)
    plain = make(task, reward=reward, tolerance=tolerance)
    env.reset(seed=0)
    plain.reset(seed=0)
    expert, rows, rewards, infos, exact = Expert(env), [], [], [], []
    for _ in range(150):
        action = expert.action()
        seen, got, ended, _, info = env.step(action)
        rows.append(seen)
        rewards.append(got)
        infos.append(info)
        exact.append(plain.step(action)[1])
        if ended:
            break
    achieved, desired = (
        np.array([row[key] for row in rows]) for key in ("achieved_goal", "desired_goal")
    )
    vectorised = env.compute_reward(achieved, desired, infos)
    assert vectorised.shape == (len(rows),)
    assert vectorised.tolist() == rewards
    assert env.compute_reward(achieved[0], desired[0], infos[0]) == rewards[0]
    ends = env.compute_terminated(achieved, desired, infos)
    assert ends.tolist() == [info["is_success"] for info in infos]
    assert not env.compute_truncated(achieved, desired, infos).any()
    expected = [-(info["d_trans"] + info["d_angle"] / 10) for info in infos]
    if reward == "sparse":
        expected = [0.0 if info["is_success"] else -1.0 for info in infos]
        assert infos[-1]["is_success"]
    assert np.allclose(exact, expected, rtol=0, atol=1e-12)
    assert np.allclose(rewards, exact, rtol=0, atol=1e-6)  # goals are float32


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_the_goals_pose_alone_is_no_reward(task):
    """A needle placed at its goal is rewarded only where nothing else is required.

    Here jaws are closed on nothing and no hole is passed.
    """
    env = make(task, obs_type="goal")
    seen, _ = env.reset(seed=1)
    achieved, desired = seen["desired_goal"].copy(), seen["desired_goal"]
    achieved[7] = seen["achieved_goal"][7]
    asked = task != "place"
    assert achieved[7] == (not asked) and desired[7] == 1.0
    assert env.compute_reward(achieved, desired) == (-1.0 if asked else 0.0)
    batch = env.compute_reward(np.stack([achieved, desired]), np.stack([desired, desired]))
    assert batch.tolist() == [-1.0 if asked else 0.0, 0.0]
    relabelled = seen["achieved_goal"]  # as HER does: the achieved goal is the desired one
    assert env.compute_reward(seen["achieved_goal"], relabelled) == 0.0


@pytest.mark.parametrize("task", names.TASKS)
def test_rewards_can_be_computed_before_the_first_reset(task):
    seen, _ = make(task, obs_type="goal").reset(seed=0)
    env = make(task, obs_type="goal")
    goal = seen["desired_goal"]
    assert env.compute_reward(goal, goal) == 0.0
    assert env.compute_reward(seen["achieved_goal"], goal) == -1.0
    assert env.compute_terminated(goal, goal).tolist() is True
    assert env.compute_truncated(np.stack([goal] * 3), goal).tolist() == [False] * 3


def test_a_physics_error_terminates_whatever_the_goal_is():
    env = make("grasp", obs_type="goal")
    seen, info = env.reset(seed=0)
    achieved, desired = np.stack([seen["achieved_goal"]] * 2), np.stack([seen["desired_goal"]] * 2)
    infos = np.array([info, info | {"physics_error": True}])
    assert env.compute_terminated(achieved, desired, infos).tolist() == [False, True]
    assert env.compute_terminated(achieved[0], desired[0], infos[1]).tolist() is True


@pytest.mark.parametrize("obs_type", [name for name in names.OBS_TYPES if name != "goal"])
def test_only_goal_envs_compute_rewards_of_goals(obs_type):
    assert not hasattr(make("grasp", obs_type=obs_type), "compute_reward")
