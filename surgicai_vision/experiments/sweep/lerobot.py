"""LeRobot's policies as cells: `lerobot-train` in a process of its own, on images or on exported
features.

Its checkpoint is evaluated as `surgicai-vision evaluate` does. LeRobot is not imported here.
"""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.processes import OFFLINE, run_module
from surgicai_vision.experiments.run import OWN, Cell
from surgicai_vision.features.encoders import WeightsSource, load_encoder

if TYPE_CHECKING:
    from surgicai_vision.dataset import Dataset, RenderedDataset

LEROBOT_POLICIES = ("act", "diffusion")
OPTIONS = {
    "diffusion": (
        "--policy.use_group_norm=true",
        "--policy.noise_scheduler_type=DDIM",
        "--policy.num_inference_steps=10",
    )
}
"""What a policy needs besides: to start its backbone from random weights, and ten steps of
denoising in the place of a hundred, which take minutes an episode on a core."""
SCRATCH = "export"
VARIABLES = {**OFFLINE, "HF_DATASETS_DISABLE_PROGRESS_BARS": "1", "WANDB_MODE": "disabled"}
"""Environment of `lerobot-train`."""


def train_lerobot(
    cell: Cell,
    dataset: "RenderedDataset",
    out: Path,
    *,
    steps: int,
    batch: int,
    weights: WeightsSource,
) -> None:
    """Train a policy of LeRobot into `out`, as `lerobot-train` writes it.

    Args:
        cell: its policy, encoder (`OWN` or frozen features), views, seed and number of
            demonstrations.
        dataset: an opened dataset of the cell's task.
        out: folder to make.
        steps: updates.
        batch: batch size.
        weights: where pretrained weights come from.

    Raises:
        SurgicaiError: LeRobot failed; the message ends with the last of what it said.
    """
    if dataset.fps != names.FPS:
        raise InputError(
            f"{dataset.path} holds {dataset.fps} frames a second; {cell.policy} needs {names.FPS}."
        )
    root = dataset.path
    if cell.encoder != OWN:
        root = out.with_name(SCRATCH)
        _export(cell, dataset, root, weights)
    arguments = _arguments(cell, dataset, root, out)
    arguments += [f"--steps={steps}", f"--batch_size={batch}", f"--save_freq={steps}"]
    done = run_module("lerobot.scripts.lerobot_train", *arguments, variables=VARIABLES)
    if done.returncode:
        raise SurgicaiError(f"lerobot-train failed for {cell.name}:\n{done.stderr[-2000:]}")


def _export(cell: Cell, dataset: "RenderedDataset", root: Path, weights: WeightsSource) -> None:
    """Write a dataset with the cell's features in place of images."""
    from surgicai_vision.dataset.feature_export import export_features
    from surgicai_vision.features.cache import encode

    encoder = load_encoder(str(cell.encoder), cell.pool, weights)
    rows = [encode(dataset, view, encoder).rows for view in cell.view]
    about = {
        "encoder": cell.encoder,
        "views": list(cell.view),
        "weights_sha256": encoder.weights_sha256,
        "encoder_fingerprint": encoder.fingerprint,
    }
    shutil.rmtree(root, ignore_errors=True)
    export_features(dataset, rows, about, root)


def _arguments(cell: Cell, dataset: "Dataset", root: Path, out: Path) -> list[str]:
    """Return the options of `lerobot-train` that say what is trained on what."""
    arguments = [
        f"--dataset.repo_id=local/{cell.task}",
        f"--dataset.root={root}",
        "--env.type=surgicai",
        f"--env.dataset={root}",
        f"--policy.type={cell.policy}",
        "--policy.pretrained_backbone_weights=null",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--env_eval_freq=0",
        "--num_workers=0",
        f"--seed={cell.seed}",
        f"--output_dir={out}",
        *OPTIONS.get(cell.policy, ()),
    ]
    if cell.demonstrations is not None:
        arguments.append(f"--dataset.episodes={list(range(cell.demonstrations))}")
    if cell.encoder == OWN:
        side = dataset.image_size
        seen = {
            names.image_key(view): {"type": "VISUAL", "shape": [3, side, side]}
            for view in cell.view
        }
        inputs = {**seen, names.STATE: {"type": "STATE", "shape": [len(names.STATE_NAMES)]}}
        arguments.append(f"--policy.input_features={json.dumps(inputs)}")
        arguments.append(f"--env.cameras={json.dumps(list(cell.view))}")
    return arguments
