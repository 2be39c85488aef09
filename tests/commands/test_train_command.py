"""`train`: every option given is read or refused, and every folder is checked before any work."""

import dataclasses

import pytest
import yaml
from helpers.checkpoints import checkpoint

from surgicai_vision.commands import folders, train
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.files import CACHE_VARIABLE, write_json
from surgicai_vision.core.variants import Variants
from surgicai_vision.dataset import render_demos
from surgicai_vision.demos.disturbance import Disturbance
from surgicai_vision.demos.record import record
from surgicai_vision.features.cache import list_cache
from surgicai_vision.training.checkpoint import read_checkpoint


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Run in an empty folder: default outputs must not land in the checkout."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seeds: 3", "--seeds is not read by imitation from a dataset, only by an online"),
        ("env: {hold_jaw: true}", "env is not read by imitation"),
        ("env_steps: 100", "only by an online --algo, --residual-on: leave it out"),
        ("observation: state", "--observation is not read by imitation"),
        ("validation: 5", "--validation is not read by imitation"),
        ("workers: 2", "--workers is not read by imitation"),
        ("decisions: 9", "--decisions is not read by imitation from a dataset, only by --low"),
        ("algo: td3\nencoder: random", "--encoder is not read by an online --algo"),
        ("algo: td3\nupdates: 9", "only by an offline --algo"),
        ("algo: td3\nlog: wandb", "--log wandb is for imitation"),
        ("algo: bc\nenv_steps: 9", "--env-steps is not read by an offline --algo"),
        ("algo: bc\nweights: [a.bin]", "--weights is not read by an offline --algo"),
        ("algo: ppo\nlow: a.yaml\nobservation: state", "--observation is not read by --low"),
        ("algo: ppo\nlow: a.yaml\nenv_steps: 9", "--env-steps is not read by --low"),
        ("algo: ppo\nlow: a.yaml\nresidual_on: b", "--residual-on is not read by --low"),
        ("algo: td3\nresidual_on: a\nlog: none", "--log is not read by --residual-on"),
        ("algo: td3\nresidual_on: a\ntask: place", "--task is not read by --residual-on"),
    ],
)
def test_what_a_way_of_training_does_not_read_is_refused(text, said, tmp_path, capsys):
    (tmp_path / "train.yaml").write_text(text)
    assert main(["train", "--config", "train.yaml"]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.strip().splitlines()) == 1


@pytest.mark.parametrize("policy", ["actor", "bcq", "residual"])
def test_a_policy_that_only_an_algorithm_trains_is_refused(policy, capsys):
    assert main(["train", "--policy", policy, "--encoder", "none"]) == 2
    error = capsys.readouterr().err
    said = f"Invalid value '{policy}' for --policy. Choose from: 'bc', 'bc-chunk', 'hlp', 'act'"
    assert said in error


def test_every_option_is_read_by_some_way_of_training():
    read = [option for options in train.READ.values() for option in options]
    assert set(read) == {field.name for field in dataclasses.fields(train.Options)}


def test_imitation_takes_the_first_demonstrations_it_is_told_to(tmp_path, capsys, monkeypatch):
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
    assert main([*given, "--demos", "demos", "--out", "unread"]) == 2
    assert "'bc' learns from the frames of the dataset" in capsys.readouterr().err

    given = ["train", "--encoder", "random-conv", "--view", "back", "--dataset", "dataset"]
    given += ["--epochs", "1", "--change", "frame_stride=5"]
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    assert main([*given, "--out", "seeing-all"]) == 0
    assert main([*given, "--demonstrations", "1", "--out", "seeing-one"]) == 0
    assert len(list_cache()) == 1, "its features are those of the whole dataset"
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "other-cache"))
    assert main([*given, "--demonstrations", "1", "--out", "alone"]) == 0
    shared, alone = (read_checkpoint(tmp_path / out) for out in ("seeing-one", "alone"))
    assert shared.policy_sha256 == alone.policy_sha256 and shared.frames == alone.frames
    assert list_cache()[0].manifest["length"] < shared.frames + 5, "the others are not encoded"

    given = ["train", "--algo", "bc", "--demos", "demos"]
    assert main([*given, "--demonstrations", "3"]) == 2
    assert "3 demonstrations were requested; demos holds 2" in capsys.readouterr().err
    assert main(["train", "--algo", "bc", "--demos", "demos,dataset"]) == 2
    assert "one folder of demonstrations; --demos names 2" in capsys.readouterr().err
    assert main(["export-demos", "--demos", "demos", "--episodes", "3"]) == 2
    assert "3 demonstrations were requested; demos holds 2" in capsys.readouterr().err
    assert not (tmp_path / "outputs").exists()


def test_a_checkpoint_is_named_by_the_task_of_its_data(tmp_path, capsys):
    record(TaskConfig("place"), episodes=1, out=tmp_path / "demos", context=RunContext(0))
    render_demos(
        tmp_path / "demos", tmp_path / "dataset", views=("back",), size=32, context=RunContext(0)
    )
    given = ["train", "--encoder", "none", "--dataset", "dataset", "--epochs", "1"]
    assert main([*given, "--task", "grasp"]) == 2
    assert "--task grasp: dataset shows place" in capsys.readouterr().err
    assert not (tmp_path / "outputs").exists()
    assert main(given) == 0
    made = [path.name for path in (tmp_path / "outputs/train").iterdir()]
    assert made and all(name.startswith("place-proprioception-") for name in made)
    given = ["train", "--algo", "bc", "--demos", "demos", "--task", "grasp"]
    assert main(given) == 2
    assert "--task grasp: demos shows place" in capsys.readouterr().err


