"""docs/recipes: what a reader copies from them is accepted, or runs in small settings."""

import json
import re
from pathlib import Path

import pytest

from surgicai_vision.commands.main import main

SMALL = {
    "learning_starts=1_000": "learning_starts=201",  # HER starts after a whole episode
    "buffer_size=20_000": "buffer_size=300",
    "learn(100_000)": "learn(202)",
    "image_size=84": "image_size=36",
    "image_size = 84": "image_size = 36",
    "n_envs=8": "n_envs=2",
    "--episodes 50": "--episodes 1 --workers 1",
}
"""Text on the page → its replacement for a small run."""


def test_stable_baselines_learns_and_is_evaluated(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (root / "docs/recipes/sb3.md").read_text(encoding="utf-8")
    for large, small in SMALL.items():
        assert large in text, large
        text = text.replace(large, small)
    *blocks, agent = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    (line,) = re.findall(r"^    PYTHONPATH=\. surgicai-vision (.*)$", text, re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))

    exec(compile("\n".join(blocks), "docs/recipes/sb3.md", "exec"), {})

    assert agent.startswith("# my_agent.py\n")
    Path("my_agent.py").write_text(agent, encoding="utf-8")
    assert main(line.split()) == 0
    assert "on place: 0/1" in capsys.readouterr().out


def test_the_grid_of_a_comparison_is_a_sweep(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (root / "docs/recipes/compare.md").read_text(encoding="utf-8")
    (grid,) = re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    (line,) = re.findall(r"^    surgicai-vision (sweep .* --dry-run)$", text, re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(grid, encoding="utf-8")
    assert main([*line.split(), "--json"]) == 0
    planned = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert planned["runs"] == 2 * 5 + 5  # two encoders and proprioception, five seeds each
