"""The LeRobot plug-in: stock commands on our env and dataset, and our evaluation of the same.

LeRobot's commands run in this process through their own `main`: importing them takes most of the
time here.
"""

import dataclasses
import importlib.metadata
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
import yaml

from policies import lerobot as lerobot_policies
from surgicai_vision.core import names
from surgicai_vision.core.config import TaskConfig, to_mapping
from surgicai_vision.core.errors import BadFile, InputError, OutputExists, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.core.instructions import draw_instruction
from surgicai_vision.core.progress import silent_stage
from surgicai_vision.dataset import open_dataset, render_demos
from surgicai_vision.dataset.feature_export import export_features
from surgicai_vision.demos.record import record
from surgicai_vision.evaluation.lerobot_steps import check_steps
from surgicai_vision.evaluation.policy_spec import open_policy
from surgicai_vision.evaluation.rollout import evaluate
from surgicai_vision.experiments.run import train_run
from surgicai_vision.training import policies
from surgicai_vision.training.run_config import RunConfig

TASK, SIZE, STEPS = "place", 32, 4
CHECKPOINT = "checkpoints/last/pretrained_model"
TINY = {
    "act": ["dim_model=64", "dim_feedforward=128", "n_heads=4", "chunk_size=4", "n_action_steps=2"],
    "diffusion": [
        "down_dims=[32,64]",
        "diffusion_step_embed_dim=16",
        "num_inference_steps=2",
        "horizon=8",
        "n_action_steps=2",
        "drop_n_last_frames=3",
        "use_group_norm=true",
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lerobot")


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Path:
    """Three demonstrations in two views with depth, which only some policies can take."""
    record(TaskConfig(TASK), episodes=3, out=folder / "demos", context=RunContext(0))
    render_demos(
        folder / "demos",
        folder / "dataset",
        views=("front", "back"),
        size=SIZE,
        depth=True,
        context=RunContext(0),
    )
    return folder / "dataset"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, folder: Path):
    """Run one of LeRobot's commands."""

    def call(script: str, *arguments: str) -> None:
        from importlib import import_module

        monkeypatch.setattr(sys, "argv", [script, *arguments])
        monkeypatch.setenv("HF_LEROBOT_HOME", str(folder / "home"))
        import_module(f"lerobot.scripts.{script}").main()

    return call


def training(dataset: Path, out: Path, policy: str, *more: str) -> list[str]:
    return [
        "--dataset.repo_id=local/toy",
        f"--dataset.root={dataset}",
        f"--policy.type={policy}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--batch_size=2",
        "--steps=2",
        "--num_workers=0",
        "--log_freq=1",
        f"--output_dir={out}",
        "--env.type=surgicai",
        f"--env.dataset={dataset}",
        f"--env.max_steps={STEPS}",
        "--env_eval_freq=0",
        *more,
    ]


@pytest.fixture(scope="module")
def trained(dataset: Path, folder: Path) -> Path:
    """A `surgicai_bc` of `lerobot-train`, trained for two steps and then for two more."""
    from lerobot.scripts import lerobot_train

    out = folder / "bc"
    more = ("--policy.encoder=imagenet-lite",)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *training(dataset, out, "surgicai_bc", *more)])
        lerobot_train.main()
        resume = f"--config_path={out / CHECKPOINT / 'train_config.json'}"
        patch.setattr(sys, "argv", ["lerobot-train", resume, "--resume=true", "--steps=4"])
        lerobot_train.main()
    return out


