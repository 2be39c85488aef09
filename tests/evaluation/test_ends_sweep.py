"""Choosing the hysteresis of learned ends on validation starts."""

import json
from pathlib import Path

import pytest
import yaml
from checkpoints import checkpoint

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.progress import silent_stage
from surgicai_vision.evaluation.ends_sweep import CHOSEN, Ends, sweep_ends
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.storage import MARKER, VISITS, read_evaluation
from surgicai_vision.training.checkpoint import read_checkpoint, read_tensors, write_checkpoint
from surgicai_vision.training.run_config import Starts


@pytest.fixture
def policy_file(tmp_path: Path) -> Path:
    """Return the file of an untrained hierarchical policy with short episodes."""
    table = dict.fromkeys(names.SUBTASKS, "zero")
    table["hlp"] = checkpoint(tmp_path / "hlp", "suture", "hlp")
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**table, "max_steps": 8, "steps": 4, "decide_every": 1}))
    return path


def test_the_best_sews_most_then_ends_least_falsely_then_soonest() -> None:
    ranked = [
        Ends(0.9, 3, 9, 10, 0.5, 1.0),
        Ends(0.7, 2, 8, 10, 0.0, 0.4),
        Ends(0.5, 2, 8, 10, 0.0, None),
        Ends(0.5, 1, 8, 10, 0.1, 0.1),
    ]
    assert sorted({*ranked}, key=Ends.rank) == ranked


def test_every_pair_is_evaluated_once_and_the_best_is_a_policy(
    policy_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = [
        *("policy", "tune", str(policy_file), "--out", str(out), "--confidence", "0,0.9"),
        *("--patience", "1", "--episodes", "2", "--workers", "1", "--json"),
    ]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [(row["patience"], row["episodes"]) for row in result["ends"]] == [(1, 2)] * 2
    folders = sorted(path.name for path in out.iterdir() if path.is_dir())
    assert folders == ["confidence-0-patience-1", "confidence-0.9-patience-1"]
    assert all((out / name / VISITS).is_file() for name in folders)
    stored = read_evaluation(out / folders[0])
    assert stored.run.starts == Starts(names.VALIDATION_SEED, 2)
    assert [row["subtask"] for row in stored.summary["ends"]] == list(names.SUBTASKS)
    chosen = yaml.safe_load((out / CHOSEN).read_text())
    best = result["ends"][0]
    assert (chosen["confidence"], chosen["patience"]) == (best["confidence"], best["patience"])
    assert open_policy(out / CHOSEN).config.advance == "told"

    before = [(out / name / MARKER).stat().st_mtime_ns for name in folders]
    assert main(command) == 0
    assert before == [(out / name / MARKER).stat().st_mtime_ns for name in folders]
    with pytest.raises(OutputExists, match="holds the ends of another"):
        sweep_ends(policy_file, Starts(names.VALIDATION_SEED, 3), out, silent_stage)


def train_again(folder: Path) -> None:
    """Replace the weights in a checkpoint's folder."""
    stored = read_checkpoint(folder)
    others = {name: 2 * tensor for name, tensor in read_tensors(stored).items()}
    write_checkpoint(folder, stored, others)


def test_a_high_level_policy_trained_anew_is_another_one(policy_file: Path, tmp_path: Path) -> None:
    starts = Starts(names.VALIDATION_SEED, 1)
    sweep_ends(policy_file, starts, tmp_path / "out", silent_stage, (0.5,), (1,), workers=1)
    train_again(tmp_path / "hlp")
    with pytest.raises(OutputExists, match="the ends of another policy"):
        sweep_ends(policy_file, starts, tmp_path / "out", silent_stage, (0.5,), (1,), workers=1)


def test_ends_of_another_scene_are_not_continued(policy_file: Path, tmp_path: Path) -> None:
    starts = Starts(names.VALIDATION_SEED, 1)
    sweep_ends(policy_file, starts, tmp_path / "out", silent_stage, (0.5,), (1,), workers=1)
    marker = tmp_path / "out" / "confidence-0.5-patience-1" / MARKER
    stored = json.loads(marker.read_text())
    stored["about"]["scene_hash"] = "0" * 64
    marker.write_text(json.dumps(stored))
    with pytest.raises(OutputExists, match="ends of scene 000000000000"):
        sweep_ends(policy_file, starts, tmp_path / "out", silent_stage, (0.5,), (1,), workers=1)


def test_test_starts_and_privileged_ends_are_refused(policy_file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="reach into the test starts"):
        sweep_ends(policy_file, Starts(names.TEST_SEED - 1, 2), tmp_path / "out", silent_stage)
    policy_file.write_text(policy_file.read_text() + "termination: privileged\n")
    with pytest.raises(InputError, match="only learned ends have a confidence"):
        sweep_ends(policy_file, Starts(names.VALIDATION_SEED), tmp_path / "out", silent_stage)
    assert not (tmp_path / "out").exists()
