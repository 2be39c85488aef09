"""`train`: train a policy on a dataset's features, or with `--algo` by reinforcement learning."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter, validators

from surgicai_vision.commands import folders
from surgicai_vision.commands.console import Console
from surgicai_vision.commands.logs import LOGS, open_log
from surgicai_vision.commands.options import (
    COUNT,
    DEVICE,
    DIRECTORY,
    NOT_NEGATIVE,
    POOL,
    SEED,
    SUBTASK,
    TASK,
    VIEWS,
    AcceptLicence,
    DatasetFolder,
    EnvFields,
    WeightFiles,
    default_text,
    task_config,
)
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, read_changes, to_mapping
from surgicai_vision.core.errors import InputError, check_at_most
from surgicai_vision.evaluation.hierarchical_config import read_hierarchical
from surgicai_vision.features import encoders
from surgicai_vision.features.devices import find_device
from surgicai_vision.rl.algorithms import ALGORITHMS, LEARNED
from surgicai_vision.rl.high_level_config import DECISIONS, SAVE_EVERY, HighLevelRequest
from surgicai_vision.rl.residual_config import ALGO, BOUND, ResidualRequest, residual_settings
from surgicai_vision.training import policies
from surgicai_vision.training.checkpoint import LOCK, REQUEST, Checkpoint, read_checkpoint
from surgicai_vision.training.run_config import RunConfig, with_budget

if TYPE_CHECKING:
    from surgicai_vision.dataset import Dataset
    from surgicai_vision.dataset.made import Made
    from surgicai_vision.rl.settings import Request

app = App(
    name="train",
    help_epilogue="""\
example:
  surgicai-vision train --encoder imagenet-lite --view back
LeRobot's ACT on feature maps, for ten minutes on one core:
  surgicai-vision train --task handoff --policy act --encoder imagenet-lite-early --pool spatial \\
    --view front_psm1 --minutes 10
reinforcement learning:
  surgicai-vision train --algo td3-her-bc --env-steps 25000
a correction of an image policy:
  surgicai-vision train --algo td3 --env-steps 20000 \\
    --residual-on outputs/train/grasp-imagenet-lite-back-seed0
