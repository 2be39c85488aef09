"""Policies are pushed to and pulled from a Hub that is a folder."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from checkpoints import checkpoint
from fake_hub import FakeHub

from surgicai_vision.commands.main import main
from surgicai_vision.commands.policy import push
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, SurgicaiError
from surgicai_vision.evaluation.statistics import clopper_pearson
from surgicai_vision.evaluation.storage import FORMAT
from surgicai_vision.scene import build_scene
from surgicai_vision.training.checkpoint import CARD, WEIGHTS, Checkpoint, read_checkpoint
from surgicai_vision.training.hub import Successes, model_card, pull_policy, push_policy
from surgicai_vision.training.run_config import Shift

REPO = "somebody/suturing-grasp-bc"
SUCCESSES = Successes(count=18, episodes=20, interval=(0.683, 0.988), seeds=tuple(range(7, 27)))


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return Path(checkpoint(tmp_path / "policy", "grasp"))


@pytest.fixture
def fake_hub(tmp_path: Path) -> FakeHub:
    return FakeHub(tmp_path / "hub")


def test_what_is_pushed_is_what_is_pulled(tmp_path: Path, policy: Path, fake_hub: FakeHub) -> None:
    (policy / "training.json").write_text("{}")
    address = push_policy(policy, REPO, private=True, api=fake_hub)
    assert address == f"https://hub/{REPO}"
    assert fake_hub.asked[0] == ("create_repo", REPO, "model", True, True)
    pushed = sorted(path.name for path in fake_hub.folder.iterdir())
    assert pushed == ["README.md", CARD, WEIGHTS]
    pulled = pull_policy(REPO, tmp_path / "pulled", api=fake_hub)
    assert pulled == read_checkpoint(policy)
    assert pulled.folder == tmp_path / "pulled"
    assert sorted(path.name for path in pulled.folder.iterdir()) == pushed
    assert not list(tmp_path.glob("*.work"))
    with pytest.raises(OutputExists):
        pull_policy(REPO, tmp_path / "pulled", api=fake_hub)


def test_the_card_tells_data_recipe_seed_scene_successes_and_licence(policy: Path) -> None:
    trained = read_checkpoint(policy)
    _, header, body = model_card(trained, REPO, "cc-by-4.0", SUCCESSES).split("---\n", 2)
    table = yaml.safe_load(header)
    assert table["license"] == "cc-by-4.0"
    assert table["library_name"] == "surgicai-vision"
    (result,) = table["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == 0.9
    for part in (
        trained.policy_sha256,
        build_scene(SceneConfig()).hash,
        "recipe `paper`",
        "learning_rate: 0.001",
        "| training seed | 0 |",
        "1 demonstration, 0 of them held out",
        "18/20 (95 % interval 68–99 %), start seeds 7 to 26",
        "| licence | cc-by-4.0 |",
    ):
        assert part in body, part
    assert "model-index" not in model_card(trained, REPO)


@pytest.mark.parametrize(
    ("algo", "learning"),
    [(None, "imitation"), ("bc", "imitation"), ("td3-her-bc", "reinforcement")],
)
def test_the_card_tells_how_it_was_trained(policy: Path, algo: str | None, learning: str) -> None:
    trained = read_checkpoint(policy)
    trained = replace(trained, run=replace(trained.run, algo=algo, env_steps=24))
    _, header, body = model_card(trained, REPO).split("---\n", 2)
    assert yaml.safe_load(header)["tags"] == [
        "surgical-robotics", "suturing", f"{learning}-learning",
    ]  # fmt: skip
    assert f"trained by {learning} learning" in body


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_what_was_changed_is_refused_in_one_line(
    tmp_path: Path, policy: Path, fake_hub: FakeHub, name: str
) -> None:
    push_policy(policy, REPO, api=fake_hub)
    changed = fake_hub.folder / name
    content = bytearray(changed.read_bytes())
    content[-4] ^= 1
    changed.write_bytes(bytes(content))
    with pytest.raises(BadFile, match=f"{REPO} holds no usable policy: .*{name}") as info:
        pull_policy(REPO, tmp_path / "pulled", api=fake_hub)
    assert "\n" not in str(info.value)
    assert "fetched" not in str(info.value)
    assert not (tmp_path / "pulled").exists()


def test_a_changed_value_of_the_card_is_refused(
    tmp_path: Path, policy: Path, fake_hub: FakeHub
) -> None:
    push_policy(policy, REPO, api=fake_hub)
    card = json.loads((fake_hub.folder / CARD).read_text())
    (fake_hub.folder / CARD).write_text(json.dumps({**card, "frames": 1_000_000}))
    with pytest.raises(BadFile, match="hash does not match"):
        pull_policy(REPO, tmp_path / "pulled", api=fake_hub)


def test_a_refusal_is_one_line(tmp_path: Path, policy: Path) -> None:
    refusing = FakeHub(tmp_path / "hub", OSError("403 Forbidden\nYou need a token"))
    with pytest.raises(SurgicaiError, match=f"The Hub refused {REPO}: 403 Forbidden$"):
        push_policy(policy, REPO, api=refusing)
    with pytest.raises(SurgicaiError, match="The Hub refused"):
        pull_policy(REPO, tmp_path / "pulled", api=refusing)
    with pytest.raises(InputError, match="user/name"):
        push_policy(policy, "nobody")
    assert not (tmp_path / "pulled").exists()


def test_the_commands_show_the_card_and_say_when_offline(
    tmp_path: Path, policy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["policy", "push", str(policy), "--repo", REPO, "--dry-run"]) == 0
    assert "license: mit" in capsys.readouterr().out
    assert main(["policy", "push", str(policy), "--repo", "../b", "--dry-run"]) == 2
    assert "not a valid name on the Hub" in capsys.readouterr().err
    for arguments in (
        ["push", str(policy), "--repo", REPO],
        ["pull", REPO, "--out", str(tmp_path / "pulled")],
    ):
        assert main(["policy", *arguments]) == 1
        assert "HF_HUB_OFFLINE is set" in capsys.readouterr().err
    assert main(["policy", "push", str(policy)]) == 2
    assert "--repo USER/NAME" in capsys.readouterr().err


def write_stored(folder: Path, trained: Checkpoint, **changes: object) -> None:
    """Write the marker of an evaluation of a policy, whose run is changed."""
    counts = {"successes": 2, "episodes": 2, "ci95": [0.9, 1.0]}  # not those of the episodes
    stored = {
        "format": FORMAT,
        "run": to_mapping(replace(trained.run, **changes)),
        "summary": {"task": "grasp", "policy": "mine", **counts},
        "about": {"checkpoint": {"policy_sha256": trained.policy_sha256}},
    }
    (folder / "evaluation.json").write_text(json.dumps(stored))


@pytest.fixture
def seeds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of the starts that an evaluation is read to have."""
    found = [names.TEST_SEED, names.TEST_SEED + 1]
    monkeypatch.setattr(
        "surgicai_vision.evaluation.storage.read_rows",
        lambda _: [{"seed": seed, "success": seed == found[0]} for seed in found],
    )
    return found


