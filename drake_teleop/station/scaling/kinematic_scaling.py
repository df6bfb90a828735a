"""Slave's command from the master's motion: kinematic scaling (Fig. 4) or joint coupling."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.common import vectors
from drake_teleop.common.blocks import NO_EXTRA_SLOTS, DoubleOnlySystem, weak_callback
from drake_teleop.common.compiled import njit
from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import quaternion_at, quaternion_product, scale_vector, vector_at
from drake_teleop.station.slave.arm import ArmModel, pose_into

_MIN_COS_OF_HALF_ROTATION = 0.26  # rotation of 150 degrees: a scaled one jumps at 180 degrees


@settings
@dataclass
class KinematicScalingConfig:
    """Settings of the kinematic scaling: scales, and orientation of the master's base."""

    translation_scale: float = quantity(1.0, "1", 0.0, 100.0, "slave over master translation")
    rotation_scale: float = quantity(1.0, "1", 0.0, 10.0, "slave over master angle")
    alignment: list[float] = quantity(
        [0.0] * 3, "rad", -7.0, 7.0, "roll, pitch, yaw of the master's base B in the world W"
    )

    @property
    def R_WB(self) -> Array:
        """Orientation (3, 3) of the master's base B in world W."""
        return RollPitchYaw(self.alignment).ToRotationMatrix().matrix()

    @property
    def scales(self) -> Array:
        """Scales (2,), slave over master: translation, rotation."""
        return np.array([self.translation_scale, self.rotation_scale])


@njit(cache=True)
def scaled_rotation(rotation, scale):
    """Return the quaternion of the rotation about the same axis by `scale` times the angle."""
    turn = vectors.quaternion_logarithm(rotation)
    return vectors.quaternion_exponential(scale_vector(scale, turn))


@njit(cache=True)
def scale_pose_into(pose, master, command, alignment, translation_scale, rotation_scale, out):
    """Write the commanded pose X_WS (7,) of the slave into `out`, which may be `command`.

        p_WS = p_command + translation_scale R_WB (p_BE - p_master)
        R_WS = R_WB (R_BE R_master^T)^rotation_scale R_WB^T R_command

    `pose` (7,) is X_BE of the master now; `master` and `command` (7,) are X_BE and X_WS when the
    clutch closed; `alignment` (4,) is the quaternion of R_WB.
    """
    R_WB, R_BE = quaternion_at(alignment, 0), quaternion_at(pose, 0)
    offset = vectors.rotate_vector(R_WB, vectors.minus(vector_at(pose, 4), vector_at(master, 4)))
    turn = quaternion_product(R_BE, vectors.conjugate_quaternion(quaternion_at(master, 0)))
    turn_B = scaled_rotation(turn, rotation_scale)
    R_BW = vectors.conjugate_quaternion(R_WB)
    turn_W = quaternion_product(quaternion_product(R_WB, turn_B), R_BW)
    orientation = quaternion_product(turn_W, quaternion_at(command, 0))
    out[0], out[1], out[2], out[3] = vectors.normalized_quaternion(orientation)
    scaled = scale_vector(translation_scale, offset)
    out[4], out[5], out[6] = vectors.plus(vector_at(command, 4), scaled)


@njit(cache=True, omits_reference_counting=True)
def _pose_command_into(pose, clutch_references, R_WB, translation_scale, rotation_scale, out):
    if clutch_references[14] > 0.5:
        command, master = clutch_references[:7], clutch_references[7:14]
        scale_pose_into(pose, master, command, R_WB, translation_scale, rotation_scale, out)
    else:
        vectors.copy_into(out, 0, clutch_references, 0, 7)