a high-level policy over policies of the subtasks:
  surgicai-vision train --task suture --algo ppo --low hierarchical.yaml""",
)
NO_ENCODER = "none"
"""`--encoder`: proprioception alone."""
STATE = "state"
"""`--encoder`: the state with the goal, an upper bound."""
IMITATED = tuple(name for name in policies.policy_names() if name not in LEARNED)
"""Choices of `--policy`: the others are what `--algo` trains."""


def _check_encoder(_: type, name: str) -> None:
    if name not in (NO_ENCODER, STATE):
        encoders.check_encoder_name(name)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `train`.

    Attributes:
        task: The task, which must be that of a given dataset or of given demonstrations.
        dataset: Folder of the dataset.
        subtask: Train on one subtask's frames of whole procedures, for a hierarchical policy.
        view: Views that the policy sees.
        pool: What to take from the encoder: one vector (global), a feature map (spatial) or tokens.
        policy: The kind of policy.
        change: Replace values of the recipe, such as clock=false,map_head=softmax, or one entry of
            a table in it, such as settings.use_vae=false.
        epochs: Number of passes over the frames.
        minutes: For a policy that plans chunks, as many epochs as fit into this many minutes of one
            core, instead of --epochs.
        device: Where to encode and train; auto uses a GPU if there is one.
        start: Checkpoint, or released:NAME, to start from, with the same inputs (fine-tuning).
        progress_from: Checkpoint, or released:NAME, of a high-level policy; it predicts the
            progress that a recipe with progress_input=true feeds to the policy.
        save_every: Also keep a checkpoint every N epochs; 0 keeps only the last. With --algo,
            evaluate and save the training state every N control steps (offline algorithms: updates;
            with --low: decisions); 0 means 5000 (with --low: 500).
        log: Where to log losses; auto uses TensorBoard if it is installed.
        seed: Training seed.
        out: Checkpoint folder to create or continue.
        algo: Train an actor on the state by this algorithm of reinforcement or offline learning
            (docs/rl.md); --change then changes the algorithm's settings.
        demos: With --algo, folder of demonstrations to learn from; otherwise the demonstrations of
            the dataset, in the order in which they were rendered, for a policy that plans chunks
            when the dataset has few frames.
        demonstrations: Use only the first N demonstrations of --demos, or of the dataset.
        observation: With --algo, what the actor sees of the state.
        env_steps: With --algo, control steps in the env; offline algorithms take none.
        updates: With an offline --algo, the number of updates.
        validation: With --algo, episodes of each evaluation during training.
        seeds: With --algo, train this many seeds, from --seed on, side by side.
        low: YAML file of a hierarchical policy (docs/hierarchical.md) with hlp: order; PPO learns
            the high-level policy over its subtasks' policies.
        decisions: With --low, the number of decisions to learn from.
        residual_on: Checkpoint, or released:NAME, of a cloned image policy; TD3 learns a correction
            of its actions.
        bound: With --residual-on, the largest correction of each element of an action.
        workers: With --algo, processes that train seeds, or step the envs of a single seed; 0 uses
            this process.
        env: Fields of the env, such as hold_jaw.
    """

    task: Annotated[str | None, TASK, default_text("the data's, else grasp")] = None
    dataset: DatasetFolder = None
    subtask: Annotated[str | None, SUBTASK, Parameter(metavar="SUBTASK")] = None
    encoder: Annotated[
        str,
        Parameter(
            help=f"Encoder: {encoders.encoder_choices()}; none for proprioception alone, state for "
            "the state with the goal.",
            validator=_check_encoder,
            metavar="NAME",
        ),
    ] = "imagenet-lite"
    view: Annotated[tuple[str, ...] | None, VIEWS, default_text("front,back")] = None
    weights: WeightFiles = ()
    accept_licence: AcceptLicence = False
    pool: Annotated[str, POOL] = "global"
    policy: Annotated[str, Parameter(choices=IMITATED)] = "bc"
    recipe: Annotated[
        str | None,
        Parameter(
            help=f"Recipe of the policy: {', '.join(policies.recipe_names())}, or FILE.yaml.",
            metavar="NAME",
        ),
        default_text("the recipe named like the policy if there is one, else paper"),
    ] = None
    change: Annotated[
        tuple[str, ...], Parameter(metavar="KEY=VALUE[,KEY=VALUE]"), default_text("none")
    ] = ()
    epochs: Annotated[int | None, COUNT, default_text("the recipe's")] = None
    minutes: Annotated[
        float | None, Parameter(validator=validators.Number(gt=0)), default_text("the recipe's")
    ] = None
    device: Annotated[
        str | None, DEVICE, default_text("encode on a GPU if there is one, train on the CPU")
    ] = None
    start: Annotated[Path | None, DIRECTORY] = None
    progress_from: Annotated[Path | None, DIRECTORY] = None
    save_every: Annotated[int, NOT_NEGATIVE] = 0
    log: Annotated[str, Parameter(choices=LOGS)] = "auto"
    seed: Annotated[int, SEED] = 0
    out: Annotated[
        Path | None, DIRECTORY, default_text("outputs/train/<task>-<policy>-seed<seed>")
    ] = None
    algo: Annotated[str | None, Parameter(choices=tuple(ALGORITHMS))] = None
    demos: Annotated[
        tuple[Path, ...], Parameter(metavar="DIR[,DIR]"), default_text("outputs/demos/<task>")
    ] = ()
    demonstrations: Annotated[int | None, COUNT, default_text("all")] = None
    observation: Annotated[str, Parameter(choices=("relative", "state"))] = "relative"
    env_steps: Annotated[int, COUNT] = 50_000
    updates: Annotated[int, COUNT] = 10_000
    validation: Annotated[int, NOT_NEGATIVE] = 20
    seeds: Annotated[int, COUNT] = 1
    low: Annotated[Path | None, Parameter(metavar="FILE.yaml")] = None
    decisions: Annotated[int, COUNT] = DECISIONS
    residual_on: Annotated[Path | None, DIRECTORY] = None
    bound: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=1))] = BOUND
    workers: Annotated[int, NOT_NEGATIVE] = 0
    env: EnvFields = None


