"""Finished episodes: a stopped evaluation continues, and ends as if it had not been stopped."""

import functools
from dataclasses import replace

import pytest
from safetensors.numpy import load, save

from surgicai_vision.core.files import FAMILIES, code_version
from surgicai_vision.evaluation import finished
from surgicai_vision.evaluation.agents import ZeroAgent
from surgicai_vision.evaluation.films import Filming, Look
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.run import evaluate_into

SEEDS = range(900_000, 900_012)
LAST = SEEDS[-1]


class Watched(ZeroAgent):
    """Records the starts that it gets, and is interrupted at one of them."""

    def __init__(self, begun, stopped_at=None):
        super().__init__()
        self.begun, self.stopped_at = begun, stopped_at

    def reset(self, slot, env, seed):
        if seed == self.stopped_at:
            raise KeyboardInterrupt
        self.begun.append(seed)
        super().reset(slot, env, seed)


def spec_of(task, begun, stopped_at=None, **changes):
    spec = open_policy("zero", task=task, env={"max_steps": 3})
    return replace(spec, make=functools.partial(Watched, begun, stopped_at), **changes)


def stop(out, task="grasp", filming=None, **changes):
    """Evaluate until the last start; return the starts of the episodes that are kept."""
    with pytest.raises(KeyboardInterrupt):
        evaluate_into(out, spec_of(task, [], LAST, **changes), SEEDS, workers=1, filming=filming)
    return {int(path.stem) for path in (out / finished.FOLDER).glob(f"*{finished.SUFFIX}")}


def contents(folder):
    """Return the bytes of an evaluation's tables and films."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}


@pytest.mark.parametrize("task", ["grasp", "suture"])
def test_only_what_was_not_finished_runs_again(tmp_path, task):
    whole = evaluate_into(tmp_path / "whole", spec_of(task, []), SEEDS, workers=1)
    kept = stop(tmp_path / "out", task)
    assert 0 < len(kept) < len(SEEDS) - 1
    resumed = evaluate_into(tmp_path / "out", spec_of(task, begun := []), SEEDS, workers=1)
    assert sorted(begun) == sorted(set(SEEDS) - kept)
    assert str(resumed) == str(whole)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_progress_counts_the_kept_episodes(tmp_path):
    kept = stop(tmp_path)
    seen = []
    evaluate_into(
        tmp_path, spec_of("grasp", []), SEEDS, 1, lambda done, total: seen.append((done, total))
    )
    assert seen == sorted(seen) and seen[0][0] > 3 * len(kept)
    assert seen[-1] == (3 * len(SEEDS), 3 * len(SEEDS))


@pytest.mark.parametrize(
    "broken", ["episode", "owner", "other policy", "other code", "other families"]
)
def test_what_is_damaged_or_of_something_else_runs_again(tmp_path, monkeypatch, broken):
    kept = stop(tmp_path)
    spec = spec_of("grasp", begun := [])
    again = set(kept)
    if broken == "episode":
        again = {min(kept)}
        path = tmp_path / finished.FOLDER / f"{min(kept)}{finished.SUFFIX}"
        path.write_bytes(path.read_bytes()[:-100])
    elif broken == "owner":
        for path in (tmp_path / finished.FOLDER).iterdir():
            path.write_bytes(save(load(path.read_bytes())))  # without any metadata
    elif broken == "other policy":
        spec = replace(spec, about={"checkpoint": {"policy_sha256": "0"}})
    else:
        changed = FAMILIES if broken == "other families" else ()
        monkeypatch.setattr(
            "surgicai_vision.evaluation.provenance.code_version",
            lambda *stages: "other" if stages == changed else code_version(*stages),
        )
    evaluate_into(tmp_path, spec, SEEDS, workers=1)
    assert set(begun) & kept == again


def test_a_function_of_the_user_has_no_version_so_nothing_is_kept(tmp_path):
    assert not stop(tmp_path, resumes=False)
    assert open_policy("surgicai_vision.evaluation.agents:ZeroAgent").resumes is False


def test_videos_of_kept_episodes_stay(tmp_path):
    filming = Filming(tmp_path / "videos", look=Look(("front",), size=64))
    kept = stop(tmp_path / "out", filming=filming)
    before = {path.name: path.stat().st_mtime_ns for path in filming.folder.glob("*.mp4")}
    assert {int(name.split("-")[1]) for name in before} == kept
    evaluate_into(tmp_path / "out", spec_of("grasp", []), SEEDS, workers=1, filming=filming)
    after = {path.name: path.stat().st_mtime_ns for path in filming.folder.glob("*.mp4")}
    assert before.items() <= after.items()
    assert len(filming.videos()) == len(SEEDS) == len(after)
