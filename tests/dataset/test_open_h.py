"""Layout "open-h": the columns of Open-H-Embodiment, read by LeRobot and true to the demos."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, from_mapping
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import open_dataset, open_h, render_demos
from surgicai_vision.demos.disturbance import Disturbance
from surgicai_vision.demos.record import record
from surgicai_vision.demos.store import Demo, list_demos, read_demo
from surgicai_vision.envs.absolute import setpoints

SIZE, STRIDE = 16, 5
IMAGES = ("endoscope.left", "endoscope.right", "wrist.left", "wrist.right")


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("open-h") / "demos"
    record(TaskConfig("place"), episodes=2, out=folder, context=RunContext(0))
    return folder


@pytest.fixture(scope="module")
def dataset(demos: Path) -> Path:
    out = demos.parent / "dataset"
    render_demos(demos, out, size=SIZE, frame_stride=STRIDE, layout="open-h", context=RunContext(0))
    return out


@pytest.fixture(scope="module")
def demo(demos: Path) -> Demo:
    return read_demo(list_demos(demos)[0])


def test_features_are_those_of_the_published_sets(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    features = info["features"]
    assert info["robot_type"] == "dvrk"
    assert info["fps"] == names.FPS // STRIDE
    images = [key for key, row in features.items() if row["dtype"] == "image"]
    assert images == [f"observation.images.{name}" for name in IMAGES]
    state, action = features["observation.state"], features["action"]
    assert state["shape"] == action["shape"] == [16]
    assert state["names"][0][:8] == [
        *(f"psm1_pose.position.{axis}" for axis in "xyz"),
        *(f"psm1_pose.orientation.{axis}" for axis in "xyzw"),
        "psm1_jaw",
    ]
    assert action["names"][0][8:] == [
        *(f"psm2_sp.position.{axis}" for axis in "xyz"),
        *(f"psm2_sp.orientation.{axis}" for axis in "xyzw"),
        "psm2_jaw_sp",
    ]
    assert features["instruction.text"]["dtype"] == "string"
    seen = {key for key in features if key.startswith(("observation", "action"))}
    assert seen == {*images, "observation.state", "action"}, "a policy would be fed the others"


def test_columns_are_the_demonstration_s(dataset: Path, demo: Demo) -> None:
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    count = len(range(0, len(demo), STRIDE))
    env = envs.make(demo.config)
    for frame in range(count):
        env.set_state_vector(demo.state[frame * STRIDE])
        np.testing.assert_array_equal(rows["observation.state"][frame], env.absolute_pos())
        np.testing.assert_array_equal(rows["needle_pose"][frame], env.needle_pose())
        env.set_state_vector(demo.state[min((frame + 1) * STRIDE, len(demo))])
        np.testing.assert_array_equal(rows["action"][frame], setpoints(env.simulation))
    assert rows["next.success"][count - 1]
    assert not any(rows["next.success"][: count - 1])
    assert set(rows["instruction.text"]) == {names.TASK_TEXTS["place"]}
    assert rows["phase"][0] == names.SUBTASKS.index("place")


def test_its_actions_held_between_frames_solve_the_task(dataset: Path, demo: Demo) -> None:
    meta = json.loads((dataset / names.META_FILE).read_text())
    config = from_mapping(TaskConfig, meta["task_config"])
    assert config.action_repeat == STRIDE
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    env = envs.make(config, action_mode=names.ABSOLUTE)
    env.set_state_vector(demo.state[0])
    ended = False
    for action, episode in zip(rows["action"], rows["episode_index"], strict=True):
        if episode == 0 and not ended:
            _, _, ended, _, info = env.step(np.array(action, np.float32))
    for _ in range(3):  # the arm lags behind a set-point that moves in jumps
        if not ended:
            _, _, ended, _, info = env.step(np.array(rows["action"][-1], np.float32))
    assert info["is_success"]


def test_lerobot_reads_it(dataset: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    read = LeRobotDataset("local/open-h", root=dataset)
    item = read[3]
    assert item["observation.images.wrist.left"].shape == (3, SIZE, SIZE)
    assert item["instruction.text"] == item["task"] == names.TASK_TEXTS["place"]
    assert item["action"].shape == (16,)


def test_views_go_by_the_arm(dataset: Path) -> None:
    meta = json.loads((dataset / names.META_FILE).read_text())
    assert meta["views"] == ["endo_left", "endo_right", "wrist_psm2", "wrist_psm1"]
    assert open_h.image_key("wrist_psm1") == "observation.images.wrist.right"
    assert open_h.image_key("back") == "observation.images.back"


def test_what_it_is_not_for_is_refused(demos: Path, dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="layout 'open-h'"):
        open_dataset(dataset)
    with pytest.raises(InputError, match="convert_image_to_video"):
        render_demos(demos, tmp_path / "video", layout="open-h", video="h264")
    with pytest.raises(InputError, match="frame_stride is 25"):
        render_demos(demos, tmp_path / "stride", layout="open-h", frame_stride=25)
    slow = TaskConfig("grasp", action_repeat=2)
    held = record(slow, episodes=1, out=tmp_path / "held", context=RunContext(0))
    with pytest.raises(InputError, match="frame_stride is 10 and action_repeat 2"):
        render_demos(held[0].parent, tmp_path / "rendered", layout="open-h", frame_stride=10)
    assert not (tmp_path / "rendered.work").exists()
    shaken = {"out": tmp_path / "shaken", "disturbance": Disturbance(noise=0.3)}
    noisy = record(TaskConfig("place"), episodes=1, context=RunContext(0), **shaken)
    with pytest.raises(InputError, match="not the demonstrator's labels"):
        render_demos(noisy[0].parent, tmp_path / "rendered", layout="open-h")
    assert not (tmp_path / "rendered.work").exists()
    with pytest.raises(UnknownName, match="layout"):
        render_demos(demos, tmp_path / "layout", layout="suturebot")
