"""A sweep's folder as sweeps leave it, with generated episodes.

It has everything that a report can show.
"""

import itertools
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.evaluation.metrics import EpisodeMetrics
from surgicai_vision.evaluation.slot import Episode, Film
from surgicai_vision.evaluation.storage import FORMAT, write_evaluation
from surgicai_vision.training.checkpoint import StageErrors
from surgicai_vision.training.run_config import RunConfig, Shift, Starts

TASKS = ("grasp", "insert", "handoff")
ENCODERS = {"imagenet": 0.45, "imagenet-lite": 0.3, "random": 0.05}
VIEWS = (("front",), ("back",), ("front", "back"))
KINDS = ("missed", "dropped", "wrong_hole", "time", "physics", "error")
MACHINE = {
    "packages": {"mujoco": "4.0.0", "torch": "2.9"},
    "python": "3.12.1",
    "system": "Linux 6 x86_64",
    "processor": "a test's processor",
    "cores": 2,
    "renderer": "llvmpipe",
}
COMMAND = "surgicai-vision sweep table.yaml --out outputs/sweeps/table"


def episode(task, policy, seed, success, generator, stages=0):
    """An episode with everything measured; a failure's kind by chance."""
    kind = "" if success else str(generator.choice(KINDS, p=(0.4, 0.2, 0.1, 0.25, 0.03, 0.02)))
    steps = int(generator.integers(60, 140)) if success else 200
    passed = task in ("insert", "suture") and (success or kind == "time")
    row = EpisodeMetrics(
        task=task,
        policy=policy,
        seed=seed,
        success=success,
        steps=steps,
        grasp="friction",
        failure=kind,
        trajectory_length_mm=float(generator.normal(45, 6)),
        contact=success,
        stages=stages or int(success),
        d_trans_mm=float(abs(generator.normal(0.7 if success else 6, 1.5))),
        d_angle_deg=float(abs(generator.normal(4 if success else 14, 3))),
        error="the start cannot be made" if kind == "error" else "",
        entry_mm=float(abs(generator.normal(0.6, 0.3))) if passed else float("nan"),
        exit_mm=float(abs(generator.normal(1.1, 0.5))) if passed else float("nan"),
        slip_mm=float(abs(generator.normal(0.2, 0.1))),
        slip_deg=float(abs(generator.normal(3, 1))),
        tissue_force_n=float(abs(generator.normal(0.4, 0.2))),
        bite_depth_mm=1.1 if passed else float("nan"),
        bite_length_mm=7.8 if passed else float("nan"),
        entry_deg=21.0 if passed else float("nan"),
        exit_deg=23.0 if passed else float("nan"),
        tissue_impulse_ns=0.6,
        paper_success=success,
    )
    kept = np.linspace(0, steps, 10).astype(np.int64)
    return Episode(row, Film(kept, np.stack([kept, np.full(10, seed)], axis=1).astype(np.float64)))


def evaluation(folder, run, rate, generator, about=None, episodes=20):
    """Store one evaluation; a start's difficulty is the same for every policy."""
    made = []
    for index in range(episodes):
        hard = np.random.default_rng(index).uniform()
        won = generator.uniform() < np.clip(rate + 0.5 * (0.5 - hard), 0.0, 1.0)
        made.append(episode(run.task, run.name, names.TEST_SEED + index, bool(won), generator))
    stored = replace(run, starts=Starts(names.TEST_SEED, episodes))
    common = {"command": COMMAND, "provenance": MACHINE}
    return write_evaluation(folder, made, stored, {**common, **(about or {})})


CHECKPOINT = {
    "weights_sha256": "0123456789abcdef" * 4,
    "policy_sha256": "aa" * 32,
    "dataset": "fedcba9876543210" * 4,
}


STAGE_ERRORS = StageErrors(
    confusion=(
        (412, 9, 0, 0, 0),
        (11, 301, 4, 0, 0),
        (0, 7, 522, 13, 0),
        (0, 0, 21, 377, 2),
        (0, 0, 0, 3, 298),
    ),
    calibration_error=0.0123,
    progress_error=0.0456,
)
"""Errors of the high-level policy of the whole procedure."""


def run_of(task, encoder, views, seed, **more):
    """A run with 50 demonstrations."""
    return RunConfig(
        TaskConfig(task), encoder, tuple(views), seed=seed, **{"demonstrations": 50, **more}
    )


