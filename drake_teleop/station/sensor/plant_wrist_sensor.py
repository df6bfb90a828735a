"""Wrist sensor at a weld of any MultibodyPlant, continuous or discrete.

A plant with sampled outputs returns reaction and acceleration of the state before a step. The block
stores pose and velocity of that state for each sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common import RandomDistribution
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialAcceleration, SpatialForce, SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, ModelInstanceIndex, WeldJoint
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import RandomSource
from scipy.sparse.csgraph import connected_components

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, DoubleOnlySystem
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import (
    add_cross_product,
    apply_matrix,
    copy_into,
    cross,
    matrix_at,
    minus,
    plus,
    transposed,
    vector_at,
)
from drake_teleop.load import regressor
from drake_teleop.station.sensor.motion_estimation import (
    MotionEstimationConfig,
    initialize_motion_estimator,
    measure_sample_into,
)
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    TRUE_ANGLES_SLICE,
    WristSensorConfig,
    initialize_sensor_chain,
)

_MESSAGE_PREFIX = "AddWristSensor"
_DEFAULT_SAMPLING_PERIOD_S, _STEP_RATIO_TOLERANCE = 1e-3, 1e-6
# Output ports of a plant that the sensor reads, with the type of their elements.
_PLANT_PORT_TYPES = {"body_poses": RigidTransform, "body_spatial_velocities": SpatialVelocity}
_PLANT_PORT_TYPES |= {"body_spatial_accelerations": SpatialAcceleration}
_PLANT_PORT_TYPES |= {"reaction_forces": SpatialForce}
# Configuration: R_WB (9), angular velocity of B in W (3), joint positions.
_BODY_ROTATION_AND_OMEGA_SIZE = 12
# Groups of the discrete state: held configuration; sample; sensor chain and motion estimator.
_POSTURE_GROUP_INDEX, _SAMPLE_GROUP_INDEX, _FILTER_GROUP_INDICES = 0, 1, (2, 3)


def AddWristSensor(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    joint_or_frame: Joint | Frame,
    config: WristSensorConfig | None = None,
    *,
    period: float | None = None,
    model_instance: ModelInstanceIndex | None = None,
    name: str = "wrist_sensor",
) -> PlantWristSensor:
    """Add a wrist sensor to a finalized plant of this builder, and connect it.

    Args:
        joint_or_frame: weld between arm and tool, whose frame on the arm becomes S; or frame S on
            a body of the arm with exactly one weld to a body beyond it.
        config: errors of the sensor; None for an ideal sensor.
        period: sampling period [s]; a multiple of a discrete plant's time step, by default equal
            to it, or 1 ms for a continuous plant.
        model_instance: source of `joint_position`; all joints of the plant by default.
        name: name of the block; "<name>_noise" is its noise source.

    Raises:
        DrakeTeleopError: for a plant that is not finalized or in another builder, a missing weld, a
            tool without mass, or an unsuitable period.
    """
    _check_finalized_in_builder(builder, plant)
    config = WristSensorConfig(ideal=True) if config is None else config
    expect_type(WristSensorConfig, config, f"{_MESSAGE_PREFIX}: config", "take one of PRESETS")
    sensor = PlantWristSensor(plant, joint_or_frame, config, period, model_instance)
    builder.AddNamedSystem(name, sensor)
    state = plant.get_state_output_port(*([] if model_instance is None else [model_instance]))
    builder.Connect(state, sensor.GetInputPort("state"))
    for port in _PLANT_PORT_TYPES:
        builder.Connect(plant.GetOutputPort(port), sensor.GetInputPort(port))
    if sensor.HasInputPort("noise"):
        block_s = SAMPLES_PER_NOISE_BLOCK * sensor.period
        noise = RandomSource(RandomDistribution.kGaussian, NOISE_BLOCK_SIZE, block_s)
        builder.AddNamedSystem(f"{name}_noise", noise)
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    return sensor


class PlantWristSensor(DoubleOnlySystem, LeafSystem):
    """Block of the wrist sensor at a weld of a plant, see `AddWristSensor`.

    The outputs hold the last sample, taken at `sample_time`.

    .. pydrake_system::

        name: PlantWristSensor
        input_ports:
        - state: [q; v] of the plant or of one model instance
        - body_poses
        - body_spatial_velocities
        - body_spatial_accelerations
        - reaction_forces
        - noise: (NOISE_BLOCK_SIZE,) standard normal numbers (not if the sensor is ideal)
        output_ports:
        - measured_wrench_S: (6,) [f; tau] of the sensor on the load about So [N, N m]
        - specific_force_S: (3,) a - g of So [m/s^2]
        - angular_velocity_S: (3,) [rad/s], with delay, low-pass and rounding of the encoders
        - angular_acceleration_S: (3,) [rad/s^2]
        - status: 0 valid; 1 a channel is saturated; 2 and above: no sample yet, or implausible
        - joint_position: (n,) positions q in `state`
        - sample_time: instant of the sample [s]
        - sample: the outputs above in one vector, for `ForceScaling`
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self,
        plant: MultibodyPlant,
        joint_or_frame: Joint | Frame,
        config: WristSensorConfig,
        period: float | None,
        model_instance: ModelInstanceIndex | None,
    ) -> None:
        super().__init__()
        S, joint = _sensor_frame_and_weld(plant, joint_or_frame)
        self._weld = _weld_properties(plant, S, joint)
        step = plant.time_step() or None
        self._step_s, self._steps_per_sample = _event_period_and_step_count(step, period)
        self._pairs_steps = step is not None and plant.has_sampled_output_ports()
        config.check(_MESSAGE_PREFIX, 1 / self.period)

        which = [] if model_instance is None else [model_instance]
        n = self._n = plant.num_positions(*which)
        constants, chain = initialize_sensor_chain(config, 3 + n, self.period)
        sources = MotionEstimationConfig()
        motion, estimator = initialize_motion_estimator(sources, config, 3 + n, self.period)
        self._sensor = constants, motion, config.ideal
        self._no_noise, self._no_arm = np.zeros(NOISE_BLOCK_SIZE), np.zeros((0, 1))
        # The sample, with the angular velocity as three more joints, and its time.
        sample = np.zeros(regressor.sample_size(3 + n) + 1)
        sample[regressor.SATURATION_FLAG_INDEX] = regressor.LOST_SAMPLE_FLAG_THRESHOLD

        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states(*which))
        self._poses, self._velocities, self._accelerations, self._reactions = (
            self.DeclareAbstractInputPort(name, AbstractValue.Make([kind()]))
            for name, kind in _PLANT_PORT_TYPES.items()
        )
        noise = None if config.ideal else self.DeclareVectorInputPort("noise", NOISE_BLOCK_SIZE)
        self._noise = noise
        held = np.full(_BODY_ROTATION_AND_OMEGA_SIZE + n, np.nan)
        for start in (held, sample, chain, estimator):
            self.DeclareDiscreteState(start)
        self.DeclarePeriodicDiscreteUpdateEvent(self._step_s, 0.0, self._take_sample_if_due)
        if self._pairs_steps:
            self.DeclareInitializationDiscreteUpdateEvent(self._store_rotation_omega_joints)
        first, places = 0, np.delete(np.arange(len(sample)), [16, 17, 18])
        for name, size in {**regressor.signal_sizes_of_sample(n), "sample_time": 1}.items():
            place = places[first : first + size]
            self._declare_output("status" if name == "saturated" else name, place)
            first += size
        self._declare_output("sample", places)

    @property
    def period(self) -> float:
        """Sampling period [s]."""
        return self._step_s * self._steps_per_sample

    def _declare_output(self, name: str, indices: NDArray[np.intp]) -> None:
        def calc_part_of_sample(context: Context, output: BasicVector) -> None:
            output.SetFromVector(context.get_discrete_state(_SAMPLE_GROUP_INDEX).value()[indices])

        self.DeclareVectorOutputPort(name, len(indices), calc_part_of_sample, {self.xd_ticket()})

    def _read_rotation_omega_joints(self, context: Context) -> Array:
        _, body, _ = self._weld
        R_WB = self._poses.Eval(context)[body].rotation().matrix()
        omega_WB = self._velocities.Eval(context)[body].rotational()
        return np.concatenate([R_WB.ravel(), omega_WB, self._state.Eval(context)[: self._n]])

    def _store_rotation_omega_joints(
        self, context: Context, discrete_state: DiscreteValues
    ) -> None:
        discrete_state.set_value(_POSTURE_GROUP_INDEX, self._read_rotation_omega_joints(context))

    def _take_sample_if_due(self, context: Context, discrete_state: DiscreteValues) -> None:
        step = round(context.get_time() / self._step_s)
        configuration = discrete_state.value(_POSTURE_GROUP_INDEX).copy()
        if self._pairs_steps and (step + 1) % self._steps_per_sample == 0:
            # Drake has updated the plant: the state is that of the step's end.
            self._store_rotation_omega_joints(context, discrete_state)
        if step % self._steps_per_sample != 0:
            return
        if not self._pairs_steps:
            configuration = self._read_rotation_omega_joints(context)
        reaction, body, geometry = self._weld
        acceleration = self._accelerations.Eval(context)[body].get_coeffs()
        force = self._reactions.Eval(context)[reaction].get_coeffs()
        noise = self._no_noise if self._noise is None else self._noise.Eval(context)
        truth = np.empty(TRUE_ANGLES_SLICE.start + 3 + self._n)
        _true_sensor_values_into(geometry, configuration, acceleration, force, truth)
        sample = discrete_state.get_mutable_value(_SAMPLE_GROUP_INDEX)
        filters = (discrete_state.get_mutable_value(group) for group in _FILTER_GROUP_INDICES)
        measure_sample_into(self._sensor, self._no_arm, noise, truth, *filters, sample[:-1])
        sample[-1] = context.get_time()


