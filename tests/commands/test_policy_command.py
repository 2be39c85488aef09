"""`policy`: what cannot be shared is refused in one line."""

import pytest

from surgicai_vision.commands.main import main


@pytest.mark.parametrize("given", ["released:suture", "hierarchical.yaml"])
def test_a_hierarchical_policy_is_not_pushed_as_one(given, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["policy", "push", given, "--repo", "somebody/policy", "--dry-run"]) == 2
    error = capsys.readouterr().err
    assert f"{given} is a hierarchical policy" in error
    assert len(error.strip().splitlines()) == 1
