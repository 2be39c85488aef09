"""Jobs of a sweep over algorithms, as workers do them; see `rl_grid`.

A training and an evaluation work in `scratch`, a folder that no other job uses, and continue there
if a killed sweep is run again. Checkpoint, curve and evaluation are then copied to the job's own
folder. The sweep removes `scratch` once the result is filed.
"""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from surgicai_vision.core.config import JSON, from_mapping, read_changes
from surgicai_vision.core.files import write_json
from surgicai_vision.core.progress import silent_stage, timed
from surgicai_vision.demos.store import demos_digest, first_demos
from surgicai_vision.evaluation.hierarchical_config import HLP, ORDER, HierarchicalConfig
from surgicai_vision.evaluation.policy_spec import PolicySpec, hierarchical_policy, open_policy
from surgicai_vision.evaluation.storage import RESULT_FILE
from surgicai_vision.experiments.sweep.jobs import POLICY, Table, evaluate_run
from surgicai_vision.rl.high_level import train_high_level
from surgicai_vision.rl.high_level_config import HighLevelRequest
from surgicai_vision.rl.settings import Request, settings_of
from surgicai_vision.rl.train import train
from surgicai_vision.training.run_config import RunConfig


def train_actor(
    folder: Path,
    run: Table,
    decisions: int,
    validation: int,
    save_every: int,
    demos: str,
    scratch: str,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-actor": train an actor that whole procedures share."""
    os.environ.update(environment)
    trained = _train(from_mapping(RunConfig, run), demos, validation, save_every, Path(scratch))
    shutil.copytree(trained, folder, dirs_exist_ok=True)


def train_and_evaluate(
    folder: Path,
    run: Table,
    final: str,
    policies: Mapping[str, str],
    processes: int,
    decisions: int,
    validation: int,
    save_every: int,
    demos: str,
    scratch: str,
    command: str,
    environment: Mapping[str, str],
) -> None:
    """Job "sweep-rl": train an actor, or PPO over actors made before, and evaluate it.

    An actor that whole procedures share was trained before, and is only evaluated here.
    """
    os.environ.update(environment)
    what = from_mapping(RunConfig, run)
    seconds: dict[str, float] = {}
    with timed(silent_stage, seconds) as measured:
        with measured("policy", "steps"):
            if what.is_hierarchical:
                spec = _procedure(what, policies, decisions, validation, Path(scratch))
                trained = Path(scratch) / POLICY
            elif policies:
                trained = Path(policies[what.task])
                spec = open_policy(trained, task=what.task)
            else:
                trained = _train(what, demos, validation, save_every, Path(scratch))
                spec = open_policy(trained, task=what.task)
        shutil.copytree(trained, folder / POLICY)
        place = str(Path(final) / POLICY)
        kept: dict[str, JSON] = {"command": command, "folder": place}
        if what.is_hierarchical:
            kept["hierarchical"] = {**policies, HLP: place, "termination": what.termination}
        with measured("evaluation", "steps"):
            about = {**spec.about, **kept}
            summary = evaluate_run(folder, Path(scratch), spec, what, about, processes)
    write_json(folder / RESULT_FILE, {"run": run, "summary": summary, "seconds": seconds})


def _train(run: RunConfig, demos: str, validation: int, save_every: int, scratch: Path) -> Path:
    """Train an actor, or continue its training; return the folder of its checkpoint."""
    assert run.algo is not None, "a sweep over algorithms has runs of algorithms alone"
    paths = first_demos(Path(demos), run.demonstrations) if demos else []
    request = Request(
        algo=run.algo,
        env=run.env,
        observation="state" if run.privileged else "relative",
        settings=settings_of(run.algo, read_changes(run.changes)),
        changes=run.changes,
        env_steps=run.env_steps or 0,
        updates=run.updates or 0,
        seed=run.seed,
        demonstrations=len(paths),
        demos=demos_digest(paths) if paths else "",
        validation=validation,
        save_every=save_every,
    )
    train(request, paths, scratch / POLICY, tensorboard=False)
    return scratch / POLICY


def _procedure(
    run: RunConfig, policies: Mapping[str, str], decisions: int, validation: int, scratch: Path
) -> PolicySpec:
    """Train PPO over the low-level policies, or continue it; return the hierarchical policy."""
    low = from_mapping(
        HierarchicalConfig, {**policies, HLP: ORDER, "termination": run.termination}, "procedure"
    )
    request = HighLevelRequest(low, decisions, seed=run.seed, validation=validation)
    train_high_level(request, scratch / POLICY)
    whole = {**policies, HLP: str(scratch / POLICY), "termination": run.termination}
    return hierarchical_policy(from_mapping(HierarchicalConfig, whole, "procedure"))
