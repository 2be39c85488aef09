"""What is evaluated: `open_policy` is the only place that decides it.

open_policy("expert", task="grasp")          # or random, zero
open_policy("replay", dataset=dataset)       # the mean demonstration, without observing
open_policy("released:grasp")                # a policy that comes with the product
open_policy("outputs/train/grasp-…")         # a checkpoint of ours or of LeRobot's
open_policy("hierarchical.yaml")             # a high-level policy over low-level ones
open_policy("my_package.my_module:factory")  # a function that returns an `agent.Agent`
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from policies.chunks import ChunkPolicy
from surgicai_vision.core import names
from surgicai_vision.core.cameras import view_names
from surgicai_vision.core.config import (
    JSON,
    STEPS,
    TaskConfig,
    digest,
    from_mapping,
    read_changes,
    to_mapping,
)
from surgicai_vision.core.errors import (
    InputError,
    SurgicaiError,
    UnknownName,
    check_name,
    first_line,
)
from surgicai_vision.core.plugins import resolve
from surgicai_vision.core.tasks import task_text
from surgicai_vision.evaluation import lerobot_agent
from surgicai_vision.evaluation.agent import Agent, MakeAgent
from surgicai_vision.evaluation.agents import (
    BASELINES,
    RECOVER,
    PolicyAgent,
    ReplayAgent,
    mean_demonstration,
)
from surgicai_vision.evaluation.chunk_agent import ChunkAgent
from surgicai_vision.evaluation.denoised_agent import DenoisedAgent
from surgicai_vision.evaluation.hierarchical import HierarchicalAgent
from surgicai_vision.evaluation.hierarchical_config import (
    HLP,
    ORDER,
    SUFFIXES,
    HierarchicalConfig,
    read_hierarchical,
)
from surgicai_vision.features import encoders
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource
from surgicai_vision.training import policies, released
from surgicai_vision.training.checkpoint import Checkpoint, read_checkpoint
from surgicai_vision.training.progress_input import progress_policy_folder
from surgicai_vision.training.run_config import OWN, RunConfig, evaluated_in

if TYPE_CHECKING:
    from policies.base import Policy
    from surgicai_vision.dataset.protocol import Dataset

REPLAY = ReplayAgent.name
CONTENT = ("checkpoint", "dataset", "parts")
"""Keys of `PolicySpec.about` that hold hashes: of a checkpoint, of the dataset that is replayed,
and of the checkpoints of a hierarchical policy."""


@dataclass(frozen=True)
class PolicySpec:
    """What is evaluated in which task.

    Attributes:
        run: what it is, as data; `run.env` is the task.
        make: makes the agent in a worker process.
        about: what else is stored with the result: hashes and folders.
        training: what distinguishes it from others of its name in folder names: its training seed,
            or the beginning of a hash where that is not known; empty where there are no others.
        resumes: whether an evaluation that was killed keeps its finished episodes. A user's own
            function has no version that would tell whether they are still its own.
    """

    run: RunConfig
    make: MakeAgent
    about: Mapping[str, JSON] = field(default_factory=dict)
    training: str = ""
    resumes: bool = True

    @property
    def name(self) -> str:
        """Its name in tables."""
        return self.run.name

    @property
    def config(self) -> TaskConfig:
        """The task."""
        return self.run.env

    @property
    def folder_name(self) -> str:
        """Name for folders of what is evaluated: task, name, training and, if not plain, env."""
        parts = [self.config.task, self.name]
        if self.training and not self.name.endswith(f"-{self.training}"):
            parts.append(self.training)
        if self.config != TaskConfig(self.config.task):
            parts.append(f"env-{digest(self.config)[:8]}")
        return "-".join(parts)

    @property
    def content(self) -> dict[str, JSON]:
        """Hashes of what acts, by `CONTENT`; another training in the same folder has others."""
        return {key: self.about[key] for key in CONTENT if key in self.about}

    @property
    def make_agent(self) -> MakeAgent:
        """Makes the agent, with its name in tables."""
        return functools.partial(_named, self.make, self.name)


def _named(make: MakeAgent, name: str) -> Agent:
    """Make an agent and name it (in a worker process)."""
    agent = make()
    agent.name = name
    return agent


def open_policy(
    given: str | Path,
    *,
    task: str | None = None,
    env: Mapping[str, JSON] | None = None,
    dataset: "Dataset | None" = None,
    expert_swap: str | None = None,
    weights: WeightsSource = ANYWHERE,
    changes: tuple[str, ...] = (),
) -> PolicySpec:
    """Return what `given` names; checkpoints are read and their weights looked up at once.

    Args:
        given: a baseline's name, "replay", "released:NAME", a checkpoint folder of ours or
            LeRobot's, the YAML file of a hierarchical policy, or "module:factory".
        task: the task; None takes the checkpoint's, else grasp.
        env: fields of `TaskConfig` that differ from the default's; None keeps the env a policy was
            trained in.
        dataset: whose mean demonstration "replay" plays.
        expert_swap: the subtask of a hierarchical policy that the expert does instead.
        weights: where pretrained weights come from.
        changes: `KEY=VALUE` of `ACTED_BY` that replace the recipe's, for a checkpoint of ours.

    Raises:
        UnknownName: a name that is not known.
        BadFile: a folder or file that is no policy.
        InputError: a policy of another task, or an option that does not go with this policy.
        MissingWeights: an encoder's weights are not at hand.
    """
    text = str(given)
    path = released.resolve(given)
    if expert_swap is not None and path.suffix not in SUFFIXES:
        raise InputError(
            f"--expert-swap {expert_swap} is for the YAML file of a hierarchical policy; "
            f"leave it out for {text}."
        )
    if text == REPLAY:
        if dataset is None:
            raise InputError("replay plays the mean demonstration of a dataset; give a dataset.")
        spec = _replay(dataset)
    elif text in BASELINES:
        config = TaskConfig(_task_of_baseline(text, task))
        spec = PolicySpec(RunConfig(config, policy=text), BASELINES[text])
    elif path.suffix in SUFFIXES:
        spec = hierarchical_policy(read_hierarchical(path), expert_swap, weights)
    elif _names_code(text):
        spec = _from_factory(text, TaskConfig(task or "grasp"))
    elif not path.exists() and path.parent == Path():
        known = (*BASELINES, REPLAY, *map(released.PREFIX.__add__, released.released_names()))
        raise UnknownName("policy or checkpoint folder", text, known)
    else:
        spec = _from_folder(path, task, weights, changes)
    if changes and not spec.run.acted_by:
        raise InputError(
            f"--change {','.join(changes)} is for the checkpoint of one policy; "
            f"leave it out for {text}."
        )
    if released.is_released(text):
        spec = replace(spec, about={**spec.about, "folder": text})
    if task not in (None, spec.config.task):
        raise InputError(
            f"{text} was trained for '{spec.config.task}', not for '{task}'; "
            "leave the task out, or give a policy of that task."
        )
    return in_env(spec, env)


def _task_of_baseline(name: str, task: str | None) -> str:
    """Return the task of a baseline; the expert that goes back acts only in whole procedures."""
    if name != RECOVER:
        return task or "grasp"
    if task not in (None, names.SUTURE):
        raise InputError(
            f"'{RECOVER}' goes back to earlier subtasks, and '{task}' has none; "
            f"give --task {names.SUTURE}, or expert."
        )
    return names.SUTURE


def _names_code(text: str) -> bool:
    """Return True for "module:factory"."""
    return ":" in text and not released.is_released(text) and not Path(text).exists()


def in_env(spec: PolicySpec, env: Mapping[str, JSON] | None) -> PolicySpec:
    """Return what is evaluated, in the env of the table `env` if one is given.

    Args:
        spec: what is evaluated.
        env: fields of `TaskConfig` that differ from the default's; None or an empty table keeps the
            env that the policy was trained in.
    """
    if not env:
        return spec
    if "task" in env:
        raise InputError("env: the task is a separate option; write `task:` next to `env:`.")
    limit: dict[str, JSON] = {}
    make: Callable[..., Agent] = spec.make
    if spec.run.is_hierarchical:
        if "advance" in env:
            raise InputError(
                "env: advance follows from the termination of a hierarchical policy; leave it out."
            )
        limit = {"max_steps": spec.config.max_steps, "advance": spec.config.advance}
    config = from_mapping(TaskConfig, {**limit, **env, "task": spec.config.task}, "env")
    if spec.run.is_hierarchical:
        # It counts the control steps of a subtask.
        make = functools.partial(make, action_repeat=config.action_repeat)
    return replace(spec, run=evaluated_in(spec.run, config), make=make)


def _replay(dataset: "Dataset") -> PolicySpec:
    """Return the mean demonstration of an opened dataset.

    Raises:
        InputError: a dataset without a frame of every step.
    """
    needed = dataset.config.steps_per_second
    if dataset.fps != needed:
        raise InputError(
            f"{dataset.path} holds {dataset.fps} frames per second; "
            f"a replay needs one for each step: {needed}."
        )
    actions = mean_demonstration(dataset.columns()[names.ACTION], dataset.episode_index)
    run = RunConfig(dataset.config, policy=REPLAY)
    about: dict[str, JSON] = {"dataset": dataset.fingerprint}
    make = functools.partial(ReplayAgent, actions)
    return PolicySpec(run, make, about, dataset.fingerprint[:8])


def _from_factory(target: str, config: TaskConfig) -> PolicySpec:
    """Return the policy of a function "module:factory", called in each worker process."""
    agent = make_from_factory(target)
    encoder = OWN if agent.cameras else None
    run = RunConfig(config, encoder, agent.cameras, policy=target)
    return PolicySpec(run, functools.partial(make_from_factory, target), resumes=False)


def make_from_factory(target: str) -> Agent:
    """Call "module:factory" for an agent.

    Raises:
        InputError: there is no such function, it fails, or it returns something else.
    """
    module, _, name = target.partition(":")
    if not name or not all(module.split(".")):
        raise InputError(f"{target} is not a function in a module; give module:factory.")
    try:
        factory = resolve(target)
    except (ImportError, AttributeError) as error:
        raise InputError(f"{target} cannot be imported: {error}; give module:factory.") from error
    except Exception as error:  # third-party code, whose import may raise anything
        raise _failed(target, error) from error
    try:
        agent = factory() if callable(factory) else factory
    except SurgicaiError:
        raise
    except Exception as error:  # third-party code, which may raise anything
        raise _failed(target, error) from error
    if not isinstance(agent, Agent):
        raise InputError(
            f"{target} returns {type(agent).__name__}; "
            "it must be a function that returns a surgicai_vision.evaluation.agent.Agent."
        )
    return agent


def _failed(target: str, error: Exception) -> InputError:
    """Return the error for a factory, or the import of its module, that raised one."""
    return InputError(
        f"{target} fails with {type(error).__name__} ({first_line(error)}); give a function "
        "that takes no arguments and returns a surgicai_vision.evaluation.agent.Agent."
    )


def _from_folder(
    folder: Path, task: str | None, weights: WeightsSource, changes: tuple[str, ...]
) -> PolicySpec:
    """Return the policy of a checkpoint folder, LeRobot's or ours."""
    lerobot = lerobot_agent.find(folder)
    if lerobot is None:
        return _from_checkpoint(folder, weights, changes)
    known = lerobot_agent.read(lerobot, task)
    run = RunConfig(known.config, known.encoder, known.inputs.cameras, policy=known.policy)
    text = task_text(known.config.task)
    make = functools.partial(
        lerobot_agent.LeRobotAgent, run.name, lerobot, known.inputs, text, weights
    )
    about: dict[str, JSON] = {
        "checkpoint": {
            "policy_sha256": known.policy_sha256,
            "settings_sha256": known.settings_sha256,
        },
        "folder": str(lerobot),
    }
    return PolicySpec(run, make, about, digest(about["checkpoint"])[:8])