@app.default
def run(options: Options = Options(), *, console: Console) -> dict[str, object]:
    """Encode what is not in the cache, train and print where the checkpoint is."""
    _refuse_unread(options)
    if options.out and options.seeds > 1:
        raise InputError("--out names one folder; leave it out where --seeds trains several.")
    if options.low:
        return _high_level(options, options.low, console)
    if options.residual_on:
        return _residual(options, options.residual_on, console)
    if options.algo:
        return _reinforce(options, options.algo, console)
    if options.device is not None:
        find_device(options.device)
    weights = encoders.WeightsSource.parse(options.weights, options.accept_licence)
    encoder = None if options.encoder in (NO_ENCODER, STATE) else options.encoder
    if encoder:
        encoders.find_weights(encoder, weights)
    from surgicai_vision.experiments.run import train_run

    plugin = policies.policy_plugin(options.policy)
    if options.subtask and plugin.target == names.STAGE:
        raise InputError(
            f"Policy '{options.policy}' learns from whole procedures; leave --subtask "
            f"{options.subtask} out."
        )
    if options.demos and plugin.offsets is None:
        raise InputError(
            f"Policy '{options.policy}' learns from the frames of the dataset and reads no "
            "demonstrations; leave --demos out."
        )
    run = RunConfig(
        TaskConfig(names.SUTURE if options.subtask else options.task or "grasp"),
        encoder,
        _views(options, encoder),
        policy=options.policy,
        pool=options.pool if encoder else "global",
        privileged=options.encoder == STATE,
        recipe=options.recipe or policies.default_recipe(options.policy),
        changes=with_budget(options.change, options.epochs, options.minutes),
        seed=options.seed,
    )
    # Refuses a recipe that does not exist before any work.
    recipe = policies.recipe_of(run)
    policies.check_progress_from(recipe, options.progress_from)
    shown = options.task if options.dataset else run.task
    rendered = folders.open_dataset(options.dataset, shown, run.views)
    task = rendered.config.task
    folders.check_task(options.task, task, rendered.path)
    run = _learning_from(run, rendered.made)
    label = f"{options.subtask}-of-{task}" if options.subtask else task
    out = options.out or folders.train_folder(label, run.name, run.seed)
    folders.check_folder(out, REQUEST, ours=(LOCK,))
    is_high_level = policies.policy_plugin(run.policy).target == names.STAGE
    late = rendered.made.late
    if late and not is_high_level:
        console.note(
            f"warning: demonstrations of {rendered.path} notice a lost needle up to "
            f"{late} control steps late (record-demos --late) and until then act as if "
            f"they still held it; '{run.policy}' learns that too. `cut-demos` takes a subtask's "
            "visits without it."
        )
    dataset: Dataset = rendered
    if options.demonstrations or options.subtask:
        from surgicai_vision.dataset.subset import first_episodes, of_subtask, with_frame_stride

        if not options.subtask:  # whose stride counts from the beginning of its visits
            # In this order they are the first frames of all that are encoded without the option.
            dataset = with_frame_stride(dataset, recipe.frame_stride)
        if options.demonstrations:
            dataset = first_episodes(dataset, options.demonstrations)
        if options.subtask:
            dataset = of_subtask(dataset, options.subtask)
    run = replace(run, env=dataset.config)
    with open_log(options.log, out) as log:
        train_run(
            run,
            dataset,
            out,
            console.stage,
            weights,
            start=options.start,
            progress_from=options.progress_from,
            demos=options.demos,
            save_every=options.save_every,
            device=options.device,
            log=log,
        )
    console.say(f"checkpoint: {out}")
    _tell_errors(read_checkpoint(out), console)
    if not is_high_level:
        console.say(f"next: surgicai-vision evaluate {out}")
    return {"checkpoint": str(out)}


def _learning_from(run: RunConfig, made: "Made") -> RunConfig:
    """Return a run that records how its dataset's demonstrations were made."""
    return replace(
        run,
        demonstrator=made.demonstrator,
        noise=made.noise,
        post_success_steps=made.post_success_steps,
        frame_stride=made.frame_stride,
        variants=made.variants,
    )


def _tell_errors(checkpoint: Checkpoint, console: Console) -> None:
    """Print how well a high-level policy did on the held-out episodes."""
    errors = checkpoint.stage_errors
    if errors is None:
        return
    console.say(
        f"held-out frames: {errors.right} of {errors.frames} subtasks named correctly, calibration "
        f"error {errors.calibration_error:.3f}"
    )
    if errors.progress_error is not None:
        console.say(f"held-out frames: mean error of the progress {errors.progress_error:.3f}")


