"""LeRobot's policies as runs: `lerobot-train` in a separate process.

The policy sees images or exported features.

Its checkpoint is evaluated as by `surgicai-vision evaluate`. LeRobot is not imported here.
"""

import json
import shutil
from pathlib import Path

import numpy as np

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.processes import OFFLINE, run_module
from surgicai_vision.dataset import Dataset, RenderedDataset
from surgicai_vision.dataset.feature_export import export_features
from surgicai_vision.features.cache import encode
from surgicai_vision.features.devices import AUTO, CPU, find_device
from surgicai_vision.features.encoders import ANYWHERE, WeightsSource, load_encoder
from surgicai_vision.training.run_config import OWN, RunConfig

OPTIONS = {
    "act": (
        "--policy.chunk_size=25",
        "--policy.n_action_steps=5",
        "--policy.dim_model=128",
        "--policy.dim_feedforward=512",
        "--policy.n_heads=4",
        "--policy.n_encoder_layers=2",
        "--policy.use_vae=false",
        "--policy.optimizer_lr=1e-4",
        "--policy.optimizer_lr_backbone=1e-4",
    ),
    "diffusion": (
        "--policy.n_obs_steps=1",
        "--policy.horizon=16",
        "--policy.n_action_steps=8",
        "--policy.drop_n_last_frames=0",
        "--policy.use_group_norm=true",
        "--policy.down_dims=[32,64,128]",
        "--policy.diffusion_step_embed_dim=32",
        "--policy.noise_scheduler_type=DDIM",
        "--policy.num_inference_steps=10",
        "--policy.prediction_type=sample",
        "--policy.optimizer_lr=3e-4",
        "--policy.scheduler_warmup_steps=100",
    ),
}
"""Options of a policy that differ from LeRobot's defaults.

Widths and plans are much like those of the recipes `act` and `diffusion`: one core trains such
networks in half an hour (docs/results/yardstick.md).

ACT plans half a second and executes the first tenth of a second. LeRobot decodes an image for each
frame of a plan (docs/upstream.md), so a shorter plan also trains faster. A backbone starts from
random weights here, and LeRobot's learning rate for it, 1e-5, is meant for pretrained ones.
"""
SCRATCH = "export"
VARIABLES = {**OFFLINE, "HF_DATASETS_DISABLE_PROGRESS_BARS": "1", "WANDB_MODE": "disabled"}
"""Environment of `lerobot-train`."""


def train_lerobot(
    run: RunConfig,
    dataset: RenderedDataset,
    out: Path,
    weights: WeightsSource = ANYWHERE,
    device: str | None = None,
) -> None:
    """Train a policy of LeRobot into `out`, as `lerobot-train` writes it.

    Args:
        run: its policy, encoder (`OWN` or frozen features), views, seed, updates and number of
            demonstrations.
        dataset: an opened dataset of the run's task.
        out: folder to make.
        weights: where pretrained weights come from.
        device: where to encode and train, one of `features.devices.DEVICES`; the CPU by default.

    Raises:
        InputError: a dataset without a frame of every step.
        SurgicaiError: LeRobot failed; the message ends with its last output.
    """
    needed = dataset.config.steps_per_second
    if dataset.fps != needed:
        raise InputError(
            f"{dataset.path} holds {dataset.fps} frames per second; {run.policy} needs {needed}."
        )
    root = dataset.path
    if run.encoder != OWN:
        root = out.with_name(SCRATCH)
        _export(run, dataset, root, weights, device or AUTO)
    arguments = _arguments(run, dataset, root, out)
    where = find_device(device or CPU)
    if where == CPU:
        arguments.append("--num_workers=0")  # LeRobot's four workers would take cores that train
    arguments += [
        f"--policy.device={where}",
        f"--steps={run.updates}",
        f"--save_freq={run.updates}",
        f"--batch_size={run.batch_size}",
    ]
    done = run_module("lerobot.scripts.lerobot_train", *arguments, variables=VARIABLES)
    if done.returncode:
        raise SurgicaiError(f"lerobot-train failed for {run.name}:\n{done.stderr[-2000:]}")


def _export(
    run: RunConfig, dataset: RenderedDataset, root: Path, weights: WeightsSource, device: str
) -> None:
    """Write a dataset with the run's features instead of images."""
    encoder = load_encoder(str(run.encoder), run.pool, weights, device)
    rows = [encode(dataset, view, encoder).rows for view in run.views]
    about = {
        "encoder": run.encoder,
        "views": list(run.views),
        "weights_sha256": encoder.weights_sha256,
        "encoder_fingerprint": encoder.fingerprint,
    }
    shutil.rmtree(root, ignore_errors=True)
    export_features(dataset, rows, about, root)


def _arguments(run: RunConfig, dataset: Dataset, root: Path, out: Path) -> list[str]:
    """Return the options of `lerobot-train` that say what is trained on what."""
    arguments = [
        f"--dataset.repo_id=local/{run.task}",
        f"--dataset.root={root}",
        "--env.type=surgicai",
        f"--env.dataset={root}",
        f"--policy.type={run.policy}",
        "--policy.pretrained_backbone_weights=null",
        "--policy.push_to_hub=false",
        "--env_eval_freq=0",
        f"--seed={run.seed}",
        f"--output_dir={out}",
        *OPTIONS.get(run.policy, ()),
    ]
    if run.demonstrations not in (None, len(np.unique(dataset.demonstration_index))):
        arguments.append(f"--dataset.episodes={list(range(run.demonstrations or 0))}")
    if run.encoder == OWN:
        side = dataset.image_size
        seen = {
            names.image_key(view): {"type": "VISUAL", "shape": [3, side, side]}
            for view in run.views
        }
        inputs = {**seen, names.STATE: {"type": "STATE", "shape": [len(names.STATE_NAMES)]}}
        arguments.append(f"--policy.input_features={json.dumps(inputs)}")
        arguments.append(f"--env.cameras={json.dumps(list(run.views))}")
    return arguments