def _from_checkpoint(folder: Path, weights: WeightsSource, changes: tuple[str, ...]) -> PolicySpec:
    """Return the policy of a checkpoint folder of ours.

    Raises:
        BadFile: no checkpoint folder, or one without the policy whose progress it is fed.
        UnknownName: a change of a setting that does not decide how it acts.
        InputError: a high-level policy, or a change that is not allowed.
        MissingWeights: the encoder's weights are not at hand.
    """
    checkpoint = read_checkpoint(folder)
    if policies.policy_plugin(checkpoint.policy).target == names.STAGE:
        raise InputError(
            f"{folder} chooses subtasks and does not act; "
            "name it as hlp: in the file of a hierarchical policy (docs/hierarchical.md)."
        )
    progress = progress_policy_folder(checkpoint)
    encoder = checkpoint.encoder
    for record in (encoder, read_checkpoint(progress).encoder if progress else None):
        if record:
            encoders.find_weights(record.name, weights)
    about: dict[str, JSON] = {
        "checkpoint": _hashes(checkpoint),
        "folder": str(folder),
    }
    acted_by = read_changes(changes)
    if acted_by:
        policies.restore(checkpoint, acted_by)  # refuses what is not allowed
    if "denoise" in acted_by and encoder is None:
        raise InputError(f"{folder} sees no images that could be averaged; leave denoise out.")
    make = functools.partial(acting_agent, folder, weights, acted_by)
    run = replace(checkpoint.run, acted_by=changes)
    return PolicySpec(run, make, about, f"seed{run.seed}")


