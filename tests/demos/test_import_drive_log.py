"""The log of a drive: numbers that no drive writes are refused in one line."""

import json
from pathlib import Path

import pytest

from surgicai_vision.core.errors import BadFile
from surgicai_vision.demos.imports.drive_log import import_drive_log

LINE = {"episode": 0, "step": 0, "phase": 0, "both_arms": [0.1] * 14}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("step", 10**18, "line 2: step must be within 0 and 1000000000"),
        ("step", -1, "line 2: step must be within"),
        ("step", float("inf"), "line 2 is none of a log"),
        ("both_arms", [10**400] * 14, "line 2 is none of a log"),
    ],
)
def test_a_number_that_is_too_large_is_a_bad_file(
    tmp_path: Path, key: str, value: object, said: str
) -> None:
    log = tmp_path / "drive.jsonl"
    log.write_text("".join(f"{json.dumps(row)}\n" for row in (LINE, {**LINE, key: value})))
    with pytest.raises(BadFile, match=said):
        import_drive_log(log, task="grasp", out=tmp_path / "demos")
