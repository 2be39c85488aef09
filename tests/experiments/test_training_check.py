"""What no sweep could finish is refused before its demonstrations are recorded."""

from dataclasses import replace

import pytest
from tiny_encoder import TINY

from surgicai_vision.commands.main import main
from surgicai_vision.commands.sweep import read_experiment
from surgicai_vision.core import files
from surgicai_vision.core.config import RandomisationConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.storage import FORMAT, GRID_FILE
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.release import run_release
from surgicai_vision.experiments.sweep.grid import Ablation, Grid
from surgicai_vision.experiments.sweep.plan import LEFT, TO_DO, Jobs, plan
from surgicai_vision.experiments.sweep.rl_grid import RLGrid
from surgicai_vision.experiments.sweep.selection import read_choice
from surgicai_vision.features.encoders import ENCODERS, register_encoder
from surgicai_vision.training import released
from surgicai_vision.training.run_config import OWN

SHIPPED = files.configs_folder() / "sweep"
GRID = Grid(("insert",), ("random-conv",), (("back",),))
DEMONSTRATIONS = {
    "name": "few",
    "task": "insert",
    "episodes": 2,
    "frame_stride": 1,
    "view": ["back"],
}
POLICY = {"name": "seeing", "demonstrations": "few", "view": ["back"]}
TABLE = {
    "size": 32,
    "encoder": "random-conv",
    "pool": "global",
    "recipe": "paper",
    "episodes": 1,
    "demonstrations": [DEMONSTRATIONS],
    "policies": [POLICY],
}
NARROW = {"needle_size": 0.2, "pair": "any"}
"""Some needles of these are too small for some pair of holes."""
WHOLE = {**DEMONSTRATIONS, "task": "suture", "demonstrator": "search"}
TRYING = {**POLICY, "change": ["clock=true", "retry_after=8"]}
ON_FEW = {**POLICY, "policy": "hlp", "view": []}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"pool": "spatal"}, "Did you mean 'spatial'"),
        ({"ablation": (Ablation(pool="maps"),)}, "Unknown pool 'maps'"),
        ({"frame_stride": 5}, "paper uses a frame every 1 steps, .* hold one every 5"),
        ({"frame_stride": 10, "recipe": ("best",)}, "best uses a frame every 5 steps"),
        ({"frame_stride": 5, "policy": ("act",), "encoder": (OWN,)}, "a frame of every step"),
        ({"policy": ("act",), "ablation": (Ablation(change=("clock=true",)),)}, "reads no recipe"),
        ({"randomisation": RandomisationConfig(appearance="heldout")}, "held out for tests"),
        ({"randomisation": RandomisationConfig(**NARROW)}, "makes 'insert' impossible"),
    ],
)
def test_a_grid_that_cannot_be_trained_is_refused_when_it_is_planned(changed, told, tmp_path):
    with pytest.raises(InputError, match=told):
        plan(replace(GRID, **changed), tmp_path)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"pool": "spatal"}, "Did you mean 'spatial'"),
        ({"policies": [{**POLICY, "pool": "maps"}]}, "Unknown pool 'maps'"),
        ({"policies": [{**POLICY, "change": ["frame_stride=2"]}]}, ""),
        ({"demonstrations": [{**DEMONSTRATIONS, "frame_stride": 5}]}, "hold one every 5"),
        ({"env": {"action_repeat": 2}}, "hold one every 2"),
        ({"policies": [{**POLICY, "subtask": "insert"}]}, "taken from whole procedures"),
        (
            {
                "demonstrations": [{**DEMONSTRATIONS, "view": []}],
                "policies": [{**POLICY, "view": []}],
            },
            "few: a policy is trained on them, and view is empty",
        ),
        # Further attempts are those of the subtask that is learned, not of the whole procedure.
        ({"demonstrations": [WHOLE], "policies": [{**TRYING, "subtask": "grasp"}]}, ""),
        ({"demonstrations": [WHOLE], "policies": [{**TRYING, "subtask": "place"}]}, "no further"),
        ({"demonstrations": [WHOLE], "policies": [TRYING]}, "no further attempts"),
        ({"env": {"randomisation": NARROW}}, "demonstrations seed0/few: .* impossible"),
        (
            {"conditions": [{"name": "any", "env": {"randomisation": NARROW}}]},
            "condition any: .* impossible",
        ),
        (
            {
                "env": {"randomisation": {"pair": "any"}},
                "conditions": [{"name": "any", "shift": {"axis": "needle", "strength": 1.0}}],
            },
            "condition any: .* impossible",
        ),
    ],
)
def test_a_plan_that_cannot_be_trained_or_evaluated_is_refused(changed, told, tmp_path):
    built = plan_of({**TABLE, **changed}, "a test")
    if not told:
        assert [state.state for state in plan(built, tmp_path)] == [TO_DO]
        return
    with pytest.raises(InputError, match=told):
        plan(built, tmp_path)


def test_a_world_is_refused_only_where_a_chosen_run_needs_it(tmp_path):
    """So a sweep that was begun with such a condition can be continued without it."""
    conditions = [{"name": "plain"}, {"name": "any", "env": {"randomisation": NARROW}}]
    built = plan_of({**TABLE, "conditions": conditions}, "a test")
    choice = read_choice(["condition=plain"], built.runs)
    assert [state.state for state in plan(built, tmp_path, choice)] == [TO_DO, LEFT]


