"""The leaderboard: a row is taken only if its digest, its starts and its scene check out."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sweep_results import episode

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, digest
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.evaluation.hierarchical_config import MAX_STEPS
from surgicai_vision.evaluation.robustness.axes import ALL, AXES, shifted_config
from surgicai_vision.evaluation.storage import write_evaluation
from surgicai_vision.report.leaderboard import (
    FEWEST,
    Entry,
    Row,
    make_row,
    problem,
    read_row,
    write_leaderboard,
    write_row,
)
from surgicai_vision.scene import build_scene
from surgicai_vision.training.run_config import RunConfig, Shift, Starts

ENTRY = Entry("Ours <b>", "A. Person", "https://example.org/ours", 29.5, "one core", "a note")


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluation")
    generator = np.random.default_rng(0)
    seeds = range(names.TEST_SEED, names.TEST_SEED + FEWEST)
    episodes = [episode("handoff", "act", seed, seed % 4 != 0, generator) for seed in seeds]
    run = RunConfig(
        TaskConfig("handoff"), policy="act", demonstrations=100, starts=Starts(episodes=FEWEST)
    )
    about = {
        "scene_hash": build_scene(run.env.scene).hash,
        "command": "surgicai-vision evaluate mine",
        "checkpoint": {"policy_sha256": "ab" * 32},
        "provenance": {"packages": {"torch": "2.9"}},
    }
    write_evaluation(folder, episodes, run, about)
    return folder


@pytest.fixture(scope="module")
def row(evaluated: Path) -> Row:
    return make_row(evaluated, ENTRY)


def test_a_row_comes_back_as_it_was_written(row: Row, tmp_path: Path) -> None:
    write_row(row, tmp_path / "row.json")
    assert read_row(tmp_path / "row.json") == row
    assert problem(row) == "" and sum(row.successes) == 75


SPOILS: dict[str, Callable[[Row], Row]] = {
    "digest": lambda row: replace(row, successes=(True,) * FEWEST),
    "scene": lambda row: replace(row, scene_hash="0" * 64).sealed(),
    "tolerance": lambda row: replace(
        row, run=replace(row.run, env=replace(row.run.env, tolerance="released"))
    ).sealed(),
    "starts": lambda row: replace(row, seeds=tuple(seed + 1 for seed in row.seeds)).sealed(),
    "or more": lambda row: replace(
        row, seeds=row.seeds[:50], successes=row.successes[:50], steps=row.steps[:50]
    ).sealed(),
    "outcomes": lambda row: replace(row, successes=row.successes[:-1]).sealed(),
    "more than": lambda row: replace(row, steps=(10_000, *row.steps[1:])).sealed(),
    "shifted": lambda row: replace(row, run=replace(row.run, shift=Shift("camera", 0.5))).sealed(),
    "randomisation": lambda row: replace(row, run=replace(row.run, shift=Shift(ALL, 0.5))).sealed(),
    "upset": lambda row: replace(row, run=replace(row.run, upset=True)).sealed(),
    "other starts": lambda row: replace(row, run=replace(row.run, starts=Starts(0))).sealed(),
    "expert acts": lambda row: replace(row, run=replace(row.run, expert_swap="grasp")).sealed(),
    "one subtask": lambda row: replace(
        row,
        run=replace(
            row.run,
            env=replace(row.run.env, max_steps=MAX_STEPS, advance="told"),
            termination="learned",
        ),
    ).sealed(),
}


@pytest.mark.parametrize("told", SPOILS)
def test_a_row_that_does_not_check_out_is_not_taken(told: str, row: Row, tmp_path: Path) -> None:
    spoilt = SPOILS[told](row)
    assert told in problem(spoilt)
    write_row(spoilt, tmp_path / "spoilt.json")
    write_row(row, tmp_path / "whole.json")
    board = write_leaderboard(tmp_path, tmp_path / "page.html")
    assert board.taken == (row,) and list(board.refused) == ["spoilt.json"]


def test_the_shifted_condition_is_one_of_its_own(row: Row, tmp_path: Path) -> None:
    env = shifted_config(row.run.env, AXES[ALL], 0.5)
    shifted = replace(row, run=replace(row.run, env=env, shift=Shift(ALL, 0.5))).sealed()
    assert problem(shifted) == ""
    for number, each in enumerate((row, shifted)):
        write_row(each, tmp_path / f"{number}.json")
    text = write_leaderboard(tmp_path, tmp_path / "page.html").page.read_text(encoding="utf-8")
    assert "handoff, clean" in text and "handoff, shifted" in text


@pytest.mark.parametrize(
    ("termination", "advance", "told"),
    [("learned", "told", False), ("privileged", "success", True)],
)
def test_a_whole_procedure_has_the_env_of_its_policy(
    termination: str, advance: str, told: bool, row: Row, tmp_path: Path
) -> None:
    env = replace(TaskConfig("suture"), max_steps=MAX_STEPS, advance=advance)
    run = replace(row.run, env=env, policy="bc", parts="ab" * 32, termination=termination)
    whole = replace(row, run=run).sealed()
    assert problem(whole) == ""
    write_row(whole, tmp_path / "row.json")
    text = write_leaderboard(tmp_path, tmp_path / "page.html").page.read_text(encoding="utf-8")
    assert ("ends given by the simulator" in text) == told
    other = replace(run, env=replace(env, max_steps=10 * MAX_STEPS))
    assert "max_steps" in problem(replace(row, run=other).sealed())


def test_the_page_pairs_rows_and_escapes_what_it_is_given(row: Row, tmp_path: Path) -> None:
    better = replace(row, entry=replace(ENTRY, name="Better"), successes=(True,) * FEWEST).sealed()
    for name, each in (("a", row), ("b", better), ("again", row)):
        write_row(each, tmp_path / f"{name}.json")
    (tmp_path / "torn.json").write_text("{", encoding="utf-8")
    (tmp_path / "other.json").write_text("[1]", encoding="utf-8")
    board = write_leaderboard(tmp_path, tmp_path / "page.html")
    assert len(board.taken) == 2
    assert set(board.refused) == {"b.json", "torn.json", "other.json"} or set(board.refused) == {
        "again.json",
        "torn.json",
        "other.json",
    }
    text = board.page.read_text(encoding="utf-8")
    assert "Ours &lt;b&gt;" in text and "Ours <b>" not in text
    assert text.index("Better") < text.index("Ours &lt;b&gt;"), "the best stands first"
    assert "75/100" in text and "6e-08" in text  # 2 · 0.5^25: 25 starts that only one solves
    again = write_leaderboard(tmp_path, tmp_path / "page.html")
    assert again.page.read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    "wrong", [{"name": " "}, {"link": "http://example.org"}, {"minutes": -1.0}, {"note": "x" * 301}]
)
def test_what_is_said_of_a_row_is_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        replace(ENTRY, **wrong)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("minutes", lambda table: table["entry"].update(minutes=10**400)),
        ("endless", lambda table: table["entry"].update(minutes=float("inf"))),
        ("surrogate", lambda table: table["entry"].update(note="\ud800")),
        ("key", lambda table: table.update({"\ud800": 1})),
        ("nested", lambda table: table.update(versions={"a": json.loads("[" * 900 + "]" * 900)})),
        (os.fsdecode(b"\xff"), lambda table: table["run"].update(upset=True)),
        (os.fsdecode(b"\xfe"), lambda table: table.clear()),
    ],
)
def test_a_hostile_row_leaves_the_others_their_place(
    name: str, spoil: Callable[[dict[str, Any]], None], row: Row, tmp_path: Path
) -> None:
    write_row(row, tmp_path / "whole.json")
    table = json.loads((tmp_path / "whole.json").read_text())
    spoil(table)
    table["digest"] = digest({**table, "digest": ""})
    (tmp_path / f"{name}.json").write_text(json.dumps(table))
    board = write_leaderboard(tmp_path, tmp_path / "page.html")
    assert board.taken == (row,) and len(board.refused) == 1
    told = "".join(*board.refused.items())
    assert told.encode().decode() == told and "\n" not in told
    assert next(iter(board.refused)) in board.page.read_text(encoding="utf-8")


def test_a_large_file_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "row.json").write_bytes(b" " * (1 << 21))
    with pytest.raises(BadFile, match="larger"):
        read_row(tmp_path / "row.json")


def test_the_commands_make_a_row_and_the_page(
    evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["submit", str(evaluated), "--name", "Ours", "--by", "A. Person", "--minutes", "30"]
    rows = tmp_path / "rows"
    rows.mkdir()
    assert main([*line, "--out", str(rows / "a.json")]) == 0
    assert main(["leaderboard", str(rows), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["taken"] == 1 and Path(told["page"]).is_file()
    (rows / "b.json").write_text("{}", encoding="utf-8")
    assert main(["leaderboard", str(rows)]) == 1
    assert main(["leaderboard", str(tmp_path / "nowhere")]) == 2


def test_the_rows_of_this_repository_are_taken(tmp_path: Path) -> None:
    rows = Path(__file__).resolve().parents[2] / "rows"
    board = write_leaderboard(rows, tmp_path / "board.html")
    assert not board.refused
    stored = [read_row(path) for path in rows.glob("*.json")]
    assert len(board.taken) == len(stored)
    experts = {row.run.env.task for row in stored if row.run.policy == "expert"}
    assert experts == set(names.SUBTASKS), "the reference of a task is missing"


def test_a_high_level_policy_by_ppo_sees_poses_alone() -> None:
    assert not RunConfig(TaskConfig("suture"), policy="hlp", algo="ppo").sees_goal


@pytest.mark.parametrize(
    "on_state",
    [
        lambda run: replace(run, privileged=True),
        lambda run: replace(run, policy="actor", algo="td3"),
        lambda run: replace(run, policy="expert"),
    ],
    ids=["cloned", "reinforced", "scripted"],
)
def test_what_sees_the_state_is_marked(
    row: Row, tmp_path: Path, on_state: Callable[[RunConfig], RunConfig]
) -> None:
    for name, run in (("images", row.run), ("state", on_state(row.run))):
        (tmp_path / name).mkdir()
        write_row(replace(row, run=run).sealed(), tmp_path / name / "row.json")
        page = write_leaderboard(tmp_path / name, tmp_path / f"{name}.html").page.read_text()
        assert ("sees the state with the goal" in page) == (name == "state")
