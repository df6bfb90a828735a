"""Settings of the haptic device: Phantom, data sheets by name, or a leader arm."""

import dataclasses
import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Presets, Registry
from drake_teleop.station.master.device_parameters import pack_device_parameters
from drake_teleop.station.master.dynamics import HapticDevice
from drake_teleop.station.master.leader import LeaderDevice
from drake_teleop.station.master.leader_model import LEADER_JOINT_MODE, Leader
from drake_teleop.station.master.phantom import PEAK_FORCE_N, PEAK_WRIST_TORQUES_N_M

PHANTOM_NAME, LEADER_NAME = "phantom_premium_15", "leader"
_MAX_DEVICE_PITCH_RAD = 1.5


@settings
@dataclass
class PhantomJointFriction:
    """Settings of the Phantom's joint friction coulomb * tanh(v / 0.01 rad/s) + viscous * v."""

    # Sources as in `phantom`: main axes P, wrist estimated.
    coulomb: list[float] = quantity(
        [0.01, 0.01, 0.01, 0.001, 0.001, 0.001], "N m", 0.0, 1.0, "Coulomb friction of the joints"
    )
    viscous: list[float] = quantity(
        [5e-4, 5e-4, 5e-4, 5e-5, 5e-5, 5e-5], "N m s/rad", 0.0, 10.0, "damping of the joints"
    )


@settings
@dataclass
class DeviceFigures:
    """Data sheet of a haptic device; in its base frame, x points to the operator and z up."""

    apparent_mass: float = quantity(0.1, "kg", 1e-3, 20.0, "apparent mass at the grip")
    inertia: float = quantity(1e-4, "kg m^2", 1e-7, 0.1, "inertia about every axis")
    friction: float = quantity(0.2, "N", 0.0, 50.0, "Coulomb friction of translation")
    friction_torque: float = quantity(1e-3, "N m", 0.0, 2.0, "Coulomb friction of rotation")
    damping: float = quantity(0.1, "N s/m", 0.0, 100.0, "viscous damping of translation")
    turning_damping: float = quantity(5e-5, "N m s/rad", 0.0, 1.0, "viscous damping of rotation")
    peak_force: float = quantity(10.0, "N", 0.0, 500.0, "largest displayed force")
    peak_torque: list[float] = quantity(
        [0.0, 0.0, 0.0], "N m", 0.0, 50.0, "peak torque of yaw, pitch, roll; any at 0: no torque"
    )
    size: list[float] = quantity([0.15, 0.15, 0.15], "m", 1e-3, 2.0, "workspace along x, y, z")
    centre: list[float] = quantity(
        [0.27, 0.0, 0.03], "m", -2.0, 2.0, "p_B of the workspace's middle; default: at the start"
    )
    turn: list[float] = quantity(
        [1.2, 1.2, 2.4], "rad", 0.0, math.pi, "limits +- of yaw, pitch (at most 1.5), and roll"
    )
    resolution: float = quantity(0.0, "m", 0.0, 0.01, "position step of the stylus; 0: exact")
    turn_resolution: float = quantity(0.0, "rad", 0.0, 0.1, "rotation step of stylus; 0: exact")
    rate_hz: float = quantity(0.0, "Hz", 0.0, 1e5, "update rate; 0: as rates.hand_hz, the maximum")


_WRIST_TURN_RAD, _NO_TURN_RAD = DeviceFigures().turn, [0.0, 0.0, 0.0]
_OMEGA_BOX_EDGES_M = [0.11, 0.113, 0.113]  # workspace
_OMEGA_MAX_TURN_RAD = np.radians([120.0, 70.0, 160.0]).tolist()
_OMEGA_STEPS_AND_RATE = 1e-5, math.radians(0.09), 4000.0  # steps [m], [rad]; rate [Hz]

