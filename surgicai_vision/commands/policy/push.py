"""`policy push`: share a policy on the Hugging Face Hub, with a model card."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY
from surgicai_vision.core.banks import HELD_OUT, bank_of
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.hierarchical_config import SUFFIXES

if TYPE_CHECKING:
    from surgicai_vision.training.checkpoint import Checkpoint
    from surgicai_vision.training.hub import Successes

app = App(
    name="push",
    help_epilogue="""\
example:
  surgicai-vision policy push outputs/train/grasp-random-back-seed0 \\
      --repo somebody/suturing-grasp-bc --private""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `policy push`.

    Attributes:
        policy: A checkpoint folder, or released:NAME; of a whole procedure, push the parts.
        repo: Repository to push to; created if it does not exist.
        evaluation: Folder of an evaluation of this policy; the card states its successes.
        private: If the repository is created, make it private.
        licence: Licence of the policy, by its short name on the Hub.
        dry_run: Show the card and upload nothing.
    """

    policy: Annotated[Path, DIRECTORY] = field(kw_only=False)
    repo: Annotated[str, Parameter(metavar="USER/NAME")]
    evaluation: Annotated[Path | None, DIRECTORY] = None
    private: bool = False
    licence: Annotated[str, Parameter(metavar="NAME")] = "mit"
    dry_run: bool = False


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Verify the policy, push it and print where it is."""
    from surgicai_vision.core.hub import check_repository
    from surgicai_vision.training.checkpoint import read_checkpoint
    from surgicai_vision.training.hub import model_card, push_policy
    from surgicai_vision.training.released import resolve

    folder = resolve(options.policy)
    if folder.suffix in SUFFIXES:
        raise InputError(
            f"{options.policy} is a hierarchical policy, which has no weights of its own; push the "
            "policies that its file names, one by one."
        )
    checkpoint = read_checkpoint(folder)
    successes = _successes(options.evaluation, checkpoint) if options.evaluation else None
    if options.dry_run:
        check_repository(options.repo)
        console.say(model_card(checkpoint, options.repo, options.licence, successes))
        return {"repo": options.repo, "dry_run": True}
    address = push_policy(
        folder,
        options.repo,
        private=options.private,
        licence=options.licence,
        successes=successes,
    )
    console.say(f"pushed: {address}")
    return {"repo": options.repo, "commit": address}


def _successes(folder: Path, checkpoint: "Checkpoint") -> "Successes":
    """Return the successes of an evaluation, counted from its episodes.

    Raises:
        InputError: it is of another policy, or no evaluation of it as it was trained, on held-out
            starts.
    """
    from surgicai_vision.evaluation.statistics import clopper_pearson
    from surgicai_vision.evaluation.storage import read_evaluation, read_rows
    from surgicai_vision.training.hub import Successes

    rows = read_rows(folder)
    seeds = [int(row["seed"]) for row in rows]
    evaluation = read_evaluation(folder)
    evaluated = evaluation.about.get("checkpoint")
    sha256 = evaluated.get("policy_sha256") if isinstance(evaluated, dict) else None
    if sha256 != checkpoint.policy_sha256:
        raise InputError(
            f"--evaluation {folder} is of another policy than {checkpoint.folder}; "
            "give one of this policy, or leave it out."
        )
    run = evaluation.run
    other = {
        "starts that are not held out": any(bank_of(seed) != HELD_OUT for seed in seeds),
        "a world or rules that are not those of its training": run.env != checkpoint.task,
        "a shift": run.shift is not None,
        "episodes that were upset on purpose": run.upset,
        "other settings of acting": bool(run.acted_by),
        "crops aimed by a detector": bool(run.detector),
    }
    wrong = [what for what, holds in other.items() if holds]
    if wrong:
        raise InputError(
            f"--evaluation {folder} has {' and '.join(wrong)}; the card names the successes of the "
            "policy as it was trained. Give the folder of a plain evaluate, or leave it out."
        )
    count = sum(bool(row["success"]) for row in rows)
    return Successes(
        count=count,
        episodes=len(rows),
        interval=clopper_pearson(count, len(rows)),
        seeds=tuple(seeds),
    )
