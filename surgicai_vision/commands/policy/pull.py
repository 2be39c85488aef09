"""`policy pull`: fetch a policy from the Hugging Face Hub and verify it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import DIRECTORY, default_text

app = App(
    name="pull",
    help_epilogue="""\
example:
  surgicai-vision policy pull somebody/suturing-grasp-bc --out outputs/train/pulled""",
)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `policy pull`.

    Attributes:
        repo: A policy on the Hub, shared by `policy push`.
        out: Folder to create.
        revision: Branch, tag or commit to fetch.
    """

    repo: Annotated[str, Parameter(metavar="USER/NAME")] = field(kw_only=False)
    out: Annotated[Path | None, DIRECTORY, default_text("outputs/train/NAME")] = None
    revision: Annotated[
        str | None, Parameter(metavar="REVISION"), default_text("the main branch")
    ] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Fetch the policy, verify it and print where it is."""
    from surgicai_vision.training.hub import pull_policy

    name = options.repo.partition("/")[2] or options.repo
    out = options.out or folders.OUTPUTS / "train" / name
    checkpoint = pull_policy(options.repo, out, revision=options.revision)
    console.say(f"{checkpoint.run.name} for {checkpoint.task.task}: {out}")
    console.say(f"next: surgicai-vision evaluate {out}")
    return {
        "repo": options.repo,
        "checkpoint": str(out),
        "policy_sha256": checkpoint.policy_sha256,
    }
