"""Plans that render demonstrations in several looks and multiply a few, tiny, end to end."""

import numpy as np
import pytest

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.core.config import RandomisationConfig, digest
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset.reader import open_dataset
from surgicai_vision.demos.store import list_demos, read_demo, read_marker
from surgicai_vision.evaluation.storage import read_evaluation
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.plan import Jobs, plan, run_key, training_key
from surgicai_vision.report import collect
from surgicai_vision.report.experiment_key import condition_of
from surgicai_vision.report.groups import group
from surgicai_vision.report.pairs import compare, factor
from surgicai_vision.report.retention import looks as looks_kept
from surgicai_vision.training.checkpoint import read_checkpoint

FEW = {"name": "few", "task": "place", "episodes": 2, "view": ["back"], "noise": 0.0}
MANY = {"name": "many", "demonstrator": "multiply", "of": "few", "episodes": 3}
LOOKS = {"appearance": "train", "variants": 2}
TABLE = {
    "size": 32,
    "encoder": "random-conv",
    "pool": "spatial",
    "recipe": "unmoved",
    "episodes": 1,
    "epochs": 1,
    "env": {"max_steps": 10},
    "demonstrations": [
        {**FEW, "env": {"max_steps": 200}},
        {**FEW, **MANY, **LOOKS, "env": {"max_steps": 200}},
    ],
    "policies": [
        {"name": "few", "demonstrations": "few", "view": ["back"]},
        {"name": "many", "demonstrations": "many", "view": ["back"]},
    ],
    "conditions": [
        {"name": "plain"},
        {"name": "held in", "env": {"randomisation": {"appearance": "train"}}},
        {"name": "held out", "env": {"randomisation": {"appearance": "heldout"}}},
    ],
}


@pytest.fixture(scope="module")
def tiny():
    """The plan of this module's tests."""
    return plan_of(TABLE, "a test")


@pytest.fixture(scope="module")
def swept(tiny, tmp_path_factory):
    """The finished plan's folder, and the call's result."""
    out = tmp_path_factory.mktemp("looks") / "out"
    return out, run_sweep(tiny, out, RunContext(0, stage=QuietConsole().stage))


def test_a_few_demonstrations_are_multiplied_and_rendered_in_several_looks(swept):
    out, result = swept
    assert (result["done"], result["failed"]) == (6, 0), result["problems"]
    few, many = (out / "data/seed0" / name for name in ("few", "many"))
    starts = {read_demo(path).seed for path in list_demos(few / "demos")}
    assert not starts & {read_demo(path).seed for path in list_demos(many / "demos")}
    marker = read_marker(many / "demos")
    assert len(marker["sources"]) == 3 and set(marker["sources"]) <= set(marker["request"]["demos"])
    plain, looks = (open_dataset(folder / "dataset") for folder in (few, many))
    assert (plain.variants, looks.variants) == (1, 2)
    assert len(np.unique(looks.demonstration_index)) == 3
    assert len(np.unique(looks.episode_index)) == 6
    assert looks.config.randomisation == RandomisationConfig(appearance="train")


def test_a_policy_counts_demonstrations_and_not_looks(swept, tiny):
    out, _ = swept
    jobs = Jobs(tiny, out)
    trained = {
        name: read_checkpoint(jobs.policy_folder(part)).run
        for run in tiny.runs
        for name, part in tiny.parts(run).items()
    }
    assert (trained["few"].demonstrations, trained["few"].variants) == (2, None)
    assert (trained["many"].demonstrations, trained["many"].multiplied_from) == (3, 2)
    assert trained["many"].variants.request == {"appearance": "train", "count": 2}


def test_it_is_evaluated_in_the_world_of_the_plan_and_not_in_the_looks_it_learned_from(swept, tiny):
    out, _ = swept
    for state in plan(tiny, out):
        stored = read_evaluation(out / "runs" / state.key / "evaluation").run
        expected = {"plain": "", "held in": "train", "held out": "heldout"}[stored.condition]
        assert stored.env.randomisation == RandomisationConfig(appearance=expected)
        assert stored.env.max_steps == 10


def test_the_report_tells_looks_and_multiplied_demonstrations_apart(swept, tiny):
    groups = group(collect(swept[0]))
    labels = " ".join(item.label for item in groups)
    assert "2 looks (train)" in labels and "multiplied from 2" in labels
    assert {pair.factor for pair in compare(groups)} == {"condition"}, "two things differ"
    kept = [(row[2].split()[0], row[3].split()[0]) for row in looks_kept(groups)]
    assert kept == [("0/1", "0/1")] * 2, "held-in and held-out looks of both policies"
    changed = {"change": ["epochs=2"]}
    table = {
        **TABLE,
        "demonstrations": [FEW, {**FEW, **MANY}, {**FEW, **LOOKS, "name": "looks"}],
        "policies": [
            {"name": "few", "demonstrations": "few", **changed},
            {"name": "many", "demonstrations": "many"},
            {"name": "looks", "demonstrations": "looks", **changed},
        ],
    }
    few, many, looks = (condition_of(run) for run in plan_of(table, "a test").runs[:3])
    assert factor(few, many) == "multiplied demonstrations"
    assert (factor(few, looks), factor(many, looks)) == ("looks", "")


def test_what_a_plan_does_not_use_is_no_part_of_its_keys():
    """Golden keys from before demonstrations had looks: sweeps begun then still continue."""
    whole = {"name": "whole", "task": "suture", "episodes": 2, "view": ["back"]}
    parts = ("grasp", "place", "insert", "handoff", "pullout")
    policies = [{"name": name, "demonstrations": "whole", "subtask": name} for name in parts]
    policies.append({"name": "hlp", "demonstrations": "whole", "policy": "hlp", "view": ["back"]})
    table = {
        "size": 32,
        "encoder": "random-conv",
        "pool": "spatial",
        "recipe": "best",
        "episodes": 1,
        "epochs": 1,
        "demonstrations": [whole],
        "policies": policies,
        "conditions": [{"name": "a"}],
    }
    built = plan_of(table, "a test")
    trained = {training_key(part) for run in built.runs for part in built.parts(run).values()}
    keys = [[run_key(run) for run in built.runs], sorted(trained)]
    assert digest(keys)[:16] == "508d3b901a5a8be6"
    other = plan_of({**table, "demonstrations": [{**whole, **LOOKS}]}, "a test")
    assert not {run_key(run) for run in built.runs} & {run_key(run) for run in other.runs}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"variants": 3}, "without a look to draw"),
        ({"appearance": "train", "variants": 0}, "variants"),
        ({"appearance": "trian"}, "Did you mean 'train'"),
        ({"appearance": "heldout"}, "held out for tests"),
        ({"env": {"randomisation": {"appearance": "liver"}}}, "held out for tests"),
        ({"demonstrator": "multiply"}, "of: NAME"),
        ({"of": "few"}, "of: NAME"),
        ({**MANY, "of": "fwe"}, "Did you mean 'few'"),
        ({**MANY, "of": "many"}, "not multiplied"),
        ({**MANY, "task": "insert"}, "not multiplied"),
    ],
)
def test_wrong_demonstrations_are_refused(changed, told):
    with pytest.raises(InputError, match=told):
        plan_of({**TABLE, "demonstrations": [FEW, {**FEW, "name": "many", **changed}]}, "a test")
