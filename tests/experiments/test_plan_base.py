"""Plans that name a base and change some keys."""

from dataclasses import replace

import pytest
import yaml

from surgicai_vision.commands.sweep import grid_file, read_experiment
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.experiments.plan_config import Plan, read_plan

OWN = {"base": "endoscope", "seed": [0, 4], "episodes": 7}


def write(path, table):
    path.write_text(yaml.safe_dump(table))
    return path


def shipped(name):
    built = read_experiment(grid_file(name))
    assert isinstance(built, Plan)
    return built


def test_a_plan_is_its_base_but_for_its_own_keys(tmp_path):
    path = write(tmp_path / "own.yaml", OWN)
    assert read_experiment(path) == read_plan(path)
    assert read_plan(path) == replace(shipped("endoscope"), seed=(0, 4), episodes=7)


def test_a_base_is_found_from_the_plans_own_folder(tmp_path, monkeypatch):
    folder = tmp_path / "plans"
    folder.mkdir()
    path = write(folder / "own.yaml", {**OWN, "base": "other.yaml"})
    with pytest.raises(BadFile, match=r"other\.yaml"):
        read_plan(path)
    (folder / "other.yaml").write_text(grid_file("procedure").read_text())
    monkeypatch.chdir(tmp_path)
    assert read_plan(path) == replace(shipped("procedure"), seed=(0, 4), episodes=7)


def test_soft_tissue_takes_the_endoscopes_plan_as_it_is():
    soft, standing = shipped("endoscope-soft"), shipped("endoscope")
    assert soft.env == {"scene": {"tissue": "soft"}}
    kept = replace(soft, seed=standing.seed, env=standing.env, conditions=standing.conditions)
    assert kept == standing


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({**OWN, "base": "endoscop"}, "Did you mean 'endoscope'"),
        ({**OWN, "base": "endoscope-soft"}, "has a base itself"),
        ({**OWN, "polices": []}, "Did you mean 'policies'"),
        ({**OWN, "base": "smoke"}, "task"),  # a grid; its keys are not a plan's
        ({**OWN, "base": ["endoscope"]}, "Unknown sweep"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_wrong_base_is_refused(table, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read_plan(write(tmp_path / "own.yaml", table))
