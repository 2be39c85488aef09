"""`evaluate`: run a policy from held-out starts and count successes."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    ACCEPT_LICENCE,
    COUNT,
    DIRECTORY,
    FILE_ONLY,
    NOT_NEGATIVE,
    TASK,
    WEIGHTS,
    default_text,
    read_yaml,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import from_mapping
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.features.encoders import WeightsSource

app = App(
    name="evaluate",
    help_epilogue="""\
example:
  surgicai-vision evaluate expert --task grasp --episodes 50 --seed 900000 --json""",
)

CHAIN_SUFFIXES = (".yaml", ".yml")
ALL = "all"
"""`--swap`: the chain as it is, and with every subtask swapped in turn."""
REPLAY = "replay"
"""The mean demonstration of a dataset, played blind."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `evaluate`.

    Attributes:
        policy: A checkpoint folder, a chain.yaml, or expert, replay, random or zero.
        task: The task.
        episodes: Number of episodes.
        seed: Seed of the first start; each episode takes the next.
        workers: Number of processes.
        dataset: Dataset whose mean demonstration replay plays.
        swap: For a chain, the subtask that the expert does, or all: each in turn.
        out: Folder for the rows; an earlier evaluation in it is replaced.
    """

    policy: Annotated[str, Parameter(metavar="POLICY")] = field(kw_only=False)
    task: Annotated[str | None, TASK, default_text("the checkpoint's, else grasp")] = None
    episodes: Annotated[int, COUNT] = 20
    seed: Annotated[int, NOT_NEGATIVE] = names.TEST_SEED
    workers: Annotated[
        int | None, COUNT, default_text("one a core, at most one for four episodes")
    ] = None
    dataset: Annotated[Path | None, DIRECTORY, default_text("outputs/datasets/<task>")] = None
    weights: Annotated[tuple[str, ...], WEIGHTS] = ()
    accept_licence: Annotated[bool, ACCEPT_LICENCE] = False
    swap: Annotated[str | None, Parameter(choices=(*names.SUBTASKS, ALL), metavar="SUBTASK")] = None
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text("outputs/evaluations/<task>-<policy>-starts<seed>+<episodes>"),
    ] = None
    env: Annotated[dict[str, object] | None, FILE_ONLY] = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Evaluate, keep the rows and print the summary."""
    from surgicai_vision.evaluation import run
    from surgicai_vision.evaluation.storage import MARKER

    if options.swap == ALL:
        return _run_swaps(options, console)
    subject = subject_of(options)
    seeds = range(options.seed, options.seed + options.episodes)
    default = folders.evaluation_folder(
        subject.config.task, subject.name, options.seed, options.episodes
    )
    out = options.out or default
    folders.check_folder(out, MARKER)
    title = f"evaluating {subject.name} on {subject.config.task}"
    with console.stage(title, "steps") as progress:
        result = run.evaluate_into(out, subject, seeds, options.workers, progress)
    console.say(summary_line(result))
    console.say(f"episodes: {out}")
    return {**result, "out": str(out)}


def subject_of(options: Any) -> Any:
    """Say who acts in which task: a baseline, or a checkpoint in the task it was trained for.

    Args:
        options: of `evaluate`, or of a command with the same fields but `swap`.
    """
    from surgicai_vision.evaluation import agents, lerobot_agent, policy_spec

    folder = Path(options.policy)
    swap = getattr(options, "swap", None)
    weights = WeightsSource.parse(options.weights, options.accept_licence)
    if swap and folder.suffix not in CHAIN_SUFFIXES:
        raise InputError(f"--swap {swap} is for a chain.yaml; leave it out.")
    if options.policy == REPLAY:
        subject = policy_spec.replay_subject(
            folders.open_dataset(options.dataset, options.task or "grasp", ())
        )
        return _in_env(subject, options.env)
    if options.dataset:
        raise InputError("--dataset is for replay alone; leave it out.")
    if folder.suffix in CHAIN_SUFFIXES:
        return _chain(folder, options, swap)
    if options.policy in agents.BASELINES:
        config = task_config(options.task or "grasp", options.env)
        return policy_spec.baseline_subject(options.policy, config)
    if not folder.exists() and folder.parent == Path():
        raise UnknownName(
            "policy or checkpoint folder", options.policy, (*agents.BASELINES, REPLAY)
        )
    lerobot = lerobot_agent.find(folder)
    if lerobot:
        subject = lerobot_agent.subject(lerobot, options.task, weights)
    else:
        subject = policy_spec.checkpoint_subject(folder, weights)
    trained_for = subject.config.task
    if options.task not in (None, trained_for):
        raise InputError(
            f"{folder} was trained for '{trained_for}', not for --task {options.task}; "
            "leave --task out."
        )
    return _in_env(subject, options.env)


