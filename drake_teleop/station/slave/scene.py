"""Environment from a file: SDF, URDF or Drake model directives."""

from dataclasses import dataclass
from pathlib import Path

from pydrake import geometry
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.environment.environment import AddFreeJoint, Environment, ToolShapes
from drake_teleop.station.slave.chain_joints import move_bodies_welded_to_world
from drake_teleop.station.slave.models import ParseScene
from drake_teleop.station.slave.surroundings import supports_pose_conversion

_RESERVED_BODY_NAMES = {"tool", "leaf", "block", "sensor", "tip", "stylus"}
_TOOL_MESH_EDGE_LENGTH_M = 0.005  # m, edge length of the mesh of the tool's ball


@settings
@dataclass
class Scene(Environment):
    """Surroundings from a file, with point or hydroelastic contact."""

    file: str = plain(
        "door.sdf", "SDF, URDF, .dmd.yaml in scenario's folder; built in: door.sdf", is_path=True
    )
    position: list[float] = quantity([0.0, 0.0, 0.0], "m", -3.0, 3.0, "the file's position in W")
    rotation: list[float] = quantity([0.0, 0.0, 0.0], "rad", -3.15, 3.15, "roll, pitch, yaw in W")
    fixed: bool = plain(True, "weld free bodies at their poses in the file; false: they float")
    contact: str = choice(
        "point", ("point", "hydroelastic"), "contact model; shapes without hydroelastic data: point"
    )
    tool_modulus: float = quantity(1e7, "Pa", 1e4, 1e11, "hydroelastic tool modulus (estimate)")
    slip_speed: float = quantity(
        1e-3, "m/s", 1e-6, 1.0, "sliding speed from which friction has its full value (estimate)"
    )

    @property
    def path(self) -> Path:
        given, shipped = Path(self.file), models_dir() / self.file
        return shipped if not given.is_file() and shipped.is_file() else given

    @property
    def hydroelastic(self) -> bool:
        return self.contact == "hydroelastic"

    def AddTo(self, plant: MultibodyPlant) -> None:
        before, path = plant.num_bodies(), self.path
        world, joints_before = plant.world_body(), set(plant.GetJointIndices())
        lists = plant.GetCollisionGeometriesForBody, plant.GetVisualGeometriesForBody
        num_world_shapes = [len(shapes_on(world)) for shapes_on in lists]
        ParseScene(plant, path)
        added = range(before, plant.num_bodies())
        for body in map(plant.get_body, map(BodyIndex, added)):
            if body.name() in _RESERVED_BODY_NAMES:
                what = f"the body name {body.name()} is reserved for the station"
                remedy = "give it another name in the file"
                raise DrakeTeleopError(what, where=str(path), remedy=remedy)
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        for joint in joints:
            if not supports_pose_conversion(joint):
                what = f"the joint {joint.name()} has the unsupported type {joint.type_name()}"
                remedy = "use revolute, prismatic, fixed or free joints"
                raise DrakeTeleopError(what, where=str(path), remedy=remedy)
        attached = {joint.child_body().index() for joint in joints}
        bases = [index for index in map(BodyIndex, added) if index not in attached]
        X_WFile = RigidTransform(RollPitchYaw(self.rotation), self.position)
        if not X_WFile.IsExactlyIdentity():
            moving = (x for x in joints if x.index() not in joints_before and x.num_velocities())
            on_world = (x for x in moving if x.parent_body().index() == world.index())
            rest = [f"the joint {joint.name()}" for joint in on_world]
            if [len(shapes_on(world)) for shapes_on in lists] != num_world_shapes:
                rest.append("a shape")
            if rest:
                what = f"position and rotation cannot move {rest[0]} on the world"
                remedy = "attach it to a link that is fixed to the world, or leave both fields out"
                raise DrakeTeleopError(what, where=str(path), remedy=remedy)
            move_bodies_welded_to_world(plant, joints_before, X_WFile)
        name = "GetDefaultFloatingBaseBodyPose"  # older versions of Drake have the second name
        pose_in_file = getattr(plant, name, None) or plant.GetDefaultFreeBodyPose
        for body in map(plant.get_body, bases):
            X_WBase = X_WFile @ pose_in_file(body)
            if self.fixed:
                plant.WeldFrames(plant.world_frame(), body.body_frame(), X_WBase)
            else:
                AddFreeJoint(plant, body, X_WBase)

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: geometry.SceneGraph, tool: BodyIndex
    ) -> None:
        if not self.hydroelastic:
            return
        inspector = scene_graph.model_inspector()
        own = [shape for each in ToolShapes(plant, scene_graph, tool).values() for shape in each]
        others = set(inspector.GetAllGeometryIds(geometry.Role.kProximity)) - set(own)
        materials = map(inspector.GetProximityProperties, others)
        if not any(map(has_hydroelastic_properties, materials)):
            what = "contact is hydroelastic, but no shape in the file is"
            tags = "drake:compliant_hydroelastic or drake:rigid_hydroelastic"
            remedy = f"give one {tags} in its drake:proximity_properties, or set contact: point"
            raise DrakeTeleopError(what, where=str(self.path), remedy=remedy)
        for shape in own:
            material = geometry.ProximityProperties(inspector.GetProximityProperties(shape))
            if not has_hydroelastic_properties(material):
                edge, modulus = _TOOL_MESH_EDGE_LENGTH_M, self.tool_modulus
                geometry.AddCompliantHydroelasticProperties(edge, modulus, material)
                replace = geometry.RoleAssign.kReplace
                scene_graph.AssignRole(plant.get_source_id(), shape, material, replace)


def has_hydroelastic_properties(properties: geometry.ProximityProperties) -> bool:
    return bool(properties.HasProperty("hydroelastic", "compliance_type"))
