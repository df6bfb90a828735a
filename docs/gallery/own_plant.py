"""
The wrist sensor on your own plant
==================================

A plant with Drake's own controller (:download:`arm.urdf </gallery/arm.urdf>`), and the wrist sensor
at the weld of its gripper. In free motion no force remains without V φ of the gripper.
"""

import matplotlib.pyplot as plt
import numpy as np
import pydrake.all as drake

import drake_teleop as dt

builder = drake.DiagramBuilder()
plant = builder.AddSystem(drake.MultibodyPlant(1e-3))
drake.Parser(plant).AddModels("arm.urdf")
plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
for joint in map(plant.get_joint, plant.GetJointIndices()[:6]):
    plant.AddJointActuator(joint.name(), joint)
M = drake.SpatialInertia.SolidBoxWithMass(1.3, 0.06, 0.06, 0.14)
gripper = plant.AddRigidBody("gripper", plant.AddModelInstance("gripper"), M).body_frame()
weld = plant.WeldFrames(plant.GetFrameByName("sensor"), gripper)
plant.Finalize()
gains = np.full(6, 100.0), np.zeros(6), np.full(6, 20.0)
control = builder.AddSystem(drake.InverseDynamicsController(plant, *gains, False))
goal = builder.AddSystem(drake.ConstantVectorSource([0.2, -0.6, 1.9, 0, 0.5, 0, *np.zeros(6)]))
builder.Connect(goal.get_output_port(), control.get_input_port_desired_state())
builder.Connect(plant.get_state_output_port(), control.get_input_port_estimated_state())
builder.Connect(control.get_output_port_control(), plant.get_actuation_input_port())
port = dt.AddWristSensor(builder, plant, weld).GetOutputPort("sample")
log = drake.LogVectorOutput(port, builder, 1e-3)
(simulator := drake.Simulator(builder.Build())).AdvanceTo(1.0)
rows = log.FindLog(simulator.get_context()).data()[:15, 1:].T
wrench, *motion = np.split(rows, [6, 9, 12], axis=1)
moments = M.CalcRotationalInertia().CopyToFullMatrix3()[np.triu_indices(3)]
phi = np.array([1.3, 0.0, 0.0, 0.0, *moments])
contact = dt.contact_wrench(wrench, np.zeros(6), *motion, phi)
plt.semilogy(np.abs(wrench[:, :3]), "C0", np.abs(contact[:, :3]) + 1e-16, "C1")
_ = plt.gca().set(xlabel="t [ms]", ylabel="force, measured (blue) and without V φ [N]")
