"""SuturingEnv: a task of the suture as a gymnasium environment.

* Description: two da Vinci PSMs, a needle and a phantom; one subtask, or all five in a row
  (`suture`).
* Action: Box(-1, 1, (7,), float32): Δx Δy Δz Δroll Δpitch Δyaw of the active arm's tip in its own
  base frame and Δjaw, each scaled by the step size (`config.STEPS`); every step is 20 ms. In action
  mode "absolute" it is both arms' set-points, (16,), see `absolute`; no step size applies then, and
  PSM2 lets go after the handoff only when commanded to.
* Observation: see `observation`.
* Reward: sparse: 0 on success, else -1; dense: -(d_trans / 100 + d_angle / 10) with d_trans in cm
  and d_angle in rad; staged: 0 on success, else -(tanh(d_trans / 1 cm) + tanh(d_angle / 0.5 rad) +
  1 unless the success conditions other than the pose hold) / 3, at most `STAGED_MOST`. The dense
  reward ignores whether the needle is grasped or has passed the holes; the staged one does not.
* Success: judged from the measured state, never from the command: position and geodesic angle
  within the tolerance, and the subtask's demands (jaw contact, both holes passed, needle out).
* Start: random, seeded by `reset(seed=…)`; covers the end states of the previous subtask.
* Termination: success, or a physics error (`info["physics_error"]`, never a success).
* Truncation: `max_steps`; with `end_on_drop` also when a needle that was held at the subtask's
  start is dropped. A drop truncates rather than terminates: where every step costs, a terminal
  value of 0 would teach a policy to drop the needle.
"""

import difflib
import functools
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING, ClassVar

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import RandomisationConfig, SuccessRule, TaskConfig
from surgicai_vision.core.errors import InputError, PhysicsError, check_name, shown
from surgicai_vision.core.generators import generator_of, generator_state
from surgicai_vision.core.lazy import LazyMapping
from surgicai_vision.core.tasks import TASKS, task_text
from surgicai_vision.envs import absolute, hole_crossing, observation, poses, randomisation
from surgicai_vision.envs.calibration import Calibration
from surgicai_vision.envs.camera_rig import Images
from surgicai_vision.envs.control import Command, StepSize
from surgicai_vision.envs.feasibility import refuse_impossible
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.observation import ObservationConfig
from surgicai_vision.envs.relative import relative_features
from surgicai_vision.envs.simulation import SUBSTEPS, Simulation, refuse_beyond_mujoco
from surgicai_vision.envs.subtask import Subtask, Tolerance
from surgicai_vision.envs.success import Info, Target, measure, meets_demands
from surgicai_vision.scene import build_scene
from surgicai_vision.scene.rendering import Frame

if TYPE_CHECKING:
    from surgicai_vision.envs.live.human import Human

STAGE_DISTANCE = 0.01
"""Distance [m] at which its term of the staged reward is tanh 1."""
STAGE_TURN = 0.5
"""Angle [rad] at which its term of the staged reward is tanh 1."""
STAGED_MOST = -0.01
"""The largest staged reward of a step without success."""
START_DRAWS = 60
"""Draws of a start state before `reset` gives up."""
RENDER_CAMERA = "front"
RENDER_SIZE = (480, 640)
"""Height and width of what `render` returns [px]."""
RENDER_MODES = ("human", "rgb_array")
RESET_OPTIONS = ("randomisation",)
"""Keys that `reset` accepts in its `options`."""

Observation = NDArray[np.float32] | Mapping[str, Frame]


