"""The linearised Diagram against analytical models and simulations."""

from dataclasses import replace as changed

import numpy as np
import phantom_arrays as arrays
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis import frequency_response, linearization
from drake_teleop.lab.analysis.analyze import measure_free_impedance
from drake_teleop.lab.analysis.linear_model import COMPONENT_NAMES, Linearization
from drake_teleop.lab.analysis.linearization import linearize, linearize_station, two_port_along
from drake_teleop.lab.analysis.one_axis import device_impedance
from drake_teleop.lab.analysis.period_map import Sampling, sampled_two_port
from drake_teleop.lab.analysis.task_direction import task_direction
from drake_teleop.lab.analysis.two_port import hybrid_matrix
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.operator.operator import MinimumJerk, OperatorConfig
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import MakeSimulator, read_recorded_signals
from drake_teleop.station.slave.arm import forward_kinematics, inverse_dynamics, jacobian
from drake_teleop.station.slave.home import home_posture
from drake_teleop.station.station import GetBlock, MakeTeleopStation

PERIOD = 5e-4
UP = (0.0, 0.0, 1.0)
#: Here a vertical force on the stylus moves the inner link alone.
DECOUPLED = [0.215, 0.0, -0.17]
OMEGA = 2 * np.pi * np.geomspace(1.0, 30.0, 25)
#: A servo that reaches its command after two periods and rests there.
DEADBEAT = {
    "joint_control__position_bandwidth_hz": 1 / (1.5 * PERIOD) / (2 * np.pi),
    "joint_control__velocity_bandwidth_hz": 1.5 / PERIOD / (2 * np.pi),
}


def true_load(scenario: Scenario):
    """Return the true load, (16,) as `load_estimate`."""
    return np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])


def vertical_only(cut: Linearization) -> Linearization:
    system = cut.close_loop(["pose_command.z"], ["pose_received.z"])
    return system.close_loop(["wrench_B.z"], ["wrench_received.z"])


def wired(cut: Linearization) -> Linearization:
    return cut.close_loop("pose_command", "pose_received").close_loop("wrench_B", "wrench_received")


def stale_weight(scenario: Scenario, direction):
    """Return the change of the arm's weight by a command and by a force, at held torque.

    Acceleration over displacement [1/s^2] along the direction at So: of a command, of a push; and
    of the tool's centre of mass.
    """
    arm = slave_arm(scenario)
    q = home_posture(arm, scenario.slave.position)
    still, J, R, p = np.zeros(6), np.empty((6, 6)), np.empty((3, 3)), np.empty(3)

    def torque(q, vdot):
        out = np.empty(6)
        inverse_dynamics(arm.table, q, still, vdot, out)
        return out

    M = np.array([torque(q, unit) - torque(q, still) for unit in np.eye(6)]).T
    step = 1e-5 * np.eye(6)
    slope = np.array([torque(q + d, still) - torque(q - d, still) for d in step]).T / 2e-5
    jacobian(arm.table, q, J)
    forward_kinematics(arm.table, q, R, p)
    centre = R @ arm.phi_load[1:4] / arm.phi_load[0]
    at_So = np.append(direction, np.zeros(3))
    at_centre = np.append(direction, np.cross(centre, direction))
    commanded = np.linalg.solve(J, at_So)
    pushed = np.linalg.solve(M, J.T @ at_So)
    pushed = pushed / (at_So @ J @ pushed)
    return [
        (-at_So @ J @ np.linalg.solve(M, slope @ u), -at_centre @ J @ np.linalg.solve(M, slope @ u))
        for u in (commanded, pushed)
    ]


