"""
Your plant
==========

A plant (:download:`arm.urdf </gallery/arm.urdf>`) with Drake's controller, and the wrist sensor at
the weld of a gripper of 1.3 kg. Without contact, the sensor measures its weight and inertia, V φ.
"""

import matplotlib.pyplot as plt
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

import drake_teleop as dt

builder = DiagramBuilder()
plant = builder.AddSystem(MultibodyPlant(time_step=1e-3))
(arm,) = Parser(plant).AddModels("arm.urdf")
plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
for i in plant.GetJointIndices()[:6]:
    plant.AddJointActuator(f"motor_{i}", plant.get_joint(i))
gripper = plant.AddRigidBody("gripper", arm, SpatialInertia.SolidSphereWithMass(1.3, 0.05))
weld = plant.WeldFrames(plant.GetFrameByName("sensor"), gripper.body_frame())
plant.Finalize()
control = builder.AddSystem(InverseDynamicsController(plant, [100] * 6, [0] * 6, [20] * 6, False))
goal = builder.AddSystem(ConstantVectorSource([0.2, -0.6, 1.9, 0.3, 0.5, -0.2] + [0] * 6))
builder.Connect(goal.get_output_port(), control.get_input_port_desired_state())
builder.Connect(plant.get_state_output_port(), control.get_input_port_estimated_state())
builder.Connect(control.get_output_port_control(), plant.get_actuation_input_port())
log = LogVectorOutput(dt.AddWristSensor(builder, plant, weld).GetOutputPort("sample"), builder)
simulator = Simulator(builder.Build())
simulator.AdvanceTo(1.0)
sample = log.FindLog(simulator.get_context()).data()[:, 1:]
figure, axes = plt.subplots(figsize=(7, 3))
axes.plot(sample[-1], sample[:3].T)
axes.set(xlabel="t [s]", ylabel="measured force in S [N]")
