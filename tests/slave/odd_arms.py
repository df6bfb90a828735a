"""Test arms: the RX90, an arm with oblique axes, and one with a prismatic joint."""

from __future__ import annotations

from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import WeldJoint

from drake_teleop.common.files import models_dir

SEVEN_AXES = [
    (0, 0, 1),
    (0, 1, 0),
    (1, 0, 0),
    (0.6, -0.8, 0),
    (0, 0, -1),
    (0, 0.28, 0.96),
    (1, 0, 0),
]


def other_arm_urdf(last_joint: str = "fixed", root: str = "world", slides: int = 0) -> str:
    """Return a 7-joint arm with oblique axes, a tilted base, a camera on link 3 and a gripper."""
    parts = [f'<robot name="other"><link name="{root}"/>', link("base")]
    parts.append(joint("to_base", "fixed", root, "base", "0.1 -0.2 0.3", "0.3 0.2 -0.1"))
    parent = "base"
    for k, axis in enumerate(SEVEN_AXES, start=1):
        parts += [link(f"l{k}", mass=8.0 - k)]
        parts.append(
            joint(
                f"j{k}",
                "prismatic" if k == slides else "revolute",
                parent,
                f"l{k}",
                f"0.0{k} 0.1 0.2",
                f"0.{k} -0.3 0.5",
                axis,
            )
        )
        parent = f"l{k}"
    parts += [link("camera", mass=0.4), joint("to_camera", last_joint, "l3", "camera", "0.1 0 0.1")]
    parts += [link("ft"), joint("to_ft", "fixed", "l7", "ft", "0.01 0.02 0.1", "0.1 0.2 0.3")]
    parts += [link("hand", mass=0.8), joint("to_hand", "fixed", "ft", "hand", "0 0.01 0.05")]
    parts += [link("finger", mass=0.1)]
    parts.append(joint("to_finger", "prismatic", "hand", "finger", "0.01 0 0.04", "0 0 0.2"))
    parts += [
        f'<transmission type="SimpleTransmission"><joint name="j{k}"/><actuator name="a{k}">'
        f"<drake:gear_ratio value='10'/><drake:rotor_inertia value='0.00{k}'/></actuator>"
        "</transmission>"
        for k in range(1, 8)
    ]
    return "".join(parts) + "</robot>"


def link(name: str, mass: float = 2.0) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0.02 -0.03 0.08" rpy="0.2 0.1 0.3"/>'
        f'<mass value="{mass}"/><inertia ixx="{0.02 * mass}" iyy="{0.03 * mass}" '
        f'izz="{0.025 * mass}" ixy="0.001" ixz="-0.002" iyz="0.0015"/></inertial></link>'
    )


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: str,
    rpy: str = "0 0 0",
    axis: tuple[float, ...] = (0, 0, 1),
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
        '<limit lower="-2" upper="2.5" velocity="3" effort="40"/><dynamics damping="0.3"/></joint>'
    )


def rx90_plant(*, tool: bool = True):
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(models_dir() / "package.xml"))
    (arm,) = parser.AddModelsFromUrl("package://drake_teleop/rx90.sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", arm))
    if tool:
        parser.AddModelsFromUrl("package://drake_teleop/tool.sdf")
        plant.AddJoint(
            WeldJoint(
                "sensor_weld",
                plant.GetFrameByName("sensor", arm),
                plant.GetFrameByName("tool"),
                RigidTransform(),
            )
        )
    plant.Finalize()
    return plant, arm, "sensor"


def other_plant(**kwargs):
    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModelsFromString(other_arm_urdf(**kwargs), "urdf")
    plant.Finalize()
    return plant, arm, "ft"


def sliding_plant():
    return other_plant(slides=4)


def five_joint_plant(fourth_axis: tuple[float, ...] = (0, 1, 0)):
    """Return a small arm: by default yaw, three pitch joints, and roll, as OpenManipulator-X."""
    joints = [("0 0 0.034", (0, 0, 1)), ("0 0 0.064", (0, 1, 0)), ("0.042 0 0.113", (0, 1, 0))]
    joints += [("0.162 0 0", fourth_axis), ("0.029 0 0", (1, 0, 0))]
    parts = ['<robot name="five"><link name="world"/>']
    for k, (xyz, axis) in enumerate(joints):
        parent = "world" if k == 0 else f"l{k - 1}"
        parts += [link(f"l{k}"), joint(f"j{k}", "revolute", parent, f"l{k}", xyz, axis=axis)]
    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModelsFromString("".join(parts) + "</robot>", "urdf")
    plant.Finalize()
    return plant, arm, "l4"
