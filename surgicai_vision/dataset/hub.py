"""Share a dataset on the Hugging Face Hub, with a card, checked before and after.

    push_dataset(Path("dataset"), "somebody/suturing-grasp")
    pull_dataset("somebody/suturing-grasp", Path("dataset"))
    dataset_card(open_dataset(Path("dataset")), "somebody/suturing-grasp")

A push is one commit, tagged with LeRobot's format version, as its own loader requires. Without a
network, push and pull fail at once with a one-line error.
"""

import io
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from surgicai_vision.core import names
from surgicai_vision.core.config import digest
from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.executor import building
from surgicai_vision.core.files import check_output
from surgicai_vision.core.hub import connect, refusals_in_one_line
from surgicai_vision.core.progress import Progress, silent
from surgicai_vision.core.tasks import task_text
from surgicai_vision.dataset.check import CheckReport, check_dataset
from surgicai_vision.dataset.metadata import CODEBASE_VERSION
from surgicai_vision.dataset.reader import RenderedDataset, open_dataset

if TYPE_CHECKING:
    from huggingface_hub import HfApi

CARD = "README.md"
LICENCE = "mit"
KEPT = ("meta", "data", "videos")
"""Folders of a LeRobot v3 dataset; nothing else in a dataset's folder is pushed or pulled."""


def dataset_card(dataset: RenderedDataset, repo: str, licence: str = LICENCE) -> str:
    """Return a dataset's card: Markdown with the Hub's header."""
    meta = dataset.meta
    images = dataset.image_keys
    size = f"{dataset.image_size} × {dataset.image_size}"
    lost = "".join(
        f" The video of `{view}` differs from the images by {error:.2f} of 255 on average."
        for view, error in meta.get("video_error", {}).items()
    )
    stored = f"as {dataset.video} video.{lost}" if dataset.video else "lossless."
    rows = "\n".join(f"| `{key}` | {text} |" for key, text in COLUMN_TEXTS.items())
    looks = ""
    if dataset.variants > 1:
        looks = (
            f" Every {dataset.variants} consecutive episodes show one demonstration, each "
            "with its own look."
        )
    shown = "\n".join(f"| `{key}` | {size} |" for key in images)
    return f"""---
license: {licence}
task_categories:
- robotics
tags:
- LeRobot
- surgical-robotics
- suturing
- imitation-learning
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {repo.partition("/")[2]}

{task_text(dataset.task)}

{meta["episodes"]} simulated demonstrations of the task `{dataset.task}` in robotic suturing:
{dataset.length} frames at {dataset.fps} per second, by {", ".join(meta["demonstrators"])}.{looks}
LeRobot {CODEBASE_VERSION} format, by surgicai-vision ({meta["code_version"]}).
Images of {size} pixels, {stored}

| column | content |
|---|---|
{rows}
{shown}

Lengths in metres, angles in radians, depth in metres. The cameras' intrinsics and poses, the task's
configuration and the renderer ({", ".join(meta["renderers"])}) are in `{names.META_FILE}`.
Digest of the decoded content: `{meta["digest"]}`.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{repo}")
```

```sh
surgicai-vision dataset pull {repo} --out dataset
surgicai-vision dataset check dataset
```
"""


COLUMN_TEXTS = {
    names.STATE: f"measured tip of the active arm in its base: {', '.join(names.STATE_NAMES)}",
    names.ACTION: f"{', '.join(names.ACTION_NAMES)}, each in [-1, 1]",
    names.NEEDLE_POSE: "needle in the world: x, y, z and quaternion w, x, y, z",
    names.PHASE: f"index in {', '.join(names.SUBTASKS)}; -1 in another task",
    names.SEED: "seed of the episode's start",
    names.REWARD: "reward of the frame's action",
    names.SUCCESS: "success after the frame's action",
    names.CONTACT: "jaws touch the needle after the frame's action",
    names.DONE: "last frame of the episode",
}