@njit(cache=True)
def _true_sensor_values_into(geometry, configuration, acceleration, reaction, truth):
    p_BoSo_B, R_BS, R_SJc, p_SoJc_S, gravity_W, sign = geometry
    R_WB, omega = matrix_at(configuration, 0), vector_at(configuration, 9)
    alpha, a_Bo = vector_at(acceleration, 0), vector_at(acceleration, 3)
    r = apply_matrix(R_WB, p_BoSo_B)
    a = add_cross_product(add_cross_product(a_Bo, alpha, r), omega, cross(omega, r))
    R_SB, R_BW = transposed(R_BS), transposed(R_WB)
    s = apply_matrix(R_SB, apply_matrix(R_BW, minus(a, gravity_W)))
    omega = apply_matrix(R_SB, apply_matrix(R_BW, omega))
    alpha = apply_matrix(R_SB, apply_matrix(R_BW, alpha))
    f = apply_matrix(R_SJc, vector_at(reaction, 3))
    tau = plus(apply_matrix(R_SJc, vector_at(reaction, 0)), cross(p_SoJc_S, f))
    for i in range(3):
        truth[i], truth[3 + i] = sign * f[i], sign * tau[i]
        truth[6 + i], truth[9 + i], truth[12 + i] = s[i], omega[i], alpha[i]
        truth[TRUE_ANGLES_SLICE.start + i] = omega[i]
    n = configuration.shape[0] - _BODY_ROTATION_AND_OMEGA_SIZE
    copy_into(truth, TRUE_ANGLES_SLICE.start + 3, configuration, _BODY_ROTATION_AND_OMEGA_SIZE, n)


