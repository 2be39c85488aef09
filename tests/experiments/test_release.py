"""`release`, tiny, from scratch to the cards; `policies`; and checks of released policies."""

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.errors import BadFile, InputError, UnknownName
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.experiments.plan_config import read_plan
from surgicai_vision.training import released
from surgicai_vision.training.checkpoint import WEIGHTS
from surgicai_vision.training.policies import load_policy

PLAN = {
    "licence": "MIT",
    "size": 32,
    "encoder": "imagenet-lite-early",
    "pool": "spatial",
    "recipe": "best",
    "seed": 0,
    "episodes": 2,
    "epochs": 1,
    "procedure": {"max_steps": 30, "steps": 10},
    "demonstrations": [{"name": "whole", "task": "suture", "episodes": 3, "view": ["back"]}],
    "policies": [
        {"name": "grasp", "demonstrations": "whole", "subtask": "grasp", "view": ["back"]},
        *(
            {"name": name, "demonstrations": "whole", "subtask": name}
            for name in names.SUBTASKS[1:]
        ),
        {"name": "hlp", "demonstrations": "whole", "policy": "hlp"},
    ],
}


COMMAND = ("release", "--plan", "plan.yaml", "--workers", "1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder for the work, the plan and the released policies of this module's tests."""
    path = tmp_path_factory.mktemp("release")
    (path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    return path


@contextlib.contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Work in the folder, with its own policies and features."""
    with pytest.MonkeyPatch.context() as patch:
        work_in(folder, patch)
        yield


def work_in(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Work in the folder until `patch` is undone."""
    patch.chdir(folder)
    patch.setenv(released.VARIABLE, str(folder / "released"))
    patch.setenv("SURGICAI_VISION_CACHE", str(folder / "cache"))


@pytest.fixture(autouse=True)
def here(folder, monkeypatch):
    """Work in the folder, by the test's own `monkeypatch`: patches are undone in order."""
    work_in(folder, monkeypatch)


@pytest.fixture(scope="module")
def built(folder):
    """The result of the command that builds all policies, which then stay there."""
    said = io.StringIO()
    with working_in(folder), contextlib.redirect_stdout(said):
        assert main([*COMMAND, "--json"]) == 0
    return json.loads(said.getvalue().splitlines()[-1])


def run(capsys, *arguments):
    """Run a command; return its exit code and its JSON result."""
    code = main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def changed(name, **fields):
    """Change a card by hand."""
    path = released.released_folder() / name / released.CARD
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


@pytest.fixture
def as_built(built):
    """Put the cards back after a test that changes them."""
    cards = list(released.released_folder().glob(f"*/{released.CARD}"))
    before = {path: path.read_bytes() for path in cards}
    yield
    for path, content in before.items():
        path.write_bytes(content)


def test_nothing_is_released_before_it_is_built(tmp_path, capsys):
    with pytest.MonkeyPatch.context() as patch:  # undone before `here`, whatever else is patched
        patch.setenv(released.VARIABLE, str(tmp_path / "released"))
        with pytest.raises(InputError, match=r"no policy is released .* `surgicai-vision release`"):
            open_policy("released:grasp")
        code, listed = run(capsys, "policies")
    assert code == 0 and listed["policies"] == []


def test_one_command_builds_all_and_continues_where_it_was(built, capsys):
    assert [card["name"] for card in built["policies"]] == [*names.SUBTASKS, "hlp", "suture"]
    work = sorted(path for path in Path("outputs/release").rglob("*") if path.is_file())
    times = [path.stat().st_mtime_ns for path in work if path.name != "plan.json"]
    (stored,) = Path("outputs/release").glob("*/plan.json")
    whole = json.loads(stored.read_text())
    earlier = {key: whole[key] for key in whole if key in (*PLAN, "env")}
    stored.write_text(json.dumps({**earlier, "seed": 0}))  # as stored before conditions existed
    code, again = run(capsys, *COMMAND)
    assert code == 0 and again == built
    assert [path.stat().st_mtime_ns for path in work if path.name != "plan.json"] == times


def test_the_list_says_what_is_usable(built, capsys):
    _, listed = run(capsys, "policies")
    lines = {line["policy"]: line for line in listed["policies"]}
    assert set(lines) == {f"released:{name}" for name in (*names.SUBTASKS, "hlp", "suture")}
    assert all(line["usable"] and line["licence"] == "MIT" for line in lines.values())
    assert lines["released:grasp"]["successes"].endswith("/2 (starts 900000–900001)")
    assert lines["released:grasp"]["sees"] == "back"
    assert lines["released:hlp"]["successes"] == "–"


def test_every_verb_takes_a_released_policy_by_its_name(built, capsys):
    code, result = run(capsys, "evaluate", "released:grasp", "--episodes", "1", "--out", "one")
    assert code == 0 and result["task"] == "grasp"
    stored = json.loads(Path("one/evaluation.json").read_text())
    assert stored["about"]["folder"] == "released:grasp"
    assert open_policy("released:suture").run.is_hierarchical
    assert open_policy("released:suture", expert_swap="grasp").run.expert_swap == "grasp"
    assert load_policy("released:place").checkpoint.task.task == "place"
    code, _ = run(capsys, "policy", "push", "released:place", "--repo", "a/b", "--dry-run")
    assert code == 0


def test_a_wrong_name_names_the_nearest(built):
    with pytest.raises(UnknownName, match="Did you mean 'grasp'"):
        open_policy("released:grsp")
    with pytest.raises(UnknownName, match="Did you mean 'released:grasp'"):
        open_policy("released-grasp")


def test_a_policy_of_another_scene_is_refused_in_one_line(as_built, capsys):
    changed("grasp", scene_hash="0" * 64)
    with pytest.raises(InputError, match=r"`surgicai-vision release --only grasp`") as refused:
        open_policy("released:grasp")
    assert "\n" not in str(refused.value) and "000000000000" in str(refused.value)
    with pytest.raises(InputError, match="--only grasp"):
        open_policy("released:suture")
    _, listed = run(capsys, "policies")
    usable = {line["policy"]: line["usable"] for line in listed["policies"]}
    assert not usable["released:grasp"] and usable["released:place"]


def test_a_card_of_another_version_is_refused_and_still_listed(as_built, capsys):
    changed("grasp", format=99)
    with pytest.raises(BadFile, match="of another version"):
        open_policy("released:grasp")
    changed("place", no_such_field=1)
    with pytest.raises(BadFile, match="of another version"):
        open_policy("released:place")
    code, listed = run(capsys, "policies")
    assert code == 0
    assert sum(bool(line["problem"]) for line in listed["policies"]) == 2


def test_files_and_parts_that_differ_from_their_card_are_refused(as_built):
    weights = released.released_folder() / "place" / WEIGHTS
    content = weights.read_bytes()
    try:
        weights.write_bytes(content[:-1] + b"!")
        with pytest.raises(BadFile, match="sha256 differs"):
            open_policy("released:place")
    finally:
        weights.write_bytes(content)
    card = json.loads((released.released_folder() / "suture" / released.CARD).read_text())
    changed("suture", parts={**card["parts"], "place": "0" * 64})
    with pytest.raises(BadFile, match="evaluated with a different released:place"):
        open_policy("released:suture")


def test_wrong_input_is_refused_before_any_work(built, capsys, monkeypatch):
    assert main(["release", "--plan", "plan.yaml", "--only", "graps"]) == 2
    assert "Did you mean 'grasp'" in capsys.readouterr().err
    assert main(["release", "--plan", "missing.yaml"]) == 2
    Path("other.yaml").write_text(yaml.safe_dump({**PLAN, "seed": 1}))
    assert main(["release", "--plan", "other.yaml"]) == 2
    assert "another plan" in capsys.readouterr().err
    Path("views.yaml").write_text(
        yaml.safe_dump({**PLAN, "policies": [{**PLAN["policies"][0], "view": ["front"]}]})
    )
    assert main(["release", "--plan", "views.yaml"]) == 2
    monkeypatch.setenv(released.VARIABLE, "plan.yaml/released")
    assert main(["release", "--plan", "plan.yaml"]) == 2
    assert released.VARIABLE in capsys.readouterr().err


def test_the_plan_that_is_released_is_whole():
    plan = read_plan()
    counted = [policy.name for policy in plan.policies if policy.acts]
    assert sorted(counted) == sorted(names.SUBTASKS) and plan.names[-1] == names.SUTURE
    assert set(plan.suture) == {*names.SUBTASKS, "hlp"}
    assert {each.episodes for each in plan.smaller(demonstrations=3).demonstrations} == {3}
    with pytest.raises(InputError, match="epochs is 0"):
        plan.smaller(epochs=0)
