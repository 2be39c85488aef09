"""The shipped sweeps of unseen looks and of few demonstrations: what they record and evaluate."""

import json
from collections import Counter
from dataclasses import replace

import pytest

from surgicai_vision.commands.main import main
from surgicai_vision.commands.sweep import read_experiment
from surgicai_vision.core import names
from surgicai_vision.core.config import CLOCK_PERIOD, RANDOMISATION_LIMITS, TaskConfig
from surgicai_vision.core.files import configs_folder
from surgicai_vision.detection.card import RELEASED, detector_folder, read_card
from surgicai_vision.envs.feasibility import refuse_impossible
from surgicai_vision.evaluation.robustness.axes import ALL, AXES, shifted_config
from surgicai_vision.features.encoders import OFFLINE_ENCODERS
from surgicai_vision.training import policies
from surgicai_vision.training.run_config import Shift

SWEEPS = ("unmoved", "unmoved-encoders", "few-demonstrations")
PLANS = {name: read_experiment(configs_folder() / "sweep" / f"{name}.yaml") for name in SWEEPS}
UNMOVED = PLANS["unmoved"]
HALF = Shift(ALL, 0.5)


def by_condition(built):
    """Return how many runs each condition has."""
    return dict(Counter(run.condition for run in built.runs))


def shows(dataset):
    """Return the world that a dataset shows."""
    looks = dataset.demonstrations.looks
    return (looks.shown(dataset.env) if looks else dataset.env).randomisation


def test_the_recipe_is_best_with_moved_maps():
    best, unmoved = (policies.load_recipe("bc", name, {}) for name in ("best", "unmoved"))
    differ = {key for key, value in vars(best).items() if vars(unmoved)[key] != value}
    assert differ == {"map_shift"} and unmoved.map_shift == 2


@pytest.mark.parametrize("name", SWEEPS)
def test_every_run_counts_on_the_same_held_out_starts_and_learns_from_held_in_looks(name):
    built = PLANS[name]
    assert {run.starts.seeds for run in built.runs} == {range(900_000, 900_100)}
    trained = [run for run in built.runs if not built.needs(run)]
    assert {run.recipe for run in trained} == {"unmoved"}
    for dataset in built.datasets.values():
        assert not shows(dataset).shows_heldout
        assert dataset.first_seed + 4 * dataset.demonstrations.episodes < names.VALIDATION_SEED


@pytest.mark.parametrize(
    ("plain", "changed", "how"),
    [
        ("place", "place-corrupted", {"corruption": 0.5}),
        ("handoff", "handoff-robust", {"corruption": 0.5, "shift": 0.5, "aimed": True}),
    ],
)
def test_changed_images_are_of_the_demonstrations_that_clear_ones_are_of(plain, changed, how):
    for seed in UNMOVED.seed:
        clear, other = (UNMOVED.datasets[f"seed{seed}/{name}"] for name in (plain, changed))
        assert other.first_seed == clear.first_seed
        assert other.demonstrations == replace(clear.demonstrations, name=changed, **how)


def test_every_subtask_is_counted_in_looks_and_with_needles_never_shown():
    conditions = (
        "held-in looks",
        "held-out looks",
        "all axes at half strength",
        "all axes at half strength with aimed crops",
        "needles never seen",
    )
    # Two policies per subtask, three of the placement, in two training seeds; one grasp has seen
    # needles as large and as small as those that are never seen.
    assert by_condition(UNMOVED) == {
        **dict.fromkeys(conditions, 2 * 11),
        "needles never seen": 2 * 10,
    }
    assert {run.task for run in UNMOVED.runs} == set(names.SUBTASKS)
    assert UNMOVED.seed == (0, 1)
    looks = {shows(dataset).appearance for dataset in UNMOVED.datasets.values()}
    assert looks == {names.TRAIN, names.VARIED}
    worlds = {run.condition: run.env.randomisation for run in UNMOVED.runs}
    trained = worlds["held-in looks"]
    off = shifted_config(TaskConfig("grasp", randomisation=trained), AXES["needle"], 0.5)
    wide = {name for name in UNMOVED.datasets if name.endswith("/grasp-robust")}
    assert wide == {"seed0/grasp-robust", "seed1/grasp-robust"}
    for name, dataset in UNMOVED.datasets.items():
        world = off.randomisation if name in wide else trained
        assert replace(shows(dataset), appearance=names.TRAIN) == world
    unseen_by = {run.demonstrations for run in UNMOVED.runs if run.condition == conditions[-1]}
    assert unseen_by == {4000, 3500, 3000, 2000}, "and not those of `grasp-robust`"
    heldout = worlds["held-out looks"]
    assert heldout.shows_heldout and not trained.shows_heldout
    unseen = worlds["needles never seen"]
    assert set(unseen.arcs).isdisjoint(trained.arcs) and unseen.needle_size > trained.needle_size
    differ = {key for key, value in vars(unseen).items() if vars(heldout)[key] != value}
    assert differ == {"needle_arc", "needle_size", "needle_thickness"}, "the needle alone"
    shifts = {run.condition: run.shift for run in UNMOVED.runs if run.shift}
    alike, aimed = shifts
    assert shifts == {alike: HALF, aimed: HALF}
    found = read_card(detector_folder(RELEASED)).weights_sha256
    assert {run.detector for run in UNMOVED.runs if run.condition == aimed} == {found}
    assert not any(run.detector for run in UNMOVED.runs if run.condition != aimed)