def test_a_release_is_refused_before_any_work_too(tmp_path, monkeypatch):
    monkeypatch.setenv(released.VARIABLE, str(tmp_path / "released"))
    built = plan_of({**TABLE, "policies": [POLICY, {**ON_FEW, "name": "hlp"}]}, "a test")
    with pytest.raises(InputError, match="learns which subtask is due from whole procedures"):
        run_release(built, tmp_path / "out", None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"demonstrations": [{**DEMONSTRATIONS, "name": ""}]}, "a name is ''"),
        ({"demonstrations": [{**DEMONSTRATIONS, "name": "../few"}]}, "a name is '../few'"),
        ({"policies": [{**POLICY, "name": ""}]}, "a name is ''"),
        ({"policies": [{**POLICY, "name": "suture"}]}, "'suture' is the whole procedure"),
        ({"conditions": [{"name": "light/dark"}]}, "a name is 'light/dark'"),
        ({"procedure": {"terminatoin": "learned"}}, "Did you mean 'termination'"),
        ({"policies": [{**POLICY, "part": "place"}]}, "'place', and it is trained on 'insert'"),
        ({"policies": [{**POLICY, "part": "hlp"}]}, "part 'hlp', and its policy is 'bc'"),
        (
            {
                "policies": [{**POLICY, "view": []}],
                "conditions": [{"name": "aimed", "aimed": True}],
            },
            "'seeing' sees no images",
        ),
        (
            {
                "demonstrations": [
                    {**DEMONSTRATIONS, "learner": "second"},
                    {**DEMONSTRATIONS, "name": "more", "demonstrator": "multiply", "of": "few"},
                ],
                "policies": [POLICY, {**POLICY, "name": "second", "demonstrations": "more"}],
            },
            "'few', which they build on .* has a learner, 'second'",
        ),
        (
            {
                "demonstrations": [
                    DEMONSTRATIONS,
                    {
                        **DEMONSTRATIONS,
                        "name": "driven",
                        "learner": "seeing",
                        "env": {"scene": {"tissue": "soft"}},
                    },
                ]
            },
            "rendered with those of 'few', so both need the same task, env",
        ),
        (
            {
                "demonstrations": [
                    {**DEMONSTRATIONS, "visits_of": "whole", "env": {"max_steps": 300}},
                    {**DEMONSTRATIONS, "name": "whole", "task": "suture"},
                ]
            },
            "rendered with those of 'whole', so both need the same task, env",
        ),
    ],
)
def test_a_plan_whose_parts_do_not_fit_is_refused(changed, told):
    with pytest.raises(InputError, match=told):
        plan_of({**TABLE, **changed}, "a test")


@pytest.mark.parametrize(
    ("line", "told"),
    [("seed: []", "The grid has 0 runs"), ("env: {task: place}", "env has 'task'")],
)
def test_a_wrong_grid_over_algorithms_is_refused(line, told, tmp_path):
    path = tmp_path / "grid.yaml"
    path.write_text(f"task: grasp\nalgo: bc\n{line}\n")
    with pytest.raises(InputError, match=told):
        read_experiment(path)


@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED.glob("*.yaml")))
def test_every_shipped_file_can_be_run_and_tried_in_minutes(name, tmp_path):
    whole = read_experiment(SHIPPED / f"{name}.yaml")
    asked = {"demonstrations": 3, "episodes": 2}
    asked |= {} if isinstance(whole, RLGrid) else {"epochs": 1, "size": 64}
    tried = whole.smaller(**asked)
    assert 1 <= len(plan(tried, tmp_path)) <= len(plan(whole, tmp_path))
    assert {run.demonstrations for run in tried.runs if run.dagger_rounds == 0} <= {3, None}


def test_policies_that_differ_in_nothing_but_names_are_one_run():
    """What is compared by its number of demonstrations is so, where all get the same number."""
    more = {**DEMONSTRATIONS, "name": "more", "episodes": 3}
    others = {"name": "other", "demonstrations": "more", "view": ["back"]}
    table = {**TABLE, "demonstrations": [DEMONSTRATIONS, more], "policies": [POLICY, others]}
    built = plan_of(table, "a test")
    assert len(built.runs) == 2 and len(built.smaller(demonstrations=2).runs) == 1
    table["demonstrations"] = [DEMONSTRATIONS, {**more, "jaw_noise": 1.0}]
    with pytest.raises(InputError, match="'seeing' and 'other' have the same run"):
        plan_of(table, "a test").smaller(demonstrations=2)


def test_the_runs_of_another_sweeps_folder_are_not_listed(tmp_path, capsys):
    path = tmp_path / "grid.yaml"
    path.write_text("task: grasp\nencoder: random-conv\nview: back\n")
    command = ["sweep", str(path), "--out", str(tmp_path / "out"), "--dry-run"]
    assert main(command) == 0
    (tmp_path / "out").mkdir()
    table = {"format": FORMAT, GRID.kind: dict(GRID.table())}
    files.write_json(tmp_path / "out" / GRID_FILE, table)
    capsys.readouterr()
    assert main(command) == 2
    assert "holds another sweep" in capsys.readouterr().err


def test_a_newer_distribution_of_an_encoder_makes_other_cells(tmp_path, monkeypatch):
    info = tmp_path / "their_parts.dist-info"
    info.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    register_encoder("theirs", TINY, "their-parts")
    try:
        grid = replace(GRID, encoder=("theirs", "random-conv"))

        def keys(version):
            text = f"Metadata-Version: 2.1\nName: their-parts\nVersion: {version}\n"
            (info / "METADATA").write_text(text)
            return [Jobs(grid, tmp_path).run(run).key() for run in grid.runs]

        first = keys("1.0")
        assert keys("1.0") == first
        theirs, ours = keys("1.1")
        assert theirs != first[0] and ours == first[1]
    finally:
        ENCODERS.unregister("theirs")
