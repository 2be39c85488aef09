"""docs/demos.md: its examples run as they stand."""

import dataclasses
import re

import pytest
import yaml
from read_options import read_options

from surgicai_vision.commands import import_demos
from surgicai_vision.commands.main import main
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.demos.imports.rosbag.config import CONVENTIONS, BagConfig, Frames, Topics


@pytest.fixture(scope="module")
def text(root):
    return (root / "docs/demos.md").read_text()


def block(text, language):
    """Return the only code block in a language."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return found


def test_the_expert_labels_a_learners_states(text):
    exec(compile(block(text, "python"), "docs/demos.md", "exec"), {})


def test_the_table_of_bags_names_every_field_with_its_default(text, tmp_path):
    path = tmp_path / "bag.yaml"
    path.write_text(block(text, "yaml"))
    options = read_options(import_demos.Options, ["trial.bag"], path)
    table = yaml.safe_load(path.read_text())["bag"]
    assert set(table) == {field.name for field in dataclasses.fields(BagConfig)}
    assert set(table["frames"]) == {field.name for field in dataclasses.fields(Frames)}
    shown = dataclasses.replace(options.bag, labels={}, step=None)
    same = {"frames": Frames(), "topics": Topics(), "jaw_scale": None, "needle_scale": None}
    assert dataclasses.replace(shown, **same) == BagConfig()
    assert (shown.jaw, shown.all_topics) == (BagConfig().jaw, BagConfig().all_topics)
    assert options.env["scene"].items() <= dataclasses.asdict(TaskConfig().scene).items()


def test_the_table_of_topics_is_the_code_s(text):
    for convention in CONVENTIONS.values():
        for role, topic in convention.topics.items():
            assert role.startswith("psm2") or f"`{topic}`" in text, role


def test_noise_and_recoveries_are_recorded_as_shown(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (line,) = re.findall(r"^    surgicai-vision (record-demos .*--noise.*)$", text, re.MULTILINE)
    words = line.replace("--episodes 50", "--episodes 2").split()
    assert main([*words, "--workers", "1"]) == 0
    assert len(list((tmp_path / "outputs/demos/dart").glob("episode_*"))) == 2


def test_movement_primitives_print_the_share_that_succeeds(text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["record-demos", "--task", "place", "--episodes", "1", "--workers", "1"]) == 0
    capsys.readouterr()
    (line,) = re.findall(
        r"^    surgicai-vision (record-demos .*--demonstrator dmp.*)$", text, re.MULTILINE
    )
    words = line.replace("--episodes 50", "--episodes 2").split()
    assert main([*words, "--workers", "1", "--out", "dmp"]) == 0
    assert re.search(
        r"^2/\d+ starts succeeded \(95 % interval \d+–\d+ %\)",
        capsys.readouterr().out,
        re.MULTILINE,
    )
