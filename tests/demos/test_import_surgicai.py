"""Import of SurgicAI's recordings: input is checked, and the arm is posed as recorded."""

import dataclasses
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from surgicai_vision.core import names
from surgicai_vision.core.config import STEPS
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, UnknownName
from surgicai_vision.core.processes import ONE_THREAD
from surgicai_vision.demos.imports import replay, sandbox, surgicai_pickle
from surgicai_vision.demos.imports.sandbox import read_sandboxed
from surgicai_vision.demos.imports.surgicai import (
    check_task,
    import_demos,
    infer_step,
    is_yaw_wrapped,
    split,
    unwrap_yaw,
)
from surgicai_vision.demos.store import read_demo, read_marker
from surgicai_vision.scene import kinematics, needle

GOAL = np.array([5.549, 1.060, -12.890, -3.215, -0.919, 1.614, 0.0])
"""A handoff goal of PSM1 like SurgicAI's [cm, rad]."""
START = np.array([*np.multiply(kinematics.STARTS["psm1"][:3], 100), *kinematics.STARTS["psm1"][3:]])


def transitions(episodes=2, step="shipped", start=START, goal=GOAL, close=True):
    """Return a recording in SurgicAI's layout: straight to the goal, then the jaw closes."""
    metres, degrees, jaw = STEPS[step]
    sizes = np.array([metres * 100] * 3 + [np.radians(degrees)] * 3 + [jaw])
    rows = []
    for episode in range(episodes):
        now, target = start.copy(), goal + 0.02 * episode * np.array([1, 1, 1, 0, 0, 0, 0])
        while True:
            error = target - now
            error[6] = -1.0 if close and np.abs(error[:6] / sizes[:6]).max() < 0.5 else 0.0
            action = np.clip(0.5 * error / sizes, -0.5, 0.5)
            action[6] *= 2.0
            action[:6] *= 0.0 if error[6] else 1.0
            after = now + action * sizes
            done = after[6] < 0.1 if close else np.abs(error[:6]).max() < 0.05
            row = {}
            for key, pose in (("obs", now), ("next_obs", after)):
                row[key] = {
                    "observation": np.concatenate([pose, target, target - pose]).astype(np.float32),
                    "achieved_goal": pose.astype(np.float32),
                    "desired_goal": target.astype(np.float32),
                }
            row |= {
                "action": action,
                "reward": np.array([-0.1], np.float32),
                "done": np.array([float(done)]),
            }
            rows.append({**row, "info": {"is_success": bool(done)}})
            now = after
            if done:
                break
    return rows


def saved(path, content, protocol=4):
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.fixture
def recording(tmp_path):
    return saved(tmp_path / "recording.pkl", transitions())


def test_imported_states_stand_at_the_recorded_poses(tmp_path, recording):
    import surgicai_vision.envs as envs

    seen = []
    summary = import_demos(
        recording, task="handoff", out=tmp_path / "demos", progress=lambda *row: seen.append(row)
    )
    assert (len(summary.paths), summary.step, summary.disagreeing, summary.skipped) == (
        2,
        "shipped",
        0,
        (),
    )
    assert seen == [(1, 2, "episodes"), (2, 2, "episodes")]
    episodes = split(surgicai_pickle.read(recording))
    env = envs.make(read_demo(summary.paths[0]).config)
    for path, episode in zip(summary.paths, episodes, strict=True):
        demo = read_demo(path)
        assert demo.scene_hash == env.scene.hash
        assert demo.success.tolist() == episode.success.tolist()
        point = kinematics.base_in_world(names.PSM1) @ replay.pose_matrix(episode.goal)
        for state, pose in zip(demo.state, episode.pose, strict=True):
            env.set_state_vector(state)
            measured = env.agent_pos()
            np.testing.assert_allclose(measured[:3], pose[:3], atol=2e-6)
            wanted = replay.pose_matrix(pose)[:3, :3]
            np.testing.assert_allclose(replay.pose_matrix(measured)[:3, :3], wanted, atol=2e-5)
            np.testing.assert_allclose(measured[6], pose[6], atol=1e-3)
            # The goal grasps the needle's 105° point from 5 mm above its plane.
            transform = replay.needle_path(episode, "handoff")[0]
            np.testing.assert_allclose(env.needle_pose()[:3], transform[:3, 3], atol=1e-6)
        above = np.linalg.inv(transform) @ point[:, 3]
        np.testing.assert_allclose(
            above[:3] - needle.point(np.radians(105.0)), [0, 0, 0.005], atol=1e-6
        )


