"""Simulation: one scene in motion, with commands, measured poses, contacts and the whole state.

* `Simulation(scene)` owns an MjData.
* `advance(arm, action, step)`: one control step; False when the physics diverged.
* `tip(arm)`, `grasp(arm)`, `needle()`: measured poses in world (`scene.kinematics.Pose`).
* `touching(arm)`: whether the left and the right jaw pad touch the needle.
* `get_state()`, `set_state(vector)`: all state: MuJoCo's integration state and the task state.

A control step is ten physics steps of 2 ms, arranged so that it *ends* with MuJoCo's position and
velocity stages (`mj_step1`): measured poses, contacts and images belong to the state they are read
with, and a restored state gives the same ones, bit for bit. MuJoCo resets itself on divergence,
which the clock reveals.
"""

import copy
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from math import isfinite

import mujoco
import numpy as np
from numpy.typing import NDArray

from surgicai_vision.core import names
from surgicai_vision.core.config import LATENCY_LIMIT
from surgicai_vision.core.errors import InputError, UnreachablePose
from surgicai_vision.envs import attach, control, poses, randomisation
from surgicai_vision.envs.attach import Welds
from surgicai_vision.envs.control import COMMAND_SIZE, Command, StepSize
from surgicai_vision.envs.task_state import TaskState
from surgicai_vision.envs.tissue import Tissue
from surgicai_vision.scene import Scene, kinematics
from surgicai_vision.scene.arm import GRASP_DEPTH
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.kinematics import Pose
from surgicai_vision.scene.rotations import matrix_to_quaternion_flat

SUBSTEPS = 10
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_USER_DATA = int(mujoco.mjtState.mjSTATE_USERDATA)
CLOCK_START = 1.0
"""Time at the start of an episode [s]: not 0, so that MuJoCo's own reset to 0 is noticed."""
_SET_SEVEN = struct.Struct("7d").pack_into
_THREE = struct.Struct("3d").unpack_from
_NINE = struct.Struct("9d").unpack_from
"""One row of positions or rotations as floats, in half the time of `array[row].tolist()`."""
RELEASE_STEPS = 40
"""Control steps during which PSM2 lets go after the handoff."""
RELEASE_JAW = 0.1
"""How far its jaw opens per step [rad], up to 0.5 rad."""
RELEASE_SHIFT = 0.001
"""How far it is then drawn back per step [m]."""
DROPPED = 0.005
"""Smallest distance of the needle's arc from the jaws of an arm that has dropped it [m]."""
ARC_PARTS = 12
"""Parts of the arc at whose ends that distance is measured: 1.8 mm each."""
BESIDE = 0.0115
"""Smallest sideways distance from the exit at which PSM1 starts [m]; its home is 27 mm to the side
of pair 1's exit. A start that the draws of robot and phantom would put nearer, in PSM2's way, is
moved outwards."""


_COMMANDS = TaskState.SIZE
_DRAWS = _COMMANDS + COMMAND_SIZE * len(names.ARMS)
_WELDS = _DRAWS + randomisation.SIZE
_QUEUE = _WELDS + attach.SIZE
USED = _QUEUE + 7 * LATENCY_LIMIT
"""User data in use, in this order: task state, commands, an episode's randomisation, welds, waiting
actions; soft tissue follows (`tissue.SIZE`)."""


