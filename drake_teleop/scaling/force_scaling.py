"""The paper's 'Force scaling/elimination' block (Figs. 2 and 4)."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.compensation import scaled_wrench_into, scales_from_eta
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.quantities import quantity

#: sigma_gripper, sigma_object, gamma that leave the contact wrench alone, Eq. (13).
_ELIMINATION = (0.0, 0.0, 1.0)


@dataclass
class ForceScalingConfig:
    """sigma, gamma, eta of the paper and the scale from slave to master."""

    sigma: float = quantity(1.0, "1", 0.0, 100.0, "share of the non-contact wrench that is kept")
    gamma: float = quantity(1.0, "1", 0.0, 100.0, "scale of the contact wrench")
    eta: float | None = quantity(
        None, "1", 0.0, 1.0, "Eq. (14): share of the object kept; needs sigma = 0 and gamma = 1"
    )
    gripper_phi: list[float] | None = quantity(
        None, "kg, kg m, kg m^2", -1e3, 1e3, "phi of the gripper alone; null: all is gripper"
    )
    force_scale: float = quantity(
        1 / 17.5, "1", 0.0, 100.0, "force and torque, slave to master (VI-B)"
    )

    def scales(self) -> tuple[float, float, float]:
        """(sigma_gripper, sigma_object, gamma).

        Raises:
            DrakeTeleopError: if eta is given and sigma is not 0 or gamma is not 1 (section V).
        """
        if self.eta is None:
            return self.sigma, self.sigma, self.gamma
        if self.sigma != 0 or self.gamma != 1 or self.gripper_phi is None:
            raise DrakeTeleopError(
                "eta works on the object alone",
                where="force_scaling.eta",
                remedy="set sigma: 0, gamma: 1 and gripper_phi (section V of the paper)",
            )
        return scales_from_eta(self.eta)


class ForceScaling(LeafSystem):
    """Removes or scales the non-contact wrench: F' = gamma F_c + V (sigma_gr phi_gr + ...).

    The scales are a numeric parameter of the context, [sigma_gripper, sigma_object, gamma], so
    that they may be changed while a simulation runs.

    .. pydrake_system::

        name: ForceScaling
        input_ports:
        - measured_wrench_S
        - specific_force_S
        - angular_velocity_S
        - angular_acceleration_S
        - load_estimate: (16,) Eq. (7), [offsets; phi]
        output_ports:
        - scaled_wrench_S: F' of Fig. 2
        - contact_wrench_S: Eq. (13)
        - non_contact_wrench_S: Eq. (12)
    """

    def __init__(self, config: ForceScalingConfig) -> None:
        super().__init__()
        self._gripper_phi = None if config.gripper_phi is None else np.array(config.gripper_phi)
        self._scales = self.DeclareNumericParameter(BasicVector(list(config.scales())))
        self._measured = self.DeclareVectorInputPort("measured_wrench_S", 6)
        self._motion = [
            self.DeclareVectorInputPort(name, 3)
            for name in ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")
        ]
        self._estimate = self.DeclareVectorInputPort("load_estimate", 16)
        # Not time: what does not depend on it need not be looked at in every step.
        inputs = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
        for name, calc in (
            ("scaled_wrench_S", self._calc_scaled),
            ("contact_wrench_S", self._calc_contact),
            ("non_contact_wrench_S", self._calc_non_contact),
        ):
            self.DeclareVectorOutputPort(name, 6, calc, inputs)

    def SetScales(
        self, context: Context, *, sigma_gripper: float, sigma_object: float, gamma: float
    ) -> None:
        """Changes the scales in a running simulation."""
        parameter = context.get_mutable_numeric_parameter(self._scales)
        parameter.SetFromVector([sigma_gripper, sigma_object, gamma])

    def _calc_scaled(self, context: Context, output: BasicVector) -> None:
        self._scale(context, context.get_numeric_parameter(self._scales).value(), output)

    def _calc_contact(self, context: Context, output: BasicVector) -> None:
        self._scale(context, _ELIMINATION, output)

    def _scale(self, context: Context, scales: Sequence[float], output: BasicVector) -> None:
        estimate = self._estimate.Eval(context)
        phi_gripper = estimate[6:] if self._gripper_phi is None else self._gripper_phi
        s, omega, alpha = self._motion
        scaled_wrench_into(
            self._measured.Eval(context),
            estimate[:6],
            s.Eval(context),
            omega.Eval(context),
            alpha.Eval(context),
            phi_gripper,
            estimate[6:] - phi_gripper,
            scales[0],
            scales[1],
            scales[2],
            output.get_mutable_value(),
        )

    def _calc_non_contact(self, context: Context, output: BasicVector) -> None:
        s, omega, alpha = (port.Eval(context) for port in self._motion)
        phi = self._estimate.Eval(context)[6:]
        non_contact_wrench_into(s, omega, alpha, phi, output.get_mutable_value())