def _in_env(subject: Any, env: dict[str, Any] | None) -> Any:
    """Put a subject into the env of the table `env`, where there is one."""
    return (
        dataclasses.replace(subject, config=task_config(subject.config.task, env))
        if env
        else subject
    )


def _chain(path: Path, options: Any, swap: str | None = None) -> Any:
    """Say who acts in a chain, in the task suture."""
    from surgicai_vision.evaluation import expert_swap, hierarchical

    config = from_mapping(hierarchical.Chain, read_yaml(path), str(path))
    if options.task not in (None, names.SUTURE):
        raise InputError(
            f"{path} is a chain of the whole procedure; leave --task {options.task} out."
        )
    env = {"max_steps": config.max_steps, **options.env} if options.env else None
    weights = WeightsSource.parse(options.weights, options.accept_licence)
    if swap != ALL:
        return _in_env(expert_swap.swapped(config, swap, weights), env)
    variants = expert_swap.variants_of(config, weights)
    return {name: _in_env(subject, env) for name, subject in variants.items()}


def _run_swaps(options: Options, console: Console) -> dict[str, object]:
    """Evaluate a chain as it is and with each subtask swapped, and print how far each comes."""
    from surgicai_vision.evaluation.expert_swap import AS_IT_IS, CURVES, MARK, survival_curves

    variants = subject_of(options)
    plain = variants[AS_IT_IS]
    default = folders.evaluation_folder(
        plain.config.task, plain.name, options.seed, options.episodes
    )
    out = options.out or default.with_name(f"{default.name}-swaps")
    folders.check_folder(out, MARK)
    seeds = range(options.seed, options.seed + options.episodes)
    rows = survival_curves(variants, seeds, out, console.stage, options.workers)
    for swap in dict.fromkeys(row["swap"] for row in rows):
        mine = [row for row in rows if row["swap"] == swap]
        who = f"expert in {swap}" if swap else "the chain"
        console.say(
            f"{who:<18} " + ", ".join(f"{row['subtask']} {row['k']}/{row['n']}" for row in mine)
        )
    console.say(f"survival: {out / CURVES}")
    return {"policy": plain.name, "task": plain.config.task, "survival": rows, "out": str(out)}


def summary_line(result: dict[str, Any]) -> str:
    """Return one line about an evaluation."""
    low, high = result["ci95"]
    line = (
        f"{result['policy']} on {result['task']}: {result['successes']}/{result['episodes']} "
        f"({100 * result['success_rate']:.0f} %, 95 % interval {100 * low:.0f}–{100 * high:.0f} %)"
    )
    length, steps = result["trajectory_length_mm"], result["time_steps"]
    if length["mean"] is not None:
        line += f", {length['mean']:.1f} mm and {steps['mean']:.0f} steps"
    if result["failures"]:
        line += "; failed: " + ", ".join(
            f"{count} {kind.replace('_', ' ')}" for kind, count in result["failures"].items()
        )
    if "survival" in result:
        line += "; reached " + ", ".join(
            f"{stage['subtask']} {stage['k']}" for stage in result["survival"]
        )
    return line
