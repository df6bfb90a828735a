"""Independent readers of arm files: MuJoCo for MJCF, yourdfpy for URDF, 30 lines here for SDF.

`read_reference` returns the values that `arms.py` compares with those of the package: joints from
the base to the sensor frame with their limits, the pose of that frame, and masses. Joints beside
the chain keep the positions of the file.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray


class ReferenceJoint(NamedTuple):
    """One moving joint of the chain.

    Attributes:
        lower, upper: limits [rad, m]; infinite for a joint without limits.
        effort: torque or force limit [N m, N]; inf if the file has none.
    """

    name: str
    lower: float
    upper: float
    effort: float


class Reference(NamedTuple):
    """Arm by another reader.

    Attributes:
        reader: name of that reader.
        pose: function from joint positions (n,) to the pose (4, 4) of the sensor frame.
        mass_beyond: mass of the bodies beyond the body with the sensor frame [kg].
        mass_moved: mass that the first joint moves [kg].
    """

    reader: str
    joints: list[ReferenceJoint]
    pose: Callable[[Array], Array]
    mass_beyond: float
    mass_moved: float


def read_reference(path: Path, frame: str) -> Reference:
    """Read the arm up to `frame` without the package."""
    if path.suffix == ".urdf":
        return _read_urdf(path, frame)
    return _read_sdf(path, frame) if path.suffix == ".sdf" else _read_mjcf(path, frame)


# MJCF


def _read_mjcf(path: Path, frame: str) -> Reference:
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data, kinds = mujoco.MjData(model), mujoco.mjtObj
    body = mujoco.mj_name2id(model, kinds.mjOBJ_BODY, frame)
    site = -1 if body >= 0 else mujoco.mj_name2id(model, kinds.mjOBJ_SITE, frame)
    if body < 0 and site < 0:
        raise ValueError(f"MuJoCo finds neither a body nor a site named {frame!r}")
    last = body if body >= 0 else model.site_bodyid[site]
    chain = _joints_up_to(model, last)
    addresses = [model.jnt_qposadr[k] for k in chain]

    def pose(q: Array) -> Array:
        data.qpos[:] = model.qpos0
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        where = data.body(body) if body >= 0 else data.site(site)
        return _transform(where.xmat.reshape(3, 3), where.xpos)

    first = model.jnt_bodyid[chain[0]]
    return Reference(
        "MuJoCo",
        [_mjcf_joint(model, k) for k in chain],
        pose,
        float(model.body_subtreemass[body] - model.body_mass[body]) if body >= 0 else 0.0,
        float(model.body_subtreemass[first]),
    )


def _joints_up_to(model: Any, body: int) -> list[int]:
    """Return hinges and slides from the base to a body."""
    chain: list[int] = []
    while body > 0:
        first = model.body_jntadr[body]
        own = range(first, first + model.body_jntnum[body])
        chain[:0] = [k for k in own if model.jnt_type[k] >= 2]  # 0: free, 1: ball
        body = model.body_parentid[body]
    return chain


def _mjcf_joint(model: Any, joint: int) -> ReferenceJoint:
    limited = bool(model.jnt_limited[joint])
    lower, upper = model.jnt_range[joint] if limited else (-np.inf, np.inf)
    effort = np.inf
    for k in range(model.nu):
        if model.actuator_trntype[k] <= 1 and model.actuator_trnid[k, 0] == joint:
            effort = min(effort, _mjcf_effort(model, k))
    if model.jnt_actfrclimited[joint]:
        effort = min(effort, float(np.abs(model.jnt_actfrcrange[joint]).max()))
    return ReferenceJoint(model.joint(joint).name, float(lower), float(upper), effort)


def _mjcf_effort(model: Any, actuator: int) -> float:
    gear = abs(float(model.actuator_gear[actuator, 0]))
    if model.actuator_forcelimited[actuator]:
        return gear * float(np.abs(model.actuator_forcerange[actuator]).max())
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    is_motor = model.actuator_gaintype[actuator] == 0 and not bias.any()
    if is_motor and model.actuator_ctrllimited[actuator]:
        largest = float(np.abs(model.actuator_ctrlrange[actuator]).max())
        return gear * abs(float(gain[0])) * largest
    return np.inf


# URDF


def _read_urdf(path: Path, frame: str) -> Reference:
    import yourdfpy

    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    text = path.read_bytes()
    # Two published files have commas between the numbers of an origin.
    text = re.sub(rb'(rpy|xyz)="[^"]*"', lambda found: found[0].replace(b",", b" "), text)
    robot = yourdfpy.URDF.load(io.BytesIO(text), load_meshes=False)
    inboard = {joint.child: joint for joint in robot.robot.joints}
    if frame not in robot.link_map:
        raise ValueError(f"yourdfpy finds no link named {frame!r}")
    chain, link = [], frame
    while link in inboard:
        chain.insert(0, inboard[link])
        link = inboard[link].parent
    moving = [joint for joint in chain if joint.type in ("revolute", "continuous", "prismatic")]
    names = [joint.name for joint in moving]

    def pose(q: Array) -> Array:
        robot.update_cfg(dict(zip(names, map(float, q), strict=True)))
        return np.array(robot.get_transform(frame, link))

    outboard: dict[str, list[str]] = {}
    for joint in robot.robot.joints:
        outboard.setdefault(joint.parent, []).append(joint.child)
    masses = {name: _urdf_mass(each) for name, each in robot.link_map.items()}
    moved = _mass_from(moving[0].child, outboard, masses)
    beyond = _mass_from(frame, outboard, masses) - masses[frame]
    return Reference("yourdfpy", [_urdf_joint(each) for each in moving], pose, beyond, moved)


def _urdf_mass(link: Any) -> float:
    mass = None if link.inertial is None else link.inertial.mass
    return 0.0 if mass is None else float(mass)


def _urdf_joint(joint: Any) -> ReferenceJoint:
    limit = joint.limit
    lower, upper = (None, None) if limit is None else (limit.lower, limit.upper)
    if joint.type == "continuous" and not (lower and upper):
        lower, upper = None, None
    effort = None if limit is None else limit.effort
    return ReferenceJoint(
        joint.name,
        -np.inf if lower is None else float(lower),
        np.inf if upper is None else float(upper),
        float(effort) if effort else np.inf,
    )


def _mass_from(link: str, outboard: dict[str, list[str]], masses: dict[str, float]) -> float:
    return masses[link] + sum(_mass_from(far, outboard, masses) for far in outboard.get(link, []))


# SDF: poses of links in the model, axes in the child link; only elements of published arms


def _read_sdf(path: Path, frame: str) -> Reference:
    root = ElementTree.parse(path).getroot()
    model = next(each for each in root.iter("model") if each.find(f"link[@name='{frame}']"))
    links = {link.get("name", ""): link for link in model.findall("link")}
    inboard = {joint.findtext("child", ""): joint for joint in model.findall("joint")}
    chain, link = [], frame
    while link in inboard:
        chain.insert(0, inboard[link])
        link = inboard[link].findtext("parent", "")
    moving = [joint for joint in chain if joint.get("type") in ("revolute", "prismatic")]

    def pose(q: Array) -> Array:
        moved = np.eye(4)
        for joint, value in zip(moving, q, strict=True):
            child = _sdf_pose(links[joint.findtext("child", "")]) @ _sdf_pose(joint)
            axis = _numbers(joint.findtext("axis/xyz", "0 0 1"))
            if joint.get("type") == "revolute":
                step = _transform(Rotation.from_rotvec(value * axis).as_matrix(), np.zeros(3))
            else:
                step = _transform(np.eye(3), value * axis)
            moved = moved @ child @ step @ np.linalg.inv(child)
        return moved @ _sdf_pose(links[frame])

    outboard: dict[str, list[str]] = {}
    for child, joint in inboard.items():
        outboard.setdefault(joint.findtext("parent", ""), []).append(child)
    masses = {name: float(each.findtext("inertial/mass", "0")) for name, each in links.items()}
    moved = _mass_from(moving[0].findtext("child", ""), outboard, masses)
    beyond = _mass_from(frame, outboard, masses) - masses[frame]
    return Reference("own SDF", [_sdf_joint(each) for each in moving], pose, beyond, moved)


def _sdf_joint(joint: ElementTree.Element) -> ReferenceJoint:
    lower, upper, effort = (
        float(joint.findtext(f"axis/limit/{name}", default))
        for name, default in (("lower", "-inf"), ("upper", "inf"), ("effort", "inf"))
    )
    return ReferenceJoint(joint.get("name", ""), lower, upper, effort if effort > 0 else np.inf)


def _sdf_pose(element: ElementTree.Element) -> Array:
    numbers = _numbers(element.findtext("pose", "0 0 0 0 0 0"))
    return _transform(Rotation.from_euler("xyz", numbers[3:]).as_matrix(), numbers[:3])


def _numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])


def _transform(R: Array, p: Array) -> Array:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, p
    return X
