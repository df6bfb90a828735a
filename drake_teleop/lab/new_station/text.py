"""Text of a new station's scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drake_teleop.common.texts import to_yaml_text
from drake_teleop.lab.new_station.plan import SWING_HZ, WALL_STIFFNESS_N_M, StationPlan
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.scenario import Rates


def scenario_text(
    plan: StationPlan, slave: dict[str, Any], tool: str | None, device: str, sensor: str | None
) -> str:
    """Return the commented scenario; `slave` contains model, packages and sensor frame.

    Args:
        tool: path of the tool's file, if given.
        sensor: preset of the wrist sensor, or None.
    """
    s, swing = plan.translation_scale, plan.swing_amplitude_m
    down = 1.5 * swing + min(0.01, swing / 4.0)  # at most 10 mm into the wall
    if plan.place.is_set_by_position:
        slave["position"] = round_to_four_significant_digits(plan.place.position)
    else:
        slave["home"] = plan.place.home
    comments = {
        "slave.position": "sensor at the start, tool down [m]",
        "slave.home": "joints at the start, tool down [rad, m]",
        "slave.tip": "contact point, p_STip [m]",
        "slave.torque_limits": "the limits of the model cannot hold the arm",
        "kinematic_scaling": f"the arm can move {plan.place.reachable_text}",
        "force_scaling": "sigma 1 displays the whole load of the tool; force_scale: see analyze",
        "operator.intent": "hand motion: up and down, then down onto the wall",
        "rates": "rates of the device",
    }
    if tool is not None:
        slave["tool"] = {"model": tool}
    elif plan.stand_in_tool is None:
        slave["tool"], comments["slave.tool"] = None, "the bodies of the model beyond the sensor"
    else:
        slave["tool"] = {"mass": plan.stand_in_tool.mass, "com": plan.stand_in_tool.com}
        slave["tool"] |= {"shapes": [{"_tag": "!Ball"} | vars(plan.stand_in_tool.shapes[0])]}
        comments["slave.tool"] = "a stand-in: put model file or numbers of your tool here"
    if plan.weak_joints:
        slave["torque_limits"] = dict.fromkeys(plan.weak_joints, float("inf"))
    if plan.tip_S:
        slave["tip"] = round_to_four_significant_digits(plan.tip_S)
    up, press = (round_to_four_significant_digits([0.0, 0.0, z / s]) for z in (swing, -down))
    swing_motion = {"_tag": "!Sine", "t_start": 0.2, "duration": 2.6, "ramp": 0.5}
    swing_motion |= {"frequency": SWING_HZ, "translation": up}
    press_motion = {"_tag": "!MinimumJerk", "t_start": 3.2, "duration": 1.2, "translation": press}
    wall = wall_of_plan(plan)
    wall_data = {"_tag": "!Wall", "position": wall.position, "stiffness": wall.stiffness}
    wall_data |= {} if wall.size == Wall().size else {"size": wall.size}
    own = Master(model=device).sampling_period_if_slower_than_hand(Rates().hand_hz)
    names = ("hand_hz", "joint_control_hz")
    rates = {} if own is None else {"rates": dict.fromkeys(names, 1 / own)}
    data = {
        "description": f"{Path(slave['model']).stem} commanded by {device}",
        "simulation": {"duration": 5.0, "settle": 0.8},
        **rates,
        "slave": slave,
        "master": {"model": device},
        **({"wrist_sensor": {"preset": sensor}} if sensor else {}),
        "kinematic_scaling": {"translation_scale": s},
        "force_scaling": {"sigma": 0.0, "force_scale": plan.force_scale},
        "environment": [wall_data],
        "operator": {"grip": "medium", "intent": [swing_motion, press_motion]},
    }
    head = "Made by drake-teleop new. All fields and defaults: drake-teleop scenario station.yaml"
    return to_yaml_text(data, head=[head], comments=comments)


def wall_of_plan(plan: StationPlan) -> Wall:
    """Return the horizontal wall, 1.5 swing amplitudes below the lowest tool point."""
    x, y, z = plan.lowest_tool_point_W
    return Wall(
        position=round_to_four_significant_digits([x, y, z - 1.5 * plan.swing_amplitude_m]),
        size=[plan.place.wall_edge_m, plan.place.wall_edge_m],
        stiffness=WALL_STIFFNESS_N_M,
    )


def round_to_four_significant_digits(values: Any) -> list[float]:
    """Return numbers with four significant digits, for a file."""
    return [float(f"{value:.4g}") for value in values]