def _check_finalized_in_builder(builder: DiagramBuilder, plant: MultibodyPlant) -> None:
    expect_type(MultibodyPlant, plant, f"{_MESSAGE_PREFIX}: plant")
    if not plant.is_finalized():
        what = f"plant '{plant.get_name()}' is not finalized"
        raise DrakeTeleopError(what, where=_MESSAGE_PREFIX, remedy="call plant.Finalize() first")
    if plant not in builder.GetSystems():
        what = f"plant '{plant.get_name()}' is not in this builder"
        remedy = "add it by builder.AddSystem(plant) first"
        raise DrakeTeleopError(what, where=_MESSAGE_PREFIX, remedy=remedy)


def _event_period_and_step_count(step: float | None, period: float | None) -> tuple[float, int]:
    if period is not None and not 0.0 < period < np.inf:
        what = f"a sampling period of {period} s is not positive and finite"
        remedy = "give the time between samples [s]"
        raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: period", remedy=remedy)
    if step is None:
        return period or _DEFAULT_SAMPLING_PERIOD_S, 1
    count = (period or step) / step
    if count < 1 - _STEP_RATIO_TOLERANCE or abs(count - round(count)) > _STEP_RATIO_TOLERANCE:
        what = f"sampling period {period:g} s is no multiple of the plant's time step {step:g} s"
        remedy = f"choose a multiple, such as {max(1, round(count)) * step:g} s"
        raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: period", remedy=remedy)
    return step, round(count)


