"""Disturbance: what makes a demonstrator meet states off its own path; cheap to import.

`surgicai_vision.demos.rollout` explains what each kind is for, and runs an episode with it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import CLOCK_PERIOD, TaskConfig
from surgicai_vision.core.errors import InputError
from surgicai_vision.demos.demonstrator import ON_AIM, Miss

if TYPE_CHECKING:
    from surgicai_vision.envs.base import SuturingEnv

PERTURBATION_STEPS = (8, 25)
"""Fewest and most control steps of a perturbation: 4 to 12 mm at the paper's step size."""
AIM_STEPS = CLOCK_PERIOD
"""Control steps for which a tool aims beside its goal: one attempt of `demos.search_expert`."""
AIM_SHARE = 0.5
"""Share of these periods in which it does; in the others it aims right."""
MOST_AIM_NOISE = 5.0
"""Largest standard deviation of the aim [mm]; the needle's arc is 21 mm long, an opening 3.8."""


@dataclass(frozen=True)
class Disturbance:
    """What disturbs an episode.

    Attributes:
        noise: standard deviation of the Gaussian noise on the six motions of an executed action, in
            units of its range; the jaw's noise is separate.
        perturb_start_fraction: share of episodes that start with a motion in a random direction,
            which is not recorded.
        noise_from: lowest deviation; each episode draws its own between this and `noise`. None
            uses `noise` throughout.
        upset_fraction: share of episodes in which something goes wrong once (`envs.upset`).
        jaw_noise: standard deviation of the noise on the jaw's motion, in units of its range, while
            it is not commanded to close: a random walk of closed jaws would drop the needle.
            Without this noise, open jaws are always exactly as open as the demonstrator holds them,
            and a policy never sees how to reopen jaws that have closed a little
            (docs/results/unmoved-trials.md).
        aim_noise: standard deviation of how far beside their goal the executed motions aim [mm]:
            past a grasp, along the needle, or beside the path of an insertion, in both directions
            of the entry's plane (`demonstrator.Miss`). It is drawn anew every `AIM_STEPS`, and in
            `AIM_SHARE` of them. Noise of single steps is corrected at once, so that it shows few
            states that are far off, and a policy that comes to one repeats the demonstrated motion
            from there (docs/results/unmoved-trials.md). The jaw follows the label.
        late: the most control steps by which a demonstrator that goes back notices a loss late;
            each episode draws its own. It shows the behaviour of a policy that has not noticed yet.
    """

    noise: float = 0.0
    perturb_start_fraction: float = 0.0
    noise_from: float | None = None
    upset_fraction: float = 0.0
    late: int = 0
    jaw_noise: float = 0.0
    aim_noise: float = 0.0

    def __post_init__(self) -> None:
        if self.noise_from is not None and not 0.0 <= self.noise_from <= self.noise:
            raise InputError(
                f"noise_from is {self.noise_from:g}; it must be within 0 and noise, {self.noise:g}."
            )
        if not 0.0 <= self.noise <= 1.0 or not 0.0 <= self.perturb_start_fraction <= 1.0:
            raise InputError(
                f"noise is {self.noise:g} and perturb_start_fraction "
                f"{self.perturb_start_fraction:g}; each must be within 0 and 1."
            )
        if not 0.0 <= self.jaw_noise <= 1.0:
            raise InputError(f"jaw_noise is {self.jaw_noise:g}; it must be within 0 and 1.")
        if not 0.0 <= self.aim_noise <= MOST_AIM_NOISE:
            raise InputError(
                f"aim_noise is {self.aim_noise:g} mm; it must be within 0 and {MOST_AIM_NOISE:g}."
            )
        if not 0.0 <= self.upset_fraction <= 1.0:
            raise InputError(
                f"upset_fraction is {self.upset_fraction:g}; it must be within 0 and 1."
            )
        if self.late < 0:
            raise InputError(f"late is {self.late}; it must be at least 0 control steps.")

    def perturb_start(self, env: "SuturingEnv", rng: np.random.Generator) -> bool:
        """Move the tool away with the given probability; return False if that ended the episode.

        The episode's steps and path are counted from the moved start: it is where the recording
        begins, and where a policy's clock does.
        """
        if rng.random() >= self.perturb_start_fraction:
            return True
        direction = np.append(rng.uniform(-1.0, 1.0, 6), 0.0).astype(np.float32)
        steps = int(rng.integers(*PERTURBATION_STEPS, endpoint=True))
        for _ in range(-(-steps // env.config.action_repeat)):
            _, _, terminated, truncated, _ = env.step(direction)
            if terminated or truncated:
                return False
        state = env.simulation.task_state
        state.steps = 0
        state.tip_path = 0.0
        return True

    def draw_deviation(self, rng: np.random.Generator) -> float:
        """Return the standard deviation of an episode's noise."""
        if self.noise_from is None:
            return self.noise
        return float(rng.uniform(self.noise_from, self.noise))

    def draw_aim(self, task: str, rng: np.random.Generator) -> Miss:
        """Return how far beside the goal of `task` the motions of the next `AIM_STEPS` aim."""
        shifts = rng.normal(0.0, self.aim_noise * 1e-3, AIMING_TASKS[task])
        return Miss(*shifts.tolist()) if rng.random() < AIM_SHARE else ON_AIM

    def draw_late(self, rng: np.random.Generator) -> int:
        """Return by how many control steps an episode's demonstrator notices a loss late."""
        return int(rng.integers(0, self.late, endpoint=True)) if self.late else 0

    def disturb(
        self, action: NDArray[np.float32], deviation: float, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Return what is executed instead of `action`, (7,).

        Args:
            action: the demonstrator's, (7,) in [-1, 1]; at -1 the jaw closes.
            deviation: what `draw_deviation` returned for the episode.
            rng: the source of the noise.
        """
        noisy = action + np.append(rng.normal(0.0, deviation, 6), 0.0)
        if self.jaw_noise and action[6] > -1.0:
            noisy[6] += rng.normal(0.0, self.jaw_noise)
        executed: NDArray[np.float32] = np.clip(noisy, -1.0, 1.0).astype(np.float32)
        return executed


UNDISTURBED = Disturbance()

AIMING_DEMONSTRATORS = ("expert", "search")
"""Those that can aim beside their goal (`Demonstrator.missing`)."""
AIMING_TASKS: Mapping[str, int] = MappingProxyType(
    {"grasp": 1, "handoff": 1, "insert": 2, names.SUTURE: 1}
)
"""The tasks in which a goal can be missed → in how many directions (`demonstrator.Miss`)."""

RETURNING_DEMONSTRATORS = ("recover",)
"""Those that go back after a loss, and so can notice it late."""


def check_late(demonstrator: str, disturbance: Disturbance) -> None:
    """Refuse late noticing for a demonstrator that notices no loss.

    Raises:
        InputError: `late` is set for such a demonstrator.
    """
    if disturbance.late and demonstrator not in RETURNING_DEMONSTRATORS:
        raise InputError(
            f"late is {disturbance.late}, but demonstrator '{demonstrator}' never goes back to "
            "an earlier subtask; leave late out or use demonstrator "
            f"{', '.join(RETURNING_DEMONSTRATORS)}."
        )


def check_aim(demonstrator: str, task: str, disturbance: Disturbance) -> None:
    """Refuse `aim_noise` where no goal can be missed, or by a demonstrator that cannot miss.

    Raises:
        InputError: it is set for such a task or demonstrator.
    """
    if not disturbance.aim_noise:
        return
    if task not in AIMING_TASKS:
        raise InputError(
            f"aim_noise is {disturbance.aim_noise:g}, but task '{task}' has no goal to miss; leave "
            f"it out or use task {', '.join(AIMING_TASKS)}."
        )
    if demonstrator not in AIMING_DEMONSTRATORS:
        raise InputError(
            f"aim_noise is {disturbance.aim_noise:g}, but demonstrator '{demonstrator}' cannot "
            f"aim beside its goal; leave it out or use demonstrator "
            f"{', '.join(AIMING_DEMONSTRATORS)}."
        )


def check_returning(demonstrator: str, config: TaskConfig) -> None:
    """Refuse a demonstrator that goes back after a loss where it cannot.

    Raises:
        InputError: a single subtask, which has nothing to go back to, or an env that does not
            advance to the next subtask at a success.
    """
    if demonstrator not in RETURNING_DEMONSTRATORS:
        return
    if config.task != names.SUTURE:
        raise InputError(
            f"Demonstrator '{demonstrator}' goes back to earlier subtasks; '{config.task}' has "
            f"none. Give task {names.SUTURE}, or demonstrator expert."
        )
    if config.advance != "success":
        raise InputError(
            f"Demonstrator '{demonstrator}' needs an env that advances at each success; advance is "
            f"'{config.advance}'. Leave env.advance out."
        )


def check_told(config: TaskConfig, actor: str) -> None:
    """Refuse an env that waits to be told to begin the next subtask, where nobody tells it.

    Args:
        config: the task.
        actor: who acts, as the message says it.

    Raises:
        InputError: it waits, so that no episode could succeed.
    """
    if config.task == names.SUTURE and config.advance == "told":
        raise InputError(
            f"advance is 'told', but {actor} tells no env to begin the next subtask, so that no "
            "episode could succeed; leave env.advance out."
        )
