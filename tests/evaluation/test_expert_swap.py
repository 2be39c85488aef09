"""Survival: the expert in the place of the policy that fails lets a chain go on; everything is
paired and stored.
"""

import json

import pyarrow.parquet as pq
import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.evaluation.expert_swap import AS_IT_IS, CURVES, swapped, variants_of
from surgicai_vision.evaluation.hierarchical import Chain
from surgicai_vision.evaluation.storage import MARKER, read_rows

CHAIN = "hlp: order\ngrasp: expert\nplace: zero\ninsert: expert\nhandoff: random\npullout: expert\nmax_steps: 520\n"
STARTS = ["--episodes", "2", "--workers", "1", "--json"]


@pytest.fixture
def chain_file(tmp_path):
    path = tmp_path / "chain.yaml"
    path.write_text(CHAIN)
    return path


def test_variants_are_the_chain_and_each_learned_subtask():
    config = Chain(
        "order", grasp="expert", place="zero", insert="expert", handoff="random", pullout="expert"
    )
    variants = variants_of(config)
    assert list(variants) == [AS_IT_IS, "place", "handoff"]
    assert [subject.about["swap"] for subject in variants.values()] == [None, "place", "handoff"]
    assert len({subject.name for subject in variants.values()}) == 1
    assert len({subject.config for subject in variants.values()}) == 1
    assert variants["place"].about["chain"]["place"] == "expert"
    assert variants["place"].about["chain"]["handoff"] == "random"
    assert (
        variants["place"].make_agent().name == variants[AS_IT_IS].name == swapped(config, None).name
    )


def test_a_swapped_expert_lets_the_chain_go_on_to_the_next_weak_link(chain_file, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["evaluate", str(chain_file), "--swap", "all", "--out", str(out), *STARTS]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    found = {
        swap: [row["k"] for row in result["survival"] if row["swap"] == swap]
        for swap in ("", "place", "handoff")
    }
    assert found == {"": [2, 0, 0, 0, 0], "place": [2, 2, 2, 0, 0], "handoff": [2, 0, 0, 0, 0]}
    assert [row["subtask"] for row in result["survival"][:5]] == list(names.SUBTASKS)
    assert pq.read_table(out / CURVES).to_pylist() == result["survival"]
    assert {row["p_holm"] for row in result["survival"] if row["swap"]} == {1.0}
    stored = json.loads((out / "place" / MARKER).read_text())
    assert stored["about"]["swap"] == "place"
    assert [stage["k"] for stage in stored["summary"]["survival"]] == found["place"]
    assert [row["seed"] for row in read_rows(out / "place")] == [
        row["seed"] for row in read_rows(out / AS_IT_IS)
    ]

    assert main(command) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert main([*command, "--seed", "5"]) == 2
    assert "the survival of another" in capsys.readouterr().err


def test_one_subtask_can_be_swapped_alone(chain_file, tmp_path, capsys):
    assert (
        main(
            [
                "evaluate",
                str(chain_file),
                "--swap",
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
    assert json.loads((tmp_path / "out" / MARKER).read_text())["about"]["swap"] == "place"


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        (["expert", "--swap", "place"], "is for a chain.yaml"),
        (["x.yaml", "--swap", "plaec"], "place"),
    ],
)
def test_wrong_swaps_end_with_one_line(command, wanted, tmp_path, capsys):
    assert main(["evaluate", *command, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and wanted in error[0]
