"""`evaluate`: run a policy from held-out starts and count successes."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from cyclopts import App, Parameter

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.options import (
    COUNT,
    DIRECTORY,
    SEED,
    VIEWS,
    AcceptLicence,
    ActingChanges,
    DatasetFolder,
    DetectorName,
    EnvFields,
    EvaluationWorkers,
    PolicyName,
    PolicyTask,
    WeightFiles,
    default_text,
    within,
)
from surgicai_vision.core import names
from surgicai_vision.core.banks import HELD_OUT, USES, bank_of
from surgicai_vision.core.config import JSON, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.core.percentages import interval, percent
from surgicai_vision.features.encoders import WeightsSource

if TYPE_CHECKING:
    from surgicai_vision.evaluation.films import Filming
    from surgicai_vision.evaluation.policy_spec import PolicySpec

app = App(
    name="evaluate",
    help_epilogue="""\
example:
  surgicai-vision evaluate expert --task grasp --episodes 50 --seed 900000 --json

A policy is evaluated in the world it was trained in, even if that world varies. A --config file
with `env: {randomisation: …}` chooses another world, and `env: {randomisation: {}}` the standing
world, where nothing varies.""",
)

ALL = "all"
"""`--expert-swap`: the policy as it is, then with the expert acting in each subtask in turn."""
REPLAY = "replay"
"""The policy that plays the mean demonstration of a dataset and observes nothing."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `evaluate`.

    Attributes:
        task: The task.
        episodes: Number of episodes.
        seed: Seed of the first start; each episode takes the next.
        workers: Number of processes.
        dataset: With policy replay, the dataset whose mean demonstration it plays.
        expert_swap: For a hierarchical policy, the subtask in which the expert acts instead; all
            takes each subtask in turn.
        upset: Make one thing go wrong in every episode, drawn by its start's seed: the needle is
            pushed, or jaws open (docs/evaluation.md).
        out: Folder for the rows; an earlier evaluation in it is replaced.
        video: Folder for videos of the episodes, one MP4 each; earlier ones in it are replaced.
        video_of: With --video, which episodes: all, failures, successes, or N for the first N
            starts.
        video_view: With --video, the views shown side by side.
        video_size: With --video, height and width of each view [px]; must be even.
    """

    policy: PolicyName = field(kw_only=False)
    task: PolicyTask = None
    episodes: Annotated[int, COUNT] = 20
    seed: Annotated[int, SEED] = names.TEST_SEED
    workers: EvaluationWorkers = None
    dataset: DatasetFolder = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    change: ActingChanges = ()
    detector: DetectorName = None
    expert_swap: Annotated[
        str | None, Parameter(choices=(*names.SUBTASKS, ALL), metavar="SUBTASK")
    ] = None
    upset: bool = False
    out: Annotated[
        Path | None,
        DIRECTORY,
        default_text("outputs/evaluations/<task>-<policy>-<training>-starts<seed>+<episodes>"),
    ] = None
    video: Annotated[Path | None, DIRECTORY] = None
    video_of: Annotated[str, Parameter(metavar="WHICH")] = "all"
    video_view: Annotated[tuple[str, ...], VIEWS] = ("front", "back")
    video_size: Annotated[int, within(64, 960), Parameter(metavar="PX")] = 384
    env: EnvFields = None


@app.default
def run(options: Options, *, console: Console) -> dict[str, object]:
    """Evaluate, keep the rows and print the summary."""
    from surgicai_vision.envs.upset import check_upset_task
    from surgicai_vision.evaluation.run import evaluate_into
    from surgicai_vision.evaluation.storage import MARKER, OURS

    if options.expert_swap == ALL:
        refused = {
            "--video": options.video,
            "--upset": options.upset,
            "--change": options.change,
            "--detector": options.detector,
        }
        for option, given in refused.items():
            if given:
                raise InputError(
                    f"{option} does not go with --expert-swap {ALL}; give one subtask."
                )
        _check_dataset(options.policy, options.dataset)
        _filming(options)  # refuses options that go with --video
        return _evaluate_swaps(options, console)
    spec = open_given(
        console,
        options.policy,
        options.task,
        options.env,
        options.dataset,
        WeightsSource.parse(options.weights, options.accept_licence),
        options.expert_swap,
        options.change,
        options.detector,
    )
    if options.upset:
        check_upset_task(spec.config.task)
        spec = replace(spec, run=replace(spec.run, upset=True))
    seeds = range(options.seed, options.seed + options.episodes)
    out = options.out or folders.evaluation_folder(spec, options.seed, options.episodes)
    folders.check_folder(out, MARKER, ours=OURS)
    filming = _filming(options)
    with console.stage(f"evaluating {spec.name} on {spec.config.task}", "steps") as progress:
        result = evaluate_into(out, spec, seeds, options.workers, progress, filming)
    console.say(summary_line(result))
    say_conditions(seeds, spec.config, console)
    console.say(f"episodes: {out}")
    result |= {
        "starts": bank_of(seeds[0]),
        "randomisation": varied(spec.config),
        "out": str(out),
    }
    if filming is None:
        return result
    videos = [str(filming.folder / name) for name in filming.videos()]
    console.say(f"videos: {filming.folder} ({len(videos)})")
    return {**result, "videos": videos}


def varied(config: TaskConfig) -> dict[str, object]:
    """Return the axes along which the world varies from episode to episode, with their values."""
    return {axis: vars(config.randomisation)[axis] for axis in config.randomisation.on}


def _note_aim(spec: "PolicySpec", console: Console) -> None:
    """Say so if a policy without a detector learned from crops that one aims."""
    looks = spec.run.variants
    if looks and looks.aimed:
        console.note(
            "note: this policy learned from crops where a detector sees the jaws (render-demos "
            "--aimed); without a detector they lie where the arm reports them, which is "
            "elsewhere where cameras or joints are off."
        )


def say_conditions(seeds: range, config: TaskConfig, console: Console) -> None:
    """Print which bank the starts are from, unless held-out, and how the world varies."""
    bank = bank_of(seeds[0])
    if bank != HELD_OUT:
        console.say(
            f"starts: {seeds[0]}–{seeds[-1]} are {bank} starts ({USES[bank]}); held-out ones, for "
            f"results, begin at {names.TEST_SEED}"
        )
    if config.randomisation.on:
        console.say(
            f"world: varies ({config.randomisation.text}); `env: {{randomisation: {{}}}}` in a "
            "--config file evaluates in the standing world"
        )


def _filming(options: Options) -> "Filming | None":
    """Return which episodes become videos; None without --video."""
    from surgicai_vision.evaluation.films import INDEX, Filming, Look

    if options.video is None:
        plain = Options(policy="")
        for name in ("video_of", "video_view", "video_size"):
            if getattr(options, name) != getattr(plain, name):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option} goes with --video; give both or leave it out.")
        return None
    folders.check_folder(options.video, INDEX, "--video")
    return Filming(options.video, options.video_of, Look(options.video_view, options.video_size))


def open_given(
    console: Console,
    policy: str,
    task: str | None,
    env: dict[str, object] | None,
    dataset: Path | None,
    weights: WeightsSource,
    expert_swap: str | None = None,
    changes: tuple[str, ...] = (),
    detector: str | None = None,
) -> "PolicySpec":
    """Return the policy that the options of this or another command describe.

    Says so if the policy learned from crops that a detector aims and is given none.
    """
    from surgicai_vision.evaluation.policy_spec import open_policy

    _check_dataset(policy, dataset)
    demonstrated = folders.open_dataset(dataset, task, ()) if policy == REPLAY else None
    spec = open_policy(
        policy,
        task=task,
        env=cast("dict[str, JSON] | None", env),
        dataset=demonstrated,
        expert_swap=expert_swap,
        weights=weights,
        changes=changes,
    )
    if detector is None:
        _note_aim(spec, console)
        return spec
    from surgicai_vision.evaluation.aimed_agent import aimed

    return aimed(spec, detector)


def _check_dataset(policy: str, dataset: Path | None) -> None:
    """Refuse a dataset that the policy does not read."""
    if dataset and policy != REPLAY:
        raise InputError("--dataset is only for replay; leave it out.")


def _evaluate_swaps(options: Options, console: Console) -> dict[str, object]:
    """Evaluate a hierarchical policy as it is, then with the expert in each subtask in turn."""
    from surgicai_vision.evaluation.expert_swap import (
        AS_IT_IS,
        CURVES,
        MARK,
        evaluate_swaps,
        variants_of,
    )
    from surgicai_vision.evaluation.hierarchical_config import SUFFIXES
    from surgicai_vision.training.released import resolve

    path = resolve(options.policy)
    if path.suffix not in SUFFIXES:
        raise InputError(
            f"--expert-swap {ALL} is for the YAML file of a hierarchical policy; leave it out."
        )
    if options.task not in (None, names.SUTURE):
        raise InputError(
            f"--task {options.task}: {options.policy} does the whole procedure; leave --task out."
        )
    weights = WeightsSource.parse(options.weights, options.accept_licence)
    variants = variants_of(path, cast("dict[str, JSON] | None", options.env), weights)
    plain = variants[AS_IT_IS]
    default = folders.evaluation_folder(plain, options.seed, options.episodes)
    out = options.out or default.with_name(f"{default.name}-expert-swaps")
    folders.check_folder(out, MARK)
    seeds = range(options.seed, options.seed + options.episodes)
    rows = evaluate_swaps(variants, seeds, out, console.stage, options.workers)
    for swap in dict.fromkeys(row["expert_swap"] for row in rows):
        mine = [row for row in rows if row["expert_swap"] == swap]
        who = f"expert in {swap}" if swap else "as it is"
        console.say(
            f"{who:<18} " + ", ".join(f"{row['subtask']} {row['k']}/{row['n']}" for row in mine)
        )
    say_conditions(seeds, plain.config, console)
    console.say(f"expert swaps: {out / CURVES}")
    return {
        "policy": plain.name,
        "task": plain.config.task,
        "starts": bank_of(seeds[0]),
        "expert_swap": rows,
        "out": str(out),
    }


def summary_line(result: dict[str, Any]) -> str:
    """Return one line about an evaluation."""
    line = (
        f"{result['policy']} on {result['task']}: {result['successes']}/{result['episodes']} "
        f"({percent(result['success_rate'])}, 95 % interval {interval(result['ci95'])})"
    )
    if result["paper_successes"] != result["successes"]:
        line += f", {result['paper_successes']} by the paper's tolerances alone"
    length, steps = result["trajectory_length_mm"], result["time_steps"]
    if length["mean"] is not None:
        line += f", {length['mean']:.1f} mm and {steps['mean']:.0f} steps"
    if result["failures"]:
        line += "; failed: " + ", ".join(
            f"{count} {kind.replace('_', ' ')}" for kind, count in result["failures"].items()
        )
    if "subtasks" in result:
        line += "; reached " + ", ".join(
            f"{stage['subtask']} {stage['k']}" for stage in result["subtasks"]
        )
    if "upsets" in result:
        line += "; recovered " + ", ".join(
            f"{kind} {count['k']}/{count['n']}" for kind, count in result["upsets"].items()
        )
    if "ends" in result:
        late = result["end_delay_s"]["mean"]
        line += f"; {result['false_ends']['mean']:.2f} false ends per procedure"
        line += "" if late is None else f", the others {late:.2f} s after the measured success"
    return line + _bite(result)


def _bite(result: dict[str, Any]) -> str:
    """Return the medians of the stitches, to end a line; "" if there are none."""
    entry, leaving, force = (
        result[column]["median"] for column in ("entry_mm", "exit_mm", "tissue_force_n")
    )
    if entry is None or leaving is None:
        return ""
    return (
        f"; medians: entry {entry:.2f} mm and exit {leaving:.2f} mm from the marks, "
        f"largest force on the tissue {force:.1f} N"
    )
