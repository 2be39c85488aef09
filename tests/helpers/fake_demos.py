"""Demonstrations of the stand-in environment on disk, and rendering with it in this process."""

from fake_env import FakeEnv, FakeExpert

from surgicai_vision.dataset import render_jobs
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.demos.store import write_demo, write_marker


def render_with_fake_env(monkeypatch, config):
    """Let `render_demos` see the stand-in environment, without GL."""
    monkeypatch.setattr(render_jobs, "_env", lambda _, *rest: FakeEnv(config, *rest))
    monkeypatch.setattr(render_jobs, "_renderer", lambda: "none")


def write_demos(folder, config, seeds):
    """Write one demonstration per seed into `folder` and return the folder."""
    env = FakeEnv(config)
    folder.mkdir()
    for index, seed in enumerate(seeds):
        write_demo(folder, index, rollout(env, FakeExpert(env), seed).demo)
    write_marker(folder, "grasp", "expert")
    return folder
