"""Quickstart: the whole flow once, small, from demonstrations to the report.

One folder holds everything: `demos/`, `dataset/`, `policies/<name>/`, `evaluations/<name>/`,
`run.json` and `report.html`. A step that is there is not done again, so the same command continues
a broken-off run.
"""

import functools
from dataclasses import replace
from pathlib import Path

from surgicai_vision.core import files, names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.progress import timed
from surgicai_vision.dataset import open_dataset
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.run import evaluate_once
from surgicai_vision.evaluation.storage import FORMAT, RUN_FILE, Row, read_versioned
from surgicai_vision.experiments.prepare import prepare_dataset
from surgicai_vision.experiments.quickstart_config import Quickstart
from surgicai_vision.experiments.run import train_run
from surgicai_vision.features import encoders
from surgicai_vision.report import write_report
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import CARD
from surgicai_vision.training.run_config import Starts


def run_quickstart(plan: Quickstart, out: Path, context: RunContext) -> Row:
    """Do everything that is not done yet and write the report.

    Args:
        plan: what to do.
        out: the folder; one of another plan is refused.
        context: processes and progress.

    Returns:
        {"report", "results" (summaries, expert last), "seconds"}.

    Raises:
        MissingWeights: an encoder's weights are not at hand; before any work.
        UnknownName: a recipe that does not exist; before any work.
        OutputExists: `out` holds something else.
    """
    for run in plan.runs:
        policies.recipe_of(run)
        if run.encoder:
            encoders.find_weights(run.encoder)
    state = _open_state(plan, out)
    config = TaskConfig(plan.task)
    seeds = Starts(names.TEST_SEED, plan.episodes).seeds
    evaluations = out / "evaluations"
    results: list[Row] = []
    with timed(context.stage, state["seconds"]) as measured:
        folder = prepare_dataset(
            config,
            out,
            replace(context, stage=measured),
            demonstrations=plan.demonstrations,
            views=plan.view,
            size=plan.size,
            depth=plan.depth,
        )
        dataset = open_dataset(folder)
        for run in plan.runs:
            policy = out / "policies" / run.name
            if not (policy / CARD).exists():
                train_run(run, dataset, policy, measured)
            spec = functools.partial(open_policy, policy)
            results.append(
                evaluate_once(evaluations / run.name, spec, seeds, measured, context.workers)
            )
            _store_state(out, state)
        spec = functools.partial(open_policy, "expert", task=plan.task)
        results.append(
            evaluate_once(evaluations / "expert", spec, seeds, measured, context.workers)
        )
    state["provenance"] = provenance()
    state["data"] = (
        f"{plan.demonstrations} demonstrations of the scripted expert, {dataset.length} frames; "
        f"{' and '.join(plan.view)} at {plan.size} × {plan.size}, "
        f"RGB{' and depth' if plan.depth else ''}; "
        f"behaviour cloning, recipe '{plan.recipe}', training seed {plan.seed}"
    )
    _store_state(out, state)
    with context.stage("report", "parts") as progress:
        page = write_report(out, progress=progress)
    return {"report": str(page), "results": results, "seconds": sum(state["seconds"].values())}


def _open_state(plan: Quickstart, out: Path) -> Row:
    """Make the folder and its `run.json`, or read them if they belong to the same plan."""
    files.check_output(out, may_resume=RUN_FILE)
    if (out / RUN_FILE).exists():
        state = read_versioned(out / RUN_FILE)
        if state.get("plan") != to_mapping(plan):
            raise OutputExists(
                f"--out {out} holds a run with other options (see {out / RUN_FILE}); "
                "give another folder."
            )
        return state
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out} cannot be written: {error.strerror}; choose another folder."
        ) from None
    state = {
        "format": FORMAT,
        "title": f"quickstart, {plan.task}",
        "command": command_line(),
        "plan": to_mapping(plan),
        "seconds": {},
    }
    _store_state(out, state)
    return state


def _store_state(out: Path, state: Row) -> None:
    files.write_json(out / RUN_FILE, state)
