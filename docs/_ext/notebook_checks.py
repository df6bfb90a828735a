"""Hidden checks of the notebooks, executed after each of them when the site is built."""

from __future__ import annotations

#: Assertions by notebook, about its variables.
CHECKS = {
    "01_quickstart": """
assert abs(load.mass - 3.13) < 0.01
assert np.abs(felt(1.0)[:, 2]).max() > 85
assert np.abs(felt(0.0)[:, 2]).max() < 5
np.testing.assert_allclose(felt(0.5), (felt(0.0) + felt(1.0)) / 2, atol=1e-9)
drawn, original = [], draw
def draw(sigma):
    drawn.append(sigma)
    return original(sigma)
feel.widget.children[0].value = 0.25
assert drawn == [0.25]
""",
    "02_delay_and_passivity": """
assert measures_of_run(short, model).stable and not measures_of_run(long, model).stable
assert created[0.05] > 1.0 and created[0.002] < 0.05
assert passive.least_energy_sum(AT_SLAVE) >= 0.0
assert over_internet.keys() == over_300_ms.keys() == set(METHODS)
both_runs = (over_internet, over_300_ms)
found = [{m: measures_of_run(r, model) for m, r in runs.items()} for runs in both_runs]
assert not found[0]["none"].stable and not found[1]["none"].stable
assert found[0]["ledger"].stable and abs(found[0]["ledger"].force_error) < 0.01
assert found[1]["wave"].stable and abs(found[1]["wave"].force_error) < 0.01
assert min(over_300_ms[m].least_energy_sum(AT_SLAVE) for m in ("wave", "pspm", "ledger")) >= 0.0
assert other_hands["none"].release_speed > 1.0 > 3 * other_hands["ledger"].release_speed
assert other_hands["ledger"].leaked == 0.0 < other_hands["tdpa"].leaked
assert np.ptp(age["playout 150 ms"][400:]) < 1e-9 and np.ptp(age["internet"][400:]) > 0.02
assert difference == 0.0 and np.abs(through_buffer.hand_force).max() > 0.5
silent = (cut.t > 8.31) & (cut.t < 9.04)
assert np.abs(cut.hand_force[silent]).max() == 0.0 and np.ptp(cut.command_position[silent]) == 0.0
assert np.abs(cut.hand_force[8000]) > 0.5 and np.abs(cut.hand_force[11000]) > 0.5
assert np.abs(np.diff(cut.hand_force[7500:11000])).max() < 0.5
assert covering[0.0][0].max() == 0.0 and (np.diff(covering[0.0], axis=0) > 0.1).all()
assert np.ptp(covering[5100.0][:, 1:], axis=0).max() < 1e-3  # the same for every sigma
assert (np.diff(longest) > 0.0).all()
saturated = {names: result["saturated"].mean() for names, result in station_runs.items()}
assert saturated["none", "internet"] > 0.1 and saturated["none", "with a buffer"] == 0.0
both = {k: energy[:, [AT_HAND, AT_SLAVE]].sum(axis=1) for k, energy in station_energy.items()}
assert both["none", "internet"].min() < -0.05
result = station_runs["two_layer", "with a buffer"]
happened = result.t[np.argmax(result["true_contact_wrench_W"][:, 2] > 5.0)]
felt = result.t[np.argmax(result["force_to_master"][:, 2] > 5.0 / 17.5)]
assert abs(felt - happened - 0.12) < 0.01
assert result["ports"][:, :4].sum(axis=1).min() > -0.0204
assert both["two_layer", "with a buffer"].min() > -0.005
""",
    "03_stability_and_transparency": """
below = omega <= 2 * np.pi * 30
assert deviation["sampled"][below].max(axis=0)[0, 1] < 1e-4 < deviation["paper"][below].max()
assert deviation["sampled"][below].max() < 1e-3
np.testing.assert_allclose(list(apparent.values()), [0.0, 1.565, 3.13], atol=0.03)
assert 0.018 < exact < continuous < 0.025
assert trips["light"] == 0.0 and trips["firm"] == np.inf
assert parameter.min() < 0 and lacking > 100
assert 2e3 < limit.min() < 3e3
assert (stable > passive).all() and stable[-1] > 5 * stable[0]
swinging, held = maps["free motion, light grip"], maps["wall of 5.1 kN/m, medium grip"]
assert swinging.stable[0].all() and not swinging.stable[50].all()  # sigma = 0, about 1
assert held.stable[0].sum() < held.stable[50].sum() < held.stable[-1].sum()
assert 0.7 * bound < most < bound
assert abs(closed.multipliers[0]) < 1
assert np.abs(ratio - 1).max() < 0.02 and coherence.min() > 0.95
""",
    "04_scaling_study": """
assert all(measures["success"] == 1 for _, measures in runs.values())
assert runs[1.0][1]["detection_time_s"] > runs[0.0][1]["detection_time_s"] + 0.03
assert runs[1.0][1]["effort_Ns"] > 3 * runs[0.0][1]["effort_Ns"]
assert summary["runs"] == 8 and summary["failed"] == 0
effort = found.filter(measure="effort_Ns", factor="force_scaling.sigma")["mean"]
assert (np.diff(effort) > 0).all()
scales = ["force_scaling.sigma", "force_scaling.gamma"]
late = rows.group_by(scales).agg(pl.col("detection_time_s").mean()).sort(scales)
late = late["detection_time_s"].to_numpy().reshape(2, 2)
assert (late[1] > late[0]).all() and (np.diff(late[1]) < 0).all()
assert 0 < points["front"].sum() < 4
""",
    "05_own_station": """
assert first["warnings"] == [] and first["mass_error_percent"] < 0.1
assert any("finger" in line for line in first["assumed"])
assert abs(load.identification.mass - 0.76) < 0.01
kf = scenario.force_scaling.force_scale
free, held = runs[0.0].t < 2.5, runs[0.0].t > 4.0
felt = {sigma: run["force_to_master"][:, 2] / kf for sigma, run in runs.items()}
assert abs(felt[0.0][free]).max() < 0.5
assert abs(felt[1.0][free].mean() + 0.76 * 9.81) < 0.5
wall = runs[0.0]["true_contact_wrench_W"][held, 2].mean()
assert wall > 4.0 and abs(felt[0.0][held].mean() / wall - 1) < 0.02
""",
    "06_drive": """
assert same and np.array_equal(np.diff(log.t) > 0.0, np.ones(len(log.t) - 1, bool))
assert felt[300:800].max() > 1.5 and felt[1100:1550].max() < 0.1 < felt[2300]
changed = slice(2395, None)  # to the internet and a method
assert np.abs(np.diff(felt[changed])).max() < 0.02
assert np.linalg.norm(np.diff(log["pose_received"][2398:2403, 4:], axis=0), axis=1).max() < 1e-4
""",
    "07_your_diagram": """
assert load.identifiable.all() and abs(load.mass - 1.5) < 0.01
np.testing.assert_allclose(load.com, [0.01, 0.0, 0.09], atol=3e-3)
measured, contact, received = size
assert contact[500:1000].mean() < 0.5 < 12.0 < measured[500:1000].mean()
assert abs(contact[1200:].mean() - 10.0) < 0.1
late = [int(np.argmax(force[900:] > 5.0)) for force in (contact, received)]
assert late[1] - late[0] == 50  # ms
""",
}
