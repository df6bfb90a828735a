"""Presets of wrist sensors by name."""

from __future__ import annotations

from typing import Any

from drake_teleop.common.registry import Presets
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig

# The IMU of the ATI record, with the low-pass before the noise.
_ATI_IMU_SETTINGS: dict[str, Any] = {
    "p_SoAo_S": [0.0, 0.0, 0.05],
    "low_pass": "before_noise",
    "bandwidth_hz": 300.0,
    "acceleration_noise": 0.053,
    "angular_acceleration_noise": 0.3,
    "angular_acceleration_walk": 0.0,
    "acceleration_range": 78.5,
    "acceleration_latency": 6e-3,
}

# Ranges of fx and fy, fz, tx and ty, tz; noise of force and torque; resolution.
_RANGES_AND_NOISE = {
    "ati_mini45": (290.0, 580.0, 10.0, 10.0, 0.06, 1.5e-3, 4.3e-4),
    "bota_sensone": (500.0, 1200.0, 15.0, 12.0, 0.15, 3e-3, 1e-5),
    "bota_rokubi": (500.0, 1000.0, 10.0, 10.0, 0.2, 4e-3, 1e-5),
    "robotiq_ft300": (300.0, 300.0, 30.0, 30.0, 0.1, 5e-3, 1e-5),
    "onrobot_hex_e": (200.0, 200.0, 10.0, 6.5, 0.2, 5e-3, 1e-4),
    "ur5e_built_in": (50.0, 50.0, 10.0, 10.0, 1.2, 0.07, 1e-4),
    "franka_estimated": (100.0, 100.0, 20.0, 20.0, 0.035, 5e-3, 1e-5),
}
_EXTRA_FIELDS_OF_PRESET: dict[str, dict[str, Any]] = {
    "bota_sensone": dict(acceleration_latency=0.0, p_SoAo_S=[0.0, 0.0, 0.018]),
    "bota_rokubi": dict(acceleration_latency=0.0, p_SoAo_S=[0.0, 0.0, 0.015]),
    "robotiq_ft300": dict(bandwidth_hz=40.0, force_latency=5e-3),
    "onrobot_hex_e": dict(
        bandwidth_hz=150.0, force_walk=0.05, torque_walk=5e-4, force_latency=4e-3
    ),
    "ur5e_built_in": dict(bandwidth_hz=100.0, force_walk=0.1, torque_walk=5e-3, force_latency=4e-3),
    "franka_estimated": dict(bandwidth_hz=30.0, force_walk=0.2, torque_walk=0.02)
    | dict(gain_error=0.05, cross_talk=0.03, force_latency=2e-3),
}

_presets = {
    "ideal": WristSensorConfig(ideal=True),
    "jr3_85m35a3": WristSensorConfig(),
    "ati_gamma_imu": WristSensorConfig(
        **_ATI_IMU_SETTINGS,
        R_SA=[0.0, -1.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0],
        force_noise=0.018,
        torque_noise=9e-4,
        offset=[9.08, -1.02, 9.98, 0.433, -0.692, -0.157],
        acceleration_offset=[-0.036, 0.086, 0.757, 0.0, 0.0, 0.0],
        resolution=3.05e-5,
        force_range=[130.0, 130.0, 400.0],
        torque_range=[10.0, 10.0, 10.0],
    ),
    **{
        name: WristSensorConfig(
            **_ATI_IMU_SETTINGS
            | {"force_range": [side, side, along], "torque_range": [bending, bending, twist]}
            | {"force_noise": force, "torque_noise": torque, "resolution": step}
            | _EXTRA_FIELDS_OF_PRESET.get(name, {})
        )
        for name, (side, along, bending, twist, force, torque, step) in _RANGES_AND_NOISE.items()
    },
}
PRESETS = Presets(_presets)
"""Sensors by name; the sources of their values are in docs/sensor.md, "The presets"."""
