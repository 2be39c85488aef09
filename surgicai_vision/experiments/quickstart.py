"""Quickstart, in two acts: a whole procedure to watch, then the whole workflow at a small scale.

Act 1: a released policy sews one stitch from images; a video is written (`first_stitch`). Act 2:
demonstrations of one subtask are recorded, rendered and encoded; policies are trained on them and
evaluated on the same held-out starts.

One folder holds everything: `procedure/`, `demos/`, `dataset/`, `policies/<name>/`,
`evaluations/<name>/`, `run.json` and `report.html`. A finished step is not repeated, so the
same command continues an interrupted run.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from surgicai_vision.core import files, names
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError, OutputExists
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.percentages import interval
from surgicai_vision.core.progress import timed
from surgicai_vision.dataset import open_dataset
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.provenance import command_line, provenance
from surgicai_vision.evaluation.run import evaluate_once
from surgicai_vision.evaluation.storage import FORMAT, RUN_FILE, Row, read_versioned
from surgicai_vision.experiments.first_stitch import POSTER, STRIP, VIDEO, Sewer, find_sewer, sew
from surgicai_vision.experiments.prepare import check_dataset, make_dataset
from surgicai_vision.experiments.quickstart_config import Quickstart
from surgicai_vision.experiments.run import train_run
from surgicai_vision.experiments.training_check import check_training
from surgicai_vision.features import encoders
from surgicai_vision.report import write_report
from surgicai_vision.scene.opengl import check_opengl
from surgicai_vision.training.checkpoint import CARD
from surgicai_vision.training.run_config import RunConfig, Starts

PROCEDURE = "procedure"
"""Folder of the first act."""


def run_quickstart(
    plan: Quickstart, out: Path, context: RunContext, say: Callable[[str], None]
) -> Row:
    """Do everything that is not done yet and write the report.

    Args:
        plan: what to do.
        out: the folder; one of another plan is refused.
        context: processes and progress.
        say: called with a line for each result.

    Returns:
        {"report", "procedure" (result of the first act, or None), "results" (summaries, expert
        last), "seconds"}.

    Raises:
        MissingWeights: an encoder's weights are not at hand; before any work.
        InputError: images that cannot be rendered, or not on this machine, or a policy that cannot
            be trained on them; before any work.
        UnknownName: a recipe that does not exist; before any work.
        OutputExists: `out` holds something else.
    """
    check_dataset(plan.dataset)
    for run in plan.runs:
        check_training(run, plan.dataset, None)
        if run.encoder:
            encoders.find_weights(run.encoder)
    check_opengl()
    sewer = find_sewer(plan.procedure) if plan.procedure else None
    state = _open_state(plan, out)
    sewn = None if sewer is None else _first_act(plan, sewer, out, state, context, say)
    results = _second_act(plan, out, state, context, say)
    state["provenance"] = provenance()
    state.update(_finding(plan, results))
    _store_state(out, state)
    with context.stage("report", "parts") as progress:
        page = write_report(out, progress=progress)
    return {
        "report": str(page),
        "procedure": sewn,
        "results": results,
        "seconds": sum(state["seconds"].values()),
    }


def _first_act(
    plan: Quickstart,
    sewer: Sewer,
    out: Path,
    state: Row,
    context: RunContext,
    say: Callable[[str], None],
) -> Row:
    """Sew and film a procedure, and announce what comes next; return the result."""
    say(f"Act 1. A whole procedure by {sewer.who}.")
    if sewer.why:
        say(f"  Instead of {plan.procedure}, which cannot be used: {sewer.why}")
    with timed(context.stage, state["seconds"]) as measured:
        sewn = sew(sewer, out / PROCEDURE, say, measured)
    state["video"] = _video(sewn)
    _store_state(out, state)
    say("")
    say(
        f"Act 2. A policy for {plan.task}, from demonstrations to measured successes, and what to "
        "compare it with."
    )
    return sewn


def _second_act(
    plan: Quickstart, out: Path, state: Row, context: RunContext, say: Callable[[str], None]
) -> list[Row]:
    """Train and evaluate the policies; return the summaries, the expert's last."""
    seeds = Starts(names.TEST_SEED, plan.episodes).seeds
    evaluations = out / "evaluations"
    results: list[Row] = []
    with timed(context.stage, state["seconds"]) as measured:
        folder = make_dataset(plan.dataset, out, replace(context, stage=measured))
        dataset = open_dataset(folder)
        state["data"] = (
            f"{plan.demonstrations} demonstrations of the scripted expert, {dataset.length} "
            f"frames; {' and '.join(plan.view)} at {plan.size} × {plan.size}; "
            f"behaviour cloning, training seed {plan.seed}"
        )
        for run in plan.runs:
            policy = out / "policies" / run.name
            if not (policy / CARD).exists():
                train_run(run, dataset, policy, measured)
            spec = functools.partial(open_policy, policy)
            result = evaluate_once(evaluations / run.name, spec, seeds, measured, context.workers)
            results.append(result)
            say(f"  {result['successes']:>2}/{result['episodes']}  {result['policy']}")
            _store_state(out, state)
        spec = functools.partial(open_policy, "expert", task=plan.task)
        results.append(
            evaluate_once(evaluations / "expert", spec, seeds, measured, context.workers)
        )
    return results


def _finding(plan: Quickstart, results: Sequence[Row]) -> dict[str, str]:
    """Return the page's headline, successes next to those of others, and the line below it."""
    trained = list(zip(plan.runs, results, strict=False))
    (run, shown), *others = trained
    beside = ", ".join(f"{_words(other)} {result['successes']}" for other, result in others)
    details = "; ".join(
        (
            *(f"{_words(other)} {_count(result)}{_seen(other)}" for other, result in others),
            *(
                f"the scripted {result['policy']} {_count(result)}"
                for result in results[len(trained) :]
            ),
        )
    )
    return {
        "headline": f"{plan.task.capitalize()}, {_words(run)}: {shown['successes']} of "
        f"{shown['episodes']} held-out starts" + (f"; {beside}" if beside else ""),
        "lead": f"Trained on {plan.demonstrations} demonstrations{_seen(run)}; 95 % interval "
        f"{interval(shown['ci95'])}. For comparison, from the same demonstrations and on "
        f"the same starts: {details}.",
    }


def _words(run: RunConfig) -> str:
    """Return a policy in words for a headline."""
    if not run.encoder:
        return "without images"
    recipe = Path(run.recipe).stem
    return "by the paper's recipe" if recipe == "paper" else f"from images by recipe {recipe}"


def _seen(run: RunConfig) -> str:
    """Return a policy's encoder and views, in brackets; empty for proprioception alone."""
    return f" ({run.encoder} on {' + '.join(run.views)})" if run.encoder else ""


def _count(result: Row) -> str:
    return f"{result['successes']}/{result['episodes']}"


def _video(sewn: Row) -> Row:
    """Return what the report shows of the first act."""
    return {
        "file": f"{PROCEDURE}/{VIDEO}",
        "poster": f"{PROCEDURE}/{POSTER}",
        "strip": f"{PROCEDURE}/{STRIP}",
        "title": f"One whole procedure by {sewn['who']}",
        "text": sewn["text"],
    }


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
    files.remove_partial(out, (RUN_FILE,))
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
