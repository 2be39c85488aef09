"""`surgicai_checkpoint`: an agent of surgicai-vision as a LeRobot policy, for evaluation only.

The agent is the one that `surgicai-vision evaluate` runs. It gets the images and the state of
LeRobot's batch as if they came from a robot. It keeps its plan for each row of the batch until
LeRobot resets it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from lerobot.configs import PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from numpy.typing import NDArray
from torch import Tensor, nn

from lerobot_env_surgicai.configuration_surgicai_checkpoint import SurgicaiCheckpointConfig
from lerobot_env_surgicai.images import as_uint8
from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError
from surgicai_vision.evaluation.policy_spec import acting_agent
from surgicai_vision.features.encoders import WeightsSource
from surgicai_vision.training import policies, released


@dataclass
class _Told:
    """The state of one robot, as given by LeRobot's batch.

    Attributes:
        state: `observation.state`, (7,).
    """

    state: NDArray[np.float32]

    def agent_pos(self) -> NDArray[np.float32]:
        """Return the active arm's measured tip in its base, (7,)."""
        return self.state

    def setpoint(self) -> NDArray[np.float32]:
        """Refuse: LeRobot's batch does not contain the set point."""
        raise InputError(
            "LeRobot's env does not provide set points; use 'surgicai-vision evaluate'."
        )

    def both_arms(self) -> NDArray[np.float32]:
        """Refuse: LeRobot's batch contains only one arm."""
        raise InputError("LeRobot's env provides only one arm; use 'surgicai-vision evaluate'.")

    def enter(self, phase: int) -> None:
        """Refuse: a subtask's policy does not change the arm."""
        raise InputError("A subtask's policy does not change the arm.")


class SurgicaiCheckpointPolicy(PreTrainedPolicy):  # type: ignore[misc]  # mypy skips LeRobot
    """A checkpoint of surgicai-vision, evaluated by LeRobot."""

    config_class = SurgicaiCheckpointConfig
    name = "surgicai_checkpoint"

    def __init__(self, config: SurgicaiCheckpointConfig, **_: object):
        super().__init__(config)
        config.validate_features()
        folder = released.resolve(config.checkpoint)
        inputs = policies.load_policy(folder).inputs
        unknown = set(inputs.vector) - {names.STATE, names.CLOCK}
        if unknown:
            raise InputError(
                f"{config.checkpoint} needs {', '.join(sorted(unknown))}, which LeRobot's env "
                "does not provide; use 'surgicai-vision evaluate'."
            )
        self._agent = acting_agent(folder, WeightsSource.of(config.encoder_weights))
        if self._agent.depth:
            raise InputError(
                f"{config.checkpoint} needs depth, which LeRobot's env does not provide; "
                "use 'surgicai-vision evaluate'."
            )
        given: dict[str, PolicyFeature] = config.input_features or {}
        hidden = [view for view in self._agent.cameras if names.image_key(view) not in given]
        if given and hidden:  # without any, the env is not known yet
            raise InputError(
                f"{config.checkpoint} needs {', '.join(hidden)}; given: {', '.join(given)}: "
                f"give --env.checkpoint={config.checkpoint}, and no other --env.cameras."
            )
        self._slots = 0
        self._seed = 0
        self.placed = nn.Parameter(torch.zeros(()), requires_grad=False)  # gives the device

    def get_optim_params(self) -> Iterator[nn.Parameter]:
        """Return no parameters."""
        return iter(())

    def reset(self) -> None:
        """Discard the plans of all episodes."""
        self._slots = 0

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Refuse: the policy is trained by `surgicai-vision train`."""
        raise InputError("surgicai_checkpoint cannot be trained here; use 'surgicai-vision train'.")

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return a chunk of one action, (B, 1, 7)."""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Return the actions (B, 7)."""
        states = batch[OBS_STATE].float().cpu().numpy()
        robots = [_Told(state) for state in states]
        images = {view: as_uint8(batch[names.image_key(view)]) for view in self._agent.cameras}
        for view, frames in images.items():
            if frames.shape[1] != self._agent.image_size:
                raise InputError(
                    f"{view} shows images of {frames.shape[1]} pixels; the checkpoint was trained "
                    f"on {self._agent.image_size}: give --env.checkpoint={self.config.checkpoint}."
                )
        observations = [
            {view: frames[row] for view, frames in images.items()} for row in range(len(states))
        ]
        while self._slots < len(states):
            self._agent.reset(self._slots, robots[self._slots], self._seed)
            self._seed += 1
            self._slots += 1
        actions = self._agent.act(range(len(states)), robots, observations)
        return torch.from_numpy(actions).to(batch[OBS_STATE].device)
