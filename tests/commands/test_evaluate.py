"""`evaluate` and its figures: default folders are distinct, and a killed command loses nothing."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from checkpoints import checkpoint
from matplotlib.figure import Figure

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.evaluate import open_given
from surgicai_vision.commands.main import main
from surgicai_vision.core import files
from surgicai_vision.core.variants import Variants
from surgicai_vision.evaluation import occlusion, policy_spec, run, storage
from surgicai_vision.evaluation.agents import ZeroAgent
from surgicai_vision.evaluation.policy_spec import PolicySpec, open_policy
from surgicai_vision.features.encoders import WeightsSource
from surgicai_vision.training.run_config import RunConfig

SHORT = "env: {max_steps: 2}\n"


def folder_of(spec):
    return folders.evaluation_folder(spec, 900_000, 20).name


def test_default_folders_tell_trainings_and_envs_apart(tmp_path: Path) -> None:
    trained = open_policy(checkpoint(tmp_path / "grasp", "grasp"))
    assert folder_of(trained) == "grasp-proprioception-seed0-starts900000+20"
    other = replace(trained, run=replace(trained.run, seed=1), training="seed1")
    assert folder_of(other) == "grasp-proprioception-seed1-starts900000+20"
    assert folder_of(open_policy("zero")) == "grasp-zero-starts900000+20"
    envs = {folder_of(open_policy("zero", env={"max_steps": steps})) for steps in (2, 3)}
    assert len(envs) == 2 and all(name.startswith("grasp-zero-env-") for name in envs)
    named = RunConfig(recipe="mine-seed3.yaml", seed=3)
    assert PolicySpec(named, ZeroAgent, training="seed3").folder_name == f"grasp-{named.name}"
    assert folders.robustness_folder(other, 1, 2).name == "grasp-proprioception-seed1-starts1+2"


def test_evaluations_of_two_envs_are_kept_side_by_side(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = set()
    for steps in (2, 3):
        Path("env.yaml").write_text(f"env: {{max_steps: {steps}}}\n")
        arguments = ["--config", "env.yaml", "--episodes", "1", "--workers", "1", "--json"]
        assert main(["evaluate", "zero", *arguments]) == 0
        made.add(json.loads(capsys.readouterr().out.splitlines()[-1])["out"])
    assert len(made) == 2 and len(storage.find_evaluations(tmp_path)) == 2


@pytest.mark.parametrize("aimed", [True, False])
def test_a_policy_of_aimed_crops_is_told_that_it_has_no_detector(aimed, monkeypatch, capsys):
    plain = open_policy("zero", env={"max_steps": 2})
    looks = Variants(corruption=0.5, aimed=aimed)
    spec = replace(plain, run=replace(plain.run, variants=looks))
    monkeypatch.setattr(policy_spec, "open_policy", lambda *_, **__: spec)
    assert open_given(Console(), "zero", None, None, None, WeightsSource()) is spec
    assert ("without a detector" in capsys.readouterr().err) == aimed


def test_a_second_evaluation_into_a_folder_is_refused_before_its_rollouts(
    tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    command = ["evaluate", "zero", "--episodes", "1", "--workers", "1", "--out", str(out)]
    monkeypatch.setattr(run, "evaluate", lambda *_, **__: pytest.fail("it was rolled out"))
    with storage.alone_in(out):
        assert main(command) == 2
        assert "Another run is evaluating into" in capsys.readouterr().err
    assert not out.exists(), "nothing came into it"


@pytest.mark.parametrize("killed_at", [storage.EPISODES, storage.FILMS, storage.MARKER])
def test_a_killed_evaluation_is_made_again_by_the_same_command(tmp_path, monkeypatch, killed_at):
    out = tmp_path / "out"
    (tmp_path / "env.yaml").write_text(SHORT)
    command = ["evaluate", "zero", "--episodes", "1", "--workers", "1", "--out", str(out)]
    command += ["--config", str(tmp_path / "env.yaml")]
    write = files.write_bytes

    def killed(path, content):
        if path.name == killed_at:
            (path.parent / f"{files.TEMPORARY}0-{path.name}").write_bytes(content[:9])
            raise KeyboardInterrupt
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(files, "write_bytes", killed)
        main(command)
    assert not (out / storage.MARKER).exists()
    assert main(command) == 0
    wanted = {storage.EPISODES, storage.FILMS, storage.MARKER}
    assert {path.name for path in out.iterdir()} == wanted
    (out / storage.MARKER).unlink()
    (out / "notes.txt").write_text("mine")
    assert main(command) == 2
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--task", "grasp"], "does the whole procedure"),
        (["--dataset", "set"], "only for replay"),
        (["--video-of", "failures"], "goes with --video"),
    ],
)
def test_swapping_every_subtask_refuses_what_it_would_ignore(tmp_path, capsys, options, told):
    out = tmp_path / "out"
    command = ["evaluate", "hierarchical.yaml", "--expert-swap", "all", "--out", str(out)]
    assert main([*command, *options]) == 2
    assert told in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    "command",
    [
        ["scene", "--looks", "figure.png", "--appearance", "plain"],
        ["scene", "--needles", "figure.png"],
        ["saliency", "zero", "--out", "figure.png"],
    ],
)
def test_a_killed_drawing_leaves_the_earlier_one(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    Path("figure.png").write_bytes(b"earlier")

    def killed(self, path, **_):
        assert Path(path).suffix == ".png"
        Path(path).write_bytes(b"half")
        raise KeyboardInterrupt

    found = SimpleNamespace(success=True, steps=1, largest=0.0, sheet=lambda title: Figure())
    monkeypatch.setattr(occlusion, "occlusion", lambda *_: found)
    monkeypatch.setattr(Figure, "savefig", killed)
    small = ["--view", "front", "--size", "32", "--draws", "1"] if command[0] == "scene" else []
    assert main([*command, *small]) != 0
    assert Path("figure.png").read_bytes() == b"earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]