def exact_two_port(scenario: Scenario, omega):
    """Return H of one axis with ideal sensor, delayed weight and a tool that a force rotates.

    The slave's motion is that of command and push; the sensor measures the tool's
    mass times the acceleration of its centre, 125 us before the end of each period.
    """
    task = task_direction(scenario, UP)
    axis = task.axis
    T, before = 1 / scenario.rates.hand_hz, 1 / scenario.rates.sensor_hz
    mass = axis.device_mass + axis.hand_mass
    decay = np.exp(-axis.device_damping * T / mass)
    glide = mass / axis.device_damping * (1 - decay)
    # x_m, v_m; x, v of So and of the tool's centre, by the command, and by the push; sensor force |
    # hand's force, push. The servo pulls back each in its own direction.
    A = np.zeros((11, 13))
    A[0, :2], A[1, 1] = (1, glide), decay
    for force in (10, 11):
        A[:2, force] = (T - glide) / axis.device_damping, (1 - decay) / axis.device_damping
    kv, kp = axis.velocity_gain, axis.position_gain
    columns, late = np.eye(13), T - before
    stale = stale_weight(scenario, np.array(UP))
    causes = (kv * kp * axis.position_scale * columns[0], columns[12] / axis.slave_mass)
    for So, slopes, cause, turn in zip((2, 6), stale, causes, (1, task.tool_coupling), strict=True):
        moved = columns[So + 1], cause - kv * kp * columns[So] - kv * columns[So + 1]
        for x, slope, share in ((So, slopes[0], 1.0), (So + 2, slopes[1], turn)):
            V, a = columns[x + 1], share * cause - kv * kp * columns[x] - kv * columns[x + 1]
            A[x] = columns[x] + V * T + a * T**2 / 2
            A[x] += slope * (moved[0] * T**3 / 6 + moved[1] * T**4 / 24)
            A[x + 1] = V + a * T + slope * (moved[0] * T**2 / 2 + moved[1] * T**3 / 6)
        felt = a + slope * (moved[0] * late + moved[1] * late**2 / 2)
        A[10] -= axis.force_scale * axis.displayed_tool_mass * felt
    A[10, 12] += axis.force_scale * axis.gamma
    C = np.zeros((2, 11))
    C[0, 1] = C[1, 3] = C[1, 7] = 1.0
    z = np.exp(1j * omega * T)[:, None, None]
    hold = -np.expm1(-1j * omega * T) / (1j * omega * T)
    G = C @ np.linalg.solve(z * np.eye(11) - A[:, :11], A[:, 11:].astype(complex))
    G = G / hold[:, None, None]
    (mm, ms), (sm, ss) = np.moveaxis(G, 0, -1)
    return np.moveaxis(np.array([[1 / mm, ms / mm], [-sm / mm, ss - sm * ms / mm]]), -1, 0)


def difference(H, other):
    """Return the largest relative difference of each entry."""
    return np.abs(H / other - 1).max(axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1.0])
@pytest.mark.parametrize("servo", [{}, DEADBEAT], ids=["servo", "ideal servo"])
def test_one_direction_equals_the_analytical_model(servo, sigma):
    scenario = replace(
        LoadScenario("ideal_sensor"),
        master__position=DECOUPLED,
        force_scaling__sigma=sigma,
        **servo,
    )
    task = task_direction(scenario, UP)
    system = vertical_only(linearize(scenario, load_estimate=true_load(scenario)))
    H = two_port_along(system, OMEGA, task.hand, task.tool)
    assert (difference(H, exact_two_port(scenario, OMEGA)) < 1e-6).all()


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_station_agrees_with_sampled_model_within_1_percent_up_to_30_hz(sigma):
    """Coulomb friction is left out."""
    scenario = replace(
        LoadScenario("free_motion_force"), force_scaling__sigma=sigma, slave__friction=[0.2]
    )
    task = task_direction(scenario, UP)
    cut = linearize(scenario, load_estimate=true_load(scenario))
    H = two_port_along(wired(cut), OMEGA, task.hand, task.tool)
    axis = changed(task.axis, device_mass=task.axis.device_mass + task.axis.hand_mass)
    sampling = Sampling(low_pass_hz=scenario.wrist_sensor.bandwidth_hz)
    assert (difference(H, sampled_two_port(axis, sampling, OMEGA)) < 0.01).all()


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_closed_form_with_delays_of_holds_and_filter_agrees(sigma):
    """The servo's loop has half a period more delay, the force a period and the low-pass's.

    A held input of the model acts on the sensor 1.5 samples earlier than a smooth one.
    """
    scenario = replace(LoadScenario("free_motion_force"), force_scaling__sigma=sigma)
    task = task_direction(scenario, UP)
    cut = linearize(scenario, load_estimate=true_load(scenario))
    H = two_port_along(wired(cut), OMEGA, task.hand, task.tool)
    axis, s = task.axis, 1j * OMEGA
    held = np.exp(-s * PERIOD / 2)
    pull = axis.velocity_gain * (s + axis.position_gain) * held
    spring = axis.velocity_gain * axis.position_gain * held
    servo = spring / (s**2 + pull), s / (axis.slave_mass * (s**2 + pull))
    low_pass = 2 * (np.cos(np.pi / 8) + np.cos(3 * np.pi / 8))
    low_pass /= 2 * np.pi * scenario.wrist_sensor.bandwidth_hz
    late = np.exp(-s * (PERIOD + low_pass - 1.5 / scenario.rates.sensor_hz))
    paper = hybrid_matrix(axis, s, servo=servo)
    device = device_impedance(axis, s)
    paper[:, 0, 0] = device + axis.hand_mass * s + late * (paper[:, 0, 0] - device)
    paper[:, 0, 1] *= late
    assert (difference(H, paper) < 0.01).all()


