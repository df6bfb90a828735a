"""3D replay of a simulation: `replay.html` of a run and the command `drake-teleop replay`."""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Meshcat, Rgba, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, ModelInstanceIndex, RigidBody

from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, contact_spans
from drake_teleop.common.style import BLUE, VERMILION
from drake_teleop.station import replay_file
from drake_teleop.station.master.data_sheets import PHANTOM_NAME
from drake_teleop.station.master.phantom import serial_joint_angles
from drake_teleop.station.replay_file import ForceArrow
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario
from drake_teleop.station.signals import MOVING_BODY_POSE_PREFIX
from drake_teleop.station.slave import surroundings
from drake_teleop.station.slave.chain_joints import AddSkeleton
from drake_teleop.station.slave.plant import (
    NominalSlave,
    ParseSlave,
    finalize_without_limit_warnings,
)

Signals = Mapping[str, Array]
_ReplayDevice = tuple[ModelInstanceIndex, Callable[[Array], Array], Frame, Array]
"""Haptic device in the plant: instance, function from logged joint positions to the plant's, frame
of the stylus, and the point (3,) [m] in it that the hand holds."""

_TABLE_HEIGHT_M = 0.60
# Origin of the haptic device's base frame B in W [m].
_MASTER_BASE_POSITION_M = np.array([1.15, -0.10, _TABLE_HEIGHT_M + 0.28])  # 0.28 m above foot
_CAMERA_P_W, _CAMERA_TARGET_W = np.array([0.80, -1.15, 0.92]), np.array([0.70, 0.0, 0.50])
_CAMERA_SHIFT_WITHOUT_DEVICE_W_M = np.array([-0.3, 0.0, 0.0])  # of camera and target
_FLOOR_COLOUR = Rgba(0.93, 0.94, 0.95)
_WOOD_COLOUR = Rgba(0.78, 0.66, 0.50)
_STEEL_COLOUR = Rgba(0.40, 0.43, 0.47)
_HAND_GRIP_POSITION_M = np.array([0.09, 0.0, 0.0])  # in E, where the hand holds the stylus
_SLAVE_WRIST_POSITION_M = np.array([0.0, 0.0, -0.085])  # in S, wrist of the arm
# Arrows inside arm and tool would be hidden.
_WRIST_ARROW_OFFSET_W_M = np.array([0.07, -0.09, 0.0])
_TIP_ARROW_OFFSET_W_M = np.array([-0.06, 0.0, 0.0])

# Required signals, and signals that are shown if they were recorded.
_REQUIRED_SIGNALS = ("slave_state", "measured_wrench_S", "load_estimate")
_OPTIONAL_SIGNALS = ("master_state", "contact_wrench_S", "force_to_master", "sheet_state")


def replay_command(
    run: Path, out: Path, *, scenario: str | Path | None = None, quiet: bool = False
) -> dict[str, Any]:
    """Write a 3D replay for each log, and summary.json with their paths; return the summary.

    Args:
        run: folder written by `run` or `reproduce`, or a log in it.
        out: output folder: replay.html, or one file per log for several logs.
        scenario: shipped scenario or YAML file; by default the YAML file beside the log.
    """
    logs = _find_logs_of_run(run)
    for folder in {run, *(log.parent for log in logs)}:
        files.refuse_to_replace_inputs(out / "summary.json", folder / "summary.json")
    films = []
    with files.output_folder(out):
        for log in logs:
            path = out / ("replay.html" if len(logs) == 1 else f"{log.stem}.html")
            result = SimulationResult.scan_parquet(log)
            write_replay(path, result, LoadScenario(scenario or _find_scenario_file_of_log(log)))
            films.append({"log": str(log), "film": str(path), "duration_s": float(result.t[-1])})
            if not quiet:
                print(f"written {path} ({path.stat().st_size / 1e6:.1f} MB): open it in a browser")
        files.write_json(out / "summary.json", {"films": films})
    return {"films": films}


