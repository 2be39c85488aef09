"""Plans with rounds of DAgger: a policy is trained, acts in further demonstrations, and so on."""

import inspect
from contextlib import contextmanager

import pytest

from surgicai_vision.commands.console import QuietConsole
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import open_dataset
from surgicai_vision.demos.store import list_demos, read_demo, read_marker
from surgicai_vision.experiments import prepare
from surgicai_vision.experiments.plan_config import plan_of
from surgicai_vision.experiments.sweep import driver
from surgicai_vision.experiments.sweep.driver import run_sweep
from surgicai_vision.experiments.sweep.jobs import train_policy
from surgicai_vision.experiments.sweep.plan import Jobs, plan
from surgicai_vision.report.experiment_key import condition_of
from surgicai_vision.report.pairs import factor
from surgicai_vision.training.checkpoint import read_checkpoint

SEEN = {"task": "place", "episodes": 2, "noise": 0.3, "view": ["back"]}
TABLE = {
    "size": 32,
    "encoder": "random-conv",
    "pool": "spatial",
    "recipe": "best",
    "episodes": 1,
    "epochs": 1,
    "demonstrations": [  # not in the order in which they are made
        {**SEEN, "name": "third", "learner": "second"},
        {**SEEN, "name": "first"},
        {**SEEN, "name": "second", "learner": "first", "episodes": 1},
    ],
    "policies": [
        {"name": name, "demonstrations": name, "view": ["back"]}
        for name in ("first", "second", "third")
    ],
    "conditions": [
        {"name": "all that act"},
        {"name": "before", "policies": ["first"]},
    ],
}


@pytest.fixture(scope="module")
def tiny():
    """The plan of this module's tests."""
    return plan_of(TABLE, "a test")


@pytest.fixture(scope="module")
def swept(tiny, tmp_path_factory):
    """The finished plan's folder, and the call's result."""
    out = tmp_path_factory.mktemp("learner") / "out"
    return out, run_sweep(tiny, out, RunContext(0, stage=QuietConsole().stage))


def seeds(folder):
    return {read_demo(path).seed for path in list_demos(folder / "demos")}


def test_each_round_is_driven_by_the_policy_of_the_one_before_and_holds_its_demonstrations(
    swept, tiny
):
    out, result = swept
    assert (result["done"], result["failed"]) == (2, 0), result["problems"]
    jobs = Jobs(tiny, out)
    held = {"first": 2, "second": 2 + 1, "third": 2 + 1 + 2}
    for name, episodes in held.items():
        folder = jobs.data_folder(f"seed0/{name}")
        assert len(set(open_dataset(folder / "dataset").episode_index)) == episodes
        request = read_marker(folder / "demos")["request"]
        before = tiny.learners.get(f"seed0/{name}")
        if before is None:
            assert name == "first" and "learner" not in request
        else:
            learner = read_checkpoint(jobs.policy_folder(before))
            assert request["learner"] == learner.policy_sha256
            assert learner.run.demonstrations == held[before.dataset.removeprefix("seed0/")]
            assert learner.run.dagger_rounds == list(held).index(name) - 1
    all_seeds = [seeds(jobs.data_folder(f"seed0/{name}")) for name in held]
    assert not set.intersection(*all_seeds[:2]) and not set.intersection(*all_seeds[1:])


def test_a_policy_is_told_every_folder_of_demonstrations_that_its_dataset_shows(
    tiny, tmp_path, monkeypatch
):
    """One that plans chunks reads the actions of the frames that were not rendered there."""
    rendered = {}
    monkeypatch.setattr(prepare, "record", lambda *arguments, **options: None)
    monkeypatch.setattr(
        prepare, "render_demos", lambda demos, out, **options: rendered.update({out: list(demos)})
    )
    jobs = Jobs(tiny, tmp_path)
    for run in tiny.runs:
        for part in tiny.parts(run).values():
            folder = jobs.data_folder(part.dataset)
            prepare.make_dataset(tiny.datasets[part.dataset], folder, RunContext(0))
            job = jobs.policy(part)
            assert job.arguments["demos"] == [str(path) for path in rendered[folder / "dataset"]]
            inspect.signature(train_policy).bind(folder, **job.arguments)
    counts = [len(folders) for folders in rendered.values()]
    assert counts == [3, 1]


