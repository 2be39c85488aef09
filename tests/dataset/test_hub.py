"""Push and pull, against a Hub that is a folder."""

import json

import pytest
import yaml
from fake_demos import render_with_fake_env, write_demos
from fake_hub import FakeHub

from surgicai_vision.commands.main import main
from surgicai_vision.core import hub, names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, SurgicaiError
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import check_dataset, open_dataset, render_demos
from surgicai_vision.dataset.hub import dataset_card, pull_dataset, push_dataset

CONFIG = TaskConfig(max_steps=12)
REPO = "somebody/suturing-grasp"


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    render_with_fake_env(monkeypatch, CONFIG)
    folder = write_demos(tmp_path / "demos", CONFIG, (1, 2))
    render_demos(folder, tmp_path / "set", size=32, depth=True, context=RunContext(0))
    return tmp_path / "set"


@pytest.fixture
def fake_hub(tmp_path):
    return FakeHub(tmp_path / "hub")


def test_what_is_pushed_is_what_is_pulled(tmp_path, dataset, fake_hub):
    (dataset / "notes.txt").write_text("mine")
    assert push_dataset(dataset, REPO, private=True, api=fake_hub) == f"https://hub/{REPO}"
    assert fake_hub.asked[0] == ("create_repo", REPO, "dataset", True, True)
    assert fake_hub.tags == {"v3.0": "commit2"}
    assert not (fake_hub.folder / "notes.txt").exists()
    report = pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)
    assert report.digest == open_dataset(dataset).meta["digest"]
    assert check_dataset(tmp_path / "pulled").problems == ()
    assert open_dataset(tmp_path / "pulled").fingerprint == open_dataset(dataset).fingerprint
    assert sorted(path.name for path in (tmp_path / "pulled").iterdir()) == [
        "README.md",
        "data",
        "meta",
    ]
    assert not list(tmp_path.glob("*.work"))
    with pytest.raises(OutputExists):
        pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)
    push_dataset(dataset, REPO, api=fake_hub)  # again: the tag moves
    assert fake_hub.tags == {"v3.0": "commit5"}


def test_a_push_replaces_the_dataset_that_was_there(tmp_path, dataset, fake_hub):
    for name in ("data/chunk-000/file-001.parquet", "notes/kept.txt"):
        (fake_hub.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (fake_hub.folder / name).write_text("of a larger one")
    push_dataset(dataset, REPO, api=fake_hub)
    assert (fake_hub.folder / "notes/kept.txt").exists()
    assert pull_dataset(REPO, tmp_path / "pulled", api=fake_hub).ok


@pytest.mark.parametrize("broken", [True, False], ids=["damaged", "interrupted"])
def test_a_pull_begins_with_nothing_of_another_or_a_damaged_one(
    tmp_path, dataset, fake_hub, monkeypatch, broken
):
    push_dataset(dataset, REPO, api=fake_hub)
    extra = fake_hub.folder / "data/chunk-000/file-001.parquet"
    extra.write_bytes((fake_hub.folder / "data/chunk-000/file-000.parquet").read_bytes())
    with monkeypatch.context() as patch:
        if not broken:
            patch.setattr("surgicai_vision.dataset.hub.check_dataset", lambda *_: 1 / 0)
        with pytest.raises(BadFile if broken else ZeroDivisionError):
            pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)
    extra.unlink()
    repo = REPO if broken else "somebody/else"
    assert pull_dataset(repo, tmp_path / "pulled", api=fake_hub).ok


def test_the_card_says_what_it_is(dataset):
    card = dataset_card(open_dataset(dataset), REPO, "cc-by-4.0")
    _, header, body = card.split("---\n", 2)
    table = yaml.safe_load(header)
    assert table["license"] == "cc-by-4.0"
    assert "LeRobot" in table["tags"]
    assert table["configs"][0]["data_files"] == "data/*/*.parquet"
    meta = json.loads((dataset / names.META_FILE).read_text())
    for part in (
        meta["digest"],
        "2 simulated demonstrations",
        names.depth_key("front"),
        names.TASK_TEXTS["grasp"],
    ):
        assert part in body


def test_damage_is_neither_pushed_nor_pulled(tmp_path, dataset, fake_hub):
    push_dataset(dataset, REPO, api=fake_hub)
    data = fake_hub.folder / "data/chunk-000/file-000.parquet"
    data.write_bytes(data.read_bytes()[:-10])
    with pytest.raises(BadFile):
        pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)
    assert not (tmp_path / "pulled").exists()
    info = dataset / "meta/info.json"
    info.write_text(info.read_text().replace('"total_episodes": 2', '"total_episodes": 3'))
    before = len(fake_hub.asked)
    with pytest.raises(BadFile, match=r"is damaged: meta/info\.json"):
        push_dataset(dataset, REPO, api=fake_hub)
    assert len(fake_hub.asked) == before


def test_a_dataset_of_others_is_not_pulled(tmp_path, dataset, fake_hub):
    push_dataset(dataset, REPO, api=fake_hub)
    (fake_hub.folder / names.META_FILE).unlink()
    with pytest.raises(BadFile, match=r"not a dataset of surgicai-vision.*lerobot-salvage check"):
        pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)


def test_a_refusal_is_one_line(tmp_path, dataset):
    fake_hub = FakeHub(tmp_path / "hub", OSError("403 Forbidden\nYou need a token"))
    with pytest.raises(
        SurgicaiError, match=r"The Hub refused somebody/suturing-grasp: 403 Forbidden$"
    ):
        push_dataset(dataset, REPO, api=fake_hub)
    with pytest.raises(SurgicaiError, match="The Hub refused"):
        pull_dataset(REPO, tmp_path / "pulled", api=fake_hub)
    assert not (tmp_path / "pulled").exists()


@pytest.mark.parametrize("name", ["", "no spaces/x", "a/b/c", "nobody", "../x", "a/b.git"])
def test_bad_names_are_refused(tmp_path, dataset, name):
    with pytest.raises(InputError, match="user/name"):
        push_dataset(dataset, name)
    with pytest.raises(InputError, match="user/name"):
        pull_dataset(name, tmp_path / "pulled")


def test_offline_is_said_at_once(tmp_path, dataset, monkeypatch, capsys):
    for arguments in (
        ["push", str(dataset), "--repo", REPO],
        ["pull", REPO, "--out", str(tmp_path / "pulled")],
    ):
        assert main(["dataset", *arguments]) == 1
        assert "HF_HUB_OFFLINE is set" in capsys.readouterr().err
    assert not list(tmp_path.glob("pulled*"))


def test_a_hub_out_of_reach_is_said_in_one_line(monkeypatch):
    def refuse(address, timeout):
        assert (address[1], timeout) == (443, hub.CONNECT_SECONDS)
        raise OSError(101, "Network is unreachable")

    for name in ("https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(hub.socket, "create_connection", refuse)
    with pytest.raises(
        SurgicaiError, match=r"at hub.example cannot be reached \(Network is unreachable\)"
    ):
        hub.reach("https://hub.example")


def test_dry_run_shows_the_card(dataset, capsys):
    assert main(["dataset", "push", str(dataset), "--repo", REPO, "--dry-run"]) == 0
    assert "license: mit" in capsys.readouterr().out
    assert main(["dataset", "push", str(dataset)]) == 2
    assert "--repo USER/NAME" in capsys.readouterr().err
    assert main(["dataset", "push", str(dataset), "--repo", "../b", "--dry-run"]) == 2
    assert "not a valid name on the Hub" in capsys.readouterr().err
