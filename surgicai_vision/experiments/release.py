"""Release: build the policies that come with the product, from scratch to their cards.

Record, render, encode, train, evaluate on held-out starts, write the card. A folder named after the
hash of the scene holds the work, for the first training seed of the plan:

    <out>/<scene hash>/<demonstrations>/demos, dataset
    <out>/<scene hash>/policies/<name>, evaluations/<name>

A finished step is not repeated, so the same command continues an interrupted build; a changed scene
starts over. Each policy goes into `released_folder()` as soon as it is evaluated; the whole
procedure comes last, from parts that are released by then.
"""

import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from surgicai_vision import __version__
from surgicai_vision.core import files, names
from surgicai_vision.core.config import digest, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists, check_name
from surgicai_vision.core.executor import RunContext
from surgicai_vision.dataset import open_dataset
from surgicai_vision.dataset.protocol import Dataset
from surgicai_vision.dataset.subset import of_subtask
from surgicai_vision.envs import check_world
from surgicai_vision.evaluation.hierarchical_config import hierarchical_yaml
from surgicai_vision.evaluation.policy_spec import hierarchical_policy, open_policy
from surgicai_vision.evaluation.provenance import command_line
from surgicai_vision.evaluation.run import evaluate_once
from surgicai_vision.evaluation.storage import read_rows
from surgicai_vision.experiments.dagger import learner_of
from surgicai_vision.experiments.dataset_config import Demonstrations
from surgicai_vision.experiments.plan_config import Plan, plan_of
from surgicai_vision.experiments.plan_parts import PlannedPolicy
from surgicai_vision.experiments.prepare import (
    check_dataset,
    demos_folders,
    make_dataset,
)
from surgicai_vision.experiments.run import train_run
from surgicai_vision.experiments.training_check import check_training
from surgicai_vision.features import encoders
from surgicai_vision.scene import build_scene
from surgicai_vision.scene.opengl import check_opengl
from surgicai_vision.training.checkpoint import CARD, WEIGHTS, Checkpoint, read_checkpoint
from surgicai_vision.training.released import (
    PREFIX,
    PROCEDURE,
    VARIABLE,
    ReleaseCard,
    read_card,
    released_folder,
    write_released,
)
from surgicai_vision.training.run_config import Starts

PLAN_FILE = "plan.json"
SHOWN = 5
"""Solved starts that a card names; they are solved again wherever the policy is installed."""


def run_release(
    plan: Plan, out: Path, context: RunContext, only: Sequence[str] = ()
) -> list[ReleaseCard]:
    """Build what is not built yet and write it to `released_folder()`.

    Args:
        plan: what to build.
        out: folder of the work.
        context: processes and progress.
        only: names of `plan.names`; all of them by default.

    Returns:
        The cards, in the plan's order.

    Raises:
        UnknownName: a policy, view, encoder or recipe that does not exist; before any work.
        InputError: a policy that cannot be trained as the plan says (`training_check`), a folder
            that cannot be written, or a machine that cannot render images; before any work.
        MissingWeights: the encoder's weights are not at hand; before any work.
        OutputExists: `out` holds the work of another plan.
    """
    for name in only:
        check_name("policy of the plan", name, plan.names)
    chosen = [name for name in plan.names if name in only or not only]
    for recorded in plan.demonstrations:
        check_dataset(plan.dataset(recorded, plan.seed[0]))
    for policy in plan.policies:
        recorded = plan.recorded(policy)
        dataset = plan.dataset(recorded, plan.seed[0])
        run = plan.training(policy, plan.seed[0])
        check_training(run, dataset, policy.subtask)
        check_world(dataset.env, f"demonstrations {recorded.name}")
        if run.encoder:
            encoders.find_weights(run.encoder)
    _check_writable(released_folder())
    check_opengl()
    scene = build_scene(plan.task_config(names.SUTURE).scene).hash
    build = _Build(plan, out / scene[:12], scene, context)
    build.claim()
    cards = [build.subtask(policy) for policy in plan.policies if policy.name in chosen]
    return [*cards, build.procedure()] if names.SUTURE in chosen else cards


