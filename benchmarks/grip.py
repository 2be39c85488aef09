"""Measure how far the needle drifts in PSM2's jaws.

10 s of motion at 30 mm/s and 60 °/s, friction only.

    python benchmarks/grip.py --json

Each trial draws a grasp as the subtask `place` does (angle 5°–20°, off by up to 1.5 mm and 12°)
with the needle in free air, then swings the tool along smooth closed paths. Drift is how far the
grasped point moves in the jaws [mm], and how far the needle turns in them [deg], from start to end.
"""

import argparse
import json
import math

import numpy as np

from surgicai_vision.core.config import SceneConfig
from surgicai_vision.core.names import FPS, PSM2
from surgicai_vision.envs import poses
from surgicai_vision.envs.control import StepSize
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.place import draw_psm2_grasp
from surgicai_vision.envs.simulation import Simulation
from surgicai_vision.envs.starts import hold_needle
from surgicai_vision.scene import build_scene

SECONDS = 10.0
SPEED = 0.030
TURN = math.radians(60.0)
PLACE = (-0.02, 0.05, 0.115)
"""Where the needle is held [m, world]."""


def swing(simulation: Simulation) -> tuple[float, float] | None:
    """Return the drift (mm, deg) of one trial, or None if the needle was lost."""
    before = poses.compose(poses.invert(simulation.grasp(PSM2)), simulation.needle())
    step = StepSize(SPEED / FPS, TURN / FPS, 0.05)
    for index in range(int(SECONDS * FPS)):
        phase = 2 * math.pi * index / FPS
        direction = np.array([math.sin(phase), math.cos(phase), math.sin(0.7 * phase)])
        axis = np.array([math.cos(phase), math.sin(1.3 * phase), math.cos(0.5 * phase)])
        move = [*(direction / np.linalg.norm(direction)), *(axis / np.linalg.norm(axis)), 0.0]
        if not simulation.advance(PSM2, [float(value) for value in move], step):
            return None
    after = poses.compose(poses.invert(simulation.grasp(PSM2)), simulation.needle())
    moved = poses.compose(after, poses.invert(before))
    return poses.distance(moved, poses.IDENTITY) * 1e3, math.degrees(poses.angle(after, before))


def main() -> None:
    """Run the trials and print one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seed", type=int, default=900_000)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print JSON only")
    arguments = parser.parse_args()
    simulation = Simulation(build_scene(SceneConfig(thread=arguments.thread)))
    stitch = Stitch.of(simulation.scene.pair)
    rng = np.random.default_rng(arguments.seed)
    drifts = []
    lost = 0
    needle_pose = np.eye(4)
    needle_pose[:3, 3] = PLACE
    while len(drifts) + lost < arguments.trials:
        simulation.reset()
        if not hold_needle(
            simulation, PSM2, needle_pose, draw_psm2_grasp(rng, needle_pose, stitch)
        ):
            continue
        drift = swing(simulation)
        if drift is None or not simulation.holds(PSM2):
            lost += 1
        else:
            drifts.append(drift)
    table = np.array(drifts).reshape(-1, 2)
    row = {
        "trials": arguments.trials,
        "lost": lost,
        "seed": arguments.seed,
        "thread": arguments.thread,
    }
    for column, name in enumerate(("drift_mm", "drift_deg")):
        values = table[:, column]
        row[name] = {
            key: round(float(value), 3)
            for key, value in (
                ("median", np.median(values)),
                ("p95", np.quantile(values, 0.95)),
                ("max", values.max()),
            )
        }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
