"""`hlp`: the paper's high-level policy, which classifies the subtask that is due.

The recipe `paper` (paper, Section 4 and appendix): the network of `bc` with the logits of five
classes at its end; cross-entropy against the phases of whole procedures, a little ahead (`AHEAD`);
visual features beside the tip pose and jaw of both arms.
"""

from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from policies.base import Inputs, Plugin, Policy, Recipe
from policies.layers import FeatureMLP
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError

AHEAD = 10
"""Frames by which labels are ahead.

In our recordings a subtask continues for 15 frames after its success, while hardly anything moves.
Without the shift its last frames and the first of the next subtask would look alike with different
labels, and a policy would name the old subtask for ever; what is due there is the next one.
"""


@final
class HighLevelPolicy(Policy):
    """The MLP that classifies the phase."""

    def __init__(self, recipe: Recipe, visual: tuple[tuple[int, ...], ...]):
        if recipe.privileged:
            raise InputError("Policy 'hlp' sees both arms and images; leave 'privileged' off.")
        super().__init__(Inputs(visual, names.BOTH_ARMS if recipe.proprioception else None))
        self.network = FeatureMLP(recipe, self.inputs, len(names.SUBTASKS))

    def forward(self, observed: torch.Tensor) -> torch.Tensor:
        """Return the logits (B, 5) of the subtasks for normalised inputs."""
        logits: torch.Tensor = self.network(observed)
        return logits

    def loss(self, observed: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the cross-entropy against phases (B,) int64."""
        return nn.functional.cross_entropy(self(observed), target)

    def choose(
        self, features: NDArray[np.float32] | None, both_arms: NDArray[np.float32]
    ) -> NDArray[np.int64]:
        """Return the subtask that is due for a batch as `act` takes it.

        Returns:
            (B,) indices in `names.SUBTASKS`.
        """
        return np.asarray(self.act(features, both_arms).argmax(axis=1), np.int64)


HLP = Plugin("hlp", Recipe, HighLevelPolicy, names.PHASE, AHEAD)