def skilled(dataset: Path, out: Path, steps: int = 400) -> Path:
    """Train a `surgicai_bc` without images on all frames at once; save it as LeRobot does."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    from lerobot_env_surgicai import SurgicaiBcConfig

    torch.manual_seed(0)
    torch.set_num_threads(1)
    meta = LeRobotDatasetMetadata("local/toy", root=dataset)
    config = SurgicaiBcConfig(encoder=None, device="cpu")
    policy = make_policy(config, ds_meta=meta)
    before, after = make_pre_post_processors(config, dataset_stats=meta.stats)
    columns = open_dataset(dataset).columns()
    batch = before({key: torch.tensor(columns[key]) for key in (names.STATE, names.ACTION)})
    optimizer = torch.optim.Adam(policy.train().get_optim_params(), 1e-3)
    for _ in range(steps):
        loss, _ = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    for part in (policy, before, after):
        part.save_pretrained(out)
    return out


# -- registration and env --------------------------------------------------------------------------


def test_lerobot_finds_the_distribution_by_its_name() -> None:
    assert (
        importlib.metadata.distribution("lerobot_env_surgicai").metadata["Name"]
        == "lerobot_env_surgicai"
    )
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    assert EnvConfig.get_choice_class("surgicai").__module__.startswith("lerobot_env_surgicai")
    assert PreTrainedConfig.get_choice_class("surgicai_bc").__module__.startswith(
        "lerobot_env_surgicai"
    )


def test_env_has_every_field_of_the_task_config_and_follows_a_dataset(dataset: Path) -> None:
    from lerobot_env_surgicai import SurgicaiEnv

    own = {field.name for field in dataclasses.fields(SurgicaiEnv)}
    assert {field.name for field in dataclasses.fields(TaskConfig)} <= own
    assert SurgicaiEnv().task_config() == TaskConfig()
    env = SurgicaiEnv(dataset=str(dataset), max_steps=7)
    assert (env.task, env.views, env.image_size, env.max_steps) == (
        TASK,
        ("front", "back"),
        SIZE,
        7,
    )
    assert not [key for key in env.features if "/" in key or "depth" in key]
    with pytest.raises(UnknownName):
        SurgicaiEnv(cameras=["side"])
    with pytest.raises(UnknownName):
        SurgicaiEnv(task="sew")


def test_env_without_a_dataset_has_its_tasks_own_limit() -> None:
    from lerobot_env_surgicai import SurgicaiEnv

    assert SurgicaiEnv(task="suture").max_steps == 1000
    assert SurgicaiEnv(task="place").max_steps == SurgicaiEnv().max_steps == 200


def test_env_of_another_task_than_the_datasets_has_that_tasks_limit(dataset: Path) -> None:
    from lerobot_env_surgicai import SurgicaiEnv

    assert SurgicaiEnv(dataset=str(dataset), task="suture").max_steps == 1000
    assert SurgicaiEnv(dataset=str(dataset), task="suture", max_steps=9).max_steps == 9
    assert SurgicaiEnv(dataset=str(dataset), tasks=["suture", TASK]).max_steps == 1000


def test_env_counts_control_steps_of_held_actions() -> None:
    """As `evaluate` does: an episode is no longer because its actions are held."""
    from lerobot_env_surgicai import SurgicaiEnv

    held = SurgicaiEnv(task="place", action_repeat=2, max_steps=5, image_size=16)
    env = held.create_envs(1)["surgicai"][0]
    assert env.call("_max_episode_steps") == (3,)
    env.reset(seed=[0])
    ends = [bool(env.step(np.zeros((1, 7), np.float32))[3][0]) for _ in range(3)]
    assert ends == [False, False, True]
    env.close()
    assert SurgicaiEnv(max_steps=0).gym_kwargs["max_episode_steps"] == 200


def test_env_shows_what_the_dataset_holds_and_waits_after_its_end(dataset: Path) -> None:
    from lerobot.envs.factory import make_env, make_env_config
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION, preprocess_observation

    config = make_env_config("surgicai", dataset=str(dataset), max_steps=2, reward="dense")
    env = make_env(config, n_envs=1)["surgicai"][0]
    assert env.call("_max_episode_steps") == (2,)
    assert env.call("task_description") == (names.TASK_TEXTS[TASK],)
    assert env.metadata["render_fps"] == names.FPS
    seeds = open_dataset(dataset).columns()[names.SEED]
    observation, info = env.reset(seed=[int(seeds[0])], options={NEW_ROLLOUT_OPTION: True})
    seen = preprocess_observation(observation)
    assert set(seen) == {names.STATE, names.image_key("front"), names.image_key("back")}
    first = open_dataset(dataset).frames("back", 0, 1)
    np.testing.assert_array_equal(
        (seen[names.image_key("back")] * 255).round().byte().permute(0, 2, 3, 1), first
    )
    assert "is_success" in info
    action = np.zeros((1, 7), np.float32)
    env.step(action)
    _, reward, _, truncated, info = env.step(action)
    assert truncated[0]
    assert "is_success" in info["final_info"]
    assert reward[0] != 0.0
    _, reward, _, truncated, _ = env.step(action)
    assert truncated[0]
    assert reward[0] == 0.0
    env.close()


def test_envs_run_in_processes_of_their_own(dataset: Path) -> None:
    from lerobot.envs.factory import make_env, make_env_config

    config = make_env_config("surgicai", dataset=str(dataset), max_steps=2)
    env = make_env(config, n_envs=2, use_async_envs=True)["surgicai"][0]
    assert isinstance(env, gymnasium.vector.AsyncVectorEnv)
    observation, _ = env.reset(seed=[1, 2], options={})
    assert observation["pixels"]["front"].shape == (2, SIZE, SIZE, 3)
    env.close()


# -- surgicai_bc -----------------------------------------------------------------------------------


def test_defaults_are_the_recipe_paper() -> None:
    from lerobot_env_surgicai import SurgicaiBcConfig
    from surgicai_vision.training import policies

    assert SurgicaiBcConfig(device="cpu").recipe() == policies.load_recipe("bc", "paper")


@pytest.mark.parametrize("changed", ["config.json", "policy_preprocessor.json"])
def test_a_checkpoint_that_acts_otherwise_is_another_policy(
    changed: str, trained: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(trained / CHECKPOINT, other)
    specs = [open_policy(other)]
    table = json.loads((other / changed).read_text())
    (other / changed).write_text(json.dumps({**table, "told": "otherwise"}))
    specs.append(open_policy(other))
    assert specs[0].content != specs[1].content
    assert specs[0].folder_name != specs[1].folder_name


def test_checkpoint_names_the_encoder_and_holds_none_of_it(trained: Path) -> None:
    from safetensors.torch import load_file

    config = json.loads((trained / CHECKPOINT / "config.json").read_text())
    assert config["encoder"] == "imagenet-lite"
    assert len(config["encoder_sha256"]) == len(config["encoder_identity"]) == 64
    assert set(config["input_features"]) == {
        names.STATE,
        names.image_key("front"),
        names.image_key("back"),
    }
    tensors = load_file(trained / CHECKPOINT / "model.safetensors")
    assert all(key.startswith("network.") for key in tensors)
    assert (trained / CHECKPOINT / "model.safetensors").stat().st_size < 5e6
    assert (trained / "checkpoints" / "000004").is_dir()


def load(folder: Path) -> Any:
    from lerobot_env_surgicai.modeling_surgicai_bc import SurgicaiBcPolicy

    return SurgicaiBcPolicy.from_pretrained(folder)


def frames(count: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, 3, SIZE, SIZE), generator=generator) / 255
    return {
        names.image_key("front"): images,
        names.image_key("back"): 1 - images,
        names.STATE: torch.randn(count, 7, generator=generator),
        names.ACTION: torch.rand(count, 7, generator=generator),
    }


def test_policy_acts_the_same_after_saving_and_in_any_batch(trained: Path, tmp_path: Path) -> None:
    policy, batch = load(trained / CHECKPOINT), frames(3)
    before = {key: value.clone() for key, value in batch.items()}
    actions = policy.select_action(batch)
    assert actions.shape == (3, 7)
    assert actions.abs().max() <= 1.0
    assert torch.equal(policy.predict_action_chunk(batch), actions[:, None])
    policy.save_pretrained(tmp_path)
    again = load(tmp_path)
    for index in range(3):
        alone = {key: value[index : index + 1] for key, value in batch.items()}
        assert torch.equal(again.select_action(alone)[0], actions[index])
    assert all(torch.equal(batch[key], before[key]) for key in batch)


def test_training_moves_the_network_and_never_the_encoder(trained: Path) -> None:
    policy = load(trained / CHECKPOINT).train()
    encoder = policy._encoder
    feature = encoder(np.full((1, SIZE, SIZE, 3), 90, np.uint8))
    before = policy.select_action(frames(2))
    optimizer = torch.optim.Adam(policy.get_optim_params(), 1e-3)
    for count in (2, 1):  # an epoch may end in a batch of one
        loss, parts = policy.forward(frames(count))
        loss.backward()
        optimizer.step()
        assert parts["mse"] == loss.item()
    assert not torch.equal(policy.eval().select_action(frames(2)), before)
    assert not [part for part in encoder._network.modules() if part.training]
    np.testing.assert_array_equal(encoder(np.full((1, SIZE, SIZE, 3), 90, np.uint8)), feature)


def test_training_encodes_an_image_once_and_forgets_beyond_its_limit() -> None:
    from lerobot_env_surgicai.images import FeatureMemory

    encoded: list[int] = []

    def encoder(images: np.ndarray) -> np.ndarray:
        encoded.append(len(images))
        return images.reshape(len(images), -1)[:, :4].astype(np.float16).astype(np.float32) / 3

    images = np.random.default_rng(0).integers(0, 256, (6, 8, 8, 3), np.uint8)
    memory = FeatureMemory(encoder)
    batches = [[0, 1, 2], [2, 1, 3], [3, 3, 0], [4, 4, 5]]
    wanted = [encoder(images[rows]).astype(np.float16).astype(np.float32) for rows in batches]
    encoded.clear()
    for rows, features in zip(batches, wanted, strict=True):
        np.testing.assert_array_equal(memory(images[rows]), features)
    assert encoded == [3, 1, 2], "each image once, each batch's new ones together"
    changed_one = images[:1].copy()
    changed_one[0, 7, 7, 2] ^= 1
    memory(changed_one)
    assert encoded[-1] == 1, "an image that differs in one bit is another"
    small = FeatureMemory(encoder, limit=8)
    encoded.clear()
    for _ in range(2):
        small(images[:3])
    assert encoded == [3, 2]


def changed(source: Path, out: Path, **values: Any) -> Path:
    shutil.copytree(source, out)
    config = json.loads((out / "config.json").read_text())
    (out / "config.json").write_text(json.dumps({**config, **values}))
    return out


def test_another_encoder_and_damaged_weights_are_refused(trained: Path, tmp_path: Path) -> None:
    source = trained / CHECKPOINT
    with pytest.raises(InputError, match="weights sha256 0000"):
        load(changed(source, tmp_path / "sha", encoder_sha256="0" * 64))
    with pytest.raises(InputError, match="preprocessing"):
        load(changed(source, tmp_path / "identity", encoder_identity="0" * 64))
    with pytest.raises(BadFile, match="surgicai_bc"):
        load(changed(source, tmp_path / "hidden", hidden=[64]))
    cut = changed(source, tmp_path / "cut")
    (cut / "model.safetensors").write_bytes((source / "model.safetensors").read_bytes()[:1000])
    with pytest.raises(BadFile, match="surgicai_bc"):
        load(cut)


def test_images_of_another_size_and_missing_views_are_refused(trained: Path) -> None:
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_env_surgicai import SurgicaiBcConfig

    policy = load(trained / CHECKPOINT)
    larger = {
        key: value.repeat(1, 1, 2, 2) if value.ndim == 4 else value
        for key, value in frames(1).items()
    }
    with pytest.raises(InputError, match=f"--env.image_size={SIZE}"):
        policy.select_action(larger)
    state = {names.STATE: PolicyFeature(FeatureType.STATE, (7,))}
    action = {names.ACTION: PolicyFeature(FeatureType.ACTION, (7,))}
    with pytest.raises(InputError, match="front"):
        SurgicaiBcConfig(
            input_features=state, output_features=action, device="cpu"
        ).validate_features()
    with pytest.raises(InputError, match=r"images\.back"):
        SurgicaiBcConfig(
            views=["back"], input_features=state, output_features=action, device="cpu"
        ).validate_features()


def test_a_constant_input_is_not_blown_up() -> None:
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors

    from lerobot_env_surgicai import SurgicaiBcConfig

    state = {names.STATE: PolicyFeature(FeatureType.STATE, (7,))}
    action = {names.ACTION: PolicyFeature(FeatureType.ACTION, (7,))}
    config = SurgicaiBcConfig(
        encoder=None, input_features=state, output_features=action, device="cpu"
    )
    statistics = {names.STATE: {"mean": torch.zeros(7), "std": torch.zeros(7)}}
    before, after = make_pre_post_processors(config, dataset_stats=statistics)
    near = before({names.STATE: torch.full((1, 7), 1e-4)})[names.STATE]
    assert near.abs().max() < 1e-3
    assert torch.equal(after(torch.full((1, 7), 0.5)), torch.full((1, 7), 0.5))


# -- the same checkpoint in lerobot-eval and in evaluate -------------------------------------------


def test_lerobot_eval_and_evaluate_count_the_same_successes(dataset: Path, tmp_path: Path) -> None:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.factory import make_env, make_env_config, make_env_pre_post_processors
    from lerobot.policies.factory import make_policy, make_pre_post_processors
    from lerobot.scripts.lerobot_eval import eval_policy

    from surgicai_vision.evaluation.policy_spec import open_policy
    from surgicai_vision.evaluation.rollout import evaluate

    folder = skilled(dataset, tmp_path / "policy")
    episodes, steps = 4, 100
    env_config = make_env_config("surgicai", dataset=str(dataset), max_steps=steps)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = make_policy(config, env_cfg=env_config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    env_before, env_after = make_env_pre_post_processors(env_config, config)
    env = make_env(env_config, n_envs=2)["surgicai"][0]
    theirs = eval_policy(
        env, policy, env_before, env_after, before, after, n_episodes=episodes, start_seed=0
    )
    env.close()
    spec = open_policy(folder, task=TASK)
    ours = evaluate(
        spec.make_agent, TaskConfig(TASK, max_steps=steps), range(episodes), batch=3, workers=1
    )
    assert [episode.row.success for episode in ours] == [
        row["success"] for row in theirs["per_episode"]
    ]
    # A sparse reward is -1 a step and 0 on success: the sums tell the steps.
    lengths = [-row["sum_reward"] + row["success"] for row in theirs["per_episode"]]
    assert [episode.row.steps for episode in ours] == lengths
    assert any(episode.row.success for episode in ours)


def test_lerobot_eval_and_evaluate_see_the_same_through_the_encoder(
    trained: Path, dataset: Path, command
) -> None:
    """Dense rewards tell two trajectories apart in the last bit."""
    from surgicai_vision import envs
    from surgicai_vision.evaluation.policy_spec import open_policy
    from surgicai_vision.evaluation.rollout import evaluate

    command(
        "lerobot_eval",
        f"--policy.path={trained / CHECKPOINT}",
        "--env.type=surgicai",
        f"--env.dataset={dataset}",
        f"--env.max_steps={STEPS}",
        "--env.reward=dense",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        "--policy.device=cpu",
        f"--output_dir={trained / 'eval'}",
        "--seed=1000",
    )
    metrics = json.loads((trained / "eval" / "eval_info.json").read_text())["per_task"][0][
        "metrics"
    ]
    spec = open_policy(trained)
    assert spec.config == TaskConfig(TASK, max_steps=STEPS)
    rows = evaluate(spec.make_agent, spec.config, [1000, 1001], workers=1)
    assert [episode.row.success for episode in rows] == metrics["successes"]
    agent = spec.make_agent()
    for seed, wanted in zip((1000, 1001), metrics["sum_rewards"], strict=True):
        config = TaskConfig(TASK, max_steps=STEPS, reward="dense")
        env = envs.make(config, "pixels_agent_pos", agent.cameras, agent.image_size)
        observation, _ = env.reset(seed=seed)
        agent.reset(0, env, seed)
        total = 0.0
        for _ in range(STEPS):
            observation, reward, *_ = env.step(agent.act([0], [env], [observation])[0])
            total += reward
        env.close()
        assert total == pytest.approx(wanted, rel=1e-9)


# -- LeRobot's own policies ------------------------------------------------------------------------


def test_act_trains_beside_depth_and_is_evaluated(dataset: Path, tmp_path: Path, command) -> None:
    from surgicai_vision.evaluation import lerobot_agent
    from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
    from surgicai_vision.evaluation.policy_spec import hierarchical_policy, open_policy
    from surgicai_vision.evaluation.rollout import evaluate

    inputs = {names.image_key("back"): {"type": "VISUAL", "shape": [3, SIZE, SIZE]}}
    inputs[names.STATE] = {"type": "STATE", "shape": [7]}
    settings = [
        "pretrained_backbone_weights=null",
        f"input_features={json.dumps(inputs)}",
        *TINY["act"],
    ]
    out = tmp_path / "act"
    command(
        "lerobot_train",
        *training(dataset, out, "act", *(f"--policy.{setting}" for setting in settings)),
    )
    found = lerobot_agent.find(out)
    assert found == out / CHECKPOINT
    # A checkpoint of pretrained weights asks for them by name; they are in the checkpoint already.
    changed(found, tmp_path / "named", pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    for place in (found, tmp_path / "named"):
        spec = open_policy(place)
        assert spec.name == "act-own-back"
        rows = [
            evaluate(spec.make_agent, spec.config, [1, 2, 3], batch=batch, workers=1)
            for batch in (1, 3)
        ]
        assert said(rows[0]) == said(rows[1])
    low = dict.fromkeys(names.SUBTASKS, "zero") | {open_dataset(dataset).task: str(out)}
    low["termination"] = "privileged"
    made = hierarchical_policy(HierarchicalConfig("order", **low, steps=4, max_steps=10))
    assert made.run.views == ("back",) and made.config.task == "suture"
    rows = [
        evaluate(lambda: chosen(made, dataset), made.config, [1, 2], batch=batch, workers=1)
        for batch in (1, 2)
    ]
    assert said(rows[0]) == said(rows[1])
    assert rows[0][0].row.steps == 10 and rows[0][0].row.trajectory_length_mm > 0
    with pytest.raises(InputError, match="not for 'pullout'"):
        hierarchical_policy(HierarchicalConfig("order", **{**low, "pullout": str(out)}))


def chosen(made, dataset: Path):
    """The agent of a chain whose high-level policy always says the dataset's subtask."""
    agent, subtask = made.make_agent(), names.SUBTASKS.index(open_dataset(dataset).task)
    agent._high = SimpleNamespace(
        answer=lambda envs, _: np.eye(len(names.SUBTASKS))[[subtask] * len(envs)]
    )
    return agent


