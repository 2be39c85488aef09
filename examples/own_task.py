"""Your own task, with its expert and its gymnasium id: lift the needle.

python examples/own_task.py
"""

from types import MappingProxyType

import gymnasium
from numpy.random import Generator

import surgicai_vision
from surgicai_vision.core.names import PSM2
from surgicai_vision.demos.expert import Expert, ToolTarget, WorldState
from surgicai_vision.demos.rollout import rollout
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.place import Place
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.subtask import Demands, Subtask, Tolerance
from surgicai_vision.scene.holes import SURFACE
from surgicai_vision.scene.kinematics import Pose

HEIGHT = SURFACE + 0.015  # target height of the needle's centre: 15 mm above the tissue [m, world]


class Lift(Subtask):
    """Lift the needle to within 1 mm of a height, in any orientation, and keep hold of it."""

    name = "lift"
    arm = PSM2
    text = "Lift the needle."
    expert = f"{__name__}:lift"  # the rule below
    through = False  # the needle does not pass through tissue
    tolerances = MappingProxyType({"paper": Tolerance.of(1.0, 180.0)})
    demands = MappingProxyType({"paper": Demands(contact=True)})

    def start(self, simulation: Simulation, stitch: Stitch, rng: Generator) -> bool:
        """Begin like `place`: PSM2 holds the needle, which lies on the tissue."""
        return Place().start(simulation, stitch, rng)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return the needle's pose and its target: straight above, in the same orientation."""
        pose = simulation.needle()  # x, y, z and the nine elements of the rotation matrix
        return pose, (*pose[:2], HEIGHT, *pose[3:])


def lift(world: WorldState) -> ToolTarget:
    """Move the tip up by the needle's remaining height, jaws closed: the expert's rule."""
    raised = world.command.copy()
    raised[2, 3] += HEIGHT - world.needle[2, 3]
    return ToolTarget(raised, jaw=0.0)


surgicai_vision.register_task(Lift)  # at the top level: worker processes import this file too

if __name__ == "__main__":
    env = gymnasium.make("surgicai_vision/Lift-v0").unwrapped
    for seed in range(3):
        result = rollout(env, Expert(env), seed)  # one episode of the expert, with every state
        print(f"start {seed}: {len(result.demo)} steps, success: {result.success}")
