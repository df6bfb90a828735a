"""The station's Diagram, linearised at rest by simulations of one period with displaced states.

Frames: stylus E, master's base B, world W, sensor S with origin So. The loops are cut at (T63)

    loop                       output              input
    hand on the stylus         operator_wrench     hand_wrench      F_E_B at E, in B
    network, master to slave   pose_command        pose_received    of S, in W
    network, slave to master   wrench_B            wrench_received  F_E_B, in B

The input `tool_wrench` acts on the tool, about So, in W. Inputs are held for a period. The model
excludes the sensor's noise, offset, quantisation and saturation, and all Coulomb friction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Role, RoleAssign
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import CoulombFriction, ExternallyAppliedSpatialForce
from pydrake.systems.analysis import InitializeParams
from pydrake.systems.framework import Diagram

from drake_teleop.common import vectors
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.lab.analysis.linear_model import Linearization, port_component_names
from drake_teleop.lab.analysis.one_axis import Complex
from drake_teleop.lab.analysis.two_port import two_port_matrix
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import mean_delay
from drake_teleop.station.environment.point_contact import PAIR_FRICTION_COLUMNS
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.master.force_display import initial_display_state
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import Scenario, check_scenario, replace
from drake_teleop.station.sensor.sensor_chain import without_parts
from drake_teleop.station.simulation import MakeSimulator
from drake_teleop.station.slave.arm import jacobian
from drake_teleop.station.slave.joint_commands import AUTOMATIC_IK_METHOD, pick_ik_method
from drake_teleop.station.slave.plant import ARM_INSTANCE_NAME, NominalSlave
from drake_teleop.station.station import GetBlock, MakeTeleopStation

_INPUT_PORTS = ("hand_wrench", "pose_received", "wrench_received", "tool_wrench")
_OUTPUT_PORTS = ("operator_wrench", "pose_command", "wrench_B", "twist_master", "twist_slave")

# Difference steps: truncation error grows with their square, rounding error with their inverse.
_ANGLE_STEP, _RATE_STEP, _LINEAR_STATE_STEP = 1e-4, 1e-4, 1.0
_WRENCH_STEPS_N_NM = np.repeat([1.0, 0.02], 3)  # N, N m: within the device's range
_MAX_ACCELERATION_OF_COMMAND_STEP_RAD_S2 = 20.0  # of a joint: within the motors' torque
_MAX_JOINT_DIFFERENCE_STEP_IN_CONTACT_RAD = 1e-6  # rad, m: much less than the indentation by 1 N
_MAX_RELATIVE_STATE_CHANGE_AT_REST = 1e-6  # change in one period over difference step
_MAX_EQUILIBRIUM_NEWTON_STEPS = 8
_TIME_TO_OPERATING_POINT_S, _TIME_AT_OPERATING_POINT_S = 0.3, 0.1  # motion, then rest


def linearize(
    scenario: Scenario,
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> Linearization:
    """Return the linear model of the scenario's Diagram at rest, with all its loops cut.

    Intended motion, network and passivity method have no effect. `displacement` of the master [m]
    from its start is in its base frame B.
    """
    check_scenario(scenario)
    if load_estimate is not None:
        load_estimate = finite_array("load_estimate", load_estimate, 16)
        # The sensor of the linear model has no offset.
        load_estimate = np.concatenate([np.zeros(6), load_estimate[6:]])
    displacement_B = finite_array("displacement", displacement, 3)
    period = _PeriodSimulator(scenario, load_estimate)
    x, A, C = period.find_rest_state_and_derivatives(displacement_B)
    B = period.differentiate_next_state_by_input(x)
    affects = _states_affecting_outputs(A, C)
    names = tuple(name for name, used in zip(period.states, affects, strict=True) if used)
    inputs, outputs = port_component_names(*_INPUT_PORTS), port_component_names(*_OUTPUT_PORTS)
    A, B, C = A[np.ix_(affects, affects)], B[affects], C[:, affects]
    D = np.zeros((len(outputs), len(inputs)))
    return Linearization(A, B, C, D, period.dt, names, inputs, outputs)


def linearize_station(
    scenario: Scenario,
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> Linearization:
    """Return the linear model of the Diagram at rest, with loops closed over constant delays."""
    check_scenario(scenario)
    if scenario.passivity.method != "none":
        what = f"'{scenario.passivity.method}' cannot be linearised"
        remedy = "set method: none, or use measure_frequency_response"
        raise DrakeTeleopError(what, where="passivity.method", remedy=remedy)
    cut = linearize(scenario, load_estimate=load_estimate, displacement=displacement)
    return close_network_loop(cut.close_loop("operator_wrench", "hand_wrench"), scenario)


def close_network_loop(system: Linearization, scenario: Scenario) -> Linearization:
    forward, backward = network_delay_periods(scenario)
    system = system.close_loop("pose_command", "pose_received", forward)
    return system.close_loop("wrench_B", "wrench_received", backward)


def network_delay_periods(scenario: Scenario) -> tuple[int, int]:
    """Return the delays of pose and wrench in the network, in hand periods; 0: no network."""
    if scenario.has_no_network_or_passivity:
        return 0, 0
    rate, lines = scenario.rates.hand_hz, scenario.channel.networks_of_directions()
    ahead, back = (max(1, int(mean_delay(line) * rate + 0.5)) for line in lines)
    return ahead, back


def two_port_along(system: Linearization, omega: Array, hand: Array, tool: Array) -> Complex:
    """Return the hybrid matrix H (n, 2, 2) along one direction at nonzero `omega` (n,) [rad/s].

    `system` has the hand's loop open in this direction. H includes the hand's mass. `hand` (6,) is
    the direction at E in B, `tool` (6,) the wrench in W of a unit force at the tip.
    """
    G = system.frequency_response(omega)
    i, o = list(system.inputs), list(system.outputs)

    def response(output: str, output_axis: Array, input_: str, input_axis: Array) -> Complex:
        row, column = o.index(f"{output}.x"), i.index(f"{input_}.x")
        return output_axis @ G[:, row : row + 6, column : column + 6] @ input_axis

    step = 1j * np.asarray(omega) * system.dt
    hold = -np.expm1(-step) / step
    mm = response("twist_master", hand, "hand_wrench", hand) / hold
    ms = response("twist_master", hand, "tool_wrench", tool) / hold
    sm = response("twist_slave", tool, "hand_wrench", hand) / hold
    ss = response("twist_slave", tool, "tool_wrench", tool) / hold
    # -F_e acts on the tool.
    return two_port_matrix(1 / mm, ms / mm, -sm / mm, ss - sm * ms / mm)


def _states_affecting_outputs(A: Array, C: Array) -> NDArray[np.bool_]:
    affects = (C != 0.0).any(axis=0)
    while True:
        more = affects | (A[affects] != 0.0).any(axis=0)
        if (more == affects).all():
            return affects
        affects = more


@dataclass(frozen=True)
class _SystemStates:
    system_name: str
    discrete_group: int | None
    indices: slice | NDArray[np.intp]
    difference_steps: Array


class _PeriodSimulator:
    def __init__(self, scenario: Scenario, load_estimate: Array | None) -> None:
        _check_rate_multiples(scenario)
        hand_hz = scenario.rates.hand_hz
        if own_period := scenario.master.sampling_period_if_slower_than_hand(hand_hz):
            what = f"{hand_hz:g} Hz is above the device's own {1 / own_period:g} Hz (must be equal)"
            remedy = f"set it to {1 / own_period:g}, or master.figures.rate_hz to 0"
            raise DrakeTeleopError(what, where="rates.hand_hz", remedy=remedy)
        self.dt = 1 / hand_hz
        smooth = _without_nonlinear_parts(scenario)
        self._diagram = MakeTeleopStation(smooth, load_estimate=load_estimate)
        if smooth.surroundings is not None:
            sensor = GetBlock(self._diagram, "wrist_sensor")
            if beyond := sensor.reason_beyond_contact_law or sensor.moving_bodies_sentence:
                what = f"this environment cannot be linearised: {beyond}"
                remedy = "use only a sheet spring, a slot, walls and boxes, or no environment"
                raise DrakeTeleopError(what, where="environment", remedy=remedy)
            _remove_contact_friction(self._diagram)
        self._simulator = MakeSimulator(self._diagram, smooth.simulation)
        # Error control would make the steps depend on the displacements.
        self._simulator.get_mutable_integrator().set_fixed_step_mode(True)
        slave = NominalSlave(smooth.slave)
        self._arm, self._joints = slave.arm.table, slave.arm.num_joints
        self._has_ik_state = pick_ik_method(smooth.slave.inverse_kinematics, slave.arm) == "numeric"
        self._push = ExternallyAppliedSpatialForce()
        self._push.body_index = slave.tool
        self._sensor = self._get_block("wrist_sensor")
        servo = smooth.joint_control
        servo.require_computed_torque("the linearisation")
        scenario.master.check_pose_mode("the linearisation")
        if self._has_ik_state:  # a speed limit would be nonlinear
            GetBlock(self._diagram, "inverse_kinematics").speed_limit[:] = np.inf
        gain = 4 * np.pi**2 * servo.position_bandwidth_hz * servo.velocity_bandwidth_hz
        # The arm moves only a small part of a command in one period.
        self._command_step = min(_ANGLE_STEP, _MAX_ACCELERATION_OF_COMMAND_STEP_RAD_S2 / gain)
        self._joint_step = self._command_step
        if smooth.surroundings is not None:
            self._joint_step = min(self._command_step, _MAX_JOINT_DIFFERENCE_STEP_IN_CONTACT_RAD)
        hand = smooth.operator.hand
        self._device = smooth.master.device(hand.mass, hand.inertia)
        self._groups = self._make_state_groups()
        self._steps = np.concatenate([group.difference_steps for group in self._groups])
        self.states = tuple(
            f"{g.system_name} {'' if g.discrete_group is None else g.discrete_group}[{k}]"
            for g in self._groups
            for k in range(len(g.difference_steps))
        )
        # The sensor's memory follows from the other states; it is of order 1.
        sensed = [name.startswith("wrist_sensor") for name in self.states]
        self._sizes = np.where(sensed, _LINEAR_STATE_STEP, self._steps)
        self._start_B = np.array([1.0, 0.0, 0.0, 0.0, *smooth.master.position])
        self._pose = self._evaluate_output("kinematic_scaling", "pose_command")
        self._hand, self._wrench = np.zeros(6), np.zeros(6)
        self._apply_input_changes(np.zeros(24))
        self._simulator.Initialize()

    def _get_block(self, name: str) -> Any:
        return GetBlock(self._diagram, name)

    def _get_context(self, name: str) -> Any:
        root = self._simulator.get_mutable_context()
        return self._get_block(name).GetMyMutableContextFromRoot(root)

    def _evaluate_output(self, system: str, port: str) -> Array:
        return np.array(self._get_block(system).GetOutputPort(port).Eval(self._get_context(system)))

    def _fix_input_port(self, system: str, port: str, value: object) -> None:
        self._get_block(system).GetInputPort(port).FixValue(self._get_context(system), value)

    def _make_state_groups(self) -> list[_SystemStates]:
        whole = slice(None)
        axes = self._device.num_joints
        joints = self._get_context("slave_plant").num_continuous_states() // 2
        # The sensor's memory contains angles, which must stay small.
        remembered = self._sensor.motion_dependent_state_indices
        groups = [
            _SystemStates("master_device", 0, whole, np.repeat([_ANGLE_STEP, _RATE_STEP], axes)),
            _SystemStates("master_device", 1, whole, np.full(7, _ANGLE_STEP)),
            _SystemStates("master_device", 2, whole, np.full(6, _RATE_STEP)),
            # The angles for the display; its other states act only after faults.
            _SystemStates("master_device", 3, slice(0, 6), np.full(6, _ANGLE_STEP)),
            _SystemStates("joint_control", 0, whole, np.full(self._joints, _LINEAR_STATE_STEP)),
            _SystemStates(
                "slave_plant", None, whole, np.repeat([self._joint_step, _RATE_STEP], joints)
            ),
            _SystemStates("wrist_sensor", 0, remembered, np.full(len(remembered), _ANGLE_STEP)),
        ]
        if self._has_ik_state:
            steps = np.full(self._joints, self._command_step)
            groups.append(_SystemStates("inverse_kinematics", 0, slice(0, self._joints), steps))
        return groups

    def get_state(self) -> Array:
        parts = []
        for group in self._groups:
            context = self._get_context(group.system_name)
            if group.discrete_group is None:
                parts.append(context.get_continuous_state_vector().CopyToVector())
            else:
                state = context.get_discrete_state(group.discrete_group).value()
                parts.append(state[group.indices])
        return np.concatenate(parts)

    def _set_state(self, x: Array) -> None:
        ends = np.cumsum([len(group.difference_steps) for group in self._groups])
        for group, values in zip(self._groups, np.split(x, ends[:-1]), strict=True):
            context = self._get_context(group.system_name)
            if group.discrete_group is None:
                context.SetContinuousState(values)
            else:
                state = context.get_mutable_discrete_state(group.discrete_group)
                state.get_mutable_value()[group.indices] = values
        self._sensor.reset_queue(self._get_context("wrist_sensor"))

    def _apply_input_changes(self, u: Array) -> None:
        self._fix_input_port("master_device", "hand_wrench_E", self._hand + u[:6])
        rotation = vectors.quaternion_exponential(tuple(u[9:12]))
        rotated = vectors.quaternion_product(rotation, self._pose[:4])
        command = np.concatenate([rotated, self._pose[4:] + u[6:9]])
        self._fix_input_port("inverse_kinematics", "pose_command", command)
        self._fix_input_port("force_display", "wrench_command", self._wrench + u[12:18])
        push = u[18:24]
        self._push.F_Bq_W = SpatialForce(push[3:], push[:3])
        self._fix_input_port("slave_plant", "applied_spatial_force", [self._push])
        self._fix_input_port("wrist_sensor", "applied_wrench_W", push)

    def _simulate_period_and_get_state(self) -> Array:
        # At this time no event of noise or log interferes.
        context = self._simulator.get_mutable_context()
        context.SetTime(self.dt)
        if self._has_ik_state:  # time of its last command
            command = self._get_context("inverse_kinematics").get_mutable_discrete_state(0)
            command.get_mutable_value()[-1] = 0.0
        self._sensor.reset_queue(self._get_context("wrist_sensor"))
        self._simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        self._simulator.AdvanceTo(2 * self.dt)
        self._sensor.take_samples(self._get_context("wrist_sensor"))
        return self.get_state()

    def _evaluate_outputs(self) -> Array:
        pose = self._evaluate_output("kinematic_scaling", "pose_command")
        state = self._evaluate_output("slave_plant", f"{ARM_INSTANCE_NAME}_state")
        J = np.empty((6, self._joints))
        jacobian(self._arm, state[: self._joints], J)
        return np.concatenate(
            [
                self._evaluate_output("operator", "hand_wrench_E"),
                _pose_difference(pose, self._pose),
                self._evaluate_output("force_scaling", "wrench_B"),
                self._evaluate_output("master_device", "twist_master"),
                J @ state[self._joints :],
            ]
        )

    def find_rest_state_and_derivatives(self, displacement: Array) -> tuple[Array, Array, Array]:
        start = self._pose
        pose_B = self._start_B.copy()
        pose_B[4:] += displacement
        q = self._device.inverse_kinematics(pose_B)
        context = self._get_context("master_device")
        x_B = self._device.coordinates_for_force_display(q)
        display = initial_display_state(x_B, self._device.parameters)
        states = np.append(q, np.zeros_like(q)), pose_B, np.zeros(6), display
        for group, value in enumerate(states):
            context.SetDiscreteState(group, value)
        target = self._evaluate_output("kinematic_scaling", "pose_command")
        ramp = round(_TIME_TO_OPERATING_POINT_S / self.dt) if displacement.any() else 0
        for k in range(ramp + round(_TIME_AT_OPERATING_POINT_S / self.dt)):
            u = min((k + 1) / ramp, 1.0) if ramp else 1.0
            share = u**3 * (10 + u * (6 * u - 15))
            self._pose = start + share * (target - start)
            self._apply_input_changes(np.zeros(24))
            self._simulate_period_and_get_state()
        x = self._balance_hand_force_and_get_state()
        return self._find_equilibrium_state_and_derivatives(x)

    def _balance_hand_force_and_get_state(self) -> Array:
        self._wrench = self._evaluate_output("force_scaling", "wrench_B")
        self._apply_input_changes(np.zeros(24))
        self._hand = -self._evaluate_output("force_display", "force_to_master")
        self._apply_input_changes(np.zeros(24))
        return self.get_state()

    def _find_equilibrium_state_and_derivatives(self, x: Array) -> tuple[Array, Array, Array]:
        slave = np.array([not name.startswith("master") for name in self.states])
        for _ in range(_MAX_EQUILIBRIUM_NEWTON_STEPS):
            A, C = self.differentiate_by_state(x)
            free = slave & _states_affecting_outputs(A, C)
            self._set_state(x)
            moved = self._simulate_period_and_get_state() - x
            if (np.abs(moved) < _MAX_RELATIVE_STATE_CHANGE_AT_REST * self._sizes)[free].all():
                return x, A, C
            moved[free] = np.linalg.solve(np.eye(free.sum()) - A[np.ix_(free, free)], moved[free])
            x[slave] += moved[slave]
            self._set_state(x)
            x = self._balance_hand_force_and_get_state()
        what = f"the slave does not come to rest: {self.states[np.argmax(np.abs(moved))]} changes"
        raise DrakeTeleopError(what, where="displacement", remedy="choose another operating point")

    def differentiate_by_state(self, x: Array) -> tuple[Array, Array]:
        def outputs_and_end_state(change: Array) -> Array:
            self._set_state(x + change)
            outputs = self._evaluate_outputs()
            return np.concatenate([outputs, self._simulate_period_and_get_state()])

        self._apply_input_changes(np.zeros(24))
        C, A = np.split(_central_difference_jacobian(outputs_and_end_state, self._steps), [30])
        return A, C

    def differentiate_next_state_by_input(self, x: Array) -> Array:
        def end_state(change: Array) -> Array:
            self._set_state(x)
            self._apply_input_changes(change)
            return self._simulate_period_and_get_state()

        pose, tool = np.full(6, self._command_step), np.full(6, _LINEAR_STATE_STEP)
        steps = np.concatenate([_WRENCH_STEPS_N_NM, pose, _WRENCH_STEPS_N_NM, tool])
        return _central_difference_jacobian(end_state, steps)


def _central_difference_jacobian(function: Callable[[Array], Array], steps: Array) -> Array:
    columns = [function(step) - function(-step) for step in np.diag(steps)]
    return np.stack(columns, axis=1) / (2 * steps)


def _pose_difference(pose: Array, other: Array) -> Array:
    inverse = vectors.conjugate_quaternion(tuple(other[:4]))
    rotation = vectors.quaternion_product(tuple(pose[:4]), inverse)
    return np.concatenate([pose[4:] - other[4:], vectors.quaternion_logarithm(rotation)])


def _without_nonlinear_parts(scenario: Scenario) -> Scenario:
    parts = ("noise", "random_walk", "offset", "drift", "quantisation", "saturation")
    return replace(
        scenario,
        simulation__integrator="runge_kutta3",
        simulation__max_step=0.5 / scenario.rates.sensor_hz,
        rates__log_hz=1.0,
        operator__intent=[],
        channel=Channel(),
        passivity=PassivityConfig(),
        wrist_sensor=without_parts(scenario.wrist_sensor, *parts),
        master=scenario.master.without_coulomb_friction_and_encoder_steps(),
        slave__friction=[],
        load_estimator=LoadEstimatorConfig(),
        contact_detection=None,
        # The closed form, if the arm has one, has no state.
        slave__inverse_kinematics=AUTOMATIC_IK_METHOD,
    )


def _remove_contact_friction(diagram: Diagram) -> None:
    plant = GetBlock(diagram, "slave_plant")
    scene_graph = GetBlock(diagram, "scene_graph")
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        properties = inspector.GetProximityProperties(geometry)
        properties.UpdateProperty("material", "coulomb_friction", CoulombFriction(0.0, 0.0))
        scene_graph.AssignRole(source, geometry, properties, RoleAssign.kReplace)
    GetBlock(diagram, "wrist_sensor").contact_pairs[:, PAIR_FRICTION_COLUMNS] = 0.0


def _check_rate_multiples(scenario: Scenario) -> None:
    rates = scenario.rates
    rule = f"hand_hz, {rates.hand_hz:g} Hz (required by the linearisation)"
    if rates.joint_control_hz != rates.hand_hz:
        what = f"{rates.joint_control_hz:g} Hz differs from {rule}"
        raise DrakeTeleopError(what, where="rates.joint_control_hz", remedy="set it to hand_hz")
    if rates.sensor_hz % rates.hand_hz != 0.0:
        what, remedy = f"{rates.sensor_hz:g} Hz is no multiple of {rule}", "set it to a multiple"
        raise DrakeTeleopError(what, where="rates.sensor_hz", remedy=remedy)