def said(episodes: list) -> list[str]:
    """The rows as text: NaN is unequal to itself."""
    return [repr(episode.row) for episode in episodes]


def test_diffusion_trains_on_frozen_features_and_is_evaluated(
    dataset: Path, tmp_path: Path, command
) -> None:
    from surgicai_vision.dataset import check_dataset
    from surgicai_vision.evaluation.policy_spec import open_policy
    from surgicai_vision.evaluation.rollout import evaluate
    from surgicai_vision.features import encoders

    opened, encoder = open_dataset(dataset), encoders.load_encoder("imagenet-lite")
    rows = np.random.default_rng(0).random(
        (opened.length, encoder.dim), dtype=np.float32
    )  # two steps learn nothing
    about = {
        "encoder": "imagenet-lite",
        "views": ["back"],
        "weights_sha256": encoder.weights_sha256,
    }
    export_features(opened, [rows], about, tmp_path / "features")
    assert check_dataset(tmp_path / "features").ok
    with pytest.raises(OutputExists):
        export_features(opened, [rows], about, tmp_path / "features")
    with pytest.raises(InputError, match="8 features"):
        export_features(opened, [rows[:8]], about, tmp_path / "other")
    settings = [
        f"--policy.{setting}"
        for setting in ("pretrained_backbone_weights=null", *TINY["diffusion"])
    ]
    out, evaluated = (
        tmp_path / "diffusion",
        ("--env_eval_freq=2", "--eval.n_episodes=1", "--eval.batch_size=1"),
    )
    command(
        "lerobot_train", *training(tmp_path / "features", out, "diffusion", *settings, *evaluated)
    )
    config = json.loads((out / CHECKPOINT / "config.json").read_text())
    assert set(config["input_features"]) == {names.STATE, names.ENVIRONMENT_STATE}
    spec = open_policy(out)
    assert spec.name == "diffusion-imagenet-lite-back"
    rows = [
        evaluate(spec.make_agent, spec.config, [1, 2, 3], batch=batch, workers=1)
        for batch in (1, 3)
    ]
    assert said(rows[0]) == said(rows[1])