def _hashes(checkpoint: Checkpoint) -> dict[str, JSON]:
    """Return what distinguishes a checkpoint of ours from another one in the same folder."""
    encoder = checkpoint.encoder
    return {
        "weights_sha256": encoder.weights_sha256 if encoder else None,
        "policy_sha256": checkpoint.policy_sha256,
        "dataset": checkpoint.dataset,
        "recipe": digest(checkpoint.recipe),
    }


def acting_agent(
    folder: Path,
    weights: WeightsSource = ANYWHERE,
    changes: Mapping[str, JSON] = policies.UNCHANGED,
) -> Agent:
    """Make the agent of a checkpoint folder that acts, one action or a chunk of them at a time.

    Args:
        folder: the checkpoint.
        weights: where pretrained weights come from.
        changes: settings by which it acts instead of its own (`policies.restore`).

    Raises:
        InputError: the encoder at hand is not the one the policy was trained on.
        BadFile: the policy whose progress it is fed is not in its folder.
    """
    policy = policies.load_policy(folder, changes)
    senses = _agent_of(policy, weights)
    agent: Agent = senses
    if isinstance(policy, ChunkPolicy):
        translation, _, _ = STEPS[policy.checkpoint.task.step]
        agent = ChunkAgent(policy, senses, translation)
    return DenoisedAgent(agent, policy.denoise) if policy.denoise > 1 else agent


