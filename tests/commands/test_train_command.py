"""`train`: every option given is read or refused, and every folder is checked before any work."""

import pytest
import yaml
from helpers.checkpoints import checkpoint

from surgicai_vision.commands import folders
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import render_demos
from surgicai_vision.demos.record import record
from surgicai_vision.training.checkpoint import read_checkpoint


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Run in an empty folder: default outputs must not land in the checkout."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seeds: 3", "--seeds is for --algo"),
        ("env: {hold_jaw: true}", "env is for --algo"),
        ("env_steps: 100", "--env-steps is for --algo"),
        ("observation: state", "--observation is for --algo"),
        ("validation: 5", "--validation is for --algo"),
    ],
)
def test_what_imitation_does_not_read_is_refused(text, said, tmp_path, capsys):
    (tmp_path / "train.yaml").write_text(text)
    assert main(["train", "--encoder", "none", "--config", "train.yaml"]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1


def test_imitation_takes_the_first_demonstrations_it_is_told_to(tmp_path, capsys):
    record(TaskConfig("grasp"), episodes=2, out=tmp_path / "demos", context=RunContext(0))
    render_demos(
        tmp_path / "demos", tmp_path / "dataset", views=("back",), size=32, context=RunContext(0)
    )
    given = ["train", "--encoder", "none", "--dataset", "dataset", "--epochs", "1"]
    assert main([*given, "--demonstrations", "1", "--out", "one"]) == 0
    assert main([*given, "--out", "all"]) == 0
    counts = [read_checkpoint(tmp_path / out).run.demonstrations for out in ("one", "all")]
    assert counts == [1, 2]
    assert main([*given, "--demonstrations", "3", "--out", "more"]) == 2
    assert "holds 2" in capsys.readouterr().err and not (tmp_path / "more").exists()


@pytest.mark.parametrize("option", ["--low", "--residual-on"])
def test_the_folder_of_every_seed_is_checked_before_the_first_is_trained(
    option, tmp_path, monkeypatch, capsys
):
    low = {**dict.fromkeys(names.SUBTASKS, "expert"), "hlp": "order", "termination": "privileged"}
    (tmp_path / "low.yaml").write_text(yaml.safe_dump(low))
    base = str(checkpoint(tmp_path / "base", "grasp"))
    given = {
        "--low": ["--task", "suture", "--algo", "ppo", "--low", "low.yaml"],
        "--residual-on": ["--algo", "td3", "--residual-on", base],
    }
    checked = []

    def check(out, marker):
        checked.append(out)
        if len(checked) == 2:
            raise OutputExists(f"--out {out} already holds files.")

    def train(*arguments, **options):
        raise AssertionError("trained")

    monkeypatch.setattr(folders, "check_folder", check)
    monkeypatch.setattr("surgicai_vision.rl.high_level.train_high_level", train)
    monkeypatch.setattr("surgicai_vision.rl.residual.train_residual", train)
    assert main(["train", *given[option], "--seeds", "2"]) == 2
    assert len(set(checked)) == 2 and "already holds files" in capsys.readouterr().err
