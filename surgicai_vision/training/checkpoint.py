"""A checkpoint: the result of a training, verified whenever it is read.

Interface:

* `Checkpoint`: everything about a trained policy, frozen, with its folder.
* `write_checkpoint(folder, checkpoint, tensors)`: `policy.safetensors` first, `checkpoint.json`
  last.
* `read_checkpoint(folder) -> Checkpoint`: refuse, in one line, one that is missing, damaged,
  tampered with or of another format.
* `read_tensors(checkpoint)`: the policy's weights and input statistics, with their hash checked.
* `check_encoder(checkpoint, encoder)`, `check_task(checkpoint, task)`: refuse an encoder or a task
  that the policy was not trained on.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from safetensors import SafetensorError

from surgicai_vision.core.config import JSON, TaskConfig, digest, from_mapping, to_mapping
from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.files import read_json, write_bytes, write_json
from surgicai_vision.training.run_config import RunConfig

if TYPE_CHECKING:
    import torch

    from encoders.base import Encoder

FORMAT = 2
CARD = "checkpoint.json"
REQUEST = "training.json"
"""Marks the folder of a training that has begun; written first."""
LOCK = ".lock"
"""File in that folder that a training keeps locked; a killed one leaves it."""
WEIGHTS = "policy.safetensors"
PREPROCESSING = ("input_size", "input_range", "mean", "std", "interpolation", "channel_order")
"""Entries of a card that change what the network sees."""


@dataclass(frozen=True)
class EncoderRecord:
    """Which encoder a policy was trained on.

    Attributes:
        name: its registered name.
        card: its card as plain data.
        weights_sha256: hash of its weights and buffers.
        pool: which of its outputs was used.
        fingerprint: hash of everything its features depend on, compute type included.
        shape: shape of one feature before it is flattened.
    """

    name: str
    card: dict[str, JSON]
    weights_sha256: str
    pool: str
    fingerprint: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class StageErrors:
    """What a high-level policy got right and wrong on held-out frames.

    Attributes:
        confusion: frames, by the subtask that was due (row) and the predicted one (column), both in
            the order of `names.SUBTASKS`.
        calibration_error: mean difference between the probability of the predicted subtask and how
            often it was right, in [0, 1] (expected calibration error).
        progress_error: mean absolute error of the progress, in [0, 1]; None for a policy that does
            not predict it.
    """

    confusion: tuple[tuple[int, ...], ...]
    calibration_error: float
    progress_error: float | None = None

    @property
    def frames(self) -> int:
        """Number of frames evaluated."""
        return sum(map(sum, self.confusion))

    @property
    def right(self) -> int:
        """Number of frames whose subtask was predicted correctly."""
        return sum(row[index] for index, row in enumerate(self.confusion))


@dataclass(frozen=True)
class Checkpoint:
    """Everything about a trained policy.

    Attributes:
        run: what was trained: task, inputs, policy, recipe by name, demonstrations, seed.
        recipe: the recipe's settings as plain data.
        image_size: side of the images it was trained on [px].
        encoder: the encoder's record; None without views.
        proprioception: True when the tip pose and jaw are fed too.
        epoch: passes made over the training frames.
        dataset: fingerprint of the dataset.
        frames: frames trained on.
        validation_episodes: indices of the episodes held out.
        train_losses: mean training loss of each epoch.
        validation_losses: validation loss after each epoch; empty where nothing was held out.
        device: the device it was trained on.
        code_version: version of this package.
        policy_sha256: hash of `policy.safetensors`.
        stage_errors: a high-level policy's errors on the episodes held out; None for any other
            policy, or where nothing was held out.
        progress_sha256: hash of the weights of the policy whose progress it is fed; "" for none.
        format: version of this file's layout.
        folder: its folder (not stored).
    """

    run: RunConfig
    recipe: dict[str, JSON]
    image_size: int
    encoder: EncoderRecord | None
    proprioception: bool
    epoch: int
    dataset: str
    frames: int
    validation_episodes: tuple[int, ...]
    train_losses: tuple[float, ...]
    validation_losses: tuple[float, ...]
    device: str
    code_version: str
    policy_sha256: str = ""
    stage_errors: StageErrors | None = None
    progress_sha256: str = ""
    format: int = FORMAT
    folder: Path = field(default=Path("."), compare=False)

    @property
    def task(self) -> TaskConfig:
        """The task it was trained in."""
        return self.run.env

    @property
    def policy(self) -> str:
        """The registered name of the policy."""
        return self.run.policy

    @property
    def views(self) -> tuple[str, ...]:
        """Its views, in the order of the features; empty for proprioception alone."""
        return self.run.views

    @property
    def visual(self) -> tuple[tuple[int, ...], ...]:
        """Shape of each view's feature."""
        return (self.encoder.shape,) * len(self.views) if self.encoder else ()