# Apparent mass, Coulomb friction, peak force, size of the workspace, largest turns, steps of
# position and rotation, update rate. The manufacturers' values, from memory, are peak forces,
# workspaces (the largest box in a cylinder of 160 x 110 mm, omega, or a ball of 450 mm, Virtuose),
# mass and friction of the Touch, turns and steps of the omegas, position steps of Touch and Falcon,
# rates but the Inverse3's, and the Virtuose's torque. The rest are estimates.
# Only the Virtuose displays torque; omega.3 and Falcon do not rotate.
_DATA_SHEET_VALUES: dict[str, tuple[Any, ...]] = {
    # name            kg     N     N     m                   rad         m        rad          Hz
    "geomagic_touch": (0.045, 0.26, 3.3, [0.07, 0.16, 0.12], _WRIST_TURN_RAD, 5.5e-5, 2e-3, 1000.0),
    "omega_3": (0.25, 0.3, 12.0, _OMEGA_BOX_EDGES_M, _NO_TURN_RAD, *_OMEGA_STEPS_AND_RATE),
    "omega_6": (0.3, 0.3, 12.0, _OMEGA_BOX_EDGES_M, _OMEGA_MAX_TURN_RAD, *_OMEGA_STEPS_AND_RATE),
    "omega_7": (0.35, 0.3, 12.0, _OMEGA_BOX_EDGES_M, _OMEGA_MAX_TURN_RAD, *_OMEGA_STEPS_AND_RATE),
    "falcon": (0.2, 0.5, 8.9, [0.102] * 3, _NO_TURN_RAD, 6.35e-5, 0.0, 1000.0),
    "haply_inverse3": (0.2, 0.15, 10.0, [0.2, 0.34, 0.19], _WRIST_TURN_RAD, 2e-5, 2e-3, 4000.0),
    "virtuose_6d": (1.0, 1.0, 35.0, [0.26] * 3, _WRIST_TURN_RAD, 2e-5, 2e-4, 1000.0),
}  # fmt: skip
_SHEET_FIELDS = "apparent_mass friction peak_force size turn resolution turn_resolution rate_hz"
_data_sheets_by_name = {
    name: DeviceFigures(**dict(zip(_SHEET_FIELDS.split(), row, strict=True)))
    for name, row in _DATA_SHEET_VALUES.items()
}


class _DataSheetRegistry(Presets[DeviceFigures], Registry[DeviceFigures]):
    pass


#: Data sheets by name, for `Master.figures`.
FIGURES = _DataSheetRegistry("device", _data_sheets_by_name, DeviceFigures)
FIGURES["virtuose_6d"] = dataclasses.replace(
    FIGURES["virtuose_6d"], inertia=5e-3, friction_torque=0.03, peak_torque=[3.1] * 3
)


