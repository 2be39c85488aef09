"""`open_policy`: every way to name what is evaluated, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from checkpoints import checkpoint

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.evaluation.agent import Agent
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.run import evaluate_into
from surgicai_vision.evaluation.storage import MARKER, read_evaluation
from surgicai_vision.training.run_config import Starts


class Still(Agent):
    """Holds still and looks through one camera."""

    name = "still"
    cameras = ("back",)

    def reset(self, slot, env, seed):
        pass

    def act(self, slots, envs, observations):
        return np.zeros((len(slots), 7), np.float32)


def not_an_agent():
    """Return something that is not an agent."""
    return 3


def interrupted():
    """Raise an exception that is not ours."""
    raise StopIteration


def test_a_baseline_acts_in_the_task_and_env_asked_for() -> None:
    spec = open_policy("zero", task="place", env={"max_steps": 7})
    assert (spec.name, spec.config) == ("zero", TaskConfig("place", max_steps=7))
    assert not spec.run.is_trained and spec.make_agent().name == "zero"


def test_a_checkpoint_acts_in_the_env_it_was_trained_in(tmp_path: Path) -> None:
    spec = open_policy(checkpoint(tmp_path / "grasp", "grasp"))
    assert (spec.name, spec.config) == ("proprioception", TaskConfig("grasp"))
    assert spec.run.demonstrations == 1
    assert open_policy(tmp_path / "grasp", env={"max_steps": 7}).config.max_steps == 7


def test_evaluate_says_in_which_world_it_counts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    varied = RandomisationConfig(phantom_shift=3.0, needle_arc="any")
    checkpoint(Path("varied"), "grasp", env=TaskConfig("grasp", max_steps=2, randomisation=varied))
    command = ["evaluate", "varied", "--episodes", "1", "--workers", "1"]
    assert main(command) == 0
    assert "world: varies (phantom_shift 3.0, needle_arc any)" in capsys.readouterr().out
    Path("standing.yaml").write_text("env: {randomisation: {}, max_steps: 2}\n")
    for more, expected in (
        ([], {"phantom_shift": 3.0, "needle_arc": "any"}),
        (["--config", "standing.yaml"], {}),
    ):
        assert main([*command, "--json", *more]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert json.loads(lines[-1])["randomisation"] == expected
        assert any("world: varies" in line for line in lines) == bool(expected)


def test_evaluate_says_which_starts_are_no_result(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    checkpoint(Path("made"), "grasp", env=TaskConfig("grasp", max_steps=2))
    command = ["evaluate", "made", "--episodes", "1", "--workers", "1", "--json", "--seed"]
    for seed, bank in ((7, "training"), (500_000, "validation"), (900_000, "held-out")):
        assert main([*command, str(seed)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert json.loads(lines[-1])["starts"] == bank
        told = [line for line in lines if line.startswith("starts:")]
        assert bool(told) == (bank != "held-out")
        assert all(f"{seed}–{seed} are {bank} starts" in line for line in told)


def test_a_factory_elsewhere_makes_the_agent(tmp_path: Path) -> None:
    spec = open_policy(f"{__name__}:Still", env={"max_steps": 2})
    assert spec.run.views == ("back",) and spec.run.is_trained
    summary = evaluate_into(tmp_path / "out", spec, [names.TEST_SEED], workers=1)
    assert summary["policy"] == spec.name == f"{__name__}-Still-own-back"
    stored = read_evaluation(tmp_path / "out").run
    assert stored.starts == Starts(names.TEST_SEED, 1) and stored.policy == f"{__name__}:Still"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (f"{__name__}:not_an_agent", "returns int"),
        (f"{__name__}:nothing", "cannot be imported"),
        ("json:loads", "fails with TypeError .*takes no arguments"),
        (f"{__name__}:interrupted", "fails with StopIteration"),
        ("this_module_fails:make", "fails with ZeroDivisionError"),
        ("no_such_module:make", "cannot be imported"),
        (":x", "is not a function in"),
        ("json:", "is not a function in"),
        (".json:loads", "is not a function in"),
        ("replay", "give a dataset"),
        ("missing.yaml", "Cannot read"),
        ("expret", "Did you mean 'expert'"),
        ("some/where", "not a checkpoint"),
    ],
)
def test_what_is_no_policy_is_refused(
    given: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "this_module_fails.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=told):
        open_policy(given)


@pytest.mark.parametrize(
    ("file", "content", "told"),
    [
        ("config.json", {"input_features": {"observation.state": {"type": "STATE"}}}, "no shape"),
        (
            "config.json",
            {"input_features": {"image": {"type": "VISUAL", "shape": [3]}}},
            "no shape",
        ),
        ("config.json", {"output_features": {"action": {"shape": [7]}}}, "no type"),
        ("config.json", {"output_features": [7]}, "'output_features' is not a table"),
        ("train_config.json", {"env": ["surgicai"]}, "'env' is not a table"),
        ("train_config.json", {"env": {"type": "surgicai", "encoder": "random"}}, "'cameras' is"),
    ],
)
def test_a_damaged_checkpoint_of_lerobot_is_refused(tmp_path, file, content, told):
    (tmp_path / "model.safetensors").write_bytes(b"")
    (tmp_path / "config.json").write_text('{"type": "act"}')
    (tmp_path / file).write_text(json.dumps({"type": "act", **content}))
    with pytest.raises(BadFile, match=told) as refused:
        open_policy(tmp_path, task="grasp")
    assert str(tmp_path / file) in str(refused.value)


@pytest.mark.parametrize("more", [["evaluate"], ["robustness", "--axis", "latency"]])
def test_a_seed_that_no_row_holds_is_refused_before_any_work(tmp_path, more, capsys):
    verb, *options = more
    out = tmp_path / "out"
    command = [verb, "zero", "--seed", "99999999999999999999", "--out", str(out), *options]
    assert main(command) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and "Must be <= 9223372036854775807" in told[0]
    assert not out.exists()


def test_options_that_do_not_go_with_a_policy_are_refused(tmp_path: Path) -> None:
    grasp = checkpoint(tmp_path / "grasp", "grasp")
    with pytest.raises(InputError, match="not for 'place'"):
        open_policy(grasp, task="place")
    with pytest.raises(InputError, match="--expert-swap place"):
        open_policy(grasp, expert_swap="place")
    with pytest.raises(InputError, match="the task is a separate option"):
        open_policy(grasp, env={"task": "place"})
    with pytest.raises(UnknownName, match="max_steps"):
        open_policy(grasp, env={"max_step": 3})


def test_an_evaluation_of_another_version_is_refused(tmp_path: Path) -> None:
    spec = open_policy("zero", env={"max_steps": 2})
    evaluate_into(tmp_path, spec, [names.TEST_SEED], workers=1)
    stored = json.loads((tmp_path / MARKER).read_text())
    del stored["format"]
    (tmp_path / MARKER).write_text(json.dumps(stored))
    with pytest.raises(BadFile, match="of another version") as refused:
        read_evaluation(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_file_names_no_code(tmp_path: Path) -> None:
    low = dict.fromkeys(names.SUBTASKS, "expert") | {"insert": "test_policy_spec:Still"}
    path = tmp_path / "hierarchical.yaml"
    path.write_text(
        "hlp: order\ntermination: privileged\n" + "".join(f"{name}: {low[name]}\n" for name in low)
    )
    with pytest.raises(InputError, match=r"insert: test_policy_spec:Still names code"):
        open_policy(path)