def test_actions_move_our_arm_along_the_recorded_path(tmp_path, recording):
    """Our control turns the converted actions back into the recorded poses."""
    from surgicai_vision.envs.control import StepSize, moved
    from surgicai_vision.envs.poses import flat, square

    episode = split(surgicai_pickle.read(recording))[0]
    action, clipped = replay.motion_actions(episode.motion, "shipped")
    pose = flat(replay.pose_matrix(episode.pose[0]))
    for row, wanted in zip(action, episode.pose[1:], strict=True):
        pose = moved(pose, row.astype(float).tolist(), StepSize.of("shipped"))
        np.testing.assert_allclose(square(pose), replay.pose_matrix(wanted), atol=1e-4)
    assert clipped == 0


def test_importing_again_does_nothing_and_another_file_is_refused(tmp_path, recording):
    first = import_demos(recording, task="handoff", out=tmp_path / "demos")
    before = first.paths[0].stat().st_mtime_ns
    assert import_demos(recording, task="handoff", out=tmp_path / "demos") == first
    assert first.paths[0].stat().st_mtime_ns == before
    other = saved(tmp_path / "other.pkl", transitions(1))
    with pytest.raises(OutputExists, match="another command"):
        import_demos(other, task="handoff", out=tmp_path / "demos")


@pytest.mark.parametrize("task", ["grasp", "place", "insert", "pullout"])
def test_a_task_the_motion_contradicts_is_refused(tmp_path, recording, task):
    with pytest.raises(
        InputError, match=f"not of {task}: it moves psm1 .* 0.80 rad; that fits handoff"
    ):
        import_demos(recording, task=task, out=tmp_path / "demos")
    assert not (tmp_path / "demos").exists()


def test_unknown_task_and_missing_file(tmp_path, recording):
    with pytest.raises(UnknownName, match="Did you mean 'handoff'"):
        import_demos(recording, task="handof", out=tmp_path / "demos")
    with pytest.raises(BadFile, match="no such file"):
        import_demos(tmp_path / "nothing.pkl", task="handoff", out=tmp_path / "demos")
    with pytest.raises(BadFile, match="it is a folder"):
        import_demos(tmp_path, task="handoff", out=tmp_path / "demos")


@pytest.mark.parametrize("step", STEPS)
def test_the_step_preset_is_inferred_and_deviations_counted(step):
    arrays = as_arrays(transitions(1, step))
    episodes = split(arrays)
    assert infer_step(episodes) == (step, 0)
    episodes[0].action[3] += 0.05
    assert infer_step(episodes) == (step, 1)
    episodes[0].action[:] = 0.0
    with pytest.raises(InputError, match="No step size explains the motion"):
        infer_step(episodes)


def test_a_step_that_is_no_preset_gets_the_smallest_larger_one():
    """As in the first release's insertions: 0.25 mm, 2°."""
    episodes = split(as_arrays(transitions(1, "paper")))
    finer = dataclasses.replace(
        episodes[0], pose=episodes[0].pose * np.array([0.5, 0.5, 0.5, 1, 1, 1, 1])
    )
    assert infer_step([finer]) == ("paper", 0)
    coarser = dataclasses.replace(
        episodes[0], pose=episodes[0].pose * np.array([8, 8, 8, 1, 1, 1, 1])
    )
    with pytest.raises(InputError, match="No step size explains the motion"):
        infer_step([coarser])


def test_the_yaw_goes_the_short_way():
    episode = split(as_arrays(transitions(1)))[0]
    yaw = np.linspace(3.0, 3.0 - 4.2, len(episode.pose))
    wrapped = dataclasses.replace(
        episode, pose=np.column_stack([episode.pose[:, :5], yaw, episode.pose[:, 6]])
    )
    short = unwrap_yaw(wrapped)
    assert (is_yaw_wrapped(wrapped), is_yaw_wrapped(short)) == (True, False)
    assert is_yaw_wrapped(episode) is False
    for row in (0, -1):
        same, wanted = (replay.pose_matrix(some.pose[row]) for some in (short, wrapped))
        np.testing.assert_allclose(same, wanted, atol=1e-12)
    np.testing.assert_array_equal(short.pose[:, :5], wrapped.pose[:, :5])
    assert np.abs(np.diff(short.pose[:, 5])).sum() == pytest.approx(2 * np.pi - 4.2)