@settings
@dataclass
class Master:
    """Settings of the haptic device, with its start position."""

    model: str = choice(
        PHANTOM_NAME, (PHANTOM_NAME, "custom", LEADER_NAME),
        "haptic device; custom: defined by `figures`; leader: by `leader`", FIGURES,
    )  # fmt: skip
    position: list[float] = quantity(
        [0.27, 0.0, 0.03], "m", -0.5, 0.5, "p_BE of the stylus at the start, in the base frame B"
    )
    friction: PhantomJointFriction = field(default_factory=PhantomJointFriction)
    figures: DeviceFigures | None = plain(
        None, "data sheet that replaces that of `model`; null: not replaced"
    )
    leader: Leader | None = None

    def device(self, hand_mass: float, hand_inertia: float) -> HapticDevice | LeaderDevice:
        """Return the device with the hand's mass [kg] and inertia about each axis at E [kg m^2]."""
        if self.leader is not None:
            return self.leader.device(self.position, hand_mass, hand_inertia)
        pack = partial(pack_device_parameters, hand_mass=hand_mass, hand_inertia=hand_inertia)
        if self.model == PHANTOM_NAME:
            parameters = pack(
                peak_force=PEAK_FORCE_N,
                peak_torque=PEAK_WRIST_TORQUES_N_M,
                dry_friction=self.friction.coulomb,
                damping=self.friction.viscous,
            )
            return HapticDevice(parameters, self.model)
        sheet = self._data_sheet()
        parameters = pack(
            peak_force=sheet.peak_force,
            peak_torque=sheet.peak_torque,
            dry_friction=np.repeat([sheet.friction, sheet.friction_torque], 3),
            damping=np.repeat([sheet.damping, sheet.turning_damping], 3),
            in_task_space=True,
            mass=sheet.apparent_mass,
            inertia=sheet.inertia,
            workspace_centre=sheet.centre,
            half_workspace=0.5 * np.array(sheet.size),
            max_rotation=sheet.turn,
        )
        return HapticDevice(parameters, self.model)

    @property
    def is_joint_leader(self) -> bool:
        return self.leader is not None and self.leader.leads == LEADER_JOINT_MODE

    def check_pose_mode(self, caller: str) -> None:
        """Raise DrakeTeleopError, which names `caller`, if a leader arm commands joints."""
        if self.is_joint_leader:
            what = f"{caller} cannot use a leader arm that commands joints"
            remedy = "set it to pose; the rendered force is the same"
            raise DrakeTeleopError(what, where="master.leader.leads", remedy=remedy)

    def encoder_steps(self) -> Array:
        """Return the encoder steps (6,), three [m] and three [rad]; 0 for an exact reading."""
        figures = self._data_sheet()
        return np.repeat([figures.resolution, figures.turn_resolution], 3)

    def sampling_period_if_slower_than_hand(self, hand_hz: float) -> float | None:
        """Return the device's sampling period [s] if its rate is below `hand_hz`, else None."""
        rate = self._data_sheet().rate_hz
        return 1 / rate if 0.0 < rate < hand_hz else None

    def without_coulomb_friction_and_encoder_steps(self) -> "Master":
        if self.model == PHANTOM_NAME:
            friction = dataclasses.replace(self.friction, coulomb=[0.0] * 6)
            return dataclasses.replace(self, friction=friction)
        if self.leader is not None:
            return dataclasses.replace(self, leader=dataclasses.replace(self.leader, friction=[]))
        names = ("friction", "friction_torque", "resolution", "turn_resolution")
        exact: Any = dict.fromkeys(names, 0.0)
        figures = dataclasses.replace(self._data_sheet(), **exact)
        return dataclasses.replace(self, figures=figures)

    def _data_sheet(self) -> DeviceFigures:
        return self.figures or FIGURES.get(self.model, DeviceFigures())

    def check(self, where: str) -> None:
        if self.model in (PHANTOM_NAME, LEADER_NAME) and self.figures is not None:
            what = f"model '{self.model}' has its own dynamics and accepts no data sheet"
            remedy = "leave figures out, or choose another model, such as custom"
            raise DrakeTeleopError(what, where=f"{where}.figures", remedy=remedy)
        if self.model != PHANTOM_NAME and self.friction != PhantomJointFriction():
            what = f"only the Phantom accepts joint friction, not model '{self.model}'"
            remedy = "leave friction out, and set figures.friction and figures.damping"
            raise DrakeTeleopError(what, where=f"{where}.friction", remedy=remedy)
        if (self.leader is None) == (self.model == LEADER_NAME):
            word = "without" if self.leader is None else "with"
            what = f"model: {self.model} {word} a block leader is invalid"
            remedy = "set model: leader and a block leader with file and hand_frame, or neither"
            raise DrakeTeleopError(what, where=f"{where}.leader", remedy=remedy)
        if self.leader is not None:
            self.leader.check(f"{where}.leader")
        if self.figures is not None and self.figures.turn[1] > _MAX_DEVICE_PITCH_RAD:
            turn, remedy = self.figures.turn[1], f"choose at most {_MAX_DEVICE_PITCH_RAD:g} rad"
            what = f"a pitch of {turn:g} rad is near 90 degrees, where yaw and roll are parallel"
            raise DrakeTeleopError(what, where=f"{where}.figures.turn", remedy=remedy)
