"""Share a trained policy on the Hugging Face Hub: with a model card, verified before and after.

    push_policy(Path("outputs/train/…"), "somebody/suturing-grasp-bc")
    pull_policy("somebody/suturing-grasp-bc", Path("outputs/train/pulled"))

The checkpoint is shared as it is in its folder, so its own hashes show whether it was changed on
the way. `PyTorchModelHubMixin` would write a second format, without hashes.
"""

import io
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output
from surgicai_vision.core.hub import connect, refusals_in_one_line
from surgicai_vision.core.percentages import interval
from surgicai_vision.core.tasks import task_text
from surgicai_vision.core.words import plural
from surgicai_vision.scene import build_scene
from surgicai_vision.training.checkpoint import CARD, WEIGHTS, Checkpoint, read_checkpoint
from surgicai_vision.training.policies import restore

if TYPE_CHECKING:
    from huggingface_hub import HfApi

MODEL_CARD = "README.md"
LICENCE = "mit"


@dataclass(frozen=True)
class Successes:
    """Measured successes of a policy on held-out starts.

    Attributes:
        count: successful episodes.
        episodes: all episodes.
        interval: exact 95 % interval of the rate.
        seeds: seed of each start.
    """

    count: int
    episodes: int
    interval: tuple[float, float]
    seeds: tuple[int, ...]

    @property
    def text(self) -> str:
        """The count with its interval, in words."""
        return (
            f"{self.count}/{self.episodes} (95 % interval {interval(self.interval)}), "
            f"start seeds {min(self.seeds)} to {max(self.seeds)}"
        )


def model_card(
    checkpoint: Checkpoint, repo: str, licence: str = LICENCE, successes: Successes | None = None
) -> str:
    """Return the card of a policy, Markdown with the Hub's header.

    Args:
        checkpoint: the policy.
        repo: "user/name".
        licence: the Hub's short name of a licence.
        successes: successes in an evaluation of this policy, if there is one.
    """
    from huggingface_hub import EvalResult, ModelCardData

    task = checkpoint.task.task
    # "bc" as an algorithm clones demonstrations too.
    learning = "imitation" if checkpoint.run.algo in (None, "bc") else "reinforcement"
    results = None
    if successes is not None:
        rate = EvalResult(
            task_type="robotics",
            task_name=task,
            dataset_type="simulation",
            dataset_name=f"{task}, {successes.episodes} starts from {min(successes.seeds)}",
            metric_type="success_rate",
            metric_value=successes.count / successes.episodes,
        )
        results = [rate]
    header = ModelCardData(
        license=licence,
        library_name="surgicai-vision",
        pipeline_tag="robotics",
        tags=["surgical-robotics", "suturing", f"{learning}-learning"],
        model_name=repo.partition("/")[2],
        eval_results=results,
    )
    facts = {**_facts(checkpoint), "licence": licence}
    if successes is not None:
        facts["successes"] = successes.text
    rows = "\n".join(f"| {name} | {text} |" for name, text in facts.items())
    settings = "\n".join(f"{key}: {value}" for key, value in checkpoint.recipe.items())
    return f"""---
{header.to_yaml().strip()}
---

# {repo.partition("/")[2]}

{task_text(task)}

A policy for the task `{task}` in simulated robotic suturing, trained by {learning} learning with
surgicai-vision ({checkpoint.code_version}). It is not a medical device.

| | |
|---|---|
{rows}

The recipe, value by value:

```yaml
{settings}
```

```sh
surgicai-vision policy pull {repo} --out policy
surgicai-vision evaluate policy
```
"""


