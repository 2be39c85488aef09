"""Episode monitor: what one episode does to needle and tissue, read after every control step.

An `EpisodeMonitor` only reads: an episode is the same with and without it.

* `bite`: where the needle's tip went in and out, how deep and at which angles
  (`envs.bite_measures`).
* `slip`, `turn`: the needle's largest shift [m] and turn [rad] in the active jaws since they
  grasped it.
* `force`: net force on the tissue when the last control step ended [N]; 0 at the start.
* `tissue_force`: largest net force [N] of needle and instruments (not of the thread) on the
  phantom, as a force plate under it would show. It is sampled when a control step ends, at 50 Hz
  (when an action ends, where actions are held), so a shorter impact can be missed. `tissue_impulse`
  is the net force summed over time [N s].
* `tears`: how often the tissue tore; NaN in channels, which cannot tear.
* `thread_drawn`: largest length of thread drawn out of the exit behind the needle [m]; 0 before the
  needle is out, NaN without a thread.
* `paper_success`: the paper's own success was reached (`envs.success`), whatever else soft tissue
  requires.
"""

import itertools
import math
import re
from collections.abc import Sequence

import mujoco

from surgicai_vision.core import names
from surgicai_vision.envs import hole_crossing
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.bite_measures import BiteMeasures, BiteWatch, watch_of
from surgicai_vision.envs.force_plate import ForcePlate
from surgicai_vision.envs.success import Info
from surgicai_vision.scene.holes import PAIRS, Hole, Point
from surgicai_vision.scene.thread import LENGTH


class EpisodeMonitor:
    """What the present episode of `env` has done; see the module's docstring.

    Args:
        env: the env to read; call `reset` after each of its resets, `update` after each step.
    """

    def __init__(self, env: SuturingEnv):
        self._env = env
        self._plate = ForcePlate(env.model, env.simulation.tissue)
        self._layout = PAIRS[env.scene.config.layout]
        self._thread = _thread_bodies(env.model)
        self._watch: BiteWatch | None = None
        self.clear()

    def clear(self) -> None:
        """Forget the last episode; until the next one begins, nothing is measured."""
        self._watch = None
        self.slip = self.turn = math.nan
        self.force = 0.0
        self.tissue_force = self.tissue_impulse = math.nan
        self.tears = self.thread_drawn = math.nan
        self.paper_success = False

    def reset(self) -> None:
        """Begin an episode; the env has just been reset."""
        self.clear()
        simulation = self._env.simulation
        self.slip = self.turn = 0.0
        self.tissue_force = self.tissue_impulse = 0.0
        if simulation.tissue is not None:
            self.tears = 0.0
        if self._thread:
            self.thread_drawn = 0.0
        self._steps = simulation.task_state.steps
        pair = self._env.stitch.pair
        pairs = [simulation.placement.placed_pair(other) for other in self._layout]
        others = [other for index, other in enumerate(pairs) if index != simulation.pair_index]
        self._watch = watch_of(simulation, pair, others)

    def update(self, info: Info) -> None:
        """Read the state that a step ended in; `info` is that step's."""
        assert self._watch is not None, "call reset() first"
        simulation = self._env.simulation
        slip, turn = info["needle_slip"]
        self.slip = max(self.slip, float(slip))
        self.turn = max(self.turn, float(turn))
        self.force = self._plate.force(simulation.data)
        self.tissue_force = max(self.tissue_force, self.force)
        # A step of a held action is several control steps.
        steps = simulation.task_state.steps
        self.tissue_impulse += self.force * self._env.dt * (steps - self._steps)
        self._steps = steps
        self.paper_success = self.paper_success or bool(info["paper_success"])
        self._watch.update()
        if simulation.tissue is not None:
            self.tears = float(simulation.tissue.tears)
        if self._thread and simulation.task_state.holes_passed == hole_crossing.OUT:
            drawn = drawn_length(self._thread_points(), self._env.stitch.pair.exit)
            self.thread_drawn = max(self.thread_drawn, drawn)

    @property
    def bite(self) -> BiteMeasures:
        """Return the measures of the episode's latest bite."""
        return BiteMeasures() if self._watch is None else self._watch.measures

    def is_held(self) -> bool:
        """Return True if either arm holds the needle now."""
        return any(self._env.simulation.holds(arm) for arm in names.ARMS)

    def _thread_points(self) -> list[Point]:
        """Return the joints of the thread from the needle's base to its end, in world [m]."""
        data = self._env.data
        points: list[Point] = data.xpos[self._thread].tolist()
        last = self._thread[-1]
        pitch = LENGTH / len(self._thread)
        # A segment runs along its body's z.
        points.append((data.xpos[last] + pitch * data.xmat[last].reshape(3, 3)[:, 2]).tolist())
        return points


def drawn_length(points: Sequence[Point], leave: Hole) -> float:
    """Return the length of a thread from its first point to where it goes through a plane [m].

    Args:
        points: points of the thread, from the needle on [m].
        leave: the exit, whose plane separates what is out from what is not.
    """
    length = 0.0
    for before, after in itertools.pairwise(points):
        high = leave.height(before)
        low = leave.height(after)
        if high <= 0.0:
            break
        step = math.dist(before, after)
        if low <= 0.0:
            return length + step * high / (high - low)
        length += step
    return length


def _thread_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies of the thread's segments, from the needle on; empty without a thread."""
    names_of_bodies = (model.body(index).name for index in range(model.nbody))
    found = [name for name in names_of_bodies if re.fullmatch(r"thread_\d+", name)]
    return [model.body(f"thread_{index}").id for index in range(len(found))]
