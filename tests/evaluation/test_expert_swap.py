"""Expert swap: the expert in place of a failing policy lets the procedure go on."""

import json

import pyarrow.parquet as pq
import pytest
from checkpoints import checkpoint

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.errors import OutputExists
from surgicai_vision.core.progress import silent_stage
from surgicai_vision.evaluation.expert_swap import AS_IT_IS, CURVES, evaluate_swaps, variants_of
from surgicai_vision.evaluation.storage import MARKER, read_rows
from surgicai_vision.training.checkpoint import read_checkpoint, read_tensors, write_checkpoint

POLICY = (
    "hlp: order\ngrasp: expert\nplace: zero\ninsert: expert\nhandoff: random\npullout: expert\n"
    "termination: privileged\nmax_steps: 520\n"
)
STARTS = ["--episodes", "2", "--workers", "1", "--json"]


@pytest.fixture
def policy_file(tmp_path):
    path = tmp_path / "hierarchical.yaml"
    path.write_text(POLICY)
    return path


def test_variants_are_the_policy_and_each_learned_subtask(policy_file):
    variants = variants_of(policy_file)
    assert list(variants) == [AS_IT_IS, "place", "handoff"]
    assert [spec.run.expert_swap for spec in variants.values()] == [None, "place", "handoff"]
    assert len({spec.run.parts for spec in variants.values()}) == 1
    assert len({spec.config for spec in variants.values()}) == 1
    called = [spec.name for spec in variants.values()]
    assert len(set(called)) == 3 and called[1] == f"{called[0]}-expert-place"
    assert variants["place"].make_agent().name == called[1]


def test_a_swapped_expert_lets_the_procedure_go_on_to_the_next_weak_link(
    policy_file, tmp_path, capsys
):
    out = tmp_path / "out"
    command = ["evaluate", str(policy_file), "--expert-swap", "all", "--out", str(out), *STARTS]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    found = {
        swap: [row["k"] for row in result["expert_swap"] if row["expert_swap"] == swap]
        for swap in ("", "place", "handoff")
    }
    assert found == {"": [2, 0, 0, 0, 0], "place": [2, 2, 2, 0, 0], "handoff": [2, 0, 0, 0, 0]}
    assert [row["subtask"] for row in result["expert_swap"][:5]] == list(names.SUBTASKS)
    assert pq.read_table(out / CURVES).to_pylist() == result["expert_swap"]
    assert {row["p_holm"] for row in result["expert_swap"] if row["expert_swap"]} == {1.0}
    stored = json.loads((out / "place" / MARKER).read_text())
    assert stored["run"]["expert_swap"] == "place"
    assert [stage["k"] for stage in stored["summary"]["subtasks"]] == found["place"]
    assert [row["seed"] for row in read_rows(out / "place")] == [
        row["seed"] for row in read_rows(out / AS_IT_IS)
    ]

    assert main(command) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert main([*command, "--seed", "5"]) == 2
    assert "the expert swaps of another" in capsys.readouterr().err


def train_again(folder):
    """Replace the weights in a checkpoint's folder."""
    stored = read_checkpoint(folder)
    others = {name: 2 * tensor for name, tensor in read_tensors(stored).items()}
    write_checkpoint(folder, stored, others)


def test_a_part_trained_anew_in_the_same_folder_is_another_policy(tmp_path):
    path = tmp_path / "hierarchical.yaml"
    checkpoint(tmp_path / "place", "place")
    given = POLICY.replace("place: zero", f"place: {tmp_path / 'place'}")
    path.write_text(given.replace("handoff: random", "handoff: expert").replace("520", "2"))
    seeds = [names.TEST_SEED]
    evaluate_swaps(variants_of(path), seeds, tmp_path / "out", silent_stage, 1)
    evaluate_swaps(variants_of(path), seeds, tmp_path / "out", silent_stage, 1)
    train_again(tmp_path / "place")
    with pytest.raises(OutputExists, match="the expert swaps of another policy"):
        evaluate_swaps(variants_of(path), seeds, tmp_path / "out", silent_stage, 1)


def test_swaps_of_another_scene_are_not_continued(policy_file, tmp_path):
    policy_file.write_text(POLICY.replace("520", "2"))
    seeds = [names.TEST_SEED]
    evaluate_swaps(variants_of(policy_file), seeds, tmp_path / "out", silent_stage, 1)
    marker = tmp_path / "out" / AS_IT_IS / MARKER
    stored = json.loads(marker.read_text())
    stored["about"]["scene_hash"] = "0" * 64
    marker.write_text(json.dumps(stored))
    with pytest.raises(OutputExists, match="expert swaps of scene 000000000000"):
        evaluate_swaps(variants_of(policy_file), seeds, tmp_path / "out", silent_stage, 1)


def test_one_subtask_can_be_swapped_alone(policy_file, tmp_path, capsys):
    assert (
        main(
            [
                "evaluate",
                str(policy_file),
                "--expert-swap",
                "place",
                "--out",
                str(tmp_path / "out"),
                *STARTS,
            ]
        )
        == 0
    )
    *told, last = capsys.readouterr().out.splitlines()
    result = json.loads(last)
    assert "failed: 2 time; reached grasp 2, place 2, insert 2, handoff 0, pullout 0" in told[0]
    assert result["reached"]["insert"] == 2
    assert json.loads((tmp_path / "out" / MARKER).read_text())["run"]["expert_swap"] == "place"


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        (["expert", "--expert-swap", "place"], "is for the YAML file of a hierarchical policy"),
        (["x.yaml", "--expert-swap", "plaec"], "place"),
    ],
)
def test_wrong_swaps_end_with_one_line(command, wanted, tmp_path, capsys):
    assert main(["evaluate", *command, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and wanted in error[0]