def test_what_evaluate_cannot_use_is_refused_in_one_line(trained: Path, tmp_path: Path) -> None:
    from surgicai_vision.evaluation import lerobot_agent
    from surgicai_vision.evaluation.policy_spec import open_policy

    assert lerobot_agent.find(tmp_path) is None
    source = trained / CHECKPOINT
    alone = changed(source, tmp_path / "alone")
    (alone / "train_config.json").unlink()
    with pytest.raises(InputError, match="give --task"):
        open_policy(alone)
    assert open_policy(alone, task="grasp").config == TaskConfig("grasp")
    depth = {"observation.images.back_depth": {"type": "VISUAL", "shape": [1, SIZE, SIZE]}}
    with pytest.raises(UnknownName, match="back_depth"):
        open_policy(changed(source, tmp_path / "depth", input_features=depth))
    with pytest.raises(BadFile, match="is not a LeRobot configuration"):
        open_policy(changed(source, tmp_path / "typeless", type=None))


STEP_FILES = ("policy_preprocessor.json", "policy_postprocessor.json")


def write_steps(folder: Path, **steps: Any) -> Path:
    """Write a checkpoint's files of processing steps: ours in both, more where they are given."""
    ours = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"class": "lerobot.processor.pipeline.IdentityProcessorStep"},
    ]
    for name in STEP_FILES:
        table = {"name": name, "steps": ours + steps.get(Path(name).stem, [])}
        (folder / name).write_text(json.dumps(table))
    return folder


