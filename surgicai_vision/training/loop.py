"""One training from its first update to its checkpoint; see `training.train`."""

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.optim.lr_scheduler import LRScheduler

from policies.base import Policy, visual_shapes
from surgicai_vision import __version__
from surgicai_vision.core import names
from surgicai_vision.core.config import to_mapping
from surgicai_vision.core.errors import InputError, SurgicaiError
from surgicai_vision.core.progress import Progress
from surgicai_vision.features.cache import Features
from surgicai_vision.features.devices import cuda_devices, random_states, set_random_states
from surgicai_vision.training.augment import with_noise, with_overlay, with_shift
from surgicai_vision.training.averages import MovingAverage
from surgicai_vision.training.checkpoint import (
    Checkpoint,
    EncoderRecord,
    StageErrors,
    write_checkpoint,
)
from surgicai_vision.training.chunks import earlier_rows
from surgicai_vision.training.data import cuts, over_places, split
from surgicai_vision.training.feature_rows import FeatureRows
from surgicai_vision.training.folder import read_state, write_state
from surgicai_vision.training.progress_input import copy_progress_policy
from surgicai_vision.training.request import TrainingRequest
from surgicai_vision.training.stage_errors import stage_errors

STATE_EVERY = 5  # epochs between training states: an interrupted training loses at most these
STATISTICS_ROWS = 1024  # rows summed at a time
WARM = 3  # warm-up updates before the first timed one
TIMED = 20
SMALLEST_STD = 1e-6  # an input that varies less counts as constant: only its mean is removed

Log = Callable[[int, dict[str, float]], None]
"""Called with (epoch, losses by name)."""