def _views(options: Options, encoder: str | None) -> tuple[str, ...]:
    if encoder is None:
        if options.view:
            raise InputError(
                f"--encoder {options.encoder} sees no image; leave --view out, or name an encoder."
            )
        return ()
    return ("front", "back") if options.view is None else options.view


IMITATION = "imitation from a dataset"
ONLINE = "an online --algo"
OFFLINE = "an offline --algo"
LOW = "--low"
RESIDUAL = "--residual-on"
_EVERY = ("algo", "save_every", "seed", "out")
_VALIDATED = (*_EVERY, "validation", "seeds")
_ACTOR = (
    *(*_VALIDATED, "task", "change", "log", "demos", "demonstrations"),
    *("observation", "workers", "env"),
)
READ: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        IMITATION: (
            *(*_EVERY, "task", "dataset", "subtask", "demos", "demonstrations"),
            *("encoder", "view", "weights", "accept_licence", "pool"),
            *("policy", "recipe", "change", "epochs", "minutes", "start", "progress_from"),
            *("device", "log"),
        ),
        ONLINE: (*_ACTOR, "env_steps"),
        OFFLINE: (*_ACTOR, "updates"),
        LOW: (*_VALIDATED, "task", "low", "decisions", "weights", "accept_licence"),
        RESIDUAL: (
            *(*_VALIDATED, "residual_on", "bound", "change", "env_steps"),
            *("weights", "accept_licence"),
        ),
    }
)
"""Way of training → the options that it reads."""


def _way(options: Options) -> str:
    """Return the way of training, a key of `READ`, that the options choose."""
    if options.low:
        return LOW
    if options.residual_on:
        return RESIDUAL
    if options.algo:
        return ONLINE if ALGORITHMS[options.algo].is_online else OFFLINE
    return IMITATION


def _refuse_unread(options: Options) -> None:
    """Refuse options that this way of training does not read, if they differ from their defaults.

    Raises:
        InputError: there is one; the message says which ways of training read it.
    """
    way = _way(options)
    for field in fields(Options):
        if field.name in READ[way] or getattr(options, field.name) == field.default:
            continue
        option = "env" if field.name == "env" else f"--{field.name.replace('_', '-')}"
        readers = ", ".join(other for other, read in READ.items() if field.name in read)
        raise InputError(f"{option} is not read by {way}, only by {readers}: leave it out.")


def _reinforce(options: Options, algo: str, console: Console) -> dict[str, object]:
    """Train an actor by reinforcement or offline learning; print where the checkpoints are."""
    from surgicai_vision.demos.store import demos_digest, first_demos
    from surgicai_vision.rl.extra import check_extra
    from surgicai_vision.rl.settings import Request, settings_of

    algorithm = ALGORITHMS[algo]
    check_extra(f"--algo {algo}", "stable_baselines3", "sb3_contrib", algorithm.library)
    if options.log == "wandb":
        raise InputError("--log wandb is for imitation; --algo logs to tensorboard or none.")
    settings = settings_of(algo, read_changes(options.change))
    task = options.task or "grasp"
    demos: list[Path] = []
    if algorithm.needs_demos:
        if len(options.demos) > 1:
            raise InputError(
                f"--algo {algo} learns from one folder of demonstrations; --demos names "
                f"{len(options.demos)}."
            )
        folder = options.demos[0] if options.demos else folders.demos_folder(task)
        demos = first_demos(folder, options.demonstrations)
        task = folders.demos_task(folder)
        folders.check_task(options.task, task, folder)
    elif options.demos or options.demonstrations:
        given = "--demos" if options.demos else "--demonstrations"
        raise InputError(f"--algo {algo} does not learn from demonstrations; leave {given} out.")
    config = task_config(task, options.env)
    requests = [
        Request(
            algo=algo,
            env=config,
            observation=options.observation,
            settings=settings,
            changes=options.change,
            env_steps=options.env_steps if algorithm.is_online else 0,
            updates=0 if algorithm.is_online else options.updates,
            seed=options.seed + index,
            demonstrations=len(demos),
            demos=demos_digest(demos) if demos else "",
            validation=options.validation,
            save_every=options.save_every or 5000,
        )
        for index in range(options.seeds)
    ]
    from surgicai_vision.rl.train import run_of, train_seeds

    outs = _checked_folders(options, requests, [run_of(request) for request in requests])
    notes: list[str] = []
    unit = "control steps" if algorithm.is_online else "updates"
    with console.stage(f"policy: {run_of(requests[0]).name}", unit) as progress:
        train_seeds(
            requests,
            demos,
            outs,
            workers=options.workers,
            progress=progress,
            note=notes.append,
            tensorboard=options.log in ("auto", "tensorboard"),
        )
    for text in dict.fromkeys(notes):  # every seed has the same
        console.note(f"warning: {text}")
    for out in outs:
        console.say(f"checkpoint: {out}")
    console.say(f"next: surgicai-vision evaluate {outs[0]}")
    return {"checkpoint": str(outs[0]), "checkpoints": [str(out) for out in outs]}