@pytest.mark.slow
def test_sideways_force_rotates_the_tool():
    """The tool's centre of mass moves 0.61 times as much as So, or as the tip."""
    scenario = replace(LoadScenario("ideal_sensor"), force_scaling__sigma=1.0)
    task = task_direction(scenario, (1.0, 0.0, 0.0))
    cut = linearize(scenario, load_estimate=true_load(scenario))
    system = cut.close_loop(["pose_command.x"], ["pose_received.x"])
    system = system.close_loop(["wrench_B.x"], ["wrench_received.x"])
    H = two_port_along(system, OMEGA, task.hand, task.tool)
    axis = changed(task.axis, device_mass=task.axis.device_mass + task.axis.hand_mass)
    assert not 0.9 < task.tool_coupling < 1.1
    turning = changed(axis, tool_mass=task.tool_coupling * axis.tool_mass)
    paper, turned = (sampled_two_port(a, Sampling(), OMEGA) for a in (axis, turning))
    assert np.abs(H[:, 0, 1] / turned[:, 0, 1] - 1).max() < 1e-3
    assert np.abs(H[:, 0, 1] / paper[:, 0, 1] - 1).max() > 0.1
    assert np.abs(H[:, 0, 0] / paper[:, 0, 0] - 1).max() < 1e-3


@pytest.mark.slow
def test_sideways_tip_compliance_includes_the_hands_wrist():
    """A force at the tip is a torque at the hand, which rotates the tool: 130 times softer."""
    scenario = replace(LoadScenario("ideal_sensor"), operator=OperatorConfig(grip="medium"))
    task = task_direction(scenario, (1.0, 0.0, 0.0))
    system = wired(linearize(scenario, load_estimate=true_load(scenario)))
    others = [axis for axis in COMPONENT_NAMES if axis != "x"]
    operator, hand = (
        [f"{port}.{a}" for a in others] for port in ("operator_wrench", "hand_wrench")
    )
    omega = np.array([0.5])  # rad/s
    H = two_port_along(system.close_loop(operator, hand), omega, task.hand, task.tool)
    compliance = (H[0, 1, 1] / (1j * omega[0])).real
    axis = task.axis
    servo = 1 / (axis.slave_mass * axis.velocity_gain * axis.position_gain)
    turning = 0.2**2 * axis.force_scale / scenario.operator.hand.rotational_stiffness
    assert compliance == pytest.approx(servo + turning, rel=0.01)


def leaf(scenario: Scenario) -> Scenario:
    """Return a scenario with a leaf 30 mm under the tip."""
    position = [0.55, 0.0, 0.45 - 0.2 - 0.03]
    sheet = SheetSpring(position=position, length=0.12, width=0.05, thickness=0.0015)
    return replace(scenario, sheet_spring=sheet)


@pytest.mark.slow
def test_displayed_stiffness_is_that_of_leaf_and_bodies_in_series():
    scenario = leaf(LoadScenario("free_motion_force"))
    task = task_direction(scenario, UP, displacement=(0.0, 0.0, -0.04))
    estimate, pressing = true_load(scenario), (0.0, 0.0, -0.04)
    cut = linearize(scenario, load_estimate=estimate, displacement=pressing)
    omega = np.array([0.5])  # rad/s
    stiffness = (1j * omega * two_port_along(wired(cut), omega, task.hand, task.tool)[:, 0, 0]).real
    axis = task.axis
    servo = axis.slave_mass * axis.velocity_gain * axis.position_gain
    touch = 4e5 / 2  # two equal bodies in series, N/m
    in_series = 1 / (1 / axis.wall_stiffness + 1 / servo + 1 / touch)
    inertia = (axis.device_mass + axis.hand_mass) * omega**2
    assert stiffness + inertia == pytest.approx(axis.force_scale * in_series, rel=1e-3)


