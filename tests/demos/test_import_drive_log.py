"""Drive logs: numbers that no drive writes are refused in one line."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from surgicai_vision.core.errors import BadFile, OutputExists
from surgicai_vision.demos.imports.drive_log import import_drive_log
from surgicai_vision.demos.imports.lerobot_dataset import import_dataset

LINE = {"episode": 0, "step": 0, "phase": 0, "both_arms": [0.1] * 14}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("step", 10**18, "line 2: step must be within 0 and 1000000000"),
        ("step", -1, "line 2: step must be within"),
        ("step", float("inf"), "line 2 is not a line of a log"),
        ("both_arms", [10**400] * 14, "line 2 is not a line of a log"),
    ],
)
def test_a_number_that_is_too_large_is_a_bad_file(
    tmp_path: Path, key: str, value: object, said: str
) -> None:
    log = tmp_path / "drive.jsonl"
    log.write_text("".join(f"{json.dumps(row)}\n" for row in (LINE, {**LINE, key: value})))
    with pytest.raises(BadFile, match=said):
        import_drive_log(log, task="grasp", out=tmp_path / "demos")


def test_a_line_nested_too_deeply_is_a_bad_file(tmp_path: Path) -> None:
    log = tmp_path / "drive.jsonl"
    log.write_text(f"{json.dumps(LINE)}\n{'[' * 100_000}\n")
    with pytest.raises(BadFile, match="line 2 is refused: its JSON is nested too deeply"):
        import_drive_log(log, task="grasp", out=tmp_path / "demos")


@pytest.mark.parametrize("read", [import_drive_log, import_dataset])
def test_a_folder_of_something_else_is_refused_before_anything_is_read(
    tmp_path: Path, read: Callable[..., object]
) -> None:
    (tmp_path / "out/insert").mkdir(parents=True)
    (tmp_path / "out/insert/notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match="insert already holds files"):
        read(tmp_path / "nothing", task=None, out=tmp_path / "out")