def write_replay(
    path: Path, result: SimulationResult, scenario: Scenario, *, slow_motion: float | None = None
) -> None:
    """Write the replay of a run to an HTML file.

    `slow_motion` is the initial factor, seconds of replay per second of the run; by default the
    replay lasts at least 6 s, with a factor of at most 100.

    Raises:
        DrakeTeleopError: for a log without a required signal, or of another arm or device.
    """
    missing = [name for name in _REQUIRED_SIGNALS if name not in result]
    if missing or not len(result.t):
        what = f"a replay cannot be made: the log contains no {', '.join(missing) or 'samples'}"
        remedy = "give the log of a station with a simulated slave"
        if not missing:
            remedy = "increase simulation.duration or rates.log_hz, or reduce simulation.settle"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    arms = NominalSlave(scenario.slave).arm, scenario.master.device(0.0, 0.0)
    for name, arm in zip(("slave_state", "master_state"), arms, strict=True):
        found = len(result.units.get(name, ())) // 2
        if name in result and found != arm.num_joints:
            what = f"{name} has {found} joints, but the scenario's arm or device {arm.num_joints}"
            raise DrakeTeleopError(what, where=str(path), remedy="give the scenario of this log")
    start, stop = float(result.t[0]), float(result.t[-1])
    times, slow_motion = replay_file.frame_times(start, stop, slow_motion)
    rows = np.searchsorted((result.t[1:] + result.t[:-1]) / 2, times)  # nearest in time
    # Read each signal of a log on disk once, and keep only the displayed rows.
    moving = [name for name in result.signals if name.startswith(MOVING_BODY_POSE_PREFIX)]
    shown = [name for name in (*_REQUIRED_SIGNALS, *_OPTIONAL_SIGNALS, *moving) if name in result]
    signals = {name: result[name][rows] for name in shown}
    contact = np.zeros(len(result.t), dtype=bool)
    if "true_contact_wrench_W" in result:
        contact = np.any(result["true_contact_wrench_W"] != 0, axis=1)
    film = replay_file.ReplayFile(
        scenario.description or "A run of the station",
        times,
        slow_motion,
        displayed_numbers=_force_magnitudes_for_page(signals),
        shaded_spans=contact_spans(result.t, contact),
        notes=("Arrows: 3 mm per newton of the force at the slave.",),
        curves_label="forces, 0 to {top} N" + ("; contact shaded" if contact.any() else ""),
    )

    def make_scene(meshcat: Meshcat) -> replay_file.ShowFrame:
        scene = ReplayScene(meshcat, scenario, signals)
        return lambda replay_time, frame: scene.show_sample(replay_time, signals, frame)

    film.write(path, make_scene)


def _force_magnitudes_for_page(signals: Signals) -> list[replay_file.DisplayedNumber]:
    measured = signals["measured_wrench_S"][:, :3] - signals["load_estimate"][:, :3]
    forces = [("Measured at the wrist", measured, BLUE)]
    if "contact_wrench_S" in signals:
        forces.append(("Contact, calculated", signals["contact_wrench_S"][:, :3], VERMILION))
    if "force_to_master" in signals:
        forces.append(("Shown to the hand", signals["force_to_master"][:, :3], ""))
    return [
        replay_file.DisplayedNumber(name, "N", np.linalg.norm(f, axis=1), colour, colour != "")
        for name, f, colour in forces
    ]


def _find_logs_of_run(run: Path) -> list[Path]:
    if not os.path.exists(run):
        what = "there is no such file or folder"
        raise DrakeTeleopError(what, where=str(run), remedy="give the folder of a run")
    if run.suffix == ".parquet":
        return [run]
    if (run / "log.parquet").exists():
        return [run / "log.parquet"]
    logs = sorted(log for log in run.glob("logs/*.parquet") if log.with_suffix(".yaml").exists())
    if not logs:
        remedy = "give a folder from drake-teleop run or reproduce, or a log.parquet; a study"
        remedy = f"{remedy} stores measures only: run one of its points as a scenario"
        raise DrakeTeleopError("the folder contains no log of a run", where=str(run), remedy=remedy)
    return logs


def _find_scenario_file_of_log(log: Path) -> Path:
    for path in (log.with_suffix(".yaml"), log.parent / "scenario.yaml"):
        if path.exists():
            return path
    remedy = "give --scenario, a shipped one or a YAML file"
    raise DrakeTeleopError("this log has no scenario file beside it", where=str(log), remedy=remedy)