def fitted_rate(y, about: complex) -> complex:
    """Return s of the sampled oscillation Re(e^(s t)), by linear prediction."""
    lag = round(np.pi / 2 / abs(about.imag) / PERIOD)
    past = np.column_stack([y[lag:-lag], y[: -2 * lag], np.ones(len(y) - 2 * lag)])
    a, b, _ = np.linalg.lstsq(past, y[2 * lag :], rcond=None)[0]
    z = np.roots([1.0, -a, -b]).astype(complex)
    s = np.log(z[np.argmax(z.imag)]) / (lag * PERIOD)
    return s


def frictionless(scenario: Scenario) -> Scenario:
    friction = changed(scenario.master.friction, coulomb=[0.0] * 6)
    return replace(scenario, master__friction=friction, rates__log_hz=1 / PERIOD)


def vertical_mode(system: Linearization) -> complex:
    """Return the slow oscillation that a vertical force of the hand excites most."""
    system = system.with_delays_as_states()
    z, modes = np.linalg.eig(system.A)
    push = np.linalg.solve(modes, system.B[:, system.inputs.index("hand_wrench.z")])
    seen = system.C[system.outputs.index("pose_command.z")] @ modes
    lasting = (np.abs(z) > 0.995) & (z.imag > 0)
    return np.log(z[np.argmax(np.abs(seen * push) * lasting)]) / PERIOD


@pytest.mark.slow
def test_multipliers_predict_a_slow_decay():
    scenario = frictionless(LoadScenario("ideal_sensor"))
    scenario = replace(scenario, operator=OperatorConfig(grip="light"), master__position=DECOUPLED)
    estimate = true_load(scenario)
    predicted = vertical_mode(linearize_station(scenario, load_estimate=estimate))
    diagram = MakeTeleopStation(scenario, load_estimate=estimate)
    simulator = MakeSimulator(diagram, scenario.simulation)
    simulator.Initialize()
    master = GetBlock(diagram, "master_device")
    context = master.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    state = context.get_mutable_discrete_state(0).get_mutable_value()
    state[6:] = np.linalg.solve(arrays.jacobian(state[:6]), [0, 0, 2e-3, 0, 0, 0])
    simulator.AdvanceTo(0.7)
    height = read_recorded_signals(simulator, 0.0)["pose_master"][200:, 6]
    assert_same_rate(fitted_rate(height, predicted), predicted)


@pytest.mark.slow
def test_multipliers_predict_growth_over_a_network():
    """Pressing on the leaf over 20 ms is unstable."""
    scenario = replace(
        leaf(frictionless(LoadScenario("ideal_sensor"))),
        operator=OperatorConfig(grip="medium"),
        master__position=[0.215, 0.0, -0.1],
        channel=Channel(delay=0.02),
    )
    estimate, depth = true_load(scenario), 0.03
    displacement = [0.0, 0.0, -0.03 - depth]
    system = linearize_station(scenario, load_estimate=estimate, displacement=displacement)
    predicted = vertical_mode(system)
    assert predicted.real == pytest.approx(np.log(np.abs(system.multipliers[0])) / PERIOD)
    force = scenario.force_scaling.force_scale * scenario.sheet_spring.stiffness * depth
    reach = displacement[2] - force / scenario.operator.hand.stiffness
    press = MinimumJerk(t_start=0.6, duration=1.2, translation=[0.0, 0.0, reach])
    scenario = replace(scenario, operator__intent=[press])
    diagram = MakeTeleopStation(scenario, load_estimate=estimate)
    simulator = MakeSimulator(diagram, scenario.simulation)
    simulator.Initialize()
    simulator.AdvanceTo(2.6)
    height = read_recorded_signals(simulator, 2.0)["pose_master"][:, 6]
    assert np.ptp(height) < 2 * depth  # permanent contact
    assert_same_rate(fitted_rate(height, predicted), predicted)


def assert_same_rate(simulated: complex, predicted: complex) -> None:
    assert simulated.real == pytest.approx(predicted.real, rel=0.02)
    assert simulated.imag == pytest.approx(predicted.imag, rel=0.02)


def small_system() -> Linearization:
    rng = np.random.default_rng(1)
    A, B, C = (rng.standard_normal(size) for size in ((4, 4), (4, 2), (2, 4)))
    A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    ports = (("force", "wrench"), ("motion", "felt"))
    return Linearization(A, 0.1 * B, C, np.zeros((2, 2)), 1e-3, tuple("abcd"), *ports)