class SuturingEnv(gymnasium.Env):
    """One task as a gymnasium environment; see the module's docstring.

    Args:
        config: the task and its scene.
        subtasks: the subtasks of the task, in order.
        view: what it observes.
        render_mode: None, "rgb_array", or "human": it displays itself (`envs.live.human`).
        truncates: end episodes at `config.max_steps`; False if gymnasium's `TimeLimit` does.

    Attributes:
        success_rule: what success in a single-subtask task requires beyond the paper's; learners
            set it (`rl.settings`). `compute_reward` sees goals alone, so it does not wait for a
            success to hold.
    """

    # gymnasium declares no ClassVar
    metadata: ClassVar[dict[str, object]] = {  # type: ignore[misc]
        "render_modes": list(RENDER_MODES),
        "render_fps": names.FPS,
    }

    def __init__(
        self,
        config: TaskConfig,
        subtasks: tuple[Subtask, ...],
        view: ObservationConfig,
        render_mode: str | None = None,
        truncates: bool = True,
    ):
        if render_mode is not None:
            check_name("render mode", render_mode, RENDER_MODES)
        self.config = config
        self.view = view
        self.render_mode = render_mode
        self._truncates = truncates
        self.success_rule = SuccessRule()
        self.scene = build_scene(config.scene)
        axes = config.randomisation
        self.simulation = Simulation(self.scene, own_model=bool(axes.on), latency=axes.latency)
        for subtask in subtasks:
            kind = f"tolerance preset of '{subtask.name}'"
            check_name(kind, config.tolerance, subtask.tolerances)
        refuse_impossible(config, any(subtask.through for subtask in subtasks))
        self.stitch = Stitch.of(self.scene.pair)
        self.observation_space = view.space()
        self._is_absolute = view.action_mode == names.ABSOLUTE
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
        if self._is_absolute:
            _refuse_increments(config)
            self.action_space = absolute.space()
        self._subtasks = subtasks
        self.simulation.task_state.phase = subtasks[0].phase
        self._step_size = StepSize.of(config.step)
        # A rendered step of a held action is longer, so a video of them has fewer frames a second.
        fps = config.steps_per_second
        self.metadata = {**self.metadata, "render_fps": fps}  # type: ignore[misc]
        self.calibration = Calibration(self.simulation)
        for camera in view.cameras if view.visual else ():
            self.calibration.window(camera, view.image_size)  # a crop that does not fit is refused
        self._images = Images(self.simulation, self.calibration)
        self._human: Human | None = None
        self._defers = False
        self._moves = 0

    # -- gymnasium ---------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Observation, Info]:
        """Draw a start state; `seed` makes it reproducible.

        Args:
            seed: seed of everything that is drawn.
            options: `randomisation`: axis → numbers to use instead of the drawn ones, as
                `info["randomisation"]` reports them; the env must have some randomisation.

        Raises:
            UnknownName: `randomisation` misspelt, or no such axis; other keys are ignored.
            InputError: numbers that no episode can have, or an env without randomisation.
            PhysicsError: no start was physical.
        """
        axes = self.config.randomisation
        given = _given(options or {}, axes)
        super().reset(seed=seed)
        self._moves += 1
        simulation = self.simulation
        first = self._subtasks[0]
        if axes.on:
            draws = randomisation.draw(axes, randomisation.generator(self.np_random))
            simulation.randomise(randomisation.with_numbers(draws, given))
            self._meet_draws()
        for _ in range(START_DRAWS):
            simulation.reset()
            simulation.task_state.phase = first.phase
            with TASKS.calling(self.task):
                is_physical = first.start(simulation, self.stitch, self.np_random)
            if is_physical:
                break
        else:
            raise PhysicsError(
                f"No start of '{self.config.task}' was physical in {START_DRAWS} draws."
            )
        hole_crossing.remember_tip(simulation, simulation.task_state)
        self._remember_tool()
        with TASKS.calling(self.task):
            info = self.measure()
        if axes.on:
            info["randomisation"] = randomisation.report(axes, simulation.draws)
        if self.render_mode == "human":
            self._shown().begin(info)
        return self.observe(), info

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Take one 20 ms control step, or up to `action_repeat` of them until the episode ends."""
        if self.config.hold_jaw and self.subtask.starts_held:
            action = np.array([*self._checked(action)[:6], 0.0], np.float32)
        for _ in range(self.config.action_repeat - 1):
            before = self._control_step(action, is_last=False)
            if before[2] or before[3]:
                return before
        return self._control_step(action)

    def _control_step(
        self, action: NDArray[np.float32], is_last: bool = True
    ) -> tuple[Observation, float, bool, bool, Info]:
        """Take one control step of 20 ms; `is_last` as in `_after`."""
        self._moves += 1
        simulation = self.simulation
        if self._is_absolute:
            is_physical = simulation.advance_to(absolute.follow(action, simulation))
        else:
            given = self._checked(action)
            is_physical = simulation.advance(self.subtask.arm, given, self._step_size)
        return self._after(is_physical, is_last)

    def step_commands(
        self, commands: Mapping[str, Command], halfway: Callable[[], None] | None = None
    ) -> tuple[Observation, float, bool, bool, Info]:
        """Take one control step of 20 ms under absolute commands of any arms.

        Args:
            commands: arm → its new command; an arm left out keeps its own.
            halfway: called after half of the step (`Simulation.advance_to`).
        """
        self._moves += 1
        return self._after(self.simulation.advance_to(commands, halfway))

    def _after(
        self, is_physical: bool, is_last: bool = True
    ) -> tuple[Observation, float, bool, bool, Info]:
        """Judge and observe the state that a control step has led to.

        Args:
            is_physical: the physics has not diverged.
            is_last: of a held action; what another one has led to is observed, and its images are
                rendered, only if the episode ends there.
        """
        simulation = self.simulation
        state = simulation.task_state
        subtask = self.subtask
        if not is_physical:
            state.has_diverged = True
        # Between these reads nothing moves, so each pose is read once.
        simulation.keep_reads()
        state.steps += 1
        self._add_path(subtask.arm)
        hole_crossing.update(simulation, state, self.stitch.pair)
        target = subtask.target(simulation, self.stitch)
        info = measure(simulation, subtask, self.stitch, self.config.tolerance, target)
        if self._progress(info):
            target = self._target()
        terminated = info["is_success"] or info["physics_error"]
        truncated = self._truncates and state.steps >= self.config.max_steps
        if self.config.end_on_drop:
            info["dropped"] = self.subtask.starts_held and simulation.has_dropped(self.subtask.arm)
            truncated = truncated or info["dropped"]
        is_seen = is_last or terminated or truncated
        seen: Observation = self._observe(target) if is_seen else {}
        simulation.forget_reads()
        if self.render_mode == "human":
            self._shown().step(info)
        return seen, self.reward(info), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the front camera's image, (480, 640, 3) uint8, in render mode "rgb_array".

        In render mode "human" every reset and step has already been displayed.
        """
        if self.render_mode != "rgb_array":
            return None
        return self.image(RENDER_CAMERA, RENDER_SIZE).astype(np.uint8, copy=False)

    def _shown(self) -> "Human":
        """Return the display of this env, opened on first use."""
        if self._human is None:
            from surgicai_vision.envs.live.human import Human  # no other env needs a server

            self._human = Human(self)
        return self._human

    def image(
        self,
        view: str,
        size: tuple[int, int],
        modality: str = names.RGB,
        quality: str = "fast",
    ) -> Frame:
        """Return an image of any view at the present state, whatever the env observes.

        Args:
            view: name of a camera or a crop.
            size: height and width [pixel].
            modality: one of `names.MODALITIES`.
            quality: "fast", as observations are, or "high".

        Returns:
            (height, width, channels) as from `scene.rendering.FrameRenderer.render`.
        """
        return self._images.frames(view, size, (modality,), quality)[modality]

    def close(self) -> None:
        """Free the renderer and close the display."""
        self._images.close()
        if self._human is not None:
            self._human.close()
            self._human = None

    # -- properties --------------------------------------------------------------------------------

    @property
    def model(self) -> mujoco.MjModel:
        """Return the `mujoco.MjModel`."""
        return self.simulation.model

    @property
    def data(self) -> mujoco.MjData:
        """Return the `mujoco.MjData`."""
        return self.simulation.data

    @property
    def frame_skip(self) -> int:
        """Return the number of physics steps per control step."""
        return SUBSTEPS

    @property
    def dt(self) -> float:
        """Return the length of a control step [s]."""
        return SUBSTEPS * float(self.model.opt.timestep)

    control_dt = dt

    @property
    def task(self) -> str:
        """Return the task's name."""
        return self.config.task

    @property
    def task_description(self) -> str:
        """Return the task as a sentence, as LeRobot stores it."""
        return task_text(self.config.task)

    @property
    def _max_episode_steps(self) -> int:
        """Return the episode limit where LeRobot looks for it: this env truncates itself."""
        return most_actions(self.config)

    @property
    def subtask(self) -> Subtask:
        """Return the present subtask.

        Raises:
            InputError: the restored state is one of a subtask that this task does not have.
        """
        index = self.simulation.task_state.phase - self._subtasks[0].phase
        if not 0 <= index < len(self._subtasks):
            raise InputError(
                f"The state is one of subtask {self.phase}, which '{self.config.task}' does not "
                "have; restore it in an env of that subtask or of the whole procedure."
            )
        return self._subtasks[index]

    @property
    def phase(self) -> int:
        """Return the present subtask's index in `names.SUBTASKS`, -1 for a task not among them."""
        return self.simulation.task_state.phase

    def enter(self, phase: int) -> None:
        """Make a subtask the present one; a single-subtask task accepts only its own.

        Args:
            phase: index in `names.SUBTASKS`; the present subtask's index changes nothing.
        """
        if phase != self.phase:
            raise InputError(
                f"'{self.config.task}' has one subtask, {self.phase}; it cannot enter {phase}."
            )

    def named(self, kind: str, name: str) -> int:
        """Return an element's id; the error for a wrong name lists the valid ones."""
        return self.scene.named(kind, name)

    # -- state -------------------------------------------------------------------------------------

    def get_state(self) -> NDArray[np.float64]:
        """Return the whole state of the episode as one vector."""
        return self.simulation.get_state()

    @property
    def snapshot(self) -> tuple[NDArray[np.float64], dict[str, object]]:
        """The whole state and that of the generator that draws the next starts; settable."""
        return self.get_state(), generator_state(self.np_random)

    @snapshot.setter
    def snapshot(self, snapshot: tuple[NDArray[np.float64], dict[str, object]]) -> None:
        state, generator = snapshot
        self.set_state_vector(state)
        self.np_random = generator_of(generator)

    def set_state_vector(self, state: NDArray[np.float64]) -> None:
        """Restore a state from `get_state`: the episode continues from it exactly as it did."""
        before = self.simulation.draws
        self._moves += 1
        self.simulation.set_state(state)
        if self.simulation.draws is not before:
            self._meet_draws()

    def set_state(self, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> None:
        """Set positions and velocities, as gymnasium's MujocoEnv does; commands are kept.

        Raises:
            InputError: not of this scene's shapes, or numbers that MuJoCo would answer by silently
                resetting itself.
        """
        if np.shape(qpos) != (self.model.nq,) or np.shape(qvel) != (self.model.nv,):
            raise InputError(
                f"set_state got shapes {np.shape(qpos)} and {np.shape(qvel)}; "
                f"this scene needs ({self.model.nq},) and ({self.model.nv},)."
            )
        refuse_beyond_mujoco(np.append(qpos, qvel))
        self._moves += 1
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel
        self.simulation.refresh()

    # -- measuring ---------------------------------------------------------------------------------

    def measure(self) -> Info:
        """Return the info dict of the present, measured state."""
        return measure(
            self.simulation, self.subtask, self.stitch, self.config.tolerance, self._target()
        )

    def _target(self) -> Target:
        return self.subtask.target(self.simulation, self.stitch)

    def tolerance(self) -> Tolerance:
        """Return the tolerance about the present subtask's goal under the success rule."""
        share = self.success_rule.tolerance_share
        return self.subtask.tolerances[self.config.tolerance].scaled(share)

    def reward(self, info: Info) -> float:
        """Return the reward of a measurement."""
        if self.config.reward == "sparse":
            return 0.0 if info["is_success"] else -1.0
        if self.config.reward == "staged":
            is_met = info["is_success"] or self._meets_demands()
            return float(
                staged_reward(info["d_trans"], info["d_angle"], is_met, info["is_success"])
            )
        error: float = info["d_trans"] + info["d_angle"] / 10.0
        return -error

    # -- observing ---------------------------------------------------------------------------------

    def agent_pos(self) -> NDArray[np.float32]:
        """Return the active arm's measured tip in its base, (7,): x y z, roll pitch yaw, jaw.

        In m and rad.
        """
        simulation = self.simulation
        arm = self.subtask.arm
        return np.array(
            observation.seven(arm, simulation.tip_in_base(arm), simulation.jaw(arm)),
            dtype=np.float32,
        )

    def both_arms(self) -> NDArray[np.float32]:
        """Return both arms' `agent_pos`, psm1 first, (14,): a high-level policy's input."""
        simulation = self.simulation
        sevens = [
            observation.seven(arm, simulation.tip_in_base(arm), simulation.jaw(arm))
            for arm in names.ARMS
        ]
        return np.array(sevens, dtype=np.float32).ravel()

    def setpoint(self) -> NDArray[np.float32]:
        """Return the offset of the active arm's set point from its measured tip, (7,) [m, rad].

        x y z and the rotation vector in the arm's base, and the jaw. The tool lags because tissue
        and load hold it back; a dVRK reports both poses (`setpoint_cp`, `measured_cp`).
        """
        simulation = self.simulation
        arm = self.subtask.arm
        told = simulation.pending(arm, self._step_size)
        return observation.setpoint(
            simulation.tip_in_base(arm), simulation.jaw(arm), told.pose, told.jaw
        )

    def absolute_pos(self) -> NDArray[np.float32]:
        """Return both arms' measured poses and jaws, laid out as in the field's data, (16,).

        See `absolute`; this is `agent_pos` of an observation in action mode "absolute".
        """
        return absolute.measured(self.simulation)

    def state_vector(self) -> NDArray[np.float32]:
        """Return the observation of obs_type "state", goal included, (21,)."""
        return self._state_vector(self._target())

    def relative_state(self) -> NDArray[np.float32]:
        """Return the observation of obs_type "relative", goal included, (24,)."""
        return self._relative_state(self._target())

    def needle_pose(self) -> NDArray[np.float32]:
        """Return the needle's position [m] and quaternion (w, x, y, z) in world, (7,)."""
        pose: NDArray[np.float32] = self.data.qpos[self.scene.needle_qpos].astype(np.float32)
        return pose

    def observe(self) -> Observation:
        """Return the observation of the present state."""
        return self._observe(self._target())

    def _observe(self, target: Target) -> Observation:
        if self.view.obs_type == "state":
            return self._state_vector(target)
        if self.view.obs_type == "relative":
            return self._relative_state(target)
        own = self.absolute_pos if self._is_absolute else self.agent_pos
        beside = {"agent_pos": own()} if self.view.shows_agent_pos else {}
        if self._defers:
            return LazyMapping(self._makers(), beside)
        return self._images.look(self.view) | beside

    def place_crops_by(self, calibration: Calibration) -> None:
        """Show crops where `calibration` places them from now on."""
        self.calibration = self._images.calibration = calibration

    def defer_images(self) -> None:
        """Render each image of an observation only when it is first accessed (`core.lazy`).

        For callers that use few of many views; an observation is then not a plain dict.
        """
        self._defers = True

    def _makers(self) -> dict[str, Callable[[], Frame]]:
        """Return functions that render the frames of an observation of the present state."""
        moves = self._moves

        def frame(view: str, modality: str) -> Frame:
            if self._moves != moves:
                raise InputError(
                    f"The image '{view}' of an observation is read for the first time after the "
                    "env has moved on; read it before the next step."
                )
            return self.image(view, self.view.image_size, modality)

        return {
            names.frame_key(view, modality): functools.partial(frame, view, modality)
            for view in self.view.cameras
            for modality in self.view.modalities
        }

    def _state_vector(self, target: Target) -> NDArray[np.float32]:
        simulation = self.simulation
        arm = self.subtask.arm
        tip = simulation.tip(arm)
        jaw = simulation.jaw(arm)
        if simulation.offsets:
            achieved, desired = target
            goal = simulation.to_base(arm, poses.compose(desired, poses.relative(achieved, tip)))
            return observation.state_vector(arm, simulation.tip_in_base(arm), goal, jaw)
        return observation.state_vector_in_world(arm, simulation.bases[arm], tip, *target, jaw)

    def _relative_state(self, target: Target) -> NDArray[np.float32]:
        """Return the relative features; in the whole procedure, those of the present subtask."""
        simulation = self.simulation
        subtask = self.subtask
        achieved, desired = target
        jaw = simulation.jaw(subtask.arm)
        return relative_features(
            self.agent_pos(),
            observation.goal_vector(achieved, jaw, self._meets_subtask()),
            observation.goal_vector(desired, 0.0, True),
            poses.square(simulation.bases[subtask.arm])[:3, :3],
        )

    # -- progress ----------------------------------------------------------------------------------

    def _checked(self, action: NDArray[np.float32]) -> list[float]:
        """Return the action as seven floats in [-1, 1]."""
        values = np.asarray(action).ravel().tolist()
        if len(values) != 7 or not isfinite(sum(values)):
            raise InputError(f"The action must be 7 finite numbers in [-1, 1]; got {values}.")
        return [-1.0 if value < -1.0 else 1.0 if value > 1.0 else value for value in values]

    def _meet_draws(self) -> None:
        """Adapt to new draws: goals move with the phantom and depend on the needle's shape."""
        simulation = self.simulation
        self.stitch = Stitch.of(simulation.pair, simulation.radius, simulation.tip_angle)

    def _remember_tool(self) -> None:
        """Start measuring the active tip's path at its present position."""
        tip = self.simulation.tip(self.subtask.arm)
        self.simulation.task_state.tool_tip = poses.position(tip)

    def _add_path(self, arm: str) -> None:
        """Add the last move of the active tip to its path."""
        state = self.simulation.task_state
        x0, y0, z0 = state.tool_tip
        state.tool_tip = x, y, z = poses.position(self.simulation.tip(arm))
        state.tip_path += ((x - x0) ** 2 + (y - y0) ** 2 + (z - z0) ** 2) ** 0.5

    def _meets_demands(self) -> bool:
        """Return True if the conditions of the episode's success other than the pose hold now."""
        return self._meets_subtask()

    def _meets_subtask(self) -> bool:
        """Return True if the conditions of the subtask's success other than the pose hold now."""
        is_met = meets_demands(self.simulation, self.subtask, self.stitch, self.config.tolerance)
        return is_met and self._has_kept_holes()

    def _has_kept_holes(self) -> bool:
        """Return False if a hole passed at the start was lost and the success rule forbids that."""
        passed = self.simulation.task_state.holes_passed
        return not self.success_rule.keeps_holes or passed >= self.subtask.passed_at_start

    def _progress(self, info: Info) -> bool:
        """Advance to the next subtask if the task has several; return True if it did."""
        if info["is_success"]:
            info["is_success"] = self._is_within_share(info) and self._has_kept_holes()
        if self.success_rule.steps > 1:
            info["is_success"] = self._count_dwell(info["is_success"]) >= self.success_rule.steps
        return False

    def _is_within_share(self, info: Info) -> bool:
        """Return True if the pose is within the success rule's share of the tolerance."""
        tolerance = self.tolerance()
        near: bool = info["d_trans"] <= tolerance.distance and info["d_angle"] <= tolerance.angle
        return near

    def _count_dwell(self, holds: bool) -> int:
        """Return for how many control steps something has held, including this one."""
        state = self.simulation.task_state
        state.dwell = state.dwell + 1 if holds else 0
        return state.dwell


def _given(
    options: Mapping[str, object], axes: RandomisationConfig
) -> Mapping[str, Sequence[float]]:
    """Return axis → numbers from the options of a reset, or refuse the options.

    The axes and their numbers are checked where they are inserted (`randomisation.with_numbers`).
    """
    for key in options:
        # Programs that drive envs, such as LeRobot, add their own keys; ours misspelt is refused.
        if difflib.get_close_matches(str(key), RESET_OPTIONS, n=1):
            check_name("option of reset", key, RESET_OPTIONS)
    given = options.get("randomisation") or {}
    if not isinstance(given, Mapping):
        raise InputError(
            f"options['randomisation'] is {shown(given)}; it must be a dict, axis → its numbers."
        )
    if given and not axes.on:
        raise InputError(
            "options['randomisation'] gives numbers, but this env has no randomisation; make it "
            f"with one, such as randomisation={{'{next(iter(given))}': …}}."
        )
    # The latency is reported as well, but is fixed by the env.
    return {axis: of for axis, of in given.items() if axis != "latency" or of != axes.latency}


def _refuse_increments(config: TaskConfig) -> None:
    """Raise `InputError` for options that change increments: actions are set-points here."""
    if config.hold_jaw or config.randomisation.latency:
        given = "hold_jaw" if config.hold_jaw else "latency"
        raise InputError(
            f"{given} changes increments, but in action mode 'absolute' an action is the "
            "set-point of both arms; leave it out."
        )


def most_actions(config: TaskConfig) -> int:
    """Return the most actions in an episode: what gymnasium and LeRobot count as its steps."""
    return -(-config.max_steps // config.action_repeat)


def staged_reward(
    distance: ArrayLike, turn: ArrayLike, is_met: ArrayLike, is_success: ArrayLike
) -> NDArray[np.float64]:
    """Return staged rewards in [-1, 0]; see the module's docstring.

    Args:
        distance: to the goal [m], a number or (batch,).
        turn: to the goal [rad].
        is_met: whether the success conditions other than the pose hold.
        is_success: whether the task is solved.
    """
    away = np.tanh(np.divide(distance, STAGE_DISTANCE))
    turned = np.tanh(np.divide(turn, STAGE_TURN))
    missing = np.where(is_met, 0.0, 1.0)
    reward = np.minimum(-(away + turned + missing) / 3.0, STAGED_MOST)
    return np.where(is_success, 0.0, reward)
