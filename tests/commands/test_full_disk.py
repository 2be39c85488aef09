"""A disk that takes no more gives a one-line error and costs only the item in progress."""

import errno
import json
import os

import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.demos.store import list_demos


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (errno.ENOSPC, "The disk is full"),
        (errno.EDQUOT, "The disk is full"),
        (errno.EFBIG, "A file could not be written or read: File too large."),
    ],
)
def test_a_full_disk_is_one_line_and_work_goes_on_once_there_is_room(
    code, message, tmp_path, capsys, monkeypatch
):
    folder = tmp_path / "demos"
    arguments = ["record-demos", "--task", "place", "--episodes", "2", "--out", str(folder)]
    written = os.fsync

    def full(file):
        if any(tmp_path.rglob("*.safetensors")):  # no room for the marker of the recording
            raise OSError(code, os.strerror(code))
        written(file)

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        assert main([*arguments, "--workers", "1"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith(f"surgicai-vision: error: {message}")
    assert not any("Traceback" in line for line in said)
    kept = {path.read_bytes() for path in tmp_path.rglob("*.safetensors")}
    assert len(kept) == 2

    assert main([*arguments, "--workers", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["episodes"] == 2
    assert {path.read_bytes() for path in list_demos(folder)} == kept
