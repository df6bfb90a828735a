"""A simulation as a film: one HTML file with Meshcat in it, to be opened in any browser.

The slave at its bench, the haptic device on a table beside it, and forces as arrows. Blue at the
stylus: what the wrist sensor measures, which is what the hand would feel. Orange at the stylus and
at the tool's tip: the calculated contact force. All are drawn in the size that they have at the
slave, 4 mm a newton.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Cylinder,
    Meshcat,
    MeshcatAnimation,
    MeshcatCone,
    MeshcatParams,
    MeshcatVisualizer,
    Rgba,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_teleop.master.phantom import serial_joint_angles
from drake_teleop.resources import models_dir
from drake_teleop.result import SimulationResult
from drake_teleop.scenario import Scenario
from drake_teleop.slave.plant import AddEnvironment, ParseSlave, finalize

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 50

_TABLE_TOP = 0.60
# Where the haptic device stands: origin of its base frame B in W [m].
_P_WB = np.array([1.15, -0.10, _TABLE_TOP + 0.28])  # the device's foot is 0.28 m below B
_CAMERA, _TARGET = (0.80, -1.25, 0.95), (0.72, 0.0, 0.56)

_FLOOR, _WOOD, _STEEL = Rgba(0.93, 0.94, 0.95), Rgba(0.78, 0.66, 0.50), Rgba(0.40, 0.43, 0.47)
_MEASURED, _CONTACT = Rgba(0.0, 0.447, 0.698), Rgba(0.835, 0.369, 0.0)
_METRES_PER_NEWTON = 0.004
_GRIP_E = np.array([0.09, 0.0, 0.0])  # where the hand holds the stylus
_BESIDE_TIP_W = np.array([-0.06, 0.0, 0.0])  # at the tip itself the tool would hide the arrow
_SHAFT, _HEAD = 0.006, 0.03  # radius of an arrow's shaft, length of its head [m]


def write_replay(
    path: Path, result: SimulationResult, scenario: Scenario, *, slow_motion: float = 1.0
) -> None:
    """Writes the film of a teleoperation run.

    Args:
        path: of the HTML file.
        result: with slave_state, master_state, contact_wrench_S, measured_wrench_S, load_estimate
            and, with a sheet spring, sheet_state.
        scenario: that was run.
        slow_motion: seconds of the film for one second of the run.
    """
    # Meshcat may be destroyed by no other thread than the one that made it, and Drake's objects
    # hold on to each other until the garbage collector comes, in whichever thread: it comes here.
    collects = gc.isenabled()
    gc.disable()
    try:
        path.write_text(_film(result, scenario, slow_motion), encoding="utf-8")
        gc.collect()
    finally:
        if collects:
            gc.enable()


def _film(result: SimulationResult, scenario: Scenario, slow_motion: float) -> str:
    with _quiet_drake():  # nobody is to connect to its server
        meshcat = Meshcat(MeshcatParams(host="localhost"))
    scene = ReplayScene(meshcat, scenario)
    meshcat.StartRecording(FRAMES_PER_SECOND, set_visualizations_while_recording=False)
    span = result.t[-1] - result.t[0]
    for frame in range(int(span * slow_motion * FRAMES_PER_SECOND) + 1):
        film_time = frame / FRAMES_PER_SECOND
        instant = result.t[0] + film_time / slow_motion
        scene.show(film_time, result, int(np.argmin(np.abs(result.t - instant))))
    meshcat.StopRecording()
    meshcat.get_mutable_recording().set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    meshcat.PublishRecording()
    return meshcat.StaticHtml()


@contextmanager
def _quiet_drake() -> Iterator[None]:
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


class ReplayScene:
    """Everything that is seen in a replay; shows one sample after the other.

    Attributes:
        plant: slave, what it touches and haptic device, for their shapes and kinematics only.
        context: of the plant, in the posture that was shown last.
    """

    def __init__(self, meshcat: Meshcat, scenario: Scenario) -> None:
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        self._slave, _ = ParseSlave(self.plant)
        self._sheet = None
        if scenario.environment is not None:
            touched = AddEnvironment(self.plant, scenario.environment)
            self._sheet = None if scenario.environment.moving_part is None else touched
        self._master = _add_master(self.plant)
        finalize(self.plant)
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        self._diagram: Diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self._root)
        _furnish(meshcat, scenario)
        # The device's base stands along the world's axes here, whatever its alignment in the run.
        alignment = RollPitchYaw(scenario.kinematic_scaling.alignment)
        self._R_BW = alignment.ToRotationMatrix().inverse().matrix()
        self._felt = _Arrow(meshcat, "measured_at_stylus", _MEASURED)
        self._contact = _Arrow(meshcat, "contact_at_stylus", _CONTACT)
        self._touch = _Arrow(meshcat, "contact_at_tip", _CONTACT)

    def show(self, film_time: float, result: SimulationResult, sample: int) -> None:
        """Shows a sample (its index) of a run, at a time of the film [s]."""
        self._root.SetTime(film_time)
        plant, context = self.plant, self.context
        master = serial_joint_angles(result["master_state"][sample, :6])
        plant.SetPositions(context, self._slave, result["slave_state"][sample, :6])
        plant.SetPositions(context, self._master, master)
        if self._sheet is not None:
            plant.SetPositions(context, self._sheet, result["sheet_state"][sample, :1])
        self._diagram.ForcedPublish(self._root)
        # Eq. (1) is what the sensor exerts on the load: the arrows show what the load exerts.
        R_WS = plant.GetFrameByName("sensor").CalcPoseInWorld(context).rotation().matrix()
        measured = result["measured_wrench_S"][sample, :3] - result["load_estimate"][sample, :3]
        measured, contact = -R_WS @ measured, -R_WS @ result["contact_wrench_S"][sample, :3]
        pen = plant.GetFrameByName("stylus").CalcPoseInWorld(context) @ _GRIP_E
        tip = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
        self._felt.show(film_time, pen, self._R_BW @ measured)
        self._contact.show(film_time, pen, self._R_BW @ contact)
        self._touch.show(film_time, tip + _BESIDE_TIP_W, contact)


class _Arrow:
    """A force at a place; its length follows the force."""

    def __init__(self, meshcat: Meshcat, name: str, colour: Rgba) -> None:
        self._meshcat, self._path = meshcat, f"/forces/{name}"
        meshcat.SetObject(f"{self._path}/shaft/scaled", Cylinder(_SHAFT, 1.0), colour)
        # The cone's tip is at its origin and it widens along its z axis.
        head = MeshcatCone(_HEAD, 0.4 * _HEAD, 0.4 * _HEAD)
        meshcat.SetObject(f"{self._path}/head/scaled", head, colour)

    def show(self, film_time: float, place: Array, force: Array) -> None:
        length = _METRES_PER_NEWTON * float(np.linalg.norm(force))
        shaft = max(length - _HEAD, 1e-3)
        along = RotationMatrix.MakeFromOneVector(force, 2) if length > 0 else RotationMatrix()
        R = along.matrix()
        middle, tip = place + 0.5 * shaft * R[:, 2], place + (shaft + _HEAD) * R[:, 2]
        back = along @ RotationMatrix.MakeXRotation(np.pi)
        put = self._meshcat.SetTransform
        put(f"{self._path}/shaft", RigidTransform(along, middle), film_time)
        put(f"{self._path}/head", RigidTransform(back, tip), film_time)
        scale = self._meshcat.SetProperty
        size = min(1.0, length / _HEAD)
        scale(f"{self._path}/shaft/scaled", "scale", [size, size, shaft], film_time)
        scale(f"{self._path}/head/scaled", "scale", [size, size, size], film_time)


def _add_master(plant: MultibodyPlant) -> ModelInstanceIndex:
    (master,) = Parser(plant, "master").AddModels(str(models_dir() / "phantom.sdf"))
    base = plant.GetFrameByName("base", master)
    plant.WeldFrames(plant.world_frame(), base, RigidTransform(_P_WB))
    return master


def _furnish(meshcat: Meshcat, scenario: Scenario) -> None:
    """Floor, table, the plinth below what is touched, light and camera."""

    def box(name: str, size: tuple[float, float, float], centre: tuple[float, ...], colour: Rgba):
        meshcat.SetObject(f"/room/{name}", Box(*size), colour)
        meshcat.SetTransform(f"/room/{name}", RigidTransform(np.array(centre)))

    box("floor", (8.0, 8.0, 0.02), (0.6, 0.5, -0.011), _FLOOR)
    x, y, _ = _P_WB
    box("table", (0.50, 0.60, 0.03), (x - 0.09, y, _TABLE_TOP - 0.015), _WOOD)
    height = _TABLE_TOP - 0.03
    for i, (dx, dy) in enumerate(((-0.31, -0.27), (-0.31, 0.27), (0.13, -0.27), (0.13, 0.27))):
        box(f"leg_{i}", (0.04, 0.04, height), (x + dx, y + dy, height / 2), _STEEL)
    stand = None if scenario.environment is None else scenario.environment.stand
    if stand is not None and stand.height > 0:
        size, centre = (stand.along_x, stand.along_y, stand.height), (stand.x, stand.y)
        box("plinth", size, (*centre, stand.height / 2), _STEEL)
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.97, 0.98, 1.0])
    meshcat.SetProperty("/Background", "bottom_color", [0.86, 0.89, 0.93])
    meshcat.SetCameraPose(_CAMERA, _TARGET)
