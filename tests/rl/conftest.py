"""Demonstrations that the tests of reinforcement learning share."""

import tempfile
from pathlib import Path

import pytest

from surgicai_vision import envs
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.expert import Expert
from surgicai_vision.demos.rollout import Disturbance, rollout
from surgicai_vision.demos.store import write_demo, write_marker


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Task → folder of two noisy demonstrations that go on after their success."""
    folders = {}
    for task in ("grasp", "insert"):
        folder = tmp_path_factory.mktemp("demos") / task
        folder.mkdir()
        env = envs.make(TaskConfig(task))
        noisy = Disturbance(noise=0.2)
        for index in range(2):
            demo = rollout(env, Expert(env), index, disturbance=noisy, post_success_steps=4).demo
            write_demo(folder, index, demo)
        write_marker(folder, task, "expert")
        folders[task] = folder
    return folders


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder that replaces the machine's temporary folder."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder
