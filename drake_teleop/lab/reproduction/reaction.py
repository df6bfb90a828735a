"""Elimination from the plant's own reaction force in the wrist, as an independent check of V.

The ideal sensor samples V phi, so elimination from its samples leaves zero for any V. Drake's
reaction force of the tool's weld does not use V.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.common.progress import Progress
from drake_teleop.lab.identification import sensor_samples, slave_arm
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import MakeSimulator, advance, read_log
from drake_teleop.station.station import GetBlock, MakeTeleopStation


def eliminated_reaction(scenario: Scenario, progress: Progress) -> Array:
    """Run a free movement with an ideal sensor; eliminate the true load from the reaction force.

    Returns:
        (N, 6) F - V phi [N, N m] after the settling time; only rounding errors if V is correct.
    """
    rate, simulation = scenario.rates.log_hz, scenario.simulation
    phi = slave_arm(scenario).phi_load
    ideal = replace(scenario, wrist_sensor__ideal=True, rates__sensor_hz=rate)
    station = MakeTeleopStation(ideal, load_estimate=np.concatenate([np.zeros(6), phi]))
    plant, simulator = GetBlock(station, "slave_plant"), MakeSimulator(station, simulation)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    reactions = plant.get_reaction_forces_output_port()
    weld = plant.GetJointByName("sensor_weld")
    place = list(plant.GetJointIndices()).index(weld.index())
    wrenches = np.empty((round((simulation.settle + simulation.duration) * rate) + 1, 6))
    for k in range(len(wrenches)):
        advance(simulator, k * (1 / rate))  # the same product as Drake's event times
        reaction = reactions.Eval(context)[place]
        wrenches[k] = *reaction.translational(), *reaction.rotational()
        if k % 256 == 0:
            progress(k / len(wrenches))
    progress(1.0)
    result = read_log(simulator, simulation.settle)
    taken = np.rint((result["sample_time"][:, 0] + simulation.settle) * rate).astype(int)
    _, s, omega, alpha = sensor_samples(result)
    started = taken >= 0
    return contact_wrench(
        wrenches[taken[started]], np.zeros(6), s[started], omega[started], alpha[started], phi
    )
