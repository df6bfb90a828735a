"""Is the wrist wrench equal to that of MuJoCo along the same motion?

For each arm the station runs in free motion. At each of the hand's sampling times MuJoCo, with its
own reader of the same URDF, gets joint positions, velocities and accelerations. Its inverse
dynamics
gives the wrench in the joint between the sensor's frame and the load: for the Panda its gripper,
for
the UR5 a tool with given inertia. All six components in S are compared with the output of the
station's ideal wrist sensor at that time.

    python benchmarks/mujoco_wrench.py [--arms panda,ur5] [--models DIR] [--json FILE]

It needs the extra `bench`: MuJoCo, and the models of example-robot-data (or --models, its robots).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from inverse_kinematics import described

from drake_teleop.lab.identification import true_load
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import MakeSimulator
from drake_teleop.station.slave.slave_config import Slave, Tool
from drake_teleop.station.station import GetBlock, MakeTeleopStation

_TOOL = Tool(mass=1.5, com=[0.01, -0.02, 0.06], inertia=[4e-3, 3e-4, -2e-4, 5e-3, 1e-4, 2e-3])
#: File and slave; the first arm carries the load of its model.
ARMS = {
    "panda": (
        "panda_description/urdf/panda.urdf",
        Slave(sensor_frame="panda_link8", position=[0.5, 0.0, 0.45], tool=None),
    ),
    "ur5": (
        "ur_description/urdf/ur5_robot.urdf",
        Slave(sensor_frame="tool0", position=[0.5, 0.1, 0.4], tool=_TOOL),
    ),
}
_TURNS = [0.2, -0.15, 0.3]  # rad, motion of the hand
_READ_BY_ITSELF = '<mujoco><compiler fusestatic="false" balanceinertia="false"/></mujoco>'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument(
        "--models", type=Path, default=described(), help="folder example-robot-data/robots"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    if arguments.models is None:
        raise SystemExit("no example-robot-data: install the extra bench, or give --models")
    rows = {}
    for arm in arguments.arms.split(","):
        file, slave = ARMS[arm]
        slave.model = str(arguments.models / file)
        rows[arm] = row = compare(slave)
        print(arm, *(f"{name} {value:.3g}" for name, value in row.items()), sep="\n  ")
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"mujoco": mujoco.__version__} | rows, indent=2) + "\n"
        )


def compare(slave: Slave) -> dict[str, float]:
    """Return the largest differences over a second of 3 Hz, and the largest values."""
    scenario = _moving(slave)
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    context = simulator.get_mutable_context()
    plant, sensor = (GetBlock(station, name) for name in ("slave_plant", "wrist_sensor"))
    of_plant, of_sensor = (block.GetMyContextFromRoot(context) for block in (plant, sensor))
    twin = Twin(slave)
    names = [
        plant.get_joint(k).name()
        for k in plant.GetJointIndices(plant.GetModelInstanceByName("arm"))
    ]
    joints = [name for name in names if plant.GetJointByName(name).num_velocities()]
    ours, theirs = [], []
    period = 1 / scenario.rates.hand_hz
    for k in range(1, round(scenario.simulation.duration / period)):
        simulator.AdvanceTo(k * period)
        q, v = np.split(plant.GetPositionsAndVelocities(of_plant), 2)
        vdot = plant.get_generalized_acceleration_output_port().Eval(of_plant)
        simulator.AdvancePendingEvents()  # the sensor's sample of this instant
        ours.append(of_sensor.get_discrete_state_vector().value()[:6].copy())
        theirs.append(twin.wrench(joints, q, v, vdot))
    ours, theirs = np.array(ours), np.array(theirs)
    off = np.abs(ours - theirs).max(axis=0)
    swing = np.ptp(ours, axis=0)
    return {
        "samples": len(ours),
        "force_off_N": off[:3].max(), "torque_off_Nm": off[3:].max(),
        "force_moves_N": swing[:3].max(), "torque_moves_Nm": swing[3:].max(),
    }  # fmt: skip


def _moving(slave: Slave) -> Scenario:
    return replace(
        LoadScenario("free_motion_force"),
        slave=slave,
        wrist_sensor__ideal=True,
        simulation__settle=0.0,
        simulation__duration=1.0,
        operator__intent=[
            Sine(
                duration=10.0,
                ramp=0.1,
                frequency=3.0,
                translation=[0.01, 0.01, 0.02],
                rotation=_TURNS,
            )
        ],
    )


class Twin:
    """The same arm in MuJoCo, from the same file.

    Args:
        slave: with a URDF, whose shapes are ignored, and the load on its sensor frame.
    """

    def __init__(self, slave: Slave) -> None:
        root = ElementTree.parse(slave.path).getroot()
        for link in root.iter("link"):
            for shape in [*link.findall("visual"), *link.findall("collision")]:
                link.remove(shape)
        root.append(ElementTree.fromstring(_READ_BY_ITSELF))
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        if slave.tool is not None:
            tool, c = slave.tool, slave.tool.com
            xx, xy, xz, yy, yz, zz = tool.inertia
            spec.body(slave.sensor_frame).add_body(
                name="tool", mass=tool.mass, ipos=c, fullinertia=[xx, yy, zz, xy, xz, yz],
                explicitinertial=True,
            )  # fmt: skip
        self.model = spec.compile()
        # Fingers keep their positions.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self.data = mujoco.MjData(self.model)
        self.S = self.model.body(slave.sensor_frame).id
        self.on_sensor = np.flatnonzero(self.model.body_parentid == self.S)

    def wrench(self, joints: list[str], q: Any, v: Any, vdot: Any) -> Any:
        """Return the wrench (6,) [f; tau] of S on the load, about the origin of S, in S."""
        data = self.data
        for k, name in enumerate(joints):
            joint = self.model.joint(name)
            data.qpos[joint.qposadr], data.qvel[joint.dofadr] = q[k], v[k]
            data.qacc[joint.dofadr] = vdot[k]
        mujoco.mj_inverse(self.model, data)
        mujoco.mj_rnePostConstraint(self.model, data)  # needs accelerations
        R_WS, p_WS = data.xmat[self.S].reshape(3, 3), data.xpos[self.S]
        tau, f = data.cfrc_int[self.on_sensor].sum(axis=0).reshape(2, 3)
        about = data.subtree_com[self.model.body_rootid[self.S]]
        return np.concatenate([R_WS.T @ f, R_WS.T @ (tau + np.cross(about - p_WS, f))])


if __name__ == "__main__":
    main()