def test_actions_that_do_not_fit_the_inferred_step_get_a_larger_one():
    """Roll, pitch and yaw together make a rotation vector longer than each."""
    episode = split(as_arrays(transitions(1, "paper")))[0]
    assert replay.fitting_step([episode.motion], "paper") == "paper"
    count = len(episode.pose)
    turning = episode.pose.copy()
    turning[:, 4] = 0.9
    turning[:, 3], turning[:, 5] = (
        np.radians(1.5) * np.arange(count),
        -np.radians(1.5) * np.arange(count),
    )
    assert (
        replay.fitting_step([dataclasses.replace(episode, pose=turning).motion], "paper")
        == "released"
    )


def as_arrays(rows):
    return {
        "observation": np.stack([row["obs"]["observation"] for row in rows]).astype(float),
        "next_observation": np.stack([row["next_obs"]["observation"] for row in rows]).astype(
            float
        ),
        "action": np.stack([row["action"] for row in rows]),
        "reward": np.array([row["reward"][0] for row in rows]),
        "done": np.array([row["done"][0] for row in rows]),
        "success": np.array([float(row["info"]["is_success"]) for row in rows]),
    }


def altered(**changes):
    rows = transitions(1)
    for key, value in changes.items():
        rows[2][key] = value
    return rows


BAD = {
    "empty list": list,
    "a dictionary": lambda: {"obs": 1},
    "an array": lambda: np.zeros((5, 21)),
    "numbers": lambda: [1, 2, 3],
    "no action": lambda: [
        {key: value for key, value in transitions(1)[0].items() if key != "action"}
    ],
    "short action": lambda: altered(action=np.zeros(6)),
    "text action": lambda: altered(action="abc"),
    "nan": lambda: altered(action=np.full(7, np.nan)),
    "infinite": lambda: altered(reward=np.array([np.inf])),
    "info is none": lambda: altered(info=None),
    "obs of 20": lambda: altered(obs=np.zeros(20)),
    "jump": lambda: altered(obs=np.zeros(21)),
    "cut off": lambda: transitions(1)[:-3],
}


@pytest.mark.parametrize("name", BAD)
def test_wrong_structure_is_one_line(tmp_path, name):
    path = saved(tmp_path / "bad.pkl", BAD[name]())
    with pytest.raises(BadFile) as caught:
        import_demos(path, task="handoff", out=tmp_path / "demos")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "demos").exists()


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 no archive", b"\x80\x04N."])
def test_what_is_no_recording_is_one_line(tmp_path, content):
    path = tmp_path / "bad.pkl"
    path.write_bytes(content)
    with pytest.raises(BadFile) as caught:
        read_sandboxed(path)
    assert "\n" not in str(caught.value)


def test_npz_with_objects_or_bombs_is_refused(tmp_path):
    arrays = as_arrays(transitions(1))
    arrays["is_success"] = arrays.pop("success")
    good, objects, bomb, short = (
        tmp_path / f"{name}.npz" for name in ("good", "objects", "bomb", "short")
    )
    np.savez(good, **arrays)
    assert read_sandboxed(good)["action"].shape == arrays["action"].shape
    np.savez(objects, **{**arrays, "action": np.array([os.system, None], dtype=object)})
    np.savez_compressed(bomb, **{**arrays, "action": np.zeros((2_000_000, 7))})
    np.savez(short, action=arrays["action"])
    for path, message in (
        (objects, "not a readable npz"),
        (bomb, "unpacks to more"),
        (short, "has no array done"),
    ):
        with pytest.raises(BadFile, match=message):
            read_sandboxed(path)


class Call:
    def __reduce__(self):
        return os.system, (f"touch {self.trace}",)


def test_a_pickle_that_names_os_system_is_refused_and_not_run(tmp_path):
    attack = Call()
    attack.trace = tmp_path / "trace"
    path = saved(tmp_path / "attack.pkl", [*transitions(1), attack])
    with pytest.raises(BadFile, match=r"it names '(posix|os|nt)\.system'"):
        import_demos(path, task="handoff", out=tmp_path / "demos")
    assert not (tmp_path / "trace").exists()


LIMITED = """
from surgicai_vision.demos.imports import sandbox
sandbox._limit()
print("limited", flush=True)
{code}
print("survived")
"""
FORBIDDEN = {
    "socket": "import socket; socket.socket()",
    "process": "import subprocess; subprocess.run(['true'])",
    "shell": "import os; os.system('true')",
    "fork": "import os; os.fork()",
    "another file": "open({other!r}, 'w')",
    "folder": "import os; os.mkdir({other!r})",
    "removal": "import os; os.remove(os.__file__ + 'x')",
    "signal": "import os; os.kill(os.getppid(), 0)",
    "packed folder": "import shutil; shutil.copytree('/etc', {other!r})",
    "memory": "x = bytearray(3 * 2**30)",
}