@pytest.mark.parametrize("file", [Path(name).stem for name in STEP_FILES])
@pytest.mark.parametrize(
    "named", ["subprocess.Popen", "lerobot.processor.pipeline.json", "a..b", 7]
)
def test_a_processing_step_never_runs_a_program(named: object, file: str, tmp_path: Path) -> None:
    from lerobot.processor import ProcessorStep

    from surgicai_vision.evaluation import lerobot_agent

    ran = tmp_path / "ran"
    step = {"class": named, "config": {"args": ["touch", str(ran)]}}
    folder = write_steps(tmp_path, **{file: [step]})
    with pytest.raises(BadFile, match=r"is refused|must be text"):
        lerobot_agent.LeRobotAgent("act", folder, lerobot_agent.Inputs((), SIZE), "Grasp.")
    assert not ran.exists()
    check_steps(write_steps(tmp_path), ProcessorStep)
    (folder / f"{file}.json").unlink()
    with pytest.raises(BadFile, match=file):
        check_steps(folder, ProcessorStep)


# -- LeRobot's tools on our dataset ----------------------------------------------------------------


def test_lerobot_edits_our_dataset(dataset: Path, folder: Path, tmp_path: Path, command) -> None:
    given = ("--repo_id=local/toy", f"--root={dataset}")
    edit = "lerobot_edit_dataset"
    command(edit, *given, "--operation.type=info", "--operation.show_features=true")
    command(
        edit,
        *given,
        "--new_repo_id=local/less",
        f"--new_root={tmp_path / 'less'}",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1]",
    )
    splits = '{"train": 0.5, "val": 0.5}'
    command(
        edit,
        *given,
        f"--new_root={tmp_path}",
        "--operation.type=split",
        f"--operation.splits={splits}",
    )
    command(
        edit,
        "--new_repo_id=local/whole",
        f"--new_root={tmp_path / 'whole'}",
        "--operation.type=merge",
        "--operation.repo_ids=['local/toy_train','local/toy_val']",
        f"--operation.roots=['{tmp_path / 'train'}','{tmp_path / 'val'}']",
    )
    infos = {
        path.name: json.loads((path / "meta/info.json").read_text()) for path in tmp_path.iterdir()
    }
    assert infos["less"]["total_episodes"] == 2
    parts = infos["train"]["total_frames"] + infos["val"]["total_frames"]
    assert infos["whole"]["total_frames"] == parts > 0


