"""Wrist sensors by name."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from drake_teleop.station.sensor.sensor_chain import WristSensorConfig


def _with_imu(
    side: float,
    along: float,
    bending: float,
    twist: float,
    force_noise: float,
    torque_noise: float,
    **others: Any,
) -> WristSensorConfig:
    """A sensor of wrenches beside which an IMU stands, that of the ATI's record.

    Args:
        side: range of fx and fy [N].
        along: of fz [N].
        bending: of tx and ty [N m].
        twist: of tz [N m].
        force_noise, torque_noise: white, 1 sigma of a sample [N, N m].
        **others: what else is not as `WristSensorConfig` has it.
    """
    figures: dict[str, Any] = {
        "p_SoAo_S": [0.0, 0.0, 0.05],
        "low_pass": "before_noise",
        "bandwidth_hz": 300.0,
        "acceleration_noise": 0.053,
        "angular_acceleration_noise": 0.3,
        "angular_acceleration_walk": 0.0,
        "acceleration_range": 78.5,
        "acceleration_latency": 6e-3,
        "force_range": [side, side, along],
        "torque_range": [bending, bending, twist],
        "force_noise": force_noise,
        "torque_noise": torque_noise,
    }
    return WristSensorConfig(**figures | others)


PRESETS: dict[str, WristSensorConfig] = {
    "ideal": WristSensorConfig(ideal=True),
    "jr3_85m35a3": WristSensorConfig(),
    "ati_gamma_imu": WristSensorConfig(
        p_SoAo_S=[0.0, 0.0, 0.05],
        R_SA=[0.0, -1.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0],
        low_pass="before_noise",
        bandwidth_hz=300.0,
        force_noise=0.018,
        torque_noise=9e-4,
        acceleration_noise=0.053,
        angular_acceleration_noise=0.3,
        angular_acceleration_walk=0.0,
        offset=[9.08, -1.02, 9.98, 0.433, -0.692, -0.157],
        acceleration_offset=[-0.036, 0.086, 0.757, 0.0, 0.0, 0.0],
        resolution=3.05e-5,
        force_range=[130.0, 130.0, 400.0],
        torque_range=[10.0, 10.0, 10.0],
        acceleration_range=78.5,
        angular_acceleration_range=500.0,
        acceleration_latency=6e-3,
    ),
    "ati_mini45": _with_imu(
        *(290.0, 580.0, 10.0, 10.0, 0.06, 1.5e-3),
        resolution=4.3e-4,
    ),
    "bota_sensone": _with_imu(
        *(500.0, 1200.0, 15.0, 12.0, 0.15, 3e-3),
        p_SoAo_S=[0.0, 0.0, 0.018],
        resolution=1e-5,
        acceleration_latency=0.0,
    ),
    "bota_rokubi": _with_imu(
        *(500.0, 1000.0, 10.0, 10.0, 0.2, 4e-3),
        p_SoAo_S=[0.0, 0.0, 0.015],
        resolution=1e-5,
        acceleration_latency=0.0,
    ),
    "robotiq_ft300": _with_imu(
        *(300.0, 300.0, 30.0, 30.0, 0.1, 5e-3),
        bandwidth_hz=40.0,
        resolution=1e-5,
        force_latency=5e-3,
    ),
    "onrobot_hex_e": _with_imu(
        *(200.0, 200.0, 10.0, 6.5, 0.2, 5e-3),
        bandwidth_hz=150.0,
        resolution=1e-4,
        force_walk=0.05,
        torque_walk=5e-4,
        force_latency=4e-3,
    ),
    "ur5e_built_in": _with_imu(
        *(50.0, 50.0, 10.0, 10.0, 1.2, 0.07),
        bandwidth_hz=100.0,
        resolution=1e-4,
        force_walk=0.1,
        torque_walk=5e-3,
        force_latency=4e-3,
    ),
    "franka_estimated": _with_imu(
        *(100.0, 100.0, 20.0, 20.0, 0.035, 5e-3),
        bandwidth_hz=30.0,
        resolution=1e-5,
        gain_error=0.05,
        cross_talk=0.03,
        force_walk=0.2,
        torque_walk=0.02,
        force_latency=2e-3,
    ),
}
"""Sensors by name.

jr3_85m35a3: JR3 85M35A3-I40-D 200N12, the paper's. Ranges of force and torque: its name and data
sheet. S lies on the flange, and the acceleration part in the middle of the housing, 35 mm high.
Noise, quantum, ranges of acceleration: estimates. Filter: one of those that can be selected. Drift:
0.5 N in 10 min, between the records of the ATI. Walks of force and torque: the Allan deviation at 1
to 2.5 s of a force sensor on a UR5 at rest (kkufieta/ur5_modeling_force_estimate, No10); of the
specific force: 0.2 mg at 30 s, what MEMS accelerometers have; of the angular acceleration: in the
ratio of the noises, as it is made of accelerometers a few centimetres apart. No latency: force and
acceleration go through the same converter, filter and line.

ati_gamma_imu: ATI Gamma with NetBox and MPU6886 IMU on an end effector, as recorded by A. Skrede
(doi 10.5281/zenodo.11075229). The white noise is what the record at rest has from one sample to the
next (Allan deviation at one sample, 698 Hz and 254 Hz; the standard deviation would count the arm's
vibration): force 0.018, 0.019, 0.018 N, torque 0.0012, 0.0010, 0.0003 N m, specific force 0.061,
0.060, 0.031 m/s^2, here their root mean squares. The spectrum of tz is white up to 349 Hz, so the
low-pass, 300 Hz for the mechanics (an estimate), stands before the noise. Offsets, axes of the IMU
and its lag of 6 ms: fits to the same records. Quantum and range of the IMU: steps of 2.44e-4 g in
its record, 16 bits of +-8 g. Ranges of the Gamma: SI-130-10, an estimate, as are the place of the
IMU and its angular acceleration: differences of a gyroscope's samples, without a walk. The record
at rest lasts 1 s: the other walks and the drift are those of the other preset.

The others: ranges are the makers' figures, recalled and not read again, and so are the noise of the
FT 300 and of Franka's estimate, and the quantum of the Mini45; all else is an estimate, and of the
offset the paper's. An IMU like the ATI's is thought to stand beside them, but in the Bota sensors,
which have one. `ur5e_built_in` and `franka_estimated` are what a robot says without a sensor of its
user's own: of the first the maker gives a precision of 3.5 N and 0.2 N m (here three deviations),
of the second an accuracy of 0.8 N, which depends on the posture: here errors of gain and
cross-talk, and a walk. Set `rates.sensor_hz` to the real one's rate: 7000 (ATI), 800 (Bota), 100
(Robotiq), 500 (OnRobot, UR), 1000 (Franka), and lower `bandwidth_hz` where that asks for it.
"""


def preset_of(block: Mapping[str, Any] | None) -> WristSensorConfig:
    """The defaults for a scenario's block `wrist_sensor`: those of the preset that it names.

    A name that is not known is left to the check of the loaded block.
    """
    name = (block or {}).get("preset")
    return copy.deepcopy(PRESETS.get(str(name), WristSensorConfig()))
