"""Quickstart: the whole flow once, small: demos → dataset → features → policies → evaluation →
report.

One folder holds everything: `demos/`, `dataset/`, `policies/<name>/`, `evaluations/<name>/`,
`run.json` and `report.html`. A step that is there is not done again, so the same command continues
a broken-off run.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.progress import timed
from surgicai_vision.evaluation.policy_spec import baseline_subject, checkpoint_subject
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.run import evaluate_once
from surgicai_vision.experiments.quickstart_config import Quickstart
from surgicai_vision.experiments.run import train_cell
from surgicai_vision.features import encoders
from surgicai_vision.report import RUN_FILE, write_report


def run_quickstart(plan: Quickstart, out: Path, context: RunContext) -> dict[str, Any]:
    """Do everything that is not done yet and write the report.

    Args:
        plan: what to do.
        out: the folder; one of another plan is refused.
        context: workers, engine and display.

    Returns:
        {"report", "results" (summaries, expert last), "seconds"}.

    Raises:
        MissingWeights: an encoder's weights are not at hand; before any work.
        OutputExists: `out` holds something else.
    """
    for cell in plan.cells:
        if cell.encoder:
            encoders.find_weights(cell.encoder)
    run = _open_run(plan, out)
    config, seeds = TaskConfig(plan.task), range(names.TEST_SEED, names.TEST_SEED + plan.episodes)
    with timed(context.stage, run["seconds"]) as measured:
        from surgicai_vision.experiments.prepare import prepare_dataset

        dataset_folder = prepare_dataset(
            config,
            out,
            dataclasses.replace(context, stage=measured),
            demonstrations=plan.demonstrations,
            views=plan.view,
            size=plan.size,
            depth=plan.depth,
        )
        from surgicai_vision.dataset import open_dataset
        from surgicai_vision.training.checkpoint import CARD

        dataset = open_dataset(dataset_folder)
        results = []
        for cell in plan.cells:
            policy = out / "policies" / cell.name
            if not (policy / CARD).exists():
                train_cell(cell, dataset, policy, measured)
            make = functools.partial(checkpoint_subject, policy)
            results.append(
                evaluate_once(
                    out / "evaluations" / cell.name, make, seeds, measured, context.workers
                )
            )
            _store_run(out, run)
        make = functools.partial(baseline_subject, "expert", config)
        results.append(
            evaluate_once(out / "evaluations" / "expert", make, seeds, measured, context.workers)
        )
    run["provenance"] = provenance()
    run["data"] = (
        f"{plan.demonstrations} demonstrations of the scripted expert, {dataset.length} frames; "
        f"{' and '.join(plan.view)} at {plan.size} × {plan.size}, RGB{' and depth' if plan.depth else ''}; "
        f"behaviour cloning, recipe '{plan.recipe}', training seed {plan.seed}"
    )
    _store_run(out, run)
    with context.stage("report", "parts") as progress:
        page = write_report(out, progress=progress)
    return {"report": str(page), "results": results, "seconds": sum(run["seconds"].values())}


def _open_run(plan: Quickstart, out: Path) -> dict[str, Any]:
    """Make the folder and its `run.json`, or read them if they belong to the same plan."""
    files.check_output(out, may_resume=RUN_FILE)
    if (out / RUN_FILE).exists():
        run: dict[str, Any] = files.read_json(out / RUN_FILE)
        if run.get("plan") != to_mapping(plan):
            raise OutputExists(
                f"--out {out} holds a run with other options (see {out / RUN_FILE}); give another folder."
            )
        return run
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out} cannot be written: {error.strerror}; choose another folder."
        ) from None
    run = {
        "title": f"quickstart, {plan.task}",
        "command": command_line(),
        "plan": to_mapping(plan),
        "seconds": {},
    }
    _store_run(out, run)
    return run


def _store_run(out: Path, run: dict[str, Any]) -> None:
    files.write_json(out / RUN_FILE, run)