CHUNKS = {
    "act": {"dim_model": 32, "dim_feedforward": 64, "n_heads": 2, "n_encoder_layers": 1},
    "diffusion": {
        "down_dims": [16, 32],
        "diffusion_step_embed_dim": 8,
        "n_groups": 4,
        "num_inference_steps": 2,
    },
    "vqbet": {
        "gpt_input_dim": 16,
        "gpt_output_dim": 16,
        "gpt_hidden_dim": 16,
        "gpt_n_layer": 1,
        "gpt_n_head": 2,
        "n_vqvae_training_steps": 2,
    },
}


def chunk_recipe(name: str, **changes: object) -> Any:
    history = 2 if name == "diffusion" else 1
    table = {"chunk": 4, "execute": 2, "history": history, "epochs": 1, "settings": CHUNKS[name]}
    return policies.load_recipe(name, "act", table | changes)


@pytest.mark.parametrize("name", CHUNKS)
def test_a_policy_of_lerobot_trains_on_cached_features(
    name: str, dataset: Path, tmp_path: Path
) -> None:
    """From the cache to `evaluate`: a checkpoint of ours, read back and acted chunk by chunk."""
    from lerobot.envs.utils import preprocess_observation
    from lerobot_env_surgicai.modeling_surgicai_checkpoint import SurgicaiCheckpointPolicy

    from lerobot_env_surgicai import SurgicaiCheckpointConfig, SurgicaiEnv

    text = yaml.safe_dump(to_mapping(chunk_recipe(name, ema=0.9, map_head="convolutions")))
    (tmp_path / "recipe.yaml").write_text(text, encoding="utf-8")
    run = RunConfig(
        TaskConfig(TASK),
        "imagenet-lite-early",
        ("back",),
        name,
        "spatial",
        recipe=str(tmp_path / "recipe.yaml"),
    )
    train_run(run, open_dataset(dataset), tmp_path / "policy", silent_stage)
    spec = open_policy(tmp_path / "policy")
    config = replace(spec.config, max_steps=6)
    one, other = (
        evaluate(spec.make_agent, config, [7, 8], workers=1, batch=batch) for batch in (1, 2)
    )
    # The same agent under lerobot-eval, which may not see more than its env tells.
    config = SurgicaiCheckpointConfig(checkpoint=str(tmp_path / "policy"), device="cpu")
    agent = SurgicaiCheckpointPolicy(config)
    env = SurgicaiEnv(checkpoint=str(tmp_path / "policy"))
    assert (env.task, env.views, env.image_size) == (TASK, ("back",), SIZE)
    shown = env.create_envs(1)["surgicai"][0].reset(seed=[7])[0]
    action = agent.select_action(preprocess_observation(shown))
    assert action.shape == (1, 7) and action.abs().max() <= 1
    told = [[repr(episode.row) for episode in episodes] for episodes in (one, other)]  # of NaN too
    assert told[0] == told[1]