def write_checkpoint(
    folder: Path, checkpoint: Checkpoint, tensors: "Mapping[str, torch.Tensor]"
) -> Checkpoint:
    """Write weights, then card; return the checkpoint as stored in `folder`."""
    from safetensors.torch import save

    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()})
    checkpoint = replace(
        checkpoint, policy_sha256=hashlib.sha256(content).hexdigest(), folder=folder
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / WEIGHTS, content)
    plain = to_mapping(replace(checkpoint, folder=None))  # type: ignore[arg-type]
    del plain["folder"]
    plain["card_sha256"] = digest(plain)
    write_json(folder / CARD, plain)
    return checkpoint


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read and verify a checkpoint folder.

    Raises:
        BadFile: it is missing, damaged, changed by hand or of another format.
    """
    folder = Path(folder)
    if not (folder / CARD).is_file():
        if folder.is_file():
            raise BadFile(
                f"{folder} is a file, not the folder of a checkpoint; of a hierarchical policy, "
                "give one of the folders that its file names."
            )
        hint = "its training has not ended" if (folder / REQUEST).exists() else f"no {CARD} in it"
        raise BadFile(
            f"{folder} is not a checkpoint ({hint}); make one with 'surgicai-vision train'."
        )
    plain = read_json(folder / CARD)
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        found = plain.get("format") if isinstance(plain, dict) else None
        raise BadFile(
            f"{folder / CARD} has format {found!r}, of another version; this one reads {FORMAT}. "
            "Train again."
        )
    if plain.pop("card_sha256", None) != digest(plain):
        raise BadFile(
            f"{folder / CARD} was changed after training (its hash does not match); train again."
        )
    try:
        checkpoint = replace(from_mapping(Checkpoint, plain, str(folder / CARD)), folder=folder)
    except (InputError, TypeError) as error:
        raise BadFile(f"{folder / CARD} is damaged ({error}); train again.") from None
    encoder = checkpoint.encoder
    lacking = [key for key in PREPROCESSING if encoder and key not in encoder.card]
    if lacking:
        raise BadFile(
            f"{folder / CARD} is damaged (the card of its encoder has no {', '.join(lacking)}); "
            "train again."
        )
    read_tensors(checkpoint)
    return checkpoint


def read_tensors(checkpoint: Checkpoint) -> "dict[str, torch.Tensor]":
    """Return the policy's tensors after checking their hash; `BadFile` if it does not match."""
    from safetensors.torch import load

    path = checkpoint.folder / WEIGHTS
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadFile(f"Cannot read {path}: {error.strerror}; train again.") from None
    if hashlib.sha256(content).hexdigest() != checkpoint.policy_sha256:
        raise BadFile(
            f"{path} is not the file its {CARD} was written for (sha256 differs); train again."
        )
    try:
        return load(content)
    except SafetensorError as error:
        raise BadFile(f"{path} is not a safetensors file ({error}); train again.") from None


def check_encoder(checkpoint: Checkpoint, encoder: "Encoder | None") -> None:
    """Refuse an encoder whose weights, preprocessing or pool differ from those trained on.

    Raises:
        InputError: it differs; the message says how.
    """
    wanted = checkpoint.encoder
    if wanted is None or encoder is None:
        if (wanted is None) != (encoder is None):
            has = "needs no encoder" if wanted is None else f"needs encoder '{wanted.name}'"
            raise InputError(f"The checkpoint {checkpoint.folder} {has}.")
        return
    card = to_mapping(encoder.card)
    given = {
        "weights": encoder.weights_sha256,
        "pool": encoder.pool,
        **{key: card[key] for key in PREPROCESSING},
    }
    trained = {
        "weights": wanted.weights_sha256,
        "pool": wanted.pool,
        **{key: wanted.card[key] for key in PREPROCESSING},
    }
    for key, value in trained.items():
        if given[key] != value:
            raise InputError(
                f"The checkpoint {checkpoint.folder} was trained on encoder '{wanted.name}' with "
                f"{key} {value}, got '{encoder.card.name}' with {given[key]}; give the same one "
                "with --weights."
            )


def check_task(checkpoint: Checkpoint, task: str) -> None:
    """Refuse a checkpoint trained on another task."""
    if checkpoint.task.task != task:
        trained = checkpoint.task.task
        raise InputError(
            f"The checkpoint {checkpoint.folder} was trained on task '{trained}', not '{task}'."
        )
