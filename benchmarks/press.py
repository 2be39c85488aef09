"""Measure how hard arms press on the tissue when a policy drives them into it.

    python benchmarks/press.py
    python benchmarks/press.py --tissue soft --torque dvrk

Each random policy acts like an untrained network: one action, drawn once and repeated for the whole
episode. Here it is drawn from actions that lead into the tissue: at full step size from the tip's
start to a point anywhere within `REACH` of the stitch, with a random turn of the tool. Policies
with an even number drive PSM2 from a start of `grasp`, the others PSM1 from one of `handoff`.

* peak: the largest net force on the phantom in the episode, over every physics step of 2 ms,
  including the impact; `peak_50hz_n` as evaluations see it, once per control step.
* held: the median over the last second, after the impact.

Both are in N, over the policies that touched the tissue: median, 90 % quantile, largest.
"""

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from common import chunks, emit, spread

from surgicai_vision import envs
from surgicai_vision.core import names
from surgicai_vision.core.config import SceneConfig, TaskConfig, to_mapping
from surgicai_vision.envs.force_plate import STATE, ForcePlate
from surgicai_vision.envs.simulation import SUBSTEPS
from surgicai_vision.scene.holes import SURFACE

STEPS = 200
REACH = (0.015, 0.020)
"""How far to either side of the stitch the policies aim, in world x and y [m]."""
TURN = 0.1
"""Largest turn per step, as a share of the step size: up to 40° about each axis per episode."""
HELD = names.FPS
"""Control steps at the end of an episode over which the held force is measured: 1 s."""
TASKS = ("grasp", "handoff")


class Job(NamedTuple):
    """Some policies in one scene."""

    scene: SceneConfig
    seeds: range


class Press(NamedTuple):
    """What one policy did [N]."""

    peak: float
    peak_50hz: float
    held: float


class FinePlate:
    """The force plate at every physics step: each control step is replayed outside the env.

    Args:
        env: the env to read; call `before` and `after` around each of its steps.
    """

    def __init__(self, env: envs.SuturingEnv):
        self._env = env
        self._plate = ForcePlate(env.model, env.simulation.tissue)
        self._again = mujoco.MjData(env.model)
        self._state = np.empty(mujoco.mj_stateSize(env.model, STATE))

    def before(self) -> None:
        """Store the state at the beginning of a control step."""
        mujoco.mj_getState(self._env.model, self._env.data, self._state, STATE)

    def after(self) -> tuple[float, float]:
        """Return the largest force in the control step and the force at its end [N]."""
        model = self._env.model
        again = self._again
        mujoco.mj_setState(model, again, self._state, STATE)
        again.ctrl[:] = self._env.data.ctrl
        largest = 0.0
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, again)
            largest = max(largest, float(np.linalg.norm(self._plate.net(again))))
        return largest, self._plate.force(self._env.data)


def press(job: Job) -> list[Press]:
    """Play the job's policies."""
    made = [envs.make(TaskConfig(task, job.scene, max_steps=STEPS)) for task in TASKS]
    plates = [FinePlate(env) for env in made]
    return [_policy(made[seed % 2], plates[seed % 2], seed) for seed in job.seeds]


def _policy(env: envs.SuturingEnv, plate: FinePlate, seed: int) -> Press:
    env.reset(seed=seed)
    action = _into_the_tissue(env, np.random.default_rng(seed))
    peak = 0.0
    forces = []
    for _ in range(STEPS):
        plate.before()
        terminated = env.step(action)[2]
        largest, now = plate.after()
        peak = max(peak, largest)
        forces.append(now)
        if terminated:
            break
    return Press(peak, max(forces), float(np.median(forces[-HELD:])))


def _into_the_tissue(env: envs.SuturingEnv, rng: np.random.Generator) -> np.ndarray:
    """Draw an action (7,): straight to a point of the tissue, with a turn."""
    arm = env.subtask.arm
    offset = rng.uniform(-1.0, 1.0, 2) * REACH
    goal = np.array([*(np.array(env.stitch.pair.entry.centre)[:2] + offset), SURFACE])
    way = goal - env.simulation.tip(arm)[:3]
    base = np.array(env.simulation.bases[arm][3:]).reshape(3, 3)
    turn = rng.uniform(-TURN, TURN, 3)
    return np.array([*(base.T @ way / np.linalg.norm(way)), *turn, 0.0], np.float32)


def row(values: Sequence[float]) -> dict[str, float]:
    """Return median, 90 % quantile and largest [N]."""
    return {
        "median": round(float(np.median(values)), 2),
        "p90": round(float(np.quantile(values, 0.9)), 2),
        "max": round(float(np.max(values)), 2),
    }


def main() -> None:
    """Press and print one JSON line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policies", type=int, default=50)
    parser.add_argument("--seed", type=int, default=names.TEST_SEED)
    parser.add_argument("--tissue", default=SceneConfig().tissue)
    parser.add_argument("--torque", default=SceneConfig().torque)
    parser.add_argument("--thread", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    scene = SceneConfig(tissue=chosen.tissue, torque=chosen.torque, thread=chosen.thread)
    jobs = [Job(scene, seeds) for seeds in chunks(chosen.seed, chosen.policies)]
    found = [one for part in spread(press, jobs, chosen.workers) for one in part]
    touched = [one for one in found if one.peak > 0.1]
    emit(
        "press",
        {
            "seed": chosen.seed,
            "scene": to_mapping(scene),
            "policies": len(found),
            "touched": len(touched),
            "peak_n": row([one.peak for one in touched]),
            "peak_50hz_n": row([one.peak_50hz for one in touched]),
            "held_n": row([one.held for one in touched]),
        },
    )


if __name__ == "__main__":
    main()