@final
class Training:
    """One training: its data, its policy, its optimiser.

    Args:
        request: what is trained.
        start: a trained policy to start from.
        device: torch device to train on.
    """

    def __init__(
        self, request: TrainingRequest, start: Policy | None, device: torch.device
    ) -> None:
        self.request = request
        self.device = device
        index = np.asarray(request.dataset.episode_index)
        self.rows, self.held_rows, self.held_episodes = split(
            index, request.recipe, request.seed, np.asarray(request.dataset.demonstration_index)
        )
        if len(self.rows) < 2:
            raise InputError(
                f"There are {len(self.rows)} frames to train on; at least 2 are needed."
            )
        torch.manual_seed(request.seed)
        self.policy = request.untrained()
        fed = [np.asarray(request.columns[key], np.float32) for key in self.policy.inputs.vector]
        self.vector = np.concatenate(fed, axis=1) if fed else None
        self.features = FeatureRows(request.features, device)
        target = request.columns[request.policy.target]
        kind = np.int64 if np.issubdtype(target.dtype, np.integer) else np.float32
        self.target = torch.from_numpy(target.astype(kind))
        history = self.policy.history
        spacing = request.recipe.frame_stride
        self.seen = earlier_rows(request.dataset, history, spacing) if history > 1 else None
        if start is None:
            self._measure()
            self.policy.measure(self.target[self.rows])
        else:
            self._copy(start)
        self.policy.to(device)
        self.average = (
            MovingAverage(self.policy, self.policy.averaging) if self.policy.averaging else None
        )
        self.optimiser, self.schedule = self._optimiser()
        self.order = np.random.default_rng((request.seed, 1))
        self.losses: list[float] = []
        self.held_losses: list[float] = []

    def run(
        self, out: Path, save_every: int, progress: Progress | None, log: Log | None
    ) -> Checkpoint:
        """Train all epochs; return the last one's checkpoint."""
        epochs = self.request.recipe.epochs
        self._resume(out)
        if progress:
            progress(len(self.losses), epochs)
        while len(self.losses) < epochs:
            self.losses.append(self._epoch())
            if len(self.held_rows):
                self.held_losses.append(self._validate())
            done = len(self.losses)
            if log:
                held = {"validation": self.held_losses[-1]} if self.held_losses else {}
                log(done, {"train": self.losses[-1], **held})
            if save_every and done % save_every == 0 and done < epochs:
                self._write(out / "epochs" / f"epoch_{done:04d}")
            if done % STATE_EVERY == 0 and done < epochs:
                self._save(out)
            if progress:
                progress(done, epochs)
        return self._write(out, self._conclude())

    def time_epoch(self, clock: Callable[[], float]) -> float:
        """Return an estimate of an epoch's duration [s], from `TIMED` updates and a validation."""
        batches = self._batches()
        self.schedule = None  # it ends with the last epoch, which these updates may exceed
        self.policy.train()
        for rows in batches[:WARM]:
            self._update(rows)
        timed = [batches[index % len(batches)] for index in range(TIMED)]
        begun = clock()
        for rows in timed:
            self._update(rows)
        seconds = (clock() - begun) / TIMED * len(batches)
        begun = clock()
        if len(self.held_rows):
            self._validate()
        return seconds + clock() - begun

    @torch.no_grad()
    def _conclude(self) -> StageErrors | None:
        """Calibrate on the frames held out; return a high-level policy's errors there."""
        if not len(self.held_rows):
            return None
        if self.request.policy.target == names.ACTION_CHUNK:
            return None
        target = self.target[self.held_rows]
        self.policy.eval()
        with self._averaged():
            self.policy.calibrate(self._answers(self.held_rows), target)
            if self.request.policy.target != names.STAGE:
                return None
            return stage_errors(self._answers(self.held_rows).numpy(), target.numpy())

    def _answers(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """Return the policy's answers to some frames, (n, …)."""
        pieces = [rows[at : at + STATISTICS_ROWS] for at in range(0, len(rows), STATISTICS_ROWS)]
        normalised = (self.policy.normalise(self._inputs(piece)) for piece in pieces)
        return torch.cat([self.policy(observed).cpu() for observed in normalised])

    def _optimiser(self) -> tuple[torch.optim.Optimizer, LRScheduler | None]:
        """Return the recipe's optimiser and its schedule (None for a constant learning rate)."""
        recipe = self.request.recipe
        kind = torch.optim.AdamW if recipe.weight_decay else torch.optim.Adam
        optimiser = kind(
            self.policy.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay
        )
        if recipe.schedule == "constant":
            return optimiser, None
        steps = recipe.epochs * len(cuts(len(self.rows), recipe.batch_size))
        return optimiser, torch.optim.lr_scheduler.OneCycleLR(
            optimiser, recipe.learning_rate, total_steps=steps
        )

    def _observed(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """Return the raw inputs of some frames where the features are, (n, inputs) float32.

        The views' features come before the vector.
        """
        observed = torch.empty(len(rows), self.policy.inputs.dim, device=self.features.home)
        at = self.features.write(rows, observed)
        if self.vector is not None:
            observed[:, at:] = torch.from_numpy(self.vector[rows])
        return observed

    def _inputs(self, rows: NDArray[np.int64]) -> torch.Tensor:
        """Return the raw inputs of some frames with their history, on the device.

        Returns:
            (n, inputs) float32, or (n, history, inputs) for a policy with a history.
        """
        if self.seen is None:
            return self._observed(rows).to(self.device)
        moments = self.seen[rows]
        observed: torch.Tensor = self._observed(moments.ravel()).unflatten(0, moments.shape)
        return observed.to(self.device)

    def _measure(self) -> None:
        """Store mean and standard deviation of the inputs over the training frames."""
        pieces = [
            self.rows[at : at + STATISTICS_ROWS] for at in range(0, len(self.rows), STATISTICS_ROWS)
        ]
        home = self.features.home
        mean = torch.zeros(self.policy.inputs.dim, dtype=torch.float64, device=home)
        squares = torch.zeros_like(mean)
        for piece in pieces:
            mean += self._observed(piece).double().sum(0) / len(self.rows)
        for piece in pieces:
            squares += ((self._observed(piece).double() - mean) ** 2).sum(0) / len(self.rows)
        std = squares.sqrt()
        mean, std = over_places(mean.cpu(), std.cpu(), self.policy.inputs.visual)
        self.policy.input_mean.copy_(mean)
        self.policy.input_std.copy_(torch.where(std > SMALLEST_STD, std, torch.ones_like(std)))

    def _copy(self, start: Policy) -> None:
        """Start from a trained policy, its input statistics included."""
        if start.inputs != self.policy.inputs:
            raise InputError(
                f"The policy to start from sees {start.inputs}, the new one {self.policy.inputs}."
            )
        try:
            self.policy.load_state_dict(start.state_dict())
        except RuntimeError as error:
            raise InputError(
                f"The policy to start from has other layers ({str(error).splitlines()[0]})."
            ) from None

    def _batches(self) -> list[NDArray[np.int64]]:
        """Return the training rows of one epoch in a new order, batch by batch.

        A last batch of one row joins the one before.
        """
        order = self.order.permutation(self.rows)
        return np.split(order, cuts(len(order), self.request.recipe.batch_size)[1:])

    def _epoch(self) -> float:
        """Make one pass over the training frames; return its mean loss."""
        self.policy.train()
        total = 0.0
        for rows in self._batches():
            total += self._update(rows) * len(rows)
        if not np.isfinite(total):
            raise SurgicaiError(
                "The training loss is not finite; lower the learning rate or check the features."
            )
        return total / len(self.rows)

    def _update(self, rows: NDArray[np.int64]) -> float:
        """Make one update of the weights on some frames; return its loss."""
        observed = self._augmented(self.policy.normalise(self._inputs(rows)))
        loss = self.policy.loss(observed, self.target[rows].to(self.device))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if self.policy.clip:
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.policy.clip)
        self.optimiser.step()
        if self.schedule:
            self.schedule.step()
        if self.average:
            self.average.update(self.policy)
        return loss.item()

    def _averaged(self) -> AbstractContextManager[None]:
        """Give the policy the weights to be kept, within a `with` block."""
        return self.average.applied(self.policy) if self.average else nullcontext()

    def _augmented(self, observed: torch.Tensor) -> torch.Tensor:
        """Return normalised inputs after the recipe's augmentation.

        Args:
            observed: (B, inputs.dim), or (B, history, inputs.dim).
        """
        recipe = self.request.recipe
        inputs = self.policy.inputs
        moments = observed.shape[1] if observed.ndim == 3 else 1
        rows = observed.reshape(-1, inputs.dim)
        shapes = visual_shapes(recipe, inputs.visual)
        if recipe.map_shift:
            rows = with_shift(rows, shapes, recipe.map_shift, moments)
        if recipe.map_overlay:
            rows = with_overlay(rows, shapes, recipe.map_overlay, moments)
        if recipe.proprioception_noise:
            rows = with_noise(rows, inputs, recipe.proprioception_noise)
        augmented: torch.Tensor = rows.reshape(observed.shape)
        return augmented

    @torch.no_grad()
    def _validate(self) -> float:
        """Return the mean loss over the frames held out; a sampling policy repeats its draws."""
        self.policy.eval()
        total = 0.0
        with self._averaged(), torch.random.fork_rng(devices=cuda_devices(self.device)):
            torch.manual_seed(self.request.seed)
            for at in range(0, len(self.held_rows), STATISTICS_ROWS):
                rows = self.held_rows[at : at + STATISTICS_ROWS]
                observed = self.policy.normalise(self._inputs(rows))
                target = self.target[rows].to(self.device)
                total += self.policy.loss(observed, target).item() * len(rows)
        return total / len(self.held_rows)

    def _save(self, out: Path) -> None:
        """Write what the next epoch needs."""
        state = {
            "policy": self.policy.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict() if self.schedule else {},
            # Its integers are wider than a tensor's.
            "order": json.dumps(self.order.bit_generator.state),
            "random": random_states(self.device),
            "losses": self.losses,
            "held_losses": self.held_losses,
            "average": self.average.state() if self.average else {},
        }
        write_state(out, state)

    def _resume(self, out: Path) -> None:
        """Resume from a training state, if there is a complete one."""
        state = read_state(out)
        if state is None:
            return
        self.policy.load_state_dict(state["policy"])
        self.optimiser.load_state_dict(state["optimiser"])
        if self.schedule:
            self.schedule.load_state_dict(state["schedule"])
        self.order.bit_generator.state = json.loads(state["order"])
        set_random_states(state["random"], self.device)
        self.losses = list(state["losses"])
        self.held_losses = list(state["held_losses"])
        if self.average:
            self.average.restore(**state["average"])

    def _write(self, folder: Path, errors: StageErrors | None = None) -> Checkpoint:
        """Write the policy in its present state."""
        request = self.request
        dataset = request.dataset
        folder.mkdir(parents=True, exist_ok=True)
        fed = request.progress_policy
        if fed is not None:
            copy_progress_policy(fed, folder)
        checkpoint = Checkpoint(
            run=request.trained_run,
            recipe=to_mapping(request.recipe),
            image_size=dataset.image_size,
            encoder=_record(request.features[0]) if request.features else None,
            proprioception=self.vector is not None and not self.policy.inputs.knows_goal,
            epoch=len(self.losses),
            dataset=dataset.fingerprint,
            frames=len(self.rows),
            validation_episodes=self.held_episodes,
            train_losses=tuple(self.losses),
            validation_losses=tuple(self.held_losses),
            device=str(self.device),
            code_version=__version__,
            stage_errors=errors,
            progress_sha256=fed.policy_sha256 if fed else "",
        )
        with self._averaged():
            return write_checkpoint(folder, checkpoint, self.policy.state_dict())


def _record(entry: Features) -> EncoderRecord:
    """Return the encoder's record from a cache entry's manifest."""
    manifest = entry.manifest
    return EncoderRecord(
        name=manifest["encoder"],
        card=manifest["card"],
        weights_sha256=manifest["weights_sha256"],
        pool=manifest["pool"],
        fingerprint=manifest["encoder_fingerprint"],
        shape=entry.shape,
    )