class ReplayScene:
    """3D scene of a replay in Meshcat, which shows one sample of a log at a time.

    Its `plant` contains slave, surroundings and haptic device, for shapes and kinematics only.
    """

    def __init__(self, meshcat: Meshcat, scenario: Scenario, recorded: Container[str]) -> None:
        self.canvas: Any = meshcat  # or an object with its SetTransform and SetProperty
        self.plant, self._shapes = MultibodyPlant(time_step=0.0), SceneGraph()
        self.plant.RegisterAsSourceForSceneGraph(self._shapes)
        self._parsed = ParseSlave(self.plant, scenario.slave)
        self._slave, self._sensor = self._parsed.instance, self._parsed.sensor_frame
        nominal = NominalSlave(scenario.slave)
        self._joints, self._tip = nominal.arm.num_joints, nominal.tip
        AddSkeleton(self.plant, self._sensor)
        touched = surroundings.AddedEnvironment([], None)
        if scenario.surroundings is not None:
            touched = surroundings.AddEnvironment(self.plant, scenario.surroundings)
        self._sheet = touched.leaf_instance
        self._device = None
        if "master_state" in recorded:
            self._device = _add_haptic_device(self.plant, scenario)
        finalize_without_limit_warnings(self.plant)
        self._moving_bodies = {
            MOVING_BODY_POSE_PREFIX + k: body
            for k, body in surroundings.MovingBodiesExceptLeaf(self.plant, touched).items()
        }
        self.context = self.plant.CreateDefaultContext()
        self._bodies = dict(self._draw_bodies_and_yield_moving_ones(meshcat))
        _draw_room_and_set_camera(meshcat, scenario, with_table=self._device is not None)
        # The replay shows the device's base parallel to W, for any alignment in the run.
        self._R_BW = scenario.kinematic_scaling.R_WB.T
        arrows = (("measured", "wrist", BLUE), ("contact", "tip", VERMILION))
        self._arrows = [
            (force, place, ForceArrow(meshcat, f"{force}_at_{place}", colour))
            for force, at_slave, colour in arrows
            if f"{force}_wrench_S" in recorded
            for place in ((at_slave,) if self._device is None else (at_slave, "stylus"))
        ]

    def _draw_bodies_and_yield_moving_ones(
        self, meshcat: Meshcat
    ) -> Iterator[tuple[str, RigidBody]]:
        plant, inspector = self.plant, self._shapes.model_inspector()
        for body in (plant.get_body(BodyIndex(k)) for k in range(plant.num_bodies())):
            path = f"/station/{int(body.index())}_{body.name()}"
            shapes = plant.GetVisualGeometriesForBody(body)
            replay_file.add_shapes(meshcat, path, inspector, shapes)
            if shapes and plant.IsAnchored(body):
                meshcat.SetTransform(path, plant.EvalBodyPoseInWorld(self.context, body))
            elif shapes:
                yield path, body

    def show_sample(self, replay_time: float, signals: Signals, sample: int) -> None:
        """Show row `sample` of the signals in the scene at `replay_time` [s] of the replay."""
        plant, context = self.plant, self.context
        plant.SetPositions(context, self._slave, signals["slave_state"][sample, : self._joints])
        if self._device is not None:
            instance, to_plant_positions, *_ = self._device
            state = signals["master_state"][sample]
            plant.SetPositions(context, instance, to_plant_positions(state[: len(state) // 2]))
        if self._sheet is not None and "sheet_state" in signals:
            plant.SetPositions(context, self._sheet, signals["sheet_state"][sample, :1])
        for name, body in self._moving_bodies.items():
            if name in signals:
                self._set_body_pose(body, signals[name][sample])
        for path, body in self._bodies.items():
            self.canvas.SetTransform(path, plant.EvalBodyPoseInWorld(context, body), replay_time)
        if self._arrows:
            self._show_force_arrows(replay_time, signals, sample)

    def _show_force_arrows(self, replay_time: float, signals: Signals, sample: int) -> None:
        X_WS = self._sensor.CalcPoseInWorld(self.context)
        places = {
            "wrist": X_WS @ _SLAVE_WRIST_POSITION_M + _WRIST_ARROW_OFFSET_W_M,
            "tip": X_WS @ self._tip + _TIP_ARROW_OFFSET_W_M,
        }
        if self._device is not None:
            *_, hand, grip = self._device
            places["stylus"] = hand.CalcPoseInWorld(self.context) @ grip
        for force, place, arrow in self._arrows:
            f_S = signals[f"{force}_wrench_S"][sample, :3]
            if force == "measured":
                f_S = f_S - signals["load_estimate"][sample, :3]
            f_W = -X_WS.rotation().matrix() @ f_S
            f_W = self._R_BW @ f_W if place == "stylus" else f_W
            arrow.show_force(self.canvas, replay_time, places[place], f_W)

    def _set_body_pose(self, index: BodyIndex, pose: Array) -> None:
        joints = map(self.plant.get_joint, self.plant.GetJointIndices())
        (joint,) = (joint for joint in joints if joint.child_body().index() == index)
        X_WBody = RigidTransform(Quaternion(pose[:4] / np.linalg.norm(pose[:4])), pose[4:])
        X_WJp = joint.frame_on_parent().CalcPoseInWorld(self.context)
        X_BodyJc = joint.frame_on_child().GetFixedPoseInBodyFrame()
        q, first = self.plant.GetPositions(self.context), joint.position_start()
        moved = surroundings.joint_positions_of_pose(joint, X_WJp.inverse() @ X_WBody @ X_BodyJc)
        q[first : first + joint.num_positions()] = moved
        self.plant.SetPositions(self.context, q)


def _add_haptic_device(plant: MultibodyPlant, scenario: Scenario) -> _ReplayDevice:
    if (leader := scenario.master.leader) is not None:
        order = np.argsort(leader.device([0.0, 0.0, 0.0], 0.0, 0.0).arm.position_index)
        on_table = RigidTransform([*_MASTER_BASE_POSITION_M[:2], _TABLE_HEIGHT_M])
        arm = leader.add_to_plant(plant, on_table)
        return arm.instance, lambda q: q[order], arm.sensor_frame, np.zeros(3)
    is_phantom = scenario.master.model == PHANTOM_NAME
    name = "phantom" if is_phantom else "grip"
    (master,) = Parser(plant, "master").AddModels(str(files.models_dir() / f"{name}.sdf"))
    base = plant.GetFrameByName("base", master)
    plant.WeldFrames(plant.world_frame(), base, RigidTransform(_MASTER_BASE_POSITION_M))
    to_plant_positions = serial_joint_angles if is_phantom else np.copy
    return master, to_plant_positions, plant.GetFrameByName("stylus", master), _HAND_GRIP_POSITION_M


def _draw_room_and_set_camera(meshcat: Meshcat, scenario: Scenario, *, with_table: bool) -> None:
    def draw_box(name: str, size: tuple[float, ...], centre: tuple[float, ...], colour: Rgba):
        meshcat.SetObject(f"/room/{name}", Box(size), colour)
        meshcat.SetTransform(f"/room/{name}", RigidTransform(np.array(centre)))

    draw_box("floor", (8.0, 8.0, 0.02), (0.6, 0.5, -0.011), _FLOOR_COLOUR)
    if with_table:
        x, y, _ = _MASTER_BASE_POSITION_M
        draw_box("table", (0.50, 0.60, 0.03), (x - 0.09, y, _TABLE_HEIGHT_M - 0.015), _WOOD_COLOUR)
        height = _TABLE_HEIGHT_M - 0.03
        for i, (dx, dy) in enumerate(((-0.31, -0.27), (-0.31, 0.27), (0.13, -0.27), (0.13, 0.27))):
            draw_box(f"leg_{i}", (0.04, 0.04, height), (x + dx, y + dy, height / 2), _STEEL_COLOUR)
    touched = scenario.surroundings
    for k, part in enumerate(() if touched is None else touched.parts):
        stand = part.floor_stand
        if stand is not None and stand.height > 0:
            size = stand.size_x, stand.size_y, stand.height
            centre = stand.centre_x, stand.centre_y, stand.height / 2
            draw_box(f"plinth_{k}" if k else "plinth", size, centre, _STEEL_COLOUR)
    replay_file.set_plain_background(meshcat)
    aside = np.zeros(3) if with_table else _CAMERA_SHIFT_WITHOUT_DEVICE_W_M
    meshcat.SetCameraPose(_CAMERA_P_W + aside, _CAMERA_TARGET_W + aside)