def policy_agent(folder: Path, weights: WeightsSource = ANYWHERE) -> PolicyAgent:
    """Make the agent of a checkpoint folder that answers one observation at a time.

    Raises:
        InputError: the encoder at hand is not the one the policy was trained on.
        BadFile: the policy whose progress it is fed is not in its folder.
    """
    return _agent_of(policies.load_policy(folder), weights)


def _agent_of(policy: "Policy", weights: WeightsSource) -> PolicyAgent:
    """Make the agent of a trained policy, with the encoder it was trained on."""
    checkpoint = policy.checkpoint
    encoder = policies.load_encoder_of(checkpoint, weights)
    progress = progress_policy_folder(checkpoint)
    return PolicyAgent(
        checkpoint.run.name,
        policy,
        encoder,
        checkpoint.views,
        checkpoint.image_size,
        policy.inputs.vector or (names.STATE,),
        policy_agent(progress, weights) if progress else None,
        checkpoint.task.action_repeat,
        policy.pace,
    )


def _common_env(trained_in: Iterable[TaskConfig]) -> TaskConfig:
    """Return the env that policies have in common, whatever their tasks.

    If what varies between episodes differed in their trainings, nothing varies.

    Raises:
        InputError: they were trained in different scenes or with different steps.
    """
    whole = TaskConfig(names.SUTURE)
    alike = {
        replace(env, task=whole.task, max_steps=whole.max_steps, advance=whole.advance)
        for env in trained_in
    } or {whole}
    if len(alike) > 1:
        alike = {replace(env, randomisation=whole.randomisation) for env in alike}
    if len(alike) > 1:
        raise InputError(
            "The policies were trained in different scenes or with different steps; "
            "give policies of one scene and step size."
        )
    return alike.pop()