def test_a_checkpoint_says_how_its_demonstrations_were_made(tmp_path, capsys):
    record(
        TaskConfig("place"),
        episodes=1,
        out=tmp_path / "demos",
        disturbance=Disturbance(noise=0.5),
        post_success_steps=3,
        context=RunContext(0),
    )
    looks = Variants("train", shift=0.5, aimed=True)
    render_demos(
        tmp_path / "demos",
        tmp_path / "dataset",
        views=("front_psm2",),
        size=32,
        frame_stride=5,
        variants=looks,
        context=RunContext(0),
    )
    given = ["train", "--encoder", "random-conv", "--view", "front_psm2", "--epochs", "1"]
    assert main([*given, "--dataset", "dataset", "--change", "frame_stride=5"]) == 0
    (out,) = (file.parent for file in tmp_path.glob("outputs/train/*/checkpoint.json"))
    assert looks.name in out.name
    run = read_checkpoint(out).run
    assert (run.demonstrator, run.noise, run.post_success_steps) == ("expert", 0.5, 3)
    assert (run.frame_stride, run.variants) == (5, looks)
    (tmp_path / "short.yaml").write_text("env: {max_steps: 2}")
    given = ["evaluate", str(out), "--episodes", "1", "--workers", "1", "--config", "short.yaml"]
    capsys.readouterr()
    for aiming, is_noted in (([], True), (["--detector", "released:detector"], False)):
        assert main([*given, *aiming]) == 0
        assert ("without a detector" in capsys.readouterr().err) == is_noted


@pytest.fixture
def trainings(tmp_path):
    """Return option → a training by it, small enough to begin at once."""
    low = {**dict.fromkeys(names.SUBTASKS, "expert"), "hlp": "order", "termination": "privileged"}
    (tmp_path / "low.yaml").write_text(yaml.safe_dump(low))
    base = str(checkpoint(tmp_path / "base", "grasp"))
    return {
        "--algo": ["--algo", "td3"],
        "--low": ["--task", "suture", "--algo", "ppo", "--low", "low.yaml"],
        "--residual-on": ["--algo", "td3", "--residual-on", base],
    }


@pytest.mark.parametrize("option", ["--low", "--residual-on"])
def test_the_folder_of_every_seed_is_checked_before_the_first_is_trained(
    option, trainings, monkeypatch, capsys
):
    checked = []

    def check(out, marker, ours=()):
        checked.append(out)
        if len(checked) == 2:
            raise OutputExists(f"--out {out} already holds files.")

    def train(*arguments, **options):
        raise AssertionError("trained")

    monkeypatch.setattr(folders, "check_folder", check)
    monkeypatch.setattr("surgicai_vision.rl.high_level.train_high_level", train)
    monkeypatch.setattr("surgicai_vision.rl.residual.train_residual", train)
    assert main(["train", *trainings[option], "--seeds", "2"]) == 2
    assert len(set(checked)) == 2 and "already holds files" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--algo", "--low", "--residual-on"])
def test_another_training_of_a_later_seed_is_refused_before_the_first_is_trained(
    option, trainings, monkeypatch, capsys
):
    begun = []

    def train(request, out, *rest, **options):
        out = rest[0] if option == "--algo" else out
        out.mkdir(parents=True)
        write_json(out / "training.json", {"request": to_mapping(request)})
        begun.append(request.seed)

    monkeypatch.setattr("surgicai_vision.rl.train.train", train)
    monkeypatch.setattr("surgicai_vision.rl.high_level.train_high_level", train)
    monkeypatch.setattr("surgicai_vision.rl.residual.train_residual", train)
    assert main(["train", *trainings[option], "--seed", "1"]) == 0
    capsys.readouterr()
    assert main(["train", *trainings[option], "--seeds", "2", "--validation", "7"]) == 2
    assert "seed1 holds another training" in capsys.readouterr().err
    assert begun == [1]


@pytest.mark.parametrize("option", ["--low", "--residual-on"])
def test_the_weights_given_are_those_of_the_policies_that_are_kept(
    option, tmp_path, monkeypatch, capsys
):
    low = {**dict.fromkeys(names.SUBTASKS, "expert"), "hlp": "order", "termination": "privileged"}
    (tmp_path / "low.yaml").write_text(yaml.safe_dump({**low, "insert": "released:insert"}))
    given = {
        "--low": ["--task", "suture", "--algo", "ppo", "--low", "low.yaml"],
        "--residual-on": ["--algo", "td3", "--residual-on", "released:grasp"],
    }

    def begin(*arguments):
        raise AssertionError("begun")

    monkeypatch.setattr("surgicai_vision.rl.high_level.training_in", begin)
    monkeypatch.setattr("surgicai_vision.rl.residual.training_in", begin)
    assert main(["train", *given[option], "--weights", "nowhere.bin"]) != 0
    assert "nowhere.bin" in capsys.readouterr().err