def test_successes_are_counted_from_the_episodes_of_this_policy(
    tmp_path: Path, policy: Path, seeds: list[int]
) -> None:
    trained = read_checkpoint(policy)
    write_stored(tmp_path, trained)
    found = push._successes(tmp_path, trained)
    assert found == Successes(1, 2, clopper_pearson(1, 2), tuple(seeds))
    write_stored(tmp_path, replace(trained, policy_sha256="0" * 64))
    with pytest.raises(InputError, match="of another policy"):
        push._successes(tmp_path, trained)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"env": TaskConfig("grasp", tolerance="released")}, "world or rules"),
        ({"env": TaskConfig("grasp", scene=SceneConfig(grasp="attach"))}, "world or rules"),
        ({"shift": Shift("light", 0.5)}, "a shift"),
        ({"upset": True}, "upset on purpose"),
        ({"detector": "12345678"}, "aimed by a detector"),
        ({"acted_by": ("samples=8",)}, "settings of acting"),
    ],
)
def test_successes_in_another_world_are_not_the_policys(
    changes: dict[str, object], said: str, tmp_path: Path, policy: Path, seeds: list[int]
) -> None:
    trained = read_checkpoint(policy)
    write_stored(tmp_path, trained, **changes)
    with pytest.raises(InputError, match=said):
        push._successes(tmp_path, trained)


@pytest.mark.parametrize("seed", [7, names.VALIDATION_SEED])
def test_successes_on_starts_that_are_not_held_out_are_refused(
    seed: int, tmp_path: Path, policy: Path, seeds: list[int]
) -> None:
    trained = read_checkpoint(policy)
    write_stored(tmp_path, trained)
    seeds[0] = seed
    with pytest.raises(InputError, match="not held out"):
        push._successes(tmp_path, trained)