@pytest.mark.parametrize("periods", [0, 1, 7])
def test_closing_with_delay_agrees_with_shift_registers(periods):
    import control

    system = small_system().close_loop(["felt"], ["wrench"], periods)
    omega = np.linspace(1.0, 3000.0, 20)
    G = system.frequency_response(omega)
    assert system.with_delays_as_states().frequency_response(omega) == pytest.approx(G, rel=1e-9)
    response = control.frequency_response(system.to_control(), omega)
    assert np.moveaxis(response.frdata, -1, 0) == pytest.approx(G, rel=1e-9)
    # At a multiplier of the closed loop the return difference is singular.
    z = system.multipliers[0]
    g = small_system()
    loop = (g.C @ np.linalg.solve(z * np.eye(4) - g.A, g.B.astype(complex)))[1, 1]
    assert loop * z**-periods == pytest.approx(1.0, rel=1e-8)


def test_control_object_has_the_names_of_ports():
    parts = {"inputs": ("hand_wrench.x", "hand_wrench.rx"), "outputs": ("twist_master.x", "felt")}
    system = changed(small_system(), **parts).to_control()
    assert system.input_labels == ["hand_wrench[x]", "hand_wrench[rx]"]
    assert system.output_labels == ["twist_master[x]", "felt"]


def test_unknown_port_raises():
    said = r"'pose\.x' is no port or component of this model; name one of"
    with pytest.raises(DrakeTeleopError, match=said):
        small_system().close_loop("pose", "wrench")


def test_sparse_search_finds_the_largest_multipliers():
    few = small_system().close_loop(["felt"], ["wrench"], 40)
    padded = few.with_delays_as_states()
    idle = 800
    A = np.zeros((len(padded.A) + idle,) * 2)
    A[:-idle, :-idle] = padded.A
    names = (*padded.states, *(f"idle {k}" for k in range(idle)))
    B, C = np.pad(padded.B, ((0, idle), (0, 0))), np.pad(padded.C, ((0, 0), (0, idle)))
    large = changed(padded, A=A, B=B, C=C, states=names)
    assert np.abs(large.multipliers[:4]) == pytest.approx(np.abs(few.multipliers[:4]), rel=1e-9)


def test_rates_method_and_direction_without_linear_model_raise():
    scenario = LoadScenario("free_motion_force")
    with pytest.raises(DrakeTeleopError, match=r"^rates\.joint_control_hz: 10000 Hz .* hand_hz, "):
        linearize(replace(scenario, rates__joint_control_hz=10000.0))
    with pytest.raises(
        DrakeTeleopError, match=r"^rates\.sensor_hz: 7000 Hz is no multiple of hand"
    ):
        linearize(replace(scenario, rates__sensor_hz=7000.0))
    with pytest.raises(DrakeTeleopError, match=r"passivity\.method"):
        linearize_station(replace(scenario, passivity=PassivityConfig(method="tdpa")))
    with pytest.raises(DrakeTeleopError, match="direction"):
        task_direction(scenario, (0.0, 0.0, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "blocks",
    [
        "{contact_detection: {}}",
        "{load_estimator: {enabled: true, method: rtls, watch: true}}",
        "{load_estimator: {watch: true}, contact_detection: {margin: 2}}",
    ],
)
def test_estimation_and_detection_do_not_prevent_linearisation_and_probing(
    tmp_path, monkeypatch, blocks
):
    class StationMadeError(Exception): ...

    def stop(*_: object, **__: object):
        raise StationMadeError

    monkeypatch.setattr(linearization._PeriodSimulator, "find_rest_state_and_derivatives", stop)
    monkeypatch.setattr(frequency_response, "simulate", stop)
    (tmp_path / "mine.yaml").write_text(blocks)
    scenario = LoadScenario(tmp_path / "mine.yaml")
    with pytest.raises(StationMadeError):
        linearize(scenario, load_estimate=true_load(scenario))
    along = task_direction(scenario, UP)
    with pytest.raises(StationMadeError):
        measure_free_impedance(scenario, along, system=None)


@pytest.mark.parametrize(
    ("displacement", "message"),
    [((0.01,), r"shape \(1,\)"), ((0.0, np.nan, 0.0), "is not finite"), (0.01, "shape")],
)
def test_displacement_that_is_no_vector_raises(displacement, message):
    with pytest.raises(DrakeTeleopError, match=f"^displacement: .*{message}"):
        linearize(LoadScenario("free_motion_force"), displacement=displacement)
