"""The paper's 'kinematic scaling' block (Fig. 4): the master's motion becomes the slave's command.

Translations are scaled, orientations by quaternions: the rotation of the master since the clutch
was closed is a rotation about one axis, and the slave turns about the same axis by the scaled
angle.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydrake.math import RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_teleop.quaternions import conjugate, exponential, logarithm, multiply, normalized, rotate


@njit(cache=True)
def scaled_rotation(rotation, scale):
    """The quaternion of the same axis and `scale` times the angle (the shorter way round).

    With a scale other than 1 the result jumps where the angle passes 180 degrees.
    """
    v = logarithm(rotation)
    return exponential((scale * v[0], scale * v[1], scale * v[2]))


@njit(cache=True)
def scale_pose_into(pose, master, command, alignment, translation_scale, rotation_scale, out):
    """Writes the commanded X_WS (7,) into `out`.

        p_WS = p_command + translation_scale R_WB (p_BE - p_master)
        R_WS = R_WB (R_BE R_master^T)^rotation_scale R_WB^T R_command

    Args:
        pose: (7,) X_BE now.
        master: (7,) X_BE when the clutch was closed.
        command: (7,) X_WS when the clutch was closed.
        alignment: (4,) quaternion of R_WB.
        out: (7,) written; the quaternion has norm 1.
    """
    R_WB = (alignment[0], alignment[1], alignment[2], alignment[3])
    offset = rotate(R_WB, (pose[4] - master[4], pose[5] - master[5], pose[6] - master[6]))
    reference = conjugate((master[0], master[1], master[2], master[3]))
    turn_B = scaled_rotation(
        multiply((pose[0], pose[1], pose[2], pose[3]), reference), rotation_scale
    )
    turn_W = multiply(multiply(R_WB, turn_B), conjugate(R_WB))
    orientation = normalized(multiply(turn_W, (command[0], command[1], command[2], command[3])))
    for k in range(4):
        out[k] = orientation[k]
    for k in range(3):
        out[4 + k] = command[4 + k] + translation_scale * offset[k]


class KinematicScaling(LeafSystem):
    """Scales the master's motion into the slave's commanded pose, through a clutch.

    While the clutch is open the command stays where it is; when it closes, motion goes on from
    there with the master's pose of that instant as its new reference (re-indexing). Neither makes
    a jump. The clutch starts open and the first sample closes it if it is engaged.

    .. pydrake_system::

        name: KinematicScaling
        input_ports:
        - pose_master: (7,) X_BE
        - clutch: (1,) engaged if above 0.5
        output_ports:
        - pose_command: (7,) X_WS

    Args:
        period: how often the clutch is looked at [s].
        start: (7,) X_WS commanded at the start.
        translation_scale: slave over master translation.
        rotation_scale: slave over master rotation angle.
        R_WB: how the master's base is aligned with the world.
    """

    def __init__(
        self,
        period: float,
        start: NDArray[np.float64],
        *,
        translation_scale: float = 1.0,
        rotation_scale: float = 1.0,
        R_WB: RotationMatrix | None = None,
    ) -> None:
        super().__init__()
        alignment = (R_WB or RotationMatrix()).ToQuaternion().wxyz()
        self._scaling = (alignment, float(translation_scale), float(rotation_scale))
        self._pose = self.DeclareVectorInputPort("pose_master", 7)
        self._clutch = self.DeclareVectorInputPort("clutch", 1)
        # X_WS and X_BE at the last change of the clutch, and whether it is engaged.
        identity = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        self.DeclareDiscreteState(np.concatenate([start, identity, [0.0]]))
        self.DeclareVectorOutputPort("pose_command", 7, self._calc_command)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        # The command follows from the first instant on.
        self.DeclareInitializationDiscreteUpdateEvent(self._update)

    def _command_into(self, context: Context, out: NDArray[np.float64]) -> None:
        state = context.get_discrete_state(0).value()
        command, master, engaged = state[:7], state[7:14], state[14] > 0.5
        if engaged:
            scale_pose_into(self._pose.Eval(context), master, command, *self._scaling, out)
        else:
            out[:] = command

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        self._command_into(context, output.get_mutable_value())

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        references = discrete_state.get_mutable_value(0)
        engage = self._clutch.Eval(context)[0] > 0.5
        if engage == (references[14] > 0.5):
            return
        self._command_into(context, references[:7])
        references[7:14] = self._pose.Eval(context)
        references[14] = float(engage)