class KinematicScaling(DoubleOnlySystem, LeafSystem):
    """Block that scales the master's motion into the slave's commanded pose, with a clutch.

    While the clutch is open, the command is constant. When it closes, or after a rotation by 150
    degrees, the master's pose is the new reference, so the command does not jump. While the pose is
    not finite, the clutch keeps its state.

    .. pydrake_system::

        name: KinematicScaling
        input_ports:
        - pose_master: (7,) pose X_BE of the master
        - clutch: (1,) closed if above 0.5 or unconnected
        output_ports:
        - pose_command: (7,) commanded pose X_WS of the slave

    Args:
        period: sampling period of the clutch [s].
        start: (7,) commanded pose X_WS at the start.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, config: KinematicScalingConfig, period: float, start: Array) -> None:
        super().__init__()
        R_WB = RollPitchYaw(config.alignment).ToQuaternion().wxyz()
        self._scaling = (R_WB, float(config.translation_scale), float(config.rotation_scale))
        self._pose = self.DeclareVectorInputPort("pose_master", 7)
        self._clutch = self.DeclareVectorInputPort("clutch", 1)
        # X_WS and X_BE at the last change of the clutch, and whether it is closed.
        self.DeclareDiscreteState(np.concatenate([start, [1.0, *np.zeros(6)], [0.0]]))
        sources = {self._pose.ticket(), self.xd_ticket()}
        self.DeclareVectorOutputPort("pose_command", 7, weak_callback(self._calc_command), sources)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update_clutch_references)
        # The command follows from the first sample on.
        self.DeclareInitializationDiscreteUpdateEvent(self._update_clutch_references)

    def OpenClutch(self, context: Context, command: Array) -> None:
        """Open the clutch; the slave's commanded pose X_WS stays at `command` (7,)."""
        references = context.get_discrete_state(0).CopyToVector()
        references[:7], references[14] = command, 0.0
        context.SetDiscreteState(0, references)

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        pose, references = self._pose.Eval(context), context.get_discrete_state(0).value()
        _pose_command_into(pose, references, *self._scaling, output.get_mutable_value())

    def _update_clutch_references(self, context: Context, discrete_state: DiscreteValues) -> None:
        references = discrete_state.get_mutable_value(0)
        engage = not self._clutch.HasValue(context) or self._clutch.Eval(context)[0] > 0.5
        pose = self._pose.Eval(context)
        if not np.isfinite(pose).all():  # the reference must be finite
            return
        far = engage and abs(pose[:4] @ references[7:11]) < _MIN_COS_OF_HALF_ROTATION
        if engage == (references[14] > 0.5) and not (far and self._scaling[2] % 1.0):
            return
        _pose_command_into(pose, references, *self._scaling, references[:7])
        references[7:14] = pose
        references[14] = float(engage)


class JointCoupling(LeafSystem):
    """Block that couples the slave's joint positions to those of the leader arm, with a clutch.

    While the clutch is open, the command is constant. Otherwise it is start + (leader's joints -
    home), so it jumps when the clutch closes.

    .. pydrake_system::

        name: JointCoupling
        input_ports:
        - master_state: (2 n,) [q; dq/dt] of the leader [rad, rad/s]
        - clutch: (1,) closed if above 0.5 or unconnected
        output_ports:
        - leader_joints: (n,) commanded joint positions of the slave [rad]
        - pose_command: (7,) X_WS for these joints

    `start` and `home` (n,) [rad] are matching joint positions of slave and leader.
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, slave: ArmModel, start: Array, home: Array, period: float) -> None:
        super().__init__()
        if len(home) != len(start):
            what = f"the leader has {len(home)} joints, but the slave {len(start)} (must agree)"
            remedy = "set leads: pose, or choose arms of the same kinematics"
            raise DrakeTeleopError(what, where="master.leader.leads", remedy=remedy)
        self._table, self._offset, n = slave.table, np.array(start) - home, len(start)
        self._state = self.DeclareVectorInputPort("master_state", 2 * n)
        self._clutch = self.DeclareVectorInputPort("clutch", 1)
        self.DeclareDiscreteState(np.append(start, 0.0))  # joints; clutch closed
        sources = {self._state.ticket(), self.xd_ticket()}
        joints, pose = map(weak_callback, (self._calc_joint_command, self._calc_commanded_pose))
        self.DeclareVectorOutputPort("leader_joints", n, joints, sources)
        self.DeclareVectorOutputPort("pose_command", 7, pose, sources)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._store_joints_and_clutch)
        self.DeclareInitializationDiscreteUpdateEvent(self._store_joints_and_clutch)

    def _commanded_joint_positions(self, context: Context) -> Array:
        memory, n = context.get_discrete_state(0).value(), len(self._offset)
        joints: Array = memory[:n]
        return self._state.Eval(context)[:n] + self._offset if memory[n] > 0.5 else joints

    def _calc_joint_command(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._commanded_joint_positions(context))

    def _calc_commanded_pose(self, context: Context, output: BasicVector) -> None:
        joints = np.array(self._commanded_joint_positions(context))
        pose_into(self._table, joints, output.get_mutable_value())

    def _store_joints_and_clutch(self, context: Context, discrete_state: DiscreteValues) -> None:
        memory = discrete_state.get_mutable_value(0)
        joints = self._commanded_joint_positions(context)
        if np.isfinite(joints).all():  # an opened clutch must hold a finite command
            memory[:-1] = joints
        memory[-1] = not self._clutch.HasValue(context) or self._clutch.Eval(context)[0] > 0.5
