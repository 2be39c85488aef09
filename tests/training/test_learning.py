"""The verbs of the learn stage: encode, cache, train, and what a training leaves behind."""

import functools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from fake_dataset import FakeData, fake_procedures

from encoders.base import POOLS
from surgicai_vision.commands import folders, logs
from surgicai_vision.commands.main import main
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName, check_name
from surgicai_vision.dataset.made import Made
from surgicai_vision.dataset.subset import first_of_visit, of_subtask, with_frame_stride
from surgicai_vision.features import encoders
from surgicai_vision.training import policies, visits
from surgicai_vision.training.checkpoint import read_checkpoint


@dataclass
class Dataset(FakeData):
    """Four episodes of noise with every column a policy may be fed."""

    task: str = "suture"
    views: tuple[str, ...] = ("front", "back")
    image_size: int = 32
    length: int = 40
    fingerprint: str = "noise"
    path: Path = Path("noise")
    made: Made = field(default_factory=Made)
    config: TaskConfig = field(default_factory=lambda: TaskConfig("suture"))

    def __post_init__(self) -> None:
        self.episode_index = np.repeat(np.arange(4), 10)

    def frames(self, view: str, start: int, stop: int) -> np.ndarray:
        return np.random.default_rng(len(view)).integers(
            0, 256, (self.length, 32, 32, 3), np.uint8
        )[start:stop]

    def columns(self) -> dict[str, np.ndarray]:
        noise = np.random.default_rng(1).normal(size=(self.length, 49)).astype(np.float32)
        phase = np.tile(np.repeat(np.arange(5), 2), 4)
        noise[:, 7:21] += 5 * phase[:, None]  # both arms reveal the phase
        return {
            names.STATE: noise[:, :7],
            names.BOTH_ARMS: noise[:, 7:21],
            names.PRIVILEGED_STATE: noise[:, 21:42],
            names.ACTION: np.tanh(noise[:, 42:]),
            names.PHASE: phase,
            names.SUCCESS: np.tile(np.arange(10) == 9, 4),
            "frame_index": np.tile(np.arange(10), 4),
            "timestamp": np.tile(np.arange(10, dtype=np.float32) / names.FPS, 4),
        }