def store_run(out, key, run, rate, generator):
    """Store a finished run."""
    folder = out / "runs" / key
    about = {"checkpoint": CHECKPOINT, "folder": f"outputs/sweeps/table/runs/{key}/policy"}
    summary = evaluation(folder / "evaluation", run, rate, generator, about)
    files.write_json(folder / "result.json", {"run": to_mapping(run), "summary": summary})


def write_sweep(out, tasks=TASKS, seeds=(0, 1), encoders=ENCODERS, views=VIEWS):
    """Write a sweep's folder: done cells, failed ones, ones not run, references, probes.

    Return `out`.
    """
    generator = np.random.default_rng(7)
    out.mkdir(parents=True, exist_ok=True)
    skipped = []
    for index, (task, view, seed) in enumerate(itertools.product(tasks, views, seeds)):
        for encoder, rate in encoders.items():
            key = f"{encoder}{index:03d}"
            run = run_of(task, encoder, view, seed)
            if (task, encoder, view, seed) == ("handoff", "imagenet", ("back",), 1):
                (out / "runs" / key).mkdir(parents=True)
                error = "Traceback\n  in train\nRuntimeError: the disk is full"
                failed = {"format": FORMAT, "run": to_mapping(run), "error": error}
                files.write_json(out / "runs" / key / "failed.json", failed)
                continue
            better = 0.25 if task == "handoff" else 0.0
            store_run(out, key, run, rate + better + 0.1 * (view == ("back",)), generator)
        lacking = run_of(task, "r3m", view, seed)
        reason = "R3M's weights are not here; see its card."
        skipped.append({"key": f"r3m{index:03d}", "run": to_mapping(lacking), "reason": reason})
    for task in tasks:
        store_run(out, f"blind{task}", run_of(task, None, (), 0), 0.05, generator)
        expert = RunConfig(TaskConfig(task), policy="expert")
        evaluation(out / "references" / f"expert-{task}", expert, 1.5, generator)
    files.write_json(out / "sweep.json", {"format": FORMAT, "grid": {"task": list(tasks)}})
    state = {
        "format": FORMAT,
        "title": "table",
        "command": COMMAND,
        "problems": ["failed: replay-grasp: the mean demonstration is empty"],
        "skipped": skipped,
        "provenance": MACHINE,
        "data": "50 demonstrations",
    }
    files.write_json(out / "run.json", state)
    probes = [
        {
            "encoder": encoder,
            "view": "+".join(view),
            "pool": "global",
            "angle_deg": 12.0,
            "n": 50,
            "task": "handoff",
            "tip_mm_low": 2.0,
            "tip_mm_high": 7.0,
            "tip_mm_chance": 9.5,
            "tip_mm": 6 - 4 * rate + generator.normal(0, 0.2),
        }
        for (encoder, rate), view in itertools.product(encoders.items(), views)
    ]
    pq.write_table(pa.Table.from_pylist(probes), out / "probes.parquet")
    return out


def add_curves(out):
    """Add what other sweeps hold: numbers of demonstrations, shifts, and the whole procedure."""
    generator = np.random.default_rng(3)
    for count, encoder in itertools.product((10, 20, 50, 100), ("imagenet", "random")):
        run = run_of("place", encoder, ("back",), 0, demonstrations=count)
        store_run(out, f"data{encoder}{count}", run, 0.1 + count / 200, generator)
    for axis, strength in itertools.product(("light", "blur"), (0.25, 0.5, 1.0)):
        for encoder in ("imagenet", "imagenet-lite"):
            run = run_of("place", encoder, ("back",), 0, shift=Shift(axis, strength))
            place = out / "robustness" / f"{encoder}-{axis}-{strength}"
            evaluation(place, run, 0.6 - 0.5 * strength, generator, {"checkpoint": CHECKPOINT})
    for swap in (None, "grasp", "insert"):
        stages = generator.integers(0, 6, size=20)
        run = run_of(
            "suture",
            "imagenet",
            ("front", "back"),
            0,
            termination="privileged",
            expert_swap=swap,
        )
        made = [
            episode(
                "suture", run.name, names.TEST_SEED + at, bool(stage == 5), generator, int(stage)
            )
            for at, stage in enumerate(stages)
        ]
        about = {
            "hierarchical": {"hlp": "outputs/train/hlp"},
            "high_level": {"policy_sha256": "bb" * 32, "stage_errors": to_mapping(STAGE_ERRORS)},
            "command": COMMAND,
            "provenance": MACHINE,
        }
        write_evaluation(out / "hierarchical" / str(swap), made, run, about)
    return out