def _sensor_frame_and_weld(
    plant: MultibodyPlant, joint_or_frame: Joint | Frame
) -> tuple[Frame, WeldJoint]:
    expect_type((Joint, Frame), joint_or_frame, f"{_MESSAGE_PREFIX}: joint_or_frame")
    if joint_or_frame.GetParentPlant() is not plant:
        what = f"joint or frame '{joint_or_frame.name()}' belongs to another plant"
        remedy = "pass a joint or frame of this plant"
        raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: joint_or_frame", remedy=remedy)
    welds = [joint for joint in _joints_of_plant(plant) if isinstance(joint, WeldJoint)]
    if isinstance(joint_or_frame, Frame):
        S = joint_or_frame
        body = S.body().index()
        beyond = [joint for joint in welds if _arm_body_and_tool(plant, joint)[0] == body]
        if len(beyond) != 1:
            names = ", ".join(f"'{joint.name()}'" for joint in beyond)
            found = f"several welds beyond it: {names}" if beyond else "no weld beyond it"
            what = f"the body '{S.body().name()}' of frame '{S.name()}' has {found}"
            remedy = "pass the WeldJoint between arm and tool"
            raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: joint_or_frame", remedy=remedy)
        return S, beyond[0]
    if not isinstance(joint_or_frame, WeldJoint):
        what = f"joint '{joint_or_frame.name()}' is {joint_or_frame.type_name()}, not a weld"
        remedy = "weld the tool to the arm and pass this WeldJoint"
        raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: joint_or_frame", remedy=remedy)
    parent = joint_or_frame.frame_on_parent()
    arm, _ = _arm_body_and_tool(plant, joint_or_frame)
    on_parent = parent.body().index() == arm
    return parent if on_parent else joint_or_frame.frame_on_child(), joint_or_frame


def _joints_of_plant(plant: MultibodyPlant) -> list[Joint]:
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def _arm_body_and_tool(plant: MultibodyPlant, weld: WeldJoint) -> tuple[BodyIndex, list[BodyIndex]]:
    others = [joint for joint in _joints_of_plant(plant) if joint.index() != weld.index()]
    ends = [(int(j.parent_body().index()), int(j.child_body().index())) for j in others]
    linked = np.zeros((plant.num_bodies(), plant.num_bodies()))
    linked[tuple(np.reshape(ends, (-1, 2)).astype(int).T)] = 1.0
    _, group = connected_components(linked, directed=False)
    arm, load = weld.parent_body().index(), weld.child_body().index()
    if group[int(load)] == group[int(plant.world_body().index())]:
        arm, load = load, arm
    return arm, [BodyIndex(int(k)) for k in np.flatnonzero(group == group[int(load)])]


def _weld_properties(
    plant: MultibodyPlant, S: Frame, joint: WeldJoint
) -> tuple[int, int, tuple[Array | float, ...]]:
    """Return indices of the weld's reaction and of S's body B in the plant's ports, and constants.

    These are p_BoSo_B, R_BS, R_SJc, p_SoJc_S (reaction frame Jc), gravity in W, reaction's sign.
    """
    arm, load = _arm_body_and_tool(plant, joint)
    if not sum(plant.get_body(body).default_mass() for body in load) > 0.0:
        what = f"the tool beyond joint '{joint.name()}' has no mass"
        remedy = "give a body of the tool a SpatialInertia"
        raise DrakeTeleopError(what, where=f"{_MESSAGE_PREFIX}: joint_or_frame", remedy=remedy)
    on_parent = joint.parent_body().index() == arm
    X_BS, X_BJc = S.GetFixedPoseInBodyFrame(), joint.frame_on_child().GetFixedPoseInBodyFrame()
    if on_parent:
        X_BJc = joint.frame_on_parent().GetFixedPoseInBodyFrame() @ joint.X_FM()
    X_SJc = X_BS.InvertAndCompose(X_BJc)
    instance = (joint.child_body() if on_parent else joint.parent_body()).model_instance()
    gravity = plant.gravity_field().gravity_vector() * plant.is_gravity_enabled(instance)
    rotations = [X.rotation().matrix().ravel() for X in (X_BS, X_SJc)]
    places = map(np.array, (X_BS.translation(), *rotations, X_SJc.translation(), gravity))
    # The sign turns the reaction on the joint's child into the wrench on the load.
    geometry: tuple[Array | float, ...] = *places, 1.0 if on_parent else -1.0
    reaction = list(plant.GetJointIndices()).index(joint.index())
    return reaction, int(S.body().index()), geometry