def _facts(checkpoint: Checkpoint) -> dict[str, str]:
    """Return the facts about a policy for its card, by name."""
    encoder = checkpoint.encoder
    held_out = len(checkpoint.validation_episodes)
    demonstrations = checkpoint.run.demonstrations or 0  # None for an actor that learned without
    facts = {
        "policy": (
            f"`{checkpoint.policy}`, recipe `{checkpoint.run.recipe_label}`, "
            f"{checkpoint.epoch} epochs"
        ),
        "training seed": str(checkpoint.run.seed),
        "views": ", ".join(checkpoint.views) or "none",
        "images": f"{checkpoint.image_size} × {checkpoint.image_size} pixels",
        "proprioception": "yes" if checkpoint.proprioception else "no",
        "data": f"{plural(demonstrations, 'demonstration')}, {held_out} of them held out",
        "frames": str(checkpoint.frames),
        "dataset, fingerprint": f"`{checkpoint.dataset}`",
        "scene, sha256": f"`{build_scene(checkpoint.task.scene).hash}`",
        "policy, sha256": f"`{checkpoint.policy_sha256}`",
    }
    run = checkpoint.run
    if run.algo:
        learned = f"{run.env_steps} control steps" if run.env_steps else f"{run.updates} updates"
        facts["policy"] = f"`{checkpoint.policy}`, algorithm `{run.algo}`, {learned}"
        facts["data"] = f"{run.demonstrations or 'no'} demonstrations"
        if run.sees_goal:
            facts["sees"] = f"the state with the goal ({run.inputs}), in simulation alone"
    if encoder is not None:
        facts["encoder"] = (
            f"`{encoder.name}`, pool {encoder.pool}, frozen and not part of this repository; "
            f"its weights: {encoder.card['source']}, {encoder.card['licence']}"
        )
        facts["encoder's weights, sha256"] = f"`{encoder.weights_sha256}`"
    return facts


def push_policy(
    folder: Path,
    repo: str,
    *,
    private: bool = False,
    licence: str = LICENCE,
    successes: Successes | None = None,
    api: "HfApi | None" = None,
) -> str:
    """Push a checkpoint with its card, in one commit; return the commit's address.

    Args:
        folder: the checkpoint folder.
        repo: "user/name"; created if it does not exist.
        private: make it private.
        licence: the Hub's short name of a licence.
        successes: successes in an evaluation of this policy, if there is one.
        api: the Hub's client; made here by default.

    Raises:
        InputError: a bad name, or a policy that is fed another policy's progress.
        BadFile: not a complete checkpoint.
        SurgicaiError: offline, or the Hub refuses.
    """
    checkpoint = read_checkpoint(folder)
    restore(checkpoint)
    if checkpoint.progress_sha256:
        raise InputError(
            f"{folder} uses the progress that another policy predicts, and one repository holds "
            "one policy; push a policy without progress_input."
        )
    api = connect(repo, api)
    from huggingface_hub import CommitOperationAdd

    card = model_card(checkpoint, repo, licence, successes)
    operations = [CommitOperationAdd(name, folder / name) for name in (CARD, WEIGHTS)]
    operations.append(CommitOperationAdd(MODEL_CARD, io.BytesIO(card.encode())))
    with refusals_in_one_line(repo):
        api.create_repo(repo, repo_type="model", private=private, exist_ok=True)
        text = f"{checkpoint.run.name} for {checkpoint.task.task}"
        commit = api.create_commit(repo, operations, commit_message=text, repo_type="model")
    return str(commit.commit_url)


def pull_policy(
    repo: str, out: Path, *, revision: str | None = None, api: "HfApi | None" = None
) -> Checkpoint:
    """Fetch a policy into the new folder `out` and verify it; return its checkpoint.

    Args:
        repo: "user/name".
        out: folder to create.
        revision: branch, tag or commit; None takes the main branch.
        api: the Hub's client; made here by default.

    Raises:
        InputError: a bad name.
        OutputExists: `out` is not empty.
        BadFile: the download is not a complete policy, or was changed.
        SurgicaiError: offline, or the Hub refuses.
    """
    check_output(out)
    api = connect(repo, api)
    with building(out) as (store, result):
        fetched = store / "fetched"
        with refusals_in_one_line(repo):
            api.snapshot_download(
                repo,
                repo_type="model",
                revision=revision,
                local_dir=fetched,
                allow_patterns=[CARD, WEIGHTS, MODEL_CARD],
            )
        shutil.rmtree(fetched / ".cache", ignore_errors=True)  # the Hub client's notes
        try:
            restore(read_checkpoint(fetched))
        except BadFile as error:
            problem = str(error).replace(f"{fetched}{os.sep}", "").replace(str(fetched), "it")
            raise BadFile(f"{repo} holds no usable policy: {problem}") from None
        if out.exists():
            out.rmdir()  # empty: checked before
        os.rename(fetched, result)
    return read_checkpoint(out)
