"""The distribution in examples/third_party: built, installed next to ours, used by its names."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

Run = Callable[..., subprocess.CompletedProcess[str]]

GRID = """
task: [touch_point]
encoder: [colour-grid]
view: [[side]]
policy: [linear]
demonstrations: 2
epochs: 1
episodes: 1
size: 32
expert: false
"""
IDS = """
import surgicai_vision, gymnasium
env = gymnasium.make("surgicai_vision/TouchPoint-v0", obs_type="pixels", cameras=("side",))
seen, info = env.reset(seed=0)
print(seen["side"].shape, info["phase"], env.unwrapped.task_description)
"""


@pytest.fixture(scope="module")
def site(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed example, for the search path."""
    source = tmp_path_factory.mktemp("source") / "third_party"
    shutil.copytree(root / "examples" / "third_party", source)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel"]
    subprocess.run(build, cwd=source, check=True, capture_output=True)
    folder = tmp_path_factory.mktemp("site")
    (wheel,) = (source / "dist").glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


@pytest.fixture
def run(site: Path, tmp_path: Path) -> Run:
    """A function that runs Python with the example installed."""

    def run(*arguments: str, more: Path | None = None) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join(str(folder) for folder in (site, more) if folder)
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )

    return run


def test_its_task_has_a_gymnasium_id_and_its_camera_an_image(run: Run) -> None:
    done = run("-c", IDS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(224, 224, 3) -1 Touch the next entry hole")


def test_it_is_recorded_rendered_trained_evaluated_and_swept(run: Run, tmp_path: Path) -> None:
    def verb(*arguments: str) -> dict[str, object]:
        done = run("-m", "surgicai_vision", *arguments, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    one = ("--workers", "1", "--out")
    both = ("--view", "side,side_psm2")
    task = ("--task", "touch_point")
    assert verb("record-demos", *task, "--episodes", "2", *one, "demos")["share"] == 1.0
    data = verb("render-demos", "--demos", "demos", *both, "--size", "32", *one, "data")
    assert data["views"] == ["side", "side_psm2"]
    learner = ("--encoder", "colour-grid", "--policy", "linear", "--epochs", "1")
    verb("train", *task, "--dataset", "data", "--view", "side", *learner, "--out", "policy")
    row = verb("evaluate", "--policy", "policy", "--episodes", "1", *one, "eval")
    assert row["episodes"] == 1
    assert row["task"] == "touch_point"
    (tmp_path / "grid.yaml").write_text(GRID)
    swept = verb("sweep", "grid.yaml", *one, "sweep")
    assert swept["done"] == swept["runs"] == 1


@pytest.mark.parametrize(
    ("kind", "name", "arguments"),
    [
        ("encoder", "random", ("encode", "--encoder", "random")),
        ("policy", "linear", ("train", "--policy", "linear", "--encoder", "random")),
        ("task", "grasp", ("record-demos", "--task", "grasp")),
        ("camera", "front", ("scene", "--view", "front")),
        ("engine", "local", ("record-demos", "--executor", "local")),
    ],
)
def test_a_name_that_is_taken_is_refused_with_both_distributions(
    run: Run, tmp_path: Path, kind: str, name: str, arguments: tuple[str, ...]
) -> None:
    info = tmp_path / "more" / "other_package-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-package\nVersion: 1.0\n")
    group = "policies" if kind == "policy" else f"{kind}s"
    point = f"[surgicai_vision.{group}]\n{name} = other_package:PART\n"
    (info / "entry_points.txt").write_text(point)
    done = run("-m", "surgicai_vision", *arguments, more=info.parent)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.strip().splitlines()
    first = "surgicai-vision-example" if name == "linear" else "surgicai-vision"
    assert re.search(f"'{name}' is offered by '{first}' and by 'other-package'", line), line