def test_a_checkpoint_whose_views_the_env_does_not_show_is_refused() -> None:
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot_env_surgicai.modeling_surgicai_checkpoint import SurgicaiCheckpointPolicy

    from lerobot_env_surgicai import SurgicaiCheckpointConfig

    shown = {"observation.images.wrist_psm1": PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE))}
    config = SurgicaiCheckpointConfig(
        checkpoint="released:handoff", input_features=shown, device="cpu"
    )
    with pytest.raises(InputError, match=r"needs front_psm1, .*wrist_psm1: give --env.checkpoint"):
        SurgicaiCheckpointPolicy(config)


@pytest.mark.parametrize("name", CHUNKS)
def test_no_tensor_of_a_chunk_policy_is_left_on_another_device(name: str) -> None:
    policy = policies.policy_plugin(name).make(chunk_recipe(name), ((12,),))
    policy.train().to("meta")
    tensors = (*policy.parameters(), *policy.buffers())
    assert {tensor.device.type for tensor in tensors} == {"meta"}


def test_settings_of_a_chunk_policy_are_lerobots() -> None:
    with pytest.raises(UnknownName, match="dim_model"):
        policies.policy_plugin("act").make(chunk_recipe("act", settings={"dim_modle": 3}), ())
    with pytest.raises(InputError, match="follows"):
        policies.policy_plugin("act").make(chunk_recipe("act", settings={"chunk_size": 3}), ())
    with pytest.raises(InputError, match="history"):
        policies.policy_plugin("act").make(chunk_recipe("act", history=2), ())
    with pytest.raises(InputError, match="samples"):
        policies.policy_plugin("act").make(chunk_recipe("act", samples=2), ())
    with pytest.raises(InputError, match="VQ-BeT"):
        policies.policy_plugin("vqbet").make(chunk_recipe("vqbet", history=2), ())


