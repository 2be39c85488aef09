"""The whole flow, tiny: quickstart and sweep from scratch, then again without work."""

import io
import json
import os
from contextlib import redirect_stdout

import PIL.Image
import pyarrow.parquet as pq
import pytest
import yaml

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.video import read_video
from surgicai_vision.experiments.first_stitch import find_sewer
from surgicai_vision.experiments.quickstart import run_quickstart
from surgicai_vision.experiments.quickstart_config import PolicyChoice, Quickstart

TINY = {
    "task": "grasp",
    "demonstrations": 3,
    "noise": 0.0,
    "episodes": 2,
    "view": ["back"],
    "size": 64,
    "frame_stride": 1,
    "workers": 1,
    "policies": [{"encoder": "imagenet-lite", "view": ["back"]}, {}],
}
GRID = {
    "task": ["grasp"],
    "encoder": ["r3m"],  # its weights are not available; the cells that run need no images
    "view": ["back"],
    "seed": [0, 1],
    "proprioception": True,
    "demonstrations": 3,
    "episodes": 2,
    "size": 64,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the configurations and its own feature cache."""
    path = tmp_path_factory.mktemp("flow")
    (path / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    (path / "grid.yaml").write_text(yaml.safe_dump(GRID))
    return path


QUICKSTART = ("quickstart", "--config", "tiny.yaml", "--out", "out")


@pytest.fixture(scope="module")
def first(folder):
    """What the first quickstart returned; its folder is `out`."""
    code, result = run(folder, *QUICKSTART)
    assert code == 0
    return result


def run(folder, *arguments):
    """Run a command in `folder`; return its exit code and its JSON result."""
    told = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.chdir(folder)
        patch.setenv("SURGICAI_VISION_CACHE", str(folder / "cache"))
        patch.setenv("SURGICAI_VISION_RELEASED", str(folder / "nothing"))
        code = main([*arguments, "--json"])
    return code, json.loads(told.getvalue().splitlines()[-1])


def test_a_quickstart_without_policies_is_refused():
    with pytest.raises(InputError, match="policies is empty; give at least one"):
        Quickstart(policies=())


def test_a_view_that_a_policy_sees_and_nobody_renders_is_refused():
    with pytest.raises(
        InputError, match=r"view is front_psm1,back, and policy .* 'back_psm1'; add"
    ):
        Quickstart(view=("front_psm1", "back"))


def test_only_the_default_procedure_is_replaced_by_the_expert(tmp_path, monkeypatch):
    monkeypatch.setenv("SURGICAI_VISION_RELEASED", str(tmp_path / "nothing"))
    sewer = find_sewer("released:suture")
    assert sewer.name == "expert" and "no policy is released" in sewer.why
    for given in ("released:sutur", "released:grasp"):
        with pytest.raises(InputError):
            find_sewer(given)


def test_policies_of_one_name_are_refused():
    """Each has a folder of its name: the second would be taken for the first."""
    two = (PolicyChoice(recipe="paper"), PolicyChoice(recipe="mine/paper.yaml"))
    with pytest.raises(InputError, match="two are called 'proprioception'"):
        Quickstart(policies=two)


def test_images_that_cannot_be_rendered_are_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="size is 2000; it must be within"):
        run_quickstart(Quickstart(procedure=None, size=2000), tmp_path, RunContext(0), print)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("choice", "told"),
    [
        (PolicyChoice(), "paper uses a frame every 1 steps"),
        (PolicyChoice("random-conv", ("back",), "maps", "best"), "Unknown pool 'maps'"),
    ],
)
def test_a_policy_that_cannot_be_trained_is_refused_before_any_work(choice, told, tmp_path):
    built = Quickstart(procedure=None, policies=(choice,))
    with pytest.raises(InputError, match=told):
        run_quickstart(built, tmp_path, RunContext(0), print)
    assert not list(tmp_path.iterdir())


def times(folder):
    """Modification times of every file below `folder`, except the page and the run's record."""
    paths = [os.path.join(root, name) for root, _, found in os.walk(folder) for name in found]
    return {
        path: os.stat(path).st_mtime_ns
        for path in paths
        if not path.endswith(("report.html", "run.json"))
    }


def test_quickstart_runs_and_runs_again_without_work(folder, first):
    assert [result["policy"] for result in first["results"]] == [
        "imagenet-lite-back",
        "proprioception",
        "expert",
    ]
    assert all(result["episodes"] == 2 and result["errors"] == 0 for result in first["results"])
    page = (folder / first["report"]).read_text()
    assert page.count("<img") >= 3, "at least the views"
    assert page.index("<video") < page.index("<img"), "the video is what the page opens with"
    assert 'src="data:video/mp4;base64,' in page and 'poster="data:image/jpeg;base64,' in page
    assert page.split('<h1 id="headline">')[1].startswith("Grasp, by the paper&#39;s recipe: ")
    before = times(folder / "out")
    code, second = run(folder, *QUICKSTART)
    assert code == 0
    assert second["results"] == first["results"]
    assert times(folder / "out") == before


def test_the_first_act_is_a_whole_procedure_by_whom_the_page_names(folder, first):
    sewn = json.loads((folder / "out/procedure/procedure.json").read_text())
    assert sewn["success"] and [row["subtask"] for row in sewn["subtasks"]] == list(names.SUBTASKS)
    assert sewn["policy"] == "expert" and "no policy is released" in sewn["why"]
    frames = read_video(folder / "out/procedure/procedure.mp4")
    assert len(frames) > 25 * sewn["subtasks"][-1]["end_s"] and frames[0].any()
    with PIL.Image.open(folder / "out/procedure/procedure.webp") as moving:
        # Half of the video's 25 images per second; identical ones at the end become one.
        assert moving.n_frames > 12 * sewn["subtasks"][-1]["end_s"] and moving.info["loop"] == 0
    assert (folder / "out/procedure/procedure.webp").stat().st_size < 3e6
    page = (folder / "out/report.html").read_text()
    assert "One whole procedure by the scripted expert, which reads the simulator" in page


def test_a_first_act_by_what_cannot_sew_is_refused_before_any_work(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["quickstart", "--procedure", "exprt", "--out", "never"]) == 2
    assert "Did you mean 'expert'" in capsys.readouterr().err
    assert not (folder / "never").exists()


def test_a_checkpoint_of_it_is_evaluated_to_the_same_result(folder, first):
    stored = json.loads(
        (folder / "out/evaluations/imagenet-lite-back/evaluation.json").read_text()
    )["summary"]
    policy = "out/policies/imagenet-lite-back"
    _, again = run(folder, "evaluate", policy, "--episodes", "2", "--workers", "2")
    assert {key: again[key] for key in stored} == stored


def test_a_checkpoint_is_not_evaluated_on_another_task(folder, first, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["evaluate", "out/policies/proprioception", "--task", "place"]) == 2
    assert "trained for 'grasp'" in capsys.readouterr().err


def test_quickstart_refuses_the_folder_of_another_plan(folder, first, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["quickstart", "--config", "tiny.yaml", "--out", "out", "--episodes", "3"]) == 2
    assert "other options" in capsys.readouterr().err


def test_sweep_runs_reports_and_resumes(folder):
    code, made = run(folder, "sweep", "grid.yaml", "--out", "sweep")
    assert code == 0
    counts = {name: made[name] for name in ("runs", "done", "cached", "failed", "not_run")}
    assert counts == {"runs": 4, "done": 2, "cached": 0, "failed": 0, "not_run": 2}
    assert pq.read_table(folder / "sweep/episodes.parquet").num_rows == 4
    before = times(folder / "sweep")
    code, second = run(folder, "sweep", "grid.yaml", "--out", "sweep")
    assert (second["done"], second["cached"], second["digest"]) == (0, 2, made["digest"])
    after = times(folder / "sweep")
    assert {path for path in after if after[path] != before.get(path)} == {
        str(folder / "sweep/episodes.parquet")
    }
    code, _ = run(folder, "report", "sweep")
    assert code == 0
    page = (folder / "sweep/report.html").read_text()
    assert page.split('id="missing"')[1].split('id="origin"')[0].count("r3m on back") == 1
    states = pq.read_table(folder / "sweep/tables/cells.parquet")["state"].to_pylist()
    assert sorted(states) == ["done", "done", "done", "not run", "not run"]  # including the expert
