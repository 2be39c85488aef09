"""`import-demos`: read demonstrations of the original SurgicAI."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgicai_vision import names
from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import one_of, option
from surgicai_vision.errors import InputError

EXAMPLE = "surgicai-vision import-demos regrasp_all_episodes_merged.pkl --task handoff --out outputs/demos/surgicai"


@dataclass(frozen=True)
class Options:
    """Options of `import-demos`."""

    file: str = option(dataclasses.MISSING, "a pickle as SurgicAI writes it", metavar="FILE.pkl")
    task: str | None = option(
        None,
        f"what it shows: {', '.join(names.SUBTASKS)}",
        check=one_of("task", names.SUBTASKS),
        default_text="none: say it",
    )
    out: str | None = option(None, "folder to make", metavar="DIR", default_text="outputs/demos/surgicai-<task>")


def run(options: Options, console: Console) -> dict[str, Any]:
    """Import and say where the demonstrations are."""
    from surgicai_vision.demos.importing import import_demos

    if options.task is None:
        raise InputError(f"import-demos needs --task: the file does not say it; one of {', '.join(names.SUBTASKS)}.")
    out = Path(options.out) if options.out else folders.demos_folder(f"surgicai-{options.task}")
    folders.check_folder(out, "demos.json")
    with console.stage(f"importing {options.task}", "episodes") as progress:
        summary = import_demos(Path(options.file), task=options.task, out=out, progress=progress)
    console.say(f"{len(summary.paths)} demonstrations of {options.task}, {summary.steps} steps: {out}")
    if summary.skipped:
        console.say(f"{len(summary.skipped)} episodes could not be replayed; {out}/demos.json says why.")
    return {
        "task": options.task,
        "episodes": len(summary.paths),
        "steps": summary.steps,
        "step": summary.step,
        "skipped": len(summary.skipped),
        "demos": str(out),
    }