def push_dataset(
    path: Path,
    repo: str,
    *,
    private: bool = False,
    licence: str = LICENCE,
    progress: Progress = silent,
    api: "HfApi | None" = None,
) -> str:
    """Push a dataset of ours with its card, in one commit; return the commit's address.

    A dataset that the repository held before is replaced.

    Args:
        path: the dataset.
        repo: "user/name"; created if it does not exist.
        private: make it private.
        licence: the Hub's short name of a licence.
        progress: called while the dataset is checked.
        api: a `huggingface_hub.HfApi`; created here by default.

    Raises:
        InputError: a bad name.
        BadFile: the dataset is damaged.
        SurgicaiError: offline, or the Hub refuses.
    """
    dataset = open_dataset(path)
    api = connect(repo, api)
    _whole(check_dataset(path, progress), str(path))
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    card = dataset_card(dataset, repo, licence)
    files = [file for name in KEPT for file in sorted((path / name).rglob("*")) if file.is_file()]
    pushed = {file.relative_to(path).as_posix(): file for file in files}
    operations: list[CommitOperationAdd | CommitOperationDelete] = [
        CommitOperationAdd(name, file) for name, file in pushed.items()
    ]
    operations.append(CommitOperationAdd(CARD, io.BytesIO(card.encode())))
    with refusals_in_one_line(repo):
        api.create_repo(repo, repo_type="dataset", private=private, exist_ok=True)
        # Files of an earlier, larger dataset would become a part of this one.
        operations += [
            CommitOperationDelete(name)
            for name in api.list_repo_files(repo, repo_type="dataset")
            if name.partition("/")[0] in KEPT and name not in pushed
        ]
        text = f"{dataset.meta['episodes']} episodes of {dataset.task}"
        commit = api.create_commit(repo, operations, commit_message=text, repo_type="dataset")
        tags = api.list_repo_refs(repo, repo_type="dataset").tags
        if any(tag.name == CODEBASE_VERSION for tag in tags):
            api.delete_tag(repo, tag=CODEBASE_VERSION, repo_type="dataset")
        api.create_tag(repo, tag=CODEBASE_VERSION, revision=commit.oid, repo_type="dataset")
    return str(commit.commit_url)


def pull_dataset(
    repo: str,
    out: Path,
    *,
    revision: str | None = None,
    progress: Progress = silent,
    api: "HfApi | None" = None,
) -> CheckReport:
    """Fetch a dataset of ours into the new folder `out` and check it.

    A call after a failure continues with what was already fetched, unless that was damaged.

    Raises:
        InputError: a bad name.
        OutputExists: `out` holds something.
        BadFile: what was fetched is damaged or not a dataset of ours.
        SurgicaiError: offline, or the Hub refuses.
    """
    check_output(out)
    api = connect(repo, api)
    with building(out) as (store, result):
        # A failed pull of another repository or revision may have left its files in the store.
        fetched = store / f"fetched-{digest([repo, revision])[:12]}"
        with refusals_in_one_line(repo):
            wanted = [f"{name}/**" for name in KEPT]
            api.snapshot_download(
                repo,
                repo_type="dataset",
                revision=revision,
                local_dir=fetched,
                allow_patterns=[*wanted, CARD],
            )
        shutil.rmtree(fetched / ".cache", ignore_errors=True)  # the Hub client's notes
        if not (fetched / names.META_FILE).exists():
            raise BadFile(
                f"{repo} is not a dataset of surgicai-vision; fetch it with 'hf download {repo} "
                "--repo-type dataset' and check it with 'lerobot-salvage check DIR'."
            )
        try:
            report = check_dataset(fetched, progress)
            _whole(report, repo)
        except BadFile:  # the next pull must not continue with it
            shutil.rmtree(fetched)
            raise
        if out.exists():
            out.rmdir()  # empty, as checked above
        os.rename(fetched, result)
    return report


def _whole(report: CheckReport, where: str) -> None:
    if not report.ok:
        raise BadFile(
            f"{where} is damaged: {report.problems[0]} See `surgicai-vision dataset check --help`."
        )