@dataclass(frozen=True)
class _Build:
    """One build.

    Attributes:
        plan: what is built.
        out: folder of the work.
        scene_hash: of the scene.
        context: processes and progress.
    """

    plan: Plan
    out: Path
    scene_hash: str
    context: RunContext

    def claim(self) -> None:
        """Make the folder of the work, or refuse the folder of another plan."""
        files.check_output(self.out, may_resume=PLAN_FILE)
        path = self.out / PLAN_FILE
        wanted = to_mapping(self.plan)
        if path.exists():
            if to_mapping(plan_of(files.read_json(path), str(path))) != wanted:
                raise OutputExists(
                    f"{self.out} holds the work of another plan (see {path}); give another --out."
                )
            return
        self.out.mkdir(parents=True, exist_ok=True)
        files.remove_partial(self.out, (PLAN_FILE,))
        files.write_json(path, wanted)

    def subtask(self, policy: PlannedPolicy) -> ReleaseCard:
        """Train, evaluate and release one policy."""
        recorded = self.plan.recorded(policy)
        folder = self._trained(policy)
        checkpoint = read_checkpoint(folder)
        whose = f"the {policy.subtask} of " if policy.subtask else ""
        card = ReleaseCard(
            name=policy.name,
            run=checkpoint.run,
            scene_hash=self.scene_hash,
            data=f"{whose}{recorded.episodes} demonstrations of {recorded.task}, "
            f"{recorded.manner}: {checkpoint.frames} frames",
            licence=self.plan.licence,
            encoder=_encoder(checkpoint),
            command=command_line(),
            code_version=__version__,
        )
        if policy.acts:
            card = self._counted(card, folder, policy.name)
        write_released(card, {name: (folder / name).read_bytes() for name in (CARD, WEIGHTS)})
        return read_card(policy.name)

    def procedure(self) -> ReleaseCard:
        """Evaluate the whole procedure with the released parts, and release it."""
        together = [policy.name for policy in self.plan.suture.values()]
        hashes = {name: read_card(name).files[WEIGHTS] for name in together}
        parts = {part: f"{PREFIX}{policy.name}" for part, policy in self.plan.suture.items()}
        config = self.plan.hierarchical(None, parts)
        content = hierarchical_yaml(config)
        policy = f"{PREFIX}{names.SUTURE}"
        card = ReleaseCard(
            name=names.SUTURE,
            run=hierarchical_policy(config).run,
            scene_hash=self.scene_hash,
            data=f"the released {', '.join(together)}",
            licence=self.plan.licence,
            encoder="",
            command=command_line(),
            code_version=__version__,
            parts=hashes,
        )
        write_released(card, {PROCEDURE: content})
        card = self._counted(card, policy, f"{names.SUTURE}-{digest(hashes)[:8]}")
        write_released(card, {PROCEDURE: content})
        return read_card(names.SUTURE)

    def _trained(self, policy: PlannedPolicy) -> Path:
        """Train a policy if that is not done yet; return its folder."""
        folder = self.out / "policies" / policy.name
        if not (folder / CARD).exists():
            recorded = self.plan.recorded(policy)
            dataset: Dataset = open_dataset(self._dataset(recorded))
            if policy.subtask:  # before encoding, so that no other frame is encoded
                dataset = of_subtask(dataset, policy.subtask)
            run = self.plan.training(policy, self.plan.seed[0])
            shown = self.plan.dataset(recorded, self.plan.seed[0])
            demos = demos_folders(shown, self.out / recorded.name)
            train_run(run, dataset, folder, self.context.stage, demos=demos)
        return folder

    def _dataset(self, recorded: Demonstrations) -> Path:
        """Record, after training the learner if one acts, and render; return the folder."""
        dataset = self.plan.dataset(recorded, self.plan.seed[0])
        learner = None
        if recorded.learner:
            policy = self.plan.policy(recorded.learner)
            learner = learner_of(self._trained(policy), dataset.env)
        return make_dataset(dataset, self.out / recorded.name, self.context, learner)

    def _counted(self, card: ReleaseCard, given: str | Path, folder: str) -> ReleaseCard:
        """Evaluate a policy on the held-out starts; return its card with the successes."""
        starts = Starts(names.TEST_SEED, self.plan.episodes)
        out = self.out / "evaluations" / folder
        summary = evaluate_once(
            out,
            functools.partial(open_policy, given),
            starts.seeds,
            self.context.stage,
            self.context.workers,
        )
        solved = [int(row["seed"]) for row in read_rows(out) if row["success"]]
        return replace(
            card, successes=summary["successes"], starts=starts, solved=tuple(solved[:SHOWN])
        )


def _encoder(checkpoint: Checkpoint) -> str:
    """Return the encoder of a policy with its weights' source and licence, in words."""
    if checkpoint.encoder is None:
        return ""
    about = checkpoint.encoder.card
    return f"{checkpoint.encoder.name}, frozen, not included: {about['source']}, {about['licence']}"


def _check_writable(folder: Path) -> None:
    """Refuse a folder of released policies that cannot be written, before any work."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=files.TEMPORARY):
            pass
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written: {error.strerror}; set {VARIABLE} to another folder."
        ) from None