@pytest.mark.parametrize("name", FORBIDDEN)
def test_the_reading_process_cannot_leave_its_limits(tmp_path, name):
    code = FORBIDDEN[name].format(other=str(tmp_path / "other"))
    script = LIMITED.format(code=code)
    child = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert child.returncode != 0
    assert child.stdout.split() == ["limited"], child.stderr
    assert not (tmp_path / "other").exists()


ALONE = """
import os, runpy, sys
sys.argv = ["sandbox", str(os.getppid()), "missing.pkl", os.devnull, "surgicai", "{}"]
os.unshare = lambda namespaces: print(len(os.listdir("/proc/self/task")), flush=True)
runpy.run_module("surgicai_vision.demos.imports.sandbox", run_name="__main__")
"""


def test_the_reading_process_has_one_thread_when_it_leaves_the_network():
    """Without root this needs a user namespace, which only one-thread processes get."""
    child = subprocess.run(
        [sys.executable, "-c", ALONE],
        capture_output=True,
        text=True,
        env={**os.environ, **ONE_THREAD},
    )
    assert child.stdout.split() == ["1"], child.stderr


def test_the_reading_process_imports_nothing_from_the_current_folder(
    tmp_path, recording, monkeypatch
):
    for name in ("argparse", "resource", "tempfile"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'trace')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    assert len(read_sandboxed(recording.resolve())["action"])
    assert not (tmp_path / "trace").exists()


def test_what_the_child_cannot_finish_is_a_bad_file(tmp_path, recording, monkeypatch):
    monkeypatch.setattr(sandbox, "WALL_SECONDS", 0.01)
    with pytest.raises(BadFile, match="was not read within"):
        read_sandboxed(recording)


# -- SurgicAI's own recordings ---------------------------------------------------------------------

SETS = {
    "grasp": "approach_v2",
    "place": "place_v1",
    "insert": "insert_v2",
    "handoff": "regrasp_v2",
    "pullout": "pullout_v2",
}


@pytest.mark.parametrize("task", SETS)
def test_every_recorded_set_fits_its_task_and_few_others(shared, task):
    arrays = surgicai_pickle.read(shared / f"surgicai/surgicai_{SETS[task]}.npz")
    episodes = split(arrays)
    check_task(episodes, task)
    refused = 0
    for other in set(names.SUBTASKS) - {task}:
        try:
            check_task(episodes, other)
        except InputError:
            refused += 1
    # A place recording cannot be distinguished from an insertion: the same arm, the same grasp.
    assert refused == (3 if task == "place" else 4)
    episodes = [replay.trimmed(episode, task) for episode in episodes]
    assert infer_step(episodes) == ("paper" if task == "place" else "shipped", 0)


@pytest.mark.parametrize("task", ["place", "insert", "handoff"])
def test_needle_poses_agree_with_those_derived_independently(shared, task):
    path = shared / f"surgicai/surgicai_{SETS[task]}.npz"
    derived = np.load(path)["needle_pose_world_derived_m"]
    start = 0
    for episode in split(surgicai_pickle.read(path)):
        poses = replay.needle_path(episode, task)[:-1]
        # 0.1 mm, and 1e-4 in rotation elements: the derivation used float32 and rounded hole
        # poses.
        np.testing.assert_allclose(poses, derived[start : start + len(poses)], atol=1e-4)
        start += len(poses)
    assert start == len(derived)


def test_the_original_pickle_is_imported_whole(tmp_path, shared):
    summary = import_demos(
        shared / "surgicai/regrasp_all_episodes_merged.pkl", task="handoff", out=tmp_path / "demos"
    )
    assert (len(summary.paths), summary.steps, summary.step) == (50, 3300, "shipped")
    assert (summary.disagreeing, summary.clipped, summary.skipped) == (0, 0, ())
    assert read_marker(tmp_path / "demos")["task"] == "handoff"
    assert all(read_demo(path).success[-1] for path in summary.paths)


def test_insertions_that_turn_the_long_way_are_imported_too(tmp_path, shared):
    summary = import_demos(
        shared / "surgicai/surgicai_insert_v2.npz", task="insert", out=tmp_path / "demos"
    )
    assert (len(summary.paths), summary.skipped, summary.clipped) == (50, (), 0)
    assert summary.unwrapped == 25
