"""A task of your own, with its expert and its gymnasium id: lift the needle.

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

HEIGHT = SURFACE + 0.015  # where the needle's centre shall be in world, 15 mm over the tissue [m]


class Lift(Subtask):
    """Lift the needle to a height and keep hold of it: 1 mm, in any orientation."""

    name = "lift"
    arm = PSM2
    text = "Lift the needle."
    expert = f"{__name__}:lift"  # the rule below
    through = False  # the needle goes through no tissue
    tolerances = MappingProxyType({"paper": Tolerance.of(1.0, 180.0)})
    demands = MappingProxyType({"paper": Demands(contact=True)})

    def start(self, simulation: Simulation, stitch: Stitch, rng: Generator) -> bool:
        """Begin as a placement does: PSM2 holds the needle, which lies on the tissue."""
        return Place().start(simulation, stitch, rng)

    def target(self, simulation: Simulation, stitch: Stitch) -> tuple[Pose, Pose]:
        """Return where the needle is and where it shall be: right above, as it is turned."""
        pose = simulation.needle()  # x, y, z and the rotation's nine numbers
        return pose, (*pose[:2], HEIGHT, *pose[3:])


def lift(world: WorldState) -> ToolTarget:
    """Move the tip up by what the needle still lacks, jaws closed: the expert's rule."""
    raised = world.command.copy()
    raised[2, 3] += HEIGHT - world.needle[2, 3]
    return ToolTarget(raised, jaw=0.0)


surgicai_vision.register_task(Lift)  # at the top of the file: worker processes import it too

if __name__ == "__main__":
    env = gymnasium.make("surgicai_vision/Lift-v0").unwrapped
    for seed in range(3):
        result = rollout(env, Expert(env), seed)  # one episode by the expert, with every state
        print(f"start {seed}: {len(result.demo)} steps, success: {result.success}")
