"""Simulated robot: an env's two arms as those of a dVRK, measured and commanded in its units.

What is measured is what the joints report: an arm that does not know its kinematic error reports
its pose without it (`Simulation.reported_joints`). A set point is drawn back to where the servos
still respond to it (`Simulation.within_reach`), so that a client that adds increments to it moves
the arm as the env's own actions do.
"""

from collections.abc import Callable, Mapping
from typing import final

from surgicai_vision.core import names
from surgicai_vision.core.errors import InputError, PhysicsError, check_name
from surgicai_vision.envs.base import SuturingEnv
from surgicai_vision.envs.control import JAW_OPEN, Command
from surgicai_vision.envs.success import Info
from surgicai_vision.envs.suture import Suture
from surgicai_vision.robot.arm import FINGER_SHARE, ArmState, Target
from surgicai_vision.scene.kinematics import Joints, Pose, forward_flat

PSM_NAMES = {arm.upper(): arm for arm in names.ARMS}
"""A dVRK's name of an arm → ours."""


@final
class SimulatedRobot:
    """The arms of one env; see the module's docstring.

    Args:
        env: the env, of obs_type "state".

    Raises:
        InputError: the env delays, holds or changes actions; a robot obeys each command as it is,
            and its delay is that of its messages.
    """

    def __init__(self, env: SuturingEnv):
        if env.config.randomisation.latency:
            raise InputError(
                "randomisation.latency delays an env's actions; served commands are not delayed. "
                "Leave it out."
            )
        if env.config.action_repeat != 1 or env.config.hold_jaw:
            given = "hold_jaw" if env.config.hold_jaw else "action_repeat"
            raise InputError(
                f"env: {given} changes an env's actions; served commands are obeyed at every "
                "control step, as they are. Leave it out."
            )
        self.env = env
        self.instrument = env.scene.config.instrument
        model = env.model
        dof_of = dict(zip(model.jnt_qposadr.tolist(), model.jnt_dofadr.tolist(), strict=True))
        self._dofs = {}
        self._finger_dofs = {}
        for name, arm in PSM_NAMES.items():
            ids = env.scene.arms[arm]
            self._dofs[name] = [dof_of[place] for place in range(ids.qpos.start, ids.qpos.stop)]
            self._finger_dofs[name] = dof_of[ids.finger_qpos]
        self.info: Info = {}
        self.seed = 0
        self.steps = 0

    def base(self, name: str) -> Pose:
        """Return T_world_base of an arm."""
        return self.env.simulation.bases[PSM_NAMES[name]]

    def reset(self, seed: int) -> None:
        """Begin the episode of `seed`.

        Raises:
            PhysicsError: the seed has no start; nothing has changed.
        """
        before = self.env.get_state()
        try:
            _, self.info = self.env.reset(seed=seed)
        except PhysicsError:
            self.env.set_state_vector(before)
            raise
        self.seed = seed
        self.steps = 0

    def enter(self, subtask: str) -> None:
        """Tell the judge which subtask is active.

        Raises:
            InputError: no such subtask, or a task of one subtask.
        """
        if not isinstance(self.env, Suture):
            raise InputError(f"the task {self.env.task} has one subtask; no other can be entered.")
        phase = names.SUBTASKS.index(check_name("subtask", subtask, names.SUBTASKS))
        self.env.enter(phase)

    def state(self, name: str) -> ArmState:
        """Return what an arm's joints report now, and its set points."""
        simulation = self.env.simulation
        arm = PSM_NAMES[name]
        speeds = simulation.data.qvel
        a, b, c, d, e, f = speeds[self._dofs[name]].tolist()
        told = simulation.within_reach(arm)
        return ArmState(
            joints=simulation.reported_joints(arm),
            velocity=(a, b, c, d, e, f),
            jaw=simulation.jaw(arm) / FINGER_SHARE,
            jaw_velocity=float(speeds[self._finger_dofs[name]]) / FINGER_SHARE,
            setpoint=told.joints,
            jaw_setpoint=told.jaw / FINGER_SHARE,
        )

    def tell(self, targets: Mapping[str, Target]) -> None:
        """Give arms new set points, which `state` returns from now on; nothing moves yet.

        Args:
            targets: arm → its new set point; an arm left out keeps its own.
        """
        for name, target in targets.items():
            self.env.simulation.command(PSM_NAMES[name], self._command(target))

    def step(self, halfway: Callable[[], None] | None) -> None:
        """Take one control step of 20 ms under the present set points.

        Args:
            halfway: called after half of it, when `state` may be read.
        """
        _, _, _, _, self.info = self.env.step_commands({}, halfway)
        self.steps += 1

    def needle(self) -> Pose:
        """Return T_world_needle: ground truth."""
        return self.env.simulation.needle()

    def _command(self, target: Target) -> Command:
        jaw = min(max(target.jaw * FINGER_SHARE, 0.0), JAW_OPEN)
        joints: Joints = target.joints
        return Command(forward_flat(joints, self.instrument), jaw, joints)