@pytest.mark.parametrize("name", SWEEPS)
def test_no_world_of_theirs_is_impossible(name):
    worlds = {
        shifted_config(run.env, AXES[run.shift.axis], run.shift.strength) if run.shift else run.env
        for run in PLANS[name].runs
    }
    worlds |= {dataset.env for dataset in PLANS[name].datasets.values()}
    through = ("insert", "handoff", "pullout")
    distinct = {
        (world.scene, world.randomisation): world for world in worlds if world.task in through
    }
    assert all(
        world.randomisation.needle_size <= RANDOMISATION_LIMITS["needle_size"] for world in worlds
    )
    for world in distinct.values():
        refuse_impossible(world, through=True)


def test_encoders_meet_in_every_cell():
    built = PLANS["unmoved-encoders"]
    assert by_condition(built) == {
        "plain look": 62,
        "held-out looks": 62,
        "all axes at half strength": 60,
    }
    listed = [run for run in built.runs if built.needs(run)]
    assert {run.policy for run in listed} == {"vc1"} and len(listed) == 4
    cells = Counter((run.task, run.encoder) for run in built.runs if run not in listed)
    encoders = {*OFFLINE_ENCODERS, "imagenet", "clip", "r3m", "dinov2", "siglip2"}
    assert cells == {(task, name): 9 for task in ("grasp", "insert") for name in encoders}
    frames = {
        (each.variants, each.episodes, each.frame_stride, policy.change[-1])
        for policy in built.policies
        for each in [built.recorded(policy)]
    }
    updates = {
        variants * episodes / stride * int(change.removeprefix("epochs="))
        for variants, episodes, stride, change in frames
    }
    assert len(frames) == 6 and updates == {350 * 5 / 10 * 20}, "as many updates of each"
    assert all(run.env.randomisation.phantom_shift == 10 for run in built.runs)


def test_few_demonstrations_are_counted_as_they_are_and_multiplied():
    built = PLANS["few-demonstrations"]
    counts = Counter((run.task, run.demonstrations, run.multiplied_from) for run in built.runs)
    kinds = ((10, None), (50, None), (350, 10), (350, 50))
    assert counts == {(task, *kind): 2 for task in ("grasp", "place", "insert") for kind in kinds}
    for policy in built.policies:
        recipe = policies.recipe_of(built.training(policy, 0))
        recorded = built.recorded(policy)
        assert recorded.frame_stride == recipe.frame_stride
        assert recorded.episodes * recipe.epochs / recipe.frame_stride == 350 * 20 / 5


@pytest.mark.parametrize("name", SWEEPS)
def test_a_dry_run_lists_every_run(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", name, "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["runs"] == len(PLANS[name].runs) == told["to_do"] + told["not_run"]
    lacks = told["not_run"] - (4 if name == "unmoved-encoders" else 0)
    assert lacks % 18 == 0, "whole encoders, whose weights are not at hand"
    assert lacks <= (5 * 18 if name == "unmoved-encoders" else 0)


@pytest.mark.parametrize("name", SWEEPS)
def test_every_moment_of_an_attempt_is_seen_in_each_attempt_of_a_search(name):
    """Else a policy learns what to do at some moment of one attempt and does it in the next."""
    searches = [
        dataset.demonstrations
        for dataset in PLANS[name].datasets.values()
        if dataset.demonstrations.demonstrator == "search" and dataset.demonstrations.view
    ]
    assert all(CLOCK_PERIOD % each.frame_stride == 0 for each in searches)