def hierarchical_policy(
    config: HierarchicalConfig,
    expert_swap: str | None = None,
    weights: WeightsSource = ANYWHERE,
) -> PolicySpec:
    """Return a high-level policy over low-level ones, every checkpoint checked.

    Args:
        config: who decides and who acts.
        expert_swap: the subtask that the expert does instead of its policy.
        weights: where pretrained weights come from.

    Raises:
        BadFile: a folder that is no checkpoint.
        InputError: a policy of another subtask or scene than it is to act in.
    """
    low = {subtask: _low_level(subtask, policy, weights) for subtask, policy in config.low.items()}
    agents = {subtask: spec.make_agent for subtask, spec in low.items()}
    # The env is the one that the trained policies have in common; experts belong to no scene.
    trained = {subtask: spec.run for subtask, spec in low.items() if spec.run.is_trained}
    parts = {subtask: low[subtask].about["checkpoint"] for subtask in trained}
    about: dict[str, JSON] = {"hierarchical": to_mapping(config)}
    high: functools.partial[PolicyAgent] | None = None
    if config.hlp != ORDER:
        folder = released.resolve(config.hlp)
        checkpoint = _read_high_level(config.hlp, folder)
        if checkpoint.stage_errors is not None:
            about["high_level"] = {
                "policy_sha256": checkpoint.policy_sha256,
                "stage_errors": to_mapping(checkpoint.stage_errors),
            }
        trained[HLP] = checkpoint.run
        parts[HLP] = _hashes(checkpoint)
        high = functools.partial(policy_agent, folder, weights)
    env = _common_env([run.env for run in trained.values()])
    if expert_swap is not None:
        agents[check_name("subtask", expert_swap, names.SUBTASKS)] = BASELINES["expert"]
        trained.pop(expert_swap, None)
        parts.pop(expert_swap, None)
    if parts:
        about["parts"] = parts
    seen = {view for run in trained.values() for view in run.views}
    run = RunConfig(
        replace(env, task=names.SUTURE, max_steps=config.max_steps, advance=config.advance),
        views=tuple(view for view in view_names() if view in seen),
        privileged=expert_swap is not None or any(spec.run.sees_goal for spec in low.values()),
        termination=config.termination,
        parts=digest(config),
        expert_swap=expert_swap,
    )
    make = functools.partial(
        HierarchicalAgent, config, tuple(agents.values()), high, action_repeat=env.action_repeat
    )
    return PolicySpec(run, make, about)


def _low_level(subtask: str, policy: str, weights: WeightsSource) -> PolicySpec:
    """Return the policy of a subtask, named in the file of a hierarchical policy.

    Raises:
        InputError: it names code or a hierarchical policy, or was trained for another subtask.
    """
    if Path(policy).suffix in SUFFIXES:  # it could even name the file that names it
        raise InputError(
            f"{subtask}: {policy} is a hierarchical policy, which does the whole procedure; give "
            f"a checkpoint or a baseline ({', '.join(BASELINES)})."
        )
    if _names_code(policy):
        raise InputError(
            f"{subtask}: {policy} names code, which is not allowed in a file; give "
            f"a checkpoint or a baseline ({', '.join(BASELINES)})."
        )
    return open_policy(policy, task=subtask, weights=weights)


def _read_high_level(given: str, folder: Path) -> Checkpoint:
    """Return the checkpoint of a high-level policy, named `given` in a hierarchical policy's file.

    Raises:
        BadFile: no checkpoint folder.
        InputError: another policy, or one of a single subtask.
    """
    checkpoint = read_checkpoint(folder)
    if checkpoint.policy != HLP or checkpoint.task.task != names.SUTURE:
        raise InputError(
            f"{given} is '{checkpoint.policy}' of '{checkpoint.task.task}'; "
            f"hlp: takes an '{HLP}' of '{names.SUTURE}'."
        )
    return checkpoint