class Simulation:
    """One scene in motion; see the module's docstring.

    Args:
        scene: the compiled scene.
        own_model: keep a copy of its model, to be randomised; scenes of grasp level "attach" or
            with soft tissue always have one.
        latency: control steps by which an action is delayed.
    """

    def __init__(self, scene: Scene, *, own_model: bool = False, latency: int = 0):
        self.scene = scene
        self.latency = latency
        welded = scene.config.grasp == "attach"
        is_soft = scene.config.tissue == "soft"
        self.model = copy.copy(scene.model) if own_model or welded or is_soft else scene.model
        self.data = data = mujoco.MjData(self.model)
        self._ctrl = data.ctrl
        self._qpos = data.qpos
        self._xpos = data.xpos
        self._xmat = data.xmat
        self.draws = randomisation.NOTHING
        self.offsets: dict[str, tuple[float, ...]] = {}
        self._meet_draws()
        self._welds = Welds(self.model, self.data) if welded else None
        self.tissue = Tissue(scene, self.model, data) if is_soft else None
        self._own = own_model
        self._instrument = scene.config.instrument
        self._fingers = {arm: scene.arms[arm].finger_qpos for arm in names.ARMS}
        self._servos = {
            arm: self._ctrl.itemsize * scene.arms[arm].actuators.start for arm in names.ARMS
        }
        self.task_state = TaskState()
        self.commands: dict[str, Command] = {}
        self._read: dict[str, Pose] | None = None
        self.bases = {arm: poses.flat(kinematics.base_in_world(arm)) for arm in names.ARMS}
        self._from_world = {arm: poses.invert(base) for arm, base in self.bases.items()}
        self._needle_id = self.model.body("needle").id
        self._phantom_id = self.model.body("phantom").id
        self._pads = {arm: scene.arms[arm].pads for arm in names.ARMS}
        self._needle_geoms = (scene.needle_geoms.start, scene.needle_geoms.stop)
        self._control_time = SUBSTEPS * float(self.model.opt.timestep)
        self._bodies = {arm: scene.arms[arm].tip_body for arm in names.ARMS} | {
            "needle": self._needle_id
        }
        self.reset()

    def reset(self) -> None:
        """Put everything at home: both arms at their start, the needle flat at its home."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = CLOCK_START
        self.task_state = TaskState()
        for arm in names.ARMS:
            self.pose_arm(arm, poses.flat(self._start(arm)), kinematics.STARTS[arm].jaw)
        if self._own:
            self.data.userdata[_DRAWS:_WELDS] = self.draws
        if self._welds:
            self._welds.unpack([0.0] * attach.SIZE)
        if self.tissue:
            self.tissue.clear()
        self.refresh()

    def _start(self, arm: str) -> NDArray[np.float64]:
        """Return T_base_tip (4, 4) of an arm at the start; PSM1 keeps clear of PSM2's stitch."""
        start = kinematics.start_in_base(arm)
        base = kinematics.base_in_world(arm)
        shift = randomisation.start_shift(self.draws, arm)
        if arm == names.PSM1:
            tip = (base @ start)[:3, 3] + shift
            leave = self.pair.exit
            beside = np.array([math.cos(leave.turn), math.sin(leave.turn), 0.0])
            shift = shift + max(0.0, BESIDE - beside @ (tip - leave.centre)) * beside
        start[:3, 3] += base[:3, :3].T @ shift
        return start

    def randomise(self, draws: randomisation.Draws) -> None:
        """Apply one episode's randomisation to the model; `reset` or `refresh` must follow.

        Raises:
            InputError: the model is shared with other envs.
        """
        if not self._own:
            raise InputError(
                "The state is from a randomised episode; make the env with the same randomisation."
            )
        randomisation.apply(self.scene, self.model, draws)
        self.draws = draws
        self.offsets = randomisation.joint_offsets(draws)
        self._meet_draws()
        if self.tissue:
            self.tissue.meet(self.radius, self.tip_angle)

    def _meet_draws(self) -> None:
        """Read the needle's shape, the phantom's placement and the pair from the draws."""
        self.shape = randomisation.needle_shape(self.draws)
        self.radius = self.shape.radius
        self.tip_angle = self.shape.tip_angle
        self.placement = randomisation.placement(self.scene, self.draws)
        self.pair_index = self.placement.pair
        own = PAIRS[self.scene.config.layout][self.pair_index]
        self.pair = self.placement.placed_pair(own)

    def refresh(self) -> None:
        """Recompute positions, velocities and contacts of the present state."""
        mujoco.mj_step1(self.model, self.data)
        self._read = None

    # -- setting -----------------------------------------------------------------------------------

    def pose_arm(self, arm: str, pose: Pose, jaw: float, measured_jaw: float | None = None) -> None:
        """Put an arm's joints at a true tip pose in its base, at rest, and command it to stay.

        Args:
            arm: "psm1" or "psm2".
            pose: T_base_tip.
            jaw: commanded jaw angle [rad].
            measured_jaw: the fingers' angle [rad], by default the commanded one.

        Raises:
            UnreachablePose: outside the joint limits.
        """
        near = self.commands[arm].joints if arm in self.commands else None
        try:
            joints = kinematics.inverse_flat(pose, self.scene.config.instrument, near)
        except UnreachablePose:
            joints = kinematics.inverse_flat(pose, self.scene.config.instrument)
        ids = self.scene.arms[arm]
        self.data.qpos[ids.qpos] = joints
        finger = jaw if measured_jaw is None else measured_jaw
        self.data.qpos[ids.finger_qpos : ids.finger_qpos + 2] = finger
        if arm in self.offsets:
            joints = self._without_error(arm, joints)
            pose = kinematics.forward_flat(joints, self.scene.config.instrument)
        self.command(arm, Command(pose, jaw, joints))

    def command(self, arm: str, command: Command) -> None:
        """Make `command` the arm's present command."""
        self.commands[arm] = command
        joints = self._with_error(arm, command.joints) if self.offsets else command.joints
        _SET_SEVEN(self._ctrl, self._servos[arm], *joints, control.jaw_servo(command.jaw))

    def pose_needle(self, pose: Pose) -> None:
        """Put the needle at a pose in world; embedded if that is in soft tissue.

        Its velocity stays as it is.
        """
        free = self.scene.needle_qpos.start
        self.data.qpos[free : free + 3] = poses.position(pose)
        turn = matrix_to_quaternion_flat(poses.rotation(pose))
        self.data.qpos[free + 3 : free + 7] = turn
        if self.tissue:
            self.tissue.embed()

    def to_base(self, arm: str, pose: Pose) -> Pose:
        """Return a pose in world as one in the arm's base."""
        return poses.compose(self._from_world[arm], pose)

    def settle(self, steps: int) -> None:
        """Let the physics run under the present commands for `steps` physics steps."""
        if steps:
            mujoco.mj_step(self.model, self.data, steps)
        self.data.time = CLOCK_START
        if self.tissue:
            self.tissue.update()
        self.refresh()
        if self._welds:
            self._attach(self._welds)

    # -- moving ------------------------------------------------------------------------------------

    def advance(self, arm: str, action: list[float], step: StepSize) -> bool:
        """Take one control step of 20 ms; return False on a physics error.

        A physics error means that MuJoCo diverged and reset itself, or that a non-finite command
        was written into `data.ctrl`: MuJoCo would replace it by zeros for all servos.

        Args:
            arm: the arm the action moves.
            action: seven floats in [-1, 1].
            step: size of an action of 1.
        """
        if self.latency:
            action = self._delayed(action)
        finite = self._have_finite_servos()
        present = self.within_reach(arm)
        self.command(arm, control.follow(present, action, step, self.bases[arm], self._instrument))
        if self.task_state.release_steps > 0:
            self._let_go()
        return self._run() and finite

    def advance_to(
        self, commands: Mapping[str, Command], halfway: Callable[[], None] | None = None
    ) -> bool:
        """Take one control step under commands of any arms, as a robot's interface gives them.

        Nothing happens automatically: actions are not delayed, and PSM2 lets go only if commanded.

        Args:
            commands: arm → its new command; an arm left out keeps its own.
            halfway: called after half of the control step, when joints may be read; body poses are
                then one physics step old.

        Returns:
            As `advance`.
        """
        finite = self._have_finite_servos()
        for arm, command in commands.items():
            self.command(arm, command)
        return self._run(halfway) and finite

    def _have_finite_servos(self) -> bool:
        """Return whether all servos' set points are finite; if not, restore their commands."""
        ctrl = self._ctrl
        finite = isfinite(ctrl.dot(ctrl))
        if not finite:
            for name, command in self.commands.items():
                self.command(name, command)
        return finite

    def _run(self, halfway: Callable[[], None] | None = None) -> bool:
        """Let the physics run for one control step; return False if it diverged."""
        data = self.data
        due = data.time + self._control_time
        mujoco.mj_step2(self.model, data)
        if halfway is None:
            mujoco.mj_step(self.model, data, SUBSTEPS - 1)
        else:
            mujoco.mj_step(self.model, data, SUBSTEPS // 2 - 1)
            halfway()
            mujoco.mj_step(self.model, data, SUBSTEPS // 2)
        if self.tissue:
            self.tissue.update()
        mujoco.mj_step1(self.model, data)
        self._read = None
        if self._welds:
            self._attach(self._welds)
        return bool(abs(data.time - due) < 1e-9)

    def within_reach(self, arm: str) -> Command:
        """Return an arm's command, drawn back to the range in which its servos still respond.

        A servo at its torque limit does not follow; without this the command of an arm that presses
        on something would run away from it, and the way back would lose as many steps.
        """
        command = self.commands[arm]
        measured = self._qpos[self.scene.arms[arm].qpos].tolist()
        told = self._with_error(arm, command.joints) if self.offsets else command.joints
        leads = [a - b for a, b in zip(told, measured, strict=True)]
        limits = self.scene.leads
        if all(-limit <= lead <= limit for lead, limit in zip(leads, limits, strict=True)):
            return command
        a, b, c, d, e, f = (
            joint - lead + max(-limit, min(lead, limit))
            for joint, lead, limit in zip(command.joints, leads, limits, strict=True)
        )
        joints = (a, b, c, d, e, f)
        return Command(kinematics.forward_flat(joints, self._instrument), command.jaw, joints)

    def _delayed(self, action: list[float]) -> list[float]:
        """Queue an action and return the one that is due."""
        waiting = self.data.userdata[_QUEUE : _QUEUE + 7 * self.latency].tolist()
        self.data.userdata[_QUEUE : _QUEUE + 7 * self.latency] = waiting[7:] + action
        return list(waiting[:7])

    def drop_waiting(self) -> None:
        """Discard the waiting actions, because another arm is active now."""
        self.data.userdata[_QUEUE:USED] = 0.0

    def pending(self, arm: str, step: StepSize) -> Command:
        """Return an arm's command once all waiting actions have taken effect."""
        command = self.commands[arm]
        for index in range(self.latency):
            action = self.data.userdata[_QUEUE + 7 * index : _QUEUE + 7 * index + 7].tolist()
            command = control.follow(
                command, action, step, self.bases[arm], self.scene.config.instrument
            )
        return command

    def _attach(self, welds: Welds) -> None:
        """Attach the needle to closed jaws that touch it, release it from open ones."""
        changed = False
        for arm in names.ARMS:
            closed = self.commands[arm].jaw < attach.CLOSED
            touching = closed and any(self.touching(arm))
            tip = self.tip(arm)
            needle = self.needle()
            changed |= welds.update(arm, closed=closed, touching=touching, tip=tip, needle=needle)
        if changed:
            self.refresh()

    def _let_go(self) -> None:
        """Open PSM2's jaw, then draw the tool back along its axis."""
        command = self.commands[names.PSM2]
        self.task_state.release_steps -= 1
        jaw = min(command.jaw + RELEASE_JAW, 0.5)
        back = [0.0] * 7
        if jaw >= 0.5:
            x, y, z = poses.z_axis(command.pose)
            back[:3] = [-x, -y, -z]
        step = StepSize(RELEASE_SHIFT, 0.0, 0.0)
        moved = control.follow(
            command, back, step, self.bases[names.PSM2], self.scene.config.instrument
        )
        self.command(names.PSM2, moved._replace(jaw=jaw))

    # -- measuring ---------------------------------------------------------------------------------

    def keep_reads(self) -> None:
        """Read each pose only once until `forget_reads`; nothing may move in between."""
        self._read = {}

    def forget_reads(self) -> None:
        """Read poses anew each time, as a caller who writes to `data` expects."""
        self._read = None

    def _body(self, name: str) -> Pose:
        read = self._read
        index = self._bodies[name]
        pose: Pose = (*_THREE(self._xpos, 24 * index), *_NINE(self._xmat, 72 * index))
        if read is not None:
            read[name] = pose
        return pose

    def tip(self, arm: str) -> Pose:
        """Return T_world_tip of an arm, measured."""
        read = self._read
        return read[arm] if read is not None and arm in read else self._body(arm)

    def grasp(self, arm: str) -> Pose:
        """Return T_world_grasp: the tip's frame shifted to the jaws' grasp point."""
        return poses.shifted_along_z(self.tip(arm), GRASP_DEPTH)

    def needle(self) -> Pose:
        """Return T_world_needle, measured."""
        read = self._read
        return read["needle"] if read is not None and "needle" in read else self._body("needle")

    def tip_in_base(self, arm: str) -> Pose:
        """Return T_base_tip as the arm reports it, without knowing its joints' error."""
        if not self.offsets:
            return self.to_base(arm, self.tip(arm))
        return kinematics.forward_flat(self.reported_joints(arm), self.scene.config.instrument)

    def reported_joints(self, arm: str) -> kinematics.Joints:
        """Return an arm's six joints [rad, m] as it reports them, without knowing their error."""
        joints: kinematics.Joints = tuple(self.data.qpos[self.scene.arms[arm].qpos].tolist())
        return self._without_error(arm, joints) if self.offsets else joints

    def true_pose(self, arm: str, command: Command) -> Pose:
        """Return where a command really brings the tip, in the arm's base."""
        if not self.offsets:
            return command.pose
        return kinematics.forward_flat(
            self._with_error(arm, command.joints), self.scene.config.instrument
        )

    def _with_error(self, arm: str, joints: kinematics.Joints) -> kinematics.Joints:
        a, b, c, d, e, f = joints
        x, y, z = self.offsets[arm][:3]
        return a + x, b + y, c + z, d, e, f

    def _without_error(self, arm: str, joints: kinematics.Joints) -> kinematics.Joints:
        a, b, c, d, e, f = joints
        x, y, z = self.offsets[arm][:3]
        return a - x, b - y, c - z, d, e, f

    def jaw(self, arm: str) -> float:
        """Return the measured angle of the left finger [rad]."""
        angle: float = self._qpos.item(self._fingers[arm])
        return angle

    def needle_point(self, angle: float) -> tuple[float, float, float]:
        """Return the needle's point at `angle` [rad] in world [m]."""
        x, y, z, r0, r1, _, r3, r4, _, r6, r7, _ = self.needle()
        along = -self.radius * math.cos(angle)
        across = self.radius * math.sin(angle)
        return (
            x + r0 * along + r1 * across,
            y + r3 * along + r4 * across,
            z + r6 * along + r7 * across,
        )

    def touching(self, arm: str) -> tuple[bool, bool]:
        """Return whether the left and the right jaw pad touch the needle."""
        left, right = self._pads[arm]
        first, last = self._needle_geoms
        found_left = found_right = False
        # MuJoCo sorts a pair by type: capsules before boxes.
        for one, other in self.data.contact.geom.tolist():
            if other == left:
                found_left = found_left or first <= one < last
            elif other == right:
                found_right = found_right or first <= one < last
        return found_left, found_right

    def holds(self, arm: str) -> bool:
        """Return True if an arm holds the needle.

        Both its jaw pads touch it, or, at grasp level "attach", it is attached.
        """
        if self._welds:
            return self._welds.active(arm)
        left, right = self.touching(arm)
        return left and right

    def has_dropped(self, arm: str) -> bool:
        """Return True if an arm neither holds the needle nor has it near its jaws."""
        if self.holds(arm):
            return False
        grasp = poses.position(self.grasp(arm))
        angles = [self.tip_angle * part / ARC_PARTS for part in range(ARC_PARTS + 1)]
        return min(math.dist(grasp, self.needle_point(angle)) for angle in angles) > DROPPED

    def touches_phantom(self, *, needle: bool) -> bool:
        """Return True if an instrument, or with `needle` the needle too, touches the phantom.

        The thread is ignored. A needle in soft tissue counts as touching it.
        """
        if needle and self.tissue and self.tissue.stage:
            return True
        bodies = self.model.geom_bodyid[self.data.contact.geom]
        may = self.model.body_rootid[bodies] == self._needle_id  # the thread hangs on the needle
        if needle:
            may &= bodies != self._needle_id
        touching = (bodies == self._phantom_id).any(axis=1) & ~may.any(axis=1)
        return bool(touching.any())

    # -- state -------------------------------------------------------------------------------------

    def get_state(self) -> NDArray[np.float64]:
        """Return everything as one vector: MuJoCo's integration state with its user data."""
        values = self.task_state.pack()
        for arm in names.ARMS:
            values += self.commands[arm].pack()
        self.data.userdata[: len(values)] = values
        if self._welds:
            self.data.userdata[_WELDS:_QUEUE] = self._welds.pack()
        if self.tissue:
            packed = self.tissue.pack()
            self.data.userdata[USED : USED + len(packed)] = packed
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        return state

    def redrawn(
        self, state: NDArray[np.float64], given: Mapping[str, Sequence[float]]
    ) -> NDArray[np.float64]:
        """Return a vector of `get_state` with the numbers of some axes of randomisation replaced.

        Nothing moves by it: with another error of the joints, the arms report other joints, and
        have been told other joints to be where they are.

        Args:
            state: a state of this scene.
            given: axis → its numbers, as `randomisation.report` returns them.
        """
        # MuJoCo stores the parts of a state in the order of their bits.
        first = mujoco.mj_stateSize(self.model, STATE & (_USER_DATA - 1))
        place = slice(first + _DRAWS, first + _WELDS)
        redrawn = np.array(state, dtype=np.float64)
        before = tuple(redrawn[place].tolist())
        after = randomisation.with_numbers(before, given)
        redrawn[place] = after
        self._retell(
            redrawn[first + _COMMANDS : first + _DRAWS],
            randomisation.joint_offsets(before),
            randomisation.joint_offsets(after),
        )
        return redrawn

    def _retell(
        self,
        commands: NDArray[np.float64],
        before: Mapping[str, Sequence[float]],
        after: Mapping[str, Sequence[float]],
    ) -> None:
        """Replace packed commands by those that bring arms of other joint errors to the same place.

        Args:
            commands: those of both arms, to be changed.
            before: arm → error of its joints for which they were meant; right where it is missing.
            after: the same, for which they are meant now.
        """
        right = (0.0,) * 6
        for arm, command in zip(names.ARMS, commands.reshape(-1, COMMAND_SIZE), strict=True):
            change = np.subtract(before.get(arm, right), after.get(arm, right))
            if change.any():
                told = Command.unpack(command.tolist())
                joints: kinematics.Joints = tuple(np.add(told.joints, change).tolist())
                pose = kinematics.forward_flat(joints, self.scene.config.instrument)
                command[:] = Command(pose, told.jaw, joints).pack()

    def set_state(self, state: NDArray[np.float64]) -> None:
        """Restore a vector of `get_state`.

        Raises:
            InputError: of another length, with numbers that no state has, or of a randomised
                episode although this env has no randomisation.
        """
        vector = np.ascontiguousarray(state, dtype=np.float64)
        size = mujoco.mj_stateSize(self.model, STATE)
        if vector.shape != (size,):
            raise InputError(
                f"The state has shape {vector.shape}; this scene's states have shape ({size},)."
            )
        refuse_beyond_mujoco(vector)
        userdata = np.empty(self.model.nuserdata)
        mujoco.mj_extractState(self.model, vector, STATE, userdata, _USER_DATA)
        values = userdata.tolist()
        draws = tuple(values[_DRAWS:_WELDS])
        if draws != self.draws:
            self.randomise(randomisation.checked(draws))
        mujoco.mj_setState(self.model, self.data, vector, STATE)
        self.task_state = TaskState.unpack(values)
        for index, arm in enumerate(names.ARMS):
            start = _COMMANDS + COMMAND_SIZE * index
            self.commands[arm] = Command.unpack(values[start : start + COMMAND_SIZE])
        if self._welds:
            self._welds.unpack(values[_WELDS:_QUEUE])
        if self.tissue:
            self.tissue.unpack(values[USED:])
        self.refresh()


def refuse_beyond_mujoco(values: NDArray[np.float64]) -> None:
    """Refuse numbers that are not finite or so large that MuJoCo resets itself to its own start.

    Raises:
        InputError: there is one.
    """
    if not (np.abs(values) <= mujoco.mjMAXVAL).all():
        raise InputError(
            f"The state holds numbers that are not finite, or beyond ±{mujoco.mjMAXVAL:g}."
        )