@pytest.fixture(autouse=True)
def noise(tiny_encoder: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run in an empty folder on a dataset of noise, with a tiny encoder and a separate cache."""

    def open_dataset(folder: str | None, task: str, views: tuple[str, ...]) -> Dataset:
        for view in views:
            check_name("view of this dataset", view, Dataset.views)
        return Dataset()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SURGICAI_VISION_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(folders, "open_dataset", open_dataset)


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict:
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 2
    return capsys.readouterr().err


def test_open_names_pools_and_licences(capsys: pytest.CaptureFixture[str]) -> None:
    assert encoders.POOLS == POOLS
    assert encoders.check_encoder_name("timm:resnet18.a1_in1k") == "timm:resnet18.a1_in1k"
    with pytest.raises(UnknownName, match="timm:<name>"):
        encoders.check_encoder_name("tmm:resnet18")
    assert "--accept-licence" in fails(capsys, "encode", "--encoder", "vc1")
    assert "pytorch_model.bin" in fails(capsys, "train", "--encoder", "vc1", "--accept-licence")
    assert "Did you mean 'spatial'" in fails(
        capsys, "encode", "--encoder", "random", "--pool", "spacial"
    )


def test_weights_are_given_for_all_or_for_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def of(name: str, *given: str) -> Path | None:
        return encoders.WeightsSource.parse(given).file_for(name)

    assert of("r3m") is None
    assert of("r3m", "a.bin") == Path("a.bin")
    assert encoders.WeightsSource.of("a.bin").file_for("r3m") == Path("a.bin")
    for both in (
        ("imagenet=a.pth,timm:resnet18.a1_in1k=b.pth,c.bin",),
        ("imagenet=a.pth", "timm:resnet18.a1_in1k=b.pth", "c.bin"),
    ):
        assert of("imagenet", *both) == Path("a.pth")
        assert of("timm:resnet18.a1_in1k", *both) == Path("b.pth")
        assert of("r3m", *both) == Path("c.bin")
    assert of("clip", "imagenet=a.pth") is None
    assert of("clip", "some/x=1.pth") == Path("some/x=1.pth")
    odd = tmp_path / "a,clip=b.bin"
    odd.write_bytes(b"")
    assert of("clip", str(odd)) == odd
    with pytest.raises(UnknownName, match="Did you mean 'imagenet'"):
        of("imagenet", "imagnet=a.pth")
    for twice in ("imagenet=a,imagenet=b", "a,b"):
        with pytest.raises(InputError, match="two files"):
            of("imagenet", twice)
    given = ("--weights", "imagenet=a.pth", "--weights", "r3m-18=none.bin")
    assert "none.bin is not a file" in fails(capsys, "encode", "--encoder", "r3m-18", *given)
    assert "a.pth is not a file" in fails(capsys, "encode", "--encoder", "imagenet", *given)


def test_cache_lists_measures_and_prunes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "cache", "list")["entries"] == []
    run(capsys, "encode", "--encoder", "tiny")
    listed = run(capsys, "cache", "list")
    assert [(row["encoder"], row["view"], row["length"]) for row in listed["entries"]].count(
        ("tiny", "back", 40)
    ) == 1
    assert run(capsys, "cache", "size")["bytes"] == listed["bytes"] > 0
    assert run(capsys, "cache", "prune", "--keep", "the/dataset")["entries"] == []
    assert "either --keep DIR or --all" in fails(capsys, "cache", "prune")
    assert "takes neither" in fails(capsys, "cache", "list", "--all")
    assert len(run(capsys, "cache", "prune", "--all")["entries"]) == 2
    assert run(capsys, "cache", "size")["bytes"] == 0
    assert "Did you mean 'prune'" in fails(capsys, "cache", "prun")


def test_epochs_recipe_and_fine_tuning(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("train", "--task", "suture", "--encoder", "tiny", "--view", "back")
    first = run(capsys, *arguments, "--epochs", "3", "--save-every", "2")
    assert first["checkpoint"] == "outputs/train/suture-tiny-back-paper+epochs=3-seed0"
    checkpoint = read_checkpoint(Path(first["checkpoint"]))
    assert (checkpoint.epoch, checkpoint.run.recipe_label) == (3, "paper+epochs=3")
    early = Path(first["checkpoint"]) / "epochs" / "epoch_0002"
    assert read_checkpoint(early).epoch == 2
    tuned = run(capsys, *arguments, "--epochs", "1", "--start", str(early), "--out", "tuned")
    fresh = run(capsys, *arguments, "--epochs", "1", "--out", "fresh")
    losses = [
        read_checkpoint(Path(result["checkpoint"])).train_losses[0] for result in (tuned, fresh)
    ]
    assert losses[0] < losses[1]
    other = ("train", "--encoder", "none", "--start", "tuned", "--out", "other")
    assert "to start from" in fails(capsys, *other)
    Path("own.yaml").write_text("epochs: 2\nhidden: [16]\n")
    own = read_checkpoint(Path(run(capsys, *arguments, "--recipe", "own.yaml")["checkpoint"]))
    assert (own.epoch, own.recipe["hidden"], own.run.recipe_label) == (2, [16], "own")


def test_controls_are_named_by_what_they_see(capsys: pytest.CaptureFixture[str]) -> None:
    state = run(capsys, "train", "--task", "suture", "--encoder", "state", "--epochs", "1")[
        "checkpoint"
    ]
    assert state.startswith("outputs/train/suture-state")
    policy = policies.load_policy(state)
    assert (
        policy.inputs.vector == (names.PRIVILEGED_STATE,) and not policy.checkpoint.proprioception
    )
    assert policy.act(None, np.zeros((2, 21), np.float32)).shape == (2, 7)
    with pytest.raises(InputError, match="21"):
        policy.act(None, np.zeros((2, 7), np.float32))
    recipe = policies.load_recipe("bc", "paper", {"privileged": True})
    with pytest.raises(InputError, match="privileged state"):
        policies.policy_plugin("bc").make(recipe, ((8,),))
    assert "leave --view out" in fails(capsys, "train", "--encoder", "state", "--view", "back")


def test_high_level_policy_learns_the_phase(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    due = functools.partial(visits.subtasks_due, ahead=0)  # these episodes are too short to shift
    monkeypatch.setattr(visits, "subtasks_due", due)
    arguments = ("train", "--task", "suture", "--policy", "hlp", "--encoder", "none")
    folder = run(capsys, *arguments, "--epochs", "60", "--recipe", "paper")["checkpoint"]
    policy, columns = policies.load_policy(folder), Dataset().columns()
    chosen = policy.choose(None, columns[names.BOTH_ARMS])
    assert (chosen == columns[names.PHASE]).mean() > 0.8
    assert policy.act(None, columns[names.BOTH_ARMS]).shape == (40, 5)
    kinds = [type(layer).__name__ for layer in policy.network.layers]
    assert kinds == ["BatchNorm1d", "Linear", "ReLU"] * 3 + ["Linear"]
    assert "does not act" in fails(capsys, "evaluate", folder)


def test_a_low_level_policy_is_warned_of_what_teaches_a_high_level_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("train", "--task", "suture", "--encoder", "none", "--epochs", "1")
    for late, policy, is_warned in ((0, "bc", False), (40, "bc", True), (40, "hlp", False)):
        dataset = Dataset(made=Made(late=late))
        monkeypatch.setattr(folders, "open_dataset", lambda *_, dataset=dataset: dataset)
        assert main([*arguments, "--policy", policy, "--out", f"{policy}{late}"]) == 0
        said = capsys.readouterr().err
        assert ("up to 40 control steps late" in said) == is_warned


def test_a_subtasks_time_counts_from_the_beginning_of_each_visit() -> None:
    """For an episode that visits a subtask twice, and for two that end and begin with it."""
    phases = np.array([2, 2, 2, 0, 2, 2, 2, 2])
    episode = np.array([0, 0, 0, 0, 0, 0, 1, 1])
    assert first_of_visit(phases, episode).tolist() == [0, 0, 0, 3, 4, 4, 6, 6]
    whole = Dataset()
    phase = whole.columns()[names.PHASE]
    once = of_subtask(whole, "insert").columns()
    # With one visit this equals counting from the episode's first frame of the subtask.
    kept = np.flatnonzero(phase == 2)
    index = whole.columns()["frame_index"][kept]
    first = np.searchsorted(whole.episode_index[kept], whole.episode_index[kept], side="left")
    np.testing.assert_array_equal(once["frame_index"], index - index[first])
    seconds = whole.columns()["timestamp"][kept]
    np.testing.assert_array_equal(once["timestamp"], seconds - seconds[first])


def test_a_subtasks_time_does_not_depend_on_which_frames_are_kept() -> None:
    """An insertion begins between two frames of a stride: its clock began then all the same."""
    whole = fake_procedures(episodes=2, steps=13)
    began = [26, 65 + 26]
    strided = of_subtask(with_frame_stride(whole, 5), "insert")
    kept = np.flatnonzero(np.isin(np.arange(whole.length) % 65, [30, 35]))
    since = kept - np.repeat(began, 2)
    assert strided.columns()["frame_index"].tolist() == since.tolist() == [4, 9, 4, 9]
    np.testing.assert_allclose(strided.columns()["timestamp"], since / names.FPS, atol=1e-6)


def test_a_subtask_of_whole_procedures_is_a_dataset_of_its_own(
    capsys: pytest.CaptureFixture[str],
) -> None:
    whole = Dataset()
    part = of_subtask(whole, "insert")
    rows = np.flatnonzero(whole.columns()[names.PHASE] == 2)
    assert part.length == len(rows) == 8 and part.episode_index.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert (
        part.config == TaskConfig("insert")
        and part.task == "insert"
        and part.fingerprint != whole.fingerprint
    )
    np.testing.assert_array_equal(part.columns()[names.ACTION], whole.columns()[names.ACTION][rows])
    frames = whole.frames("back", 0, 40)[rows]
    for start, stop in ((0, 8), (1, 6), (3, 4), (2, 2)):
        np.testing.assert_array_equal(part.frames("back", start, stop), frames[start:stop])
    with pytest.raises(InputError, match="has 0 to 8"):
        part.frames("back", 0, 9)
    assert with_frame_stride(part, 2).length == 4
    whole.fps = 25  # rendered with every other frame: the stride counts control steps
    sparse = of_subtask(whole, "insert")
    assert (
        with_frame_stride(sparse, 2) is sparse
        and with_frame_stride(sparse, 4).length == 4
        and with_frame_stride(sparse, 4).fps == 12
    )
    with pytest.raises(InputError, match="shows 'grasp'"):
        of_subtask(Dataset(task="grasp"), "insert")
    arguments = (
        "train",
        "--subtask",
        "insert",
        "--encoder",
        "tiny",
        "--view",
        "back",
        "--epochs",
        "1",
    )
    folder = run(capsys, *arguments)["checkpoint"]
    assert folder == "outputs/train/insert-of-suture-tiny-back-paper+epochs=1-seed0"
    checkpoint = read_checkpoint(Path(folder))
    assert checkpoint.task == TaskConfig("insert") and checkpoint.frames == 6
    assert "Did you mean 'insert'" in fails(capsys, "train", "--subtask", "inset")
    assert "leave --subtask" in fails(capsys, "train", "--subtask", "insert", "--policy", "hlp")


def test_event_file_holds_the_losses(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    arguments = ("train", "--task", "suture", "--encoder", "none", "--epochs", "2", "--out", "a")
    run(capsys, *arguments)
    events = EventAccumulator("a-tensorboard").Reload()
    checkpoint = read_checkpoint(Path("a"))
    for name, losses in (
        ("train", checkpoint.train_losses),
        ("validation", checkpoint.validation_losses),
    ):
        drawn = events.Scalars(f"loss/{name}")
        assert [event.step for event in drawn] == [1, 2]
        np.testing.assert_allclose([event.value for event in drawn], losses, rtol=1e-6)
    files = list(Path("a-tensorboard").iterdir())
    run(capsys, *arguments)
    assert list(Path("a-tensorboard").iterdir()) == files, "a training that is done draws nothing"
    monkeypatch.setattr(logs, "installed", lambda name: False)
    assert "not installed" in fails(capsys, *arguments, "--log", "tensorboard")


def test_wandb_needs_an_account_or_stays_offline(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple] = []

    def init(**_: object) -> SimpleNamespace:
        return SimpleNamespace(
            log=lambda losses, step: drawn.append((step, sorted(losses))),
            finish=lambda: drawn.append(("end",)),
        )

    fake = ModuleType("wandb")
    fake.init, fake.api = init, SimpleNamespace(is_authenticated=False)  # type: ignore[attr-defined]
    fake.setup = lambda: SimpleNamespace(settings=SimpleNamespace(mode="online"))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr(logs, "installed", lambda name: True)
    arguments = (
        "train",
        "--task",
        "suture",
        "--encoder",
        "none",
        "--epochs",
        "2",
        "--log",
        "wandb",
        "--out",
        "a",
    )
    assert "WANDB_MODE=offline" in fails(capsys, *arguments)
    assert not Path("a").exists()
    fake.setup = lambda: SimpleNamespace(settings=SimpleNamespace(mode="offline"))  # type: ignore[attr-defined]
    run(capsys, *arguments)
    both = ["loss/train", "loss/validation"]
    assert drawn == [(1, both), (2, both), ("end",)]
