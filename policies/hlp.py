"""`hlp`: the paper's high-level policy, which classifies the subtask that is due.

The recipe `paper` (paper, Section 4 and appendix): the network of `bc` with the logits of five
classes at its end; cross-entropy against the phases of whole procedures, shifted slightly ahead
(`training.visits.AHEAD`); visual features with the tip pose and jaw of both arms.

With `progress` in its recipe (configs/recipes/high-level.yaml) it also predicts the progress of the
present subtask, like stage and progress in SARM (Chen et al., Stage-aware reward modeling for long
horizon robot manipulation, arXiv:2509.25358; `lerobot.rewards.sarm` in LeRobot 0.6.1): one more
output of the same network, a sigmoid trained with squared error.

Its logits are calibrated on the episodes held out of training, so that their softmax is a
probability. They are divided by one temperature, which changes no choice (Guo et al., On
calibration of modern neural networks, ICML 2017, arXiv:1706.04599).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from policies.base import Inputs, Plugin, Policy, Recipe
from policies.layers import FeatureMLP
from surgicai_vision.core import names
from surgicai_vision.core.config import FULL_SPEED
from surgicai_vision.core.errors import InputError, check_at_least

CLASSES = len(names.SUBTASKS)
TEMPERATURES = (0.1, 10.0)
"""Bounds of the search for the temperature: held-out frames that are all classified correctly would
otherwise drive it to 0, making every later answer certain.
"""


@dataclass(frozen=True)
class HLPRecipe(Recipe):
    """Settings of the high-level policy.

    Attributes:
        progress: weight of the progress's squared error, added to the cross-entropy; 0 for a policy
            that predicts no progress. SARM uses 1.
    """

    progress: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(0, progress=self.progress)
        for name in ("privileged", "setpoint", "progress_input"):
            if getattr(self, name):
                raise InputError(f"Policy 'hlp' sees both arms and images; leave '{name}' off.")
        still = {**vars(FULL_SPEED), "denoise": 1}
        for key, default in still.items():
            if getattr(self, key) != default:
                raise InputError(
                    "Policy 'hlp' chooses subtasks and does not move; "
                    f"leave '{key}' at {default:g}."
                )


@final
class HighLevelPolicy(Policy):
    """The MLP that classifies the phase.

    Attributes:
        temperature: divisor of the logits; 1 before it is fitted.
    """

    temperature: torch.Tensor

    def __init__(self, recipe: HLPRecipe, visual: tuple[tuple[int, ...], ...]):
        super().__init__(Inputs(visual, (names.BOTH_ARMS,) if recipe.proprioception else ()))
        self.network = FeatureMLP(recipe, self.inputs, CLASSES + bool(recipe.progress))
        self.weight = recipe.progress
        self.register_buffer("temperature", torch.ones(()))

    def load_state_dict(
        self, state_dict: Mapping[str, torch.Tensor], strict: bool = True, assign: bool = False
    ) -> tuple[list[str], list[str]]:
        """Load a state; one from before calibration has no temperature, and its logits stay.

        Returns:
            Missing and unexpected names, as torch returns them.
        """
        whole = {"temperature": torch.ones(()), **state_dict}
        names_left: tuple[list[str], list[str]] = super().load_state_dict(whole, strict, assign)
        return names_left

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the calibrated logits of the subtasks, and the progress where it is learned.

        Returns:
            (B, 5), or (B, 6) with the progress in [0, 1] last, for normalised inputs.
        """
        answers: torch.Tensor = self.network(observed)
        logits = answers[:, :CLASSES] / self.temperature
        return torch.cat([logits, answers[:, CLASSES:].sigmoid()], dim=1)

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the cross-entropy, and the weighted squared error of the progress.

        Args:
            observed: normalised inputs (B, inputs.dim).
            target: (B, 2), the column `names.STAGE`; a progress below 0 is unknown and left out.
        """
        answers: torch.Tensor = self.network(observed)
        loss = nn.functional.cross_entropy(answers[:, :CLASSES], target[:, 0].long())
        if not self.weight:
            return loss
        known = target[:, 1] >= 0
        squares = (answers[:, CLASSES].sigmoid() - target[:, 1]) ** 2 * known
        return loss + self.weight * squares.sum() / known.sum().clamp(min=1)

    def calibrate(self, answers: torch.Tensor, target: torch.Tensor) -> None:
        """Set the temperature that maximises the likelihood of held-out frames' subtasks."""
        logits = answers[:, :CLASSES].cpu().double() * self.temperature.cpu()
        fitted = fit_temperature(logits.numpy(), target[:, 0].long().cpu().numpy())
        self.temperature.fill_(fitted)

    def choose(
        self, features: NDArray[np.float32] | None, both_arms: NDArray[np.float32]
    ) -> NDArray[np.int64]:
        """Return the subtask that is due, for a batch of the inputs that `act` takes.

        Returns:
            (B,) indices in `names.SUBTASKS`.
        """
        logits = self.act(features, both_arms)[:, :CLASSES]
        return np.asarray(logits.argmax(axis=1), np.int64)


def fit_temperature(logits: NDArray[np.float64], classes: NDArray[np.int64]) -> float:
    """Return the temperature within `TEMPERATURES` with the smallest cross-entropy.

    The cross-entropy is convex in the inverse temperature, so there is only one minimum.

    Args:
        logits: (N, classes).
        classes: (N,) the correct classes.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import log_softmax

    rows = np.arange(len(classes))

    def cross_entropy(logarithm: float) -> float:
        return -float(log_softmax(logits / np.exp(logarithm), axis=1)[rows, classes].mean())

    bounds = tuple(np.log(TEMPERATURES))
    found = minimize_scalar(cross_entropy, bounds=bounds, method="bounded")
    return float(np.exp(found.x))


def _make(recipe: Recipe, visual: tuple[tuple[int, ...], ...]) -> HighLevelPolicy:
    assert isinstance(recipe, HLPRecipe), "training and loading make the recipe of the plug-in"
    return HighLevelPolicy(recipe, visual)


HLP = Plugin("hlp", HLPRecipe, _make, names.STAGE)