def test_a_learner_is_counted_where_a_condition_names_it(swept, tiny):
    assert [(run.condition, run.dagger_rounds) for run in tiny.runs] == [
        ("all that act", 2),
        ("before", 0),
    ]
    assert tiny.names == ("third",), "what is released"


def test_a_sweep_broken_off_after_a_learner_goes_on_from_it(swept, tiny, tmp_path):
    def policies():
        return {path: path.stat().st_mtime_ns for path in tmp_path.glob("policies/*/*.safetensors")}

    @contextmanager
    def broken_off(title, unit):
        if title.startswith("demos") and policies():
            raise KeyboardInterrupt
        yield lambda done, total, unit="": None

    with pytest.raises(KeyboardInterrupt):
        run_sweep(tiny, tmp_path, RunContext(0, stage=broken_off))
    first = policies()
    assert len(first) == 1
    again = run_sweep(tiny, tmp_path, RunContext(0, stage=QuietConsole().stage))
    assert again["digest"] == swept[1]["digest"]
    assert len(policies()) == 3 and first.items() <= policies().items()


def test_the_report_pairs_a_policy_with_its_learner(swept, tiny):
    out, _ = swept
    jobs = Jobs(tiny, out)
    runs = {run.dagger_rounds: jobs.experiment.parts(run) for run in tiny.runs}
    trained = {
        rounds: read_checkpoint(jobs.policy_folder(next(iter(parts.values())))).run
        for rounds, parts in runs.items()
    }
    first, last = (condition_of(trained[rounds]) for rounds in (0, 2))
    assert factor(first, last) == "rounds of DAgger"
    assert "rounds of DAgger: 2" in last.label


def test_a_misspelt_recipe_of_a_learner_is_refused_before_any_work(tmp_path):
    policies = [{**TABLE["policies"][0], "recipe": "bets"}, *TABLE["policies"][1:]]
    wrong = plan_of({**TABLE, "policies": policies, "conditions": [{"name": "a"}]}, "a test")
    with pytest.raises(InputError, match="Did you mean 'best'"):
        plan(wrong, tmp_path)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"learner": "scond"}, "Did you mean 'second'"),
        ({"learner": "third"}, "trained on 'third'"),
        ({"learner": "second", "task": "insert"}, "acts in insert"),
        ({"learner": "second", "demonstrator": "multiply", "of": "first"}, "leave out learner"),
        ({"learner": "second", "episodes": 4000}, "a training seed"),
    ],
)
def test_a_wrong_learner_is_refused(changed, told):
    demonstrations = [{**TABLE["demonstrations"][0], **changed}, *TABLE["demonstrations"][1:]]
    if changed.get("episodes"):
        demonstrations[1] = {**demonstrations[1], "episodes": 4000}
    with pytest.raises(InputError, match=told):
        plan_of({**TABLE, "demonstrations": demonstrations}, "a test")


def test_other_policies_are_trained_beside_a_learner_and_come_out_the_same(tmp_path, monkeypatch):
    table = {
        **TABLE,
        "demonstrations": [*TABLE["demonstrations"], {**SEEN, "name": "other", "task": "grasp"}],
        "policies": [
            *TABLE["policies"],
            {"name": "other", "demonstrations": "other", "view": ["back"]},
        ],
        "conditions": [{"name": "all that act"}],
    }
    both = plan_of(table, "a test")
    trained = []
    train = driver._Sweep._train

    def noted(self, policies):
        asked = list(policies)
        trained.append([policy.dataset.removeprefix("seed0/") for policy in asked])
        return train(self, asked)

    monkeypatch.setattr(driver._Sweep, "_train", noted)
    alone = run_sweep(both, tmp_path / "alone", RunContext(0, stage=QuietConsole().stage))
    assert trained == [["first"], ["second"], ["third", "other"]]
    trained.clear()
    beside = run_sweep(both, tmp_path / "beside", RunContext(2, stage=QuietConsole().stage))
    assert trained == [["first", "other"], ["second"], ["third", "other"]]
    assert beside["digest"] == alone["digest"] and beside["failed"] == 0