def _checked_folders(
    options: Options,
    requests: Sequence["Request | HighLevelRequest | ResidualRequest"],
    runs: Sequence[RunConfig],
) -> list[Path]:
    """Return the runs' checkpoint folders; refuse unusable ones before any work.

    Raises:
        InputError: a folder that cannot be written, or a seed that the libraries do not take.
        OutputExists: a folder that holds something else.
    """
    from surgicai_vision.rl.settings import LARGEST_SEED
    from surgicai_vision.training.folder import check_part

    check_at_most(LARGEST_SEED, seed=max(run.seed for run in runs))
    outs = [options.out or folders.train_folder(run.task, run.name, run.seed) for run in runs]
    for request, out in zip(requests, outs, strict=True):
        folders.check_folder(out, REQUEST, ours=(LOCK,))
        check_part(out, {"request": to_mapping(request)})
    return outs


def _high_level(options: Options, low: Path, console: Console) -> dict[str, object]:
    """Train a high-level policy over low-level ones by PPO; print where the checkpoints are."""
    from surgicai_vision.rl.extra import check_extra

    if options.algo != "ppo" or options.task != names.SUTURE:
        raise InputError(
            f"--low goes with --task {names.SUTURE} --algo ppo; got --task {options.task} --algo "
            f"{options.algo}."
        )
    check_extra("--low", "stable_baselines3")
    config = read_hierarchical(low)
    requests = [
        HighLevelRequest(
            config,
            options.decisions,
            seed=options.seed + index,
            validation=options.validation,
            save_every=options.save_every or SAVE_EVERY,
        )
        for index in range(options.seeds)
    ]
    from surgicai_vision.rl.high_level import run_of, train_high_level

    weights = encoders.WeightsSource.parse(options.weights, options.accept_licence)
    runs = [run_of(request, TaskConfig(names.SUTURE)) for request in requests]
    outs = _checked_folders(options, requests, runs)
    for request, run, out in zip(requests, runs, outs, strict=True):
        with console.stage(f"high-level policy: {run.name}", "decisions") as progress:
            train_high_level(request, out, weights=weights, progress=progress)
        console.say(f"checkpoint: {out}")
    console.say(f"next: set hlp: {outs[0]} in {low}, then surgicai-vision evaluate {low}")
    return {"checkpoint": str(outs[0]), "checkpoints": [str(out) for out in outs]}


def _residual(options: Options, base: Path, console: Console) -> dict[str, object]:
    """Train a correction of an image policy; print where the checkpoints are."""
    from surgicai_vision.rl.extra import check_extra

    if options.algo != ALGO:
        raise InputError(f"--residual-on goes with --algo {ALGO}; got --algo {options.algo}.")
    check_extra("--residual-on", "stable_baselines3")
    requests = [
        ResidualRequest(
            str(base),
            options.bound,
            residual_settings(read_changes(options.change)),
            options.change,
            options.env_steps,
            seed=options.seed + index,
            validation=options.validation,
            save_every=options.save_every or 5000,
        )
        for index in range(options.seeds)
    ]
    from surgicai_vision.rl.residual import base_of, run_of, train_residual

    weights = encoders.WeightsSource.parse(options.weights, options.accept_licence)
    corrected = base_of(requests[0], weights).run
    runs = [run_of(request, corrected) for request in requests]
    outs = _checked_folders(options, requests, runs)
    for request, run, out in zip(requests, runs, outs, strict=True):
        with console.stage(f"policy: {run.name}", "control steps") as progress:
            train_residual(request, out, weights=weights, progress=progress)
        console.say(f"checkpoint: {out}")
    console.say(f"next: surgicai-vision evaluate {outs[0]}")
    return {"checkpoint": str(outs[0]), "checkpoints": [str(out) for out in outs]}