def test_what_acts_needs_without_lerobot_is_lerobots_own() -> None:
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig

    assert DiffusionConfig().down_dims == lerobot_policies.DOWN_DIMS
    assert VQBeTConfig().n_action_pred_token == lerobot_policies.PREDICTED_TOKENS
    for name in CHUNKS:
        recipe = chunk_recipe(name)
        config = policies.policy_plugin(name).make(recipe, ()).network.config
        offsets = policies.policy_plugin(name).offsets(recipe)
        assert list(offsets) == config.action_delta_indices


# -- EnvHub and several tasks ----------------------------------------------------------------------


def test_the_hubs_loader_makes_the_envs_of_a_local_folder(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot's own `make_env("user/repository")`, with the file in the place of its download."""
    from lerobot.envs import utils
    from lerobot.envs.factory import make_env

    hub = root / "lerobot_env_surgicai/hub"
    monkeypatch.setattr(utils, "hf_hub_download", lambda filename, **_: str(hub / filename))
    with pytest.raises(RuntimeError, match="trust_remote_code"):
        make_env("someone/suturing")
    made = make_env("someone/suturing", n_envs=1, trust_remote_code=True)
    assert list(made) == list(names.SUBTASKS)
    for task, group in made.items():
        assert group[0].call("task_description") == (names.TASK_TEXTS[task],)
        assert group[0].call("_max_episode_steps") == (TaskConfig(task).max_steps,)
        group[0].close()


def test_several_tasks_are_counted_in_one_call_in_other_words(tmp_path: Path, command: Any) -> None:
    command(
        "lerobot_eval",
        "--env.type=surgicai",
        "--env.tasks=[grasp, handoff]",
        "--env.instructions=heldout",
        f"--env.image_size={SIZE}",
        "--policy.type=surgicai_bc",
        "--policy.encoder=null",
        "--policy.device=cpu",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'out'}",
    )
    told = json.loads((tmp_path / "out/eval_info.json").read_text())
    assert [row["task_group"] for row in told["per_task"]] == ["grasp", "handoff"]
    assert set(told["per_group"]) == {"grasp", "handoff"} and told["overall"]["n_episodes"] == 2


def test_an_episode_is_told_by_its_seeds_sentence() -> None:
    from lerobot_env_surgicai.environment import SurgicaiEnv

    env = SurgicaiEnv(task="grasp", image_size=SIZE, instructions="train").create_envs(1)
    vector = env["surgicai"][0]
    for seed in (3, 4, 3):
        vector.reset(seed=[seed])
        assert vector.call("task_description") == (draw_instruction("grasp", "train", seed),)
    vector.close()


# -- the field's layout ----------------------------------------------------------------------------


def test_act_trained_on_both_arms_poses_is_evaluated(
    dataset: Path, tmp_path: Path, command
) -> None:
    """Stock `lerobot-train` on layout "open-h"; its policy acts by set-points in `evaluate`."""
    from surgicai_vision.evaluation.hierarchical import HierarchicalAgent
    from surgicai_vision.evaluation.hierarchical_config import HierarchicalConfig
    from surgicai_vision.evaluation.policy_spec import open_policy
    from surgicai_vision.evaluation.rollout import evaluate
    from surgicai_vision.evaluation.slot import Slot

    views = ("endo_left", "wrist_psm1")
    root = tmp_path / "open-h"
    render_demos(
        dataset.parent / "demos",
        root,
        views=views,
        size=SIZE,
        frame_stride=10,
        layout="open-h",
        context=RunContext(0),
    )
    settings = ["type=act", "device=cpu", "push_to_hub=false", "pretrained_backbone_weights=null"]
    command(
        "lerobot_train",
        "--dataset.repo_id=local/open-h",
        f"--dataset.root={root}",
        *(f"--policy.{setting}" for setting in (*settings, *TINY["act"])),
        "--batch_size=2",
        "--steps=1",
        "--num_workers=0",
        f"--output_dir={tmp_path / 'act'}",
    )
    spec = open_policy(tmp_path / "act")
    assert (spec.config.task, spec.config.action_repeat) == (TASK, 10)
    agent = spec.make_agent()
    assert (agent.action_mode, agent.cameras, agent.image_size) == (names.ABSOLUTE, views, SIZE)
    short = dataclasses.replace(spec.config, max_steps=40)
    (episode,) = evaluate(spec.make_agent, short, [names.TEST_SEED], workers=1)
    assert not episode.row.error
    assert episode.row.steps == 40
    with pytest.raises(InputError, match="set-points of both arms"):
        Slot(0, agent, spec.config, upset=True)
    with pytest.raises(InputError, match="by increments"):
        HierarchicalAgent(
            HierarchicalConfig("order", *["act"] * 5, termination="privileged"),
            [lambda: agent] * 5,
        )
    seven = {names.STATE: {"type": "STATE", "shape": [7]}}
    found = tmp_path / "act" / CHECKPOINT
    with pytest.raises(InputError, match="7 of both or 16 of both"):
        open_policy(changed(found, tmp_path / "mixed", input_features=seven))
