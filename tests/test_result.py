"""SimulationResult: names, units, round trip, reproducible files, canonical log."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.result import Signal, SimulationResult

XYZ = ("x", "y", "z")
SPECS = (
    Signal(
        "measured_wrench_S",
        ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z"),
        ("N",) * 3 + ("N m",) * 3,
        "wrench on the load, sign of Eq. (1)",
    ),
    Signal("specific_force_S", XYZ, "m/s^2"),
    Signal("angular_velocity_S", XYZ, "rad/s"),
    Signal("angular_acceleration_S", XYZ, "rad/s^2"),
    Signal("sample_time", ("t",), "s"),
    Signal("sigma", ("sigma",), "1"),
)


def make_result(samples: int = 50, seed: int = 3) -> SimulationResult:
    rng = np.random.default_rng(seed)
    arrays = {s.name: rng.standard_normal((samples, len(s.components))) for s in SPECS}
    t = np.arange(samples) / 8000.0
    arrays["sample_time"] = t - 1 / 8000.0
    return SimulationResult(t, arrays, SPECS)


def test_signals_are_found_by_name_and_have_units():
    result = make_result()
    assert result.signals == tuple(spec.name for spec in SPECS)
    assert "sigma" in result and "force" not in result
    assert len(result) == 6 and list(result) == list(result.signals)
    assert result["measured_wrench_S"].shape == (50, 6)
    assert result["sigma"].shape == (50, 1)
    assert result.units["measured_wrench_S"] == {
        "f_x": "N", "f_y": "N", "f_z": "N", "tau_x": "N m", "tau_y": "N m", "tau_z": "N m",
    }  # fmt: skip


def test_a_column_of_the_data_frame_is_found_by_its_name(tmp_path):
    result = make_result()
    result.write_parquet(tmp_path / "log.parquet")
    for each in (result, SimulationResult.scan_parquet(tmp_path / "log.parquet")):
        for column in each.to_dataframe().columns:
            assert column in each
            np.testing.assert_array_equal(each[column], result.to_dataframe()[column].to_numpy())
    assert result["measured_wrench_S.tau_x"].shape == (50,)
    assert "measured_wrench_S.g_x" not in result and "t.t" not in result
    with pytest.raises(KeyError, match=r"measured_wrench_S\.tau_x"):
        result["measured_wrench_S.taux"]


def test_column_of_a_replaced_spec_is_not_found():
    specs = [Signal("force", ("x",), "N"), Signal("force", ("y",), "N")]
    result = SimulationResult([0.0], {"force": [[1.0]]}, specs)
    assert result["force.y"] == [1.0]
    assert "force.x" not in result


def test_a_notebook_completes_signals_and_columns():
    offered = make_result()._ipython_key_completions_()
    assert {"t", "sigma", "measured_wrench_S", "measured_wrench_S.tau_x"} <= set(offered)
    assert all(name in make_result() for name in offered)


def test_pandas_has_the_same_table():
    result = make_result()
    table = result.to_pandas()
    assert list(table.columns) == result.to_dataframe().columns
    np.testing.assert_array_equal(table["sigma.sigma"], result["sigma.sigma"])


def test_without_pandas_the_extra_is_named(monkeypatch):
    def missing(self):
        raise ModuleNotFoundError("No module named 'pandas'", name="pandas")

    monkeypatch.setattr(pl.DataFrame, "to_pandas", missing)
    with pytest.raises(DrakeTeleopError, match=r"pandas is not installed, but.*; .*\[notebook\]"):
        make_result().to_pandas()


def test_a_column_can_be_drawn():
    (axes,) = make_result().plot("measured_wrench_S.tau_x").axes
    assert (axes.get_ylabel(), len(axes.lines)) == ("N m", 1)


def test_single_component_may_be_one_dimensional():
    result = SimulationResult([0.0, 1.0], {"sigma": [0.5, 0.7]}, [SPECS[-1]])
    np.testing.assert_array_equal(result["sigma"], [[0.5], [0.7]])


def test_unknown_name_suggests_the_right_one():
    with pytest.raises(KeyError, match="measured_wrench_S"):
        make_result()["measured_wrench"]
    with pytest.raises(KeyError, match="there are"):
        make_result().plot("nonsense")
    with pytest.raises(KeyError, match="abscissa"):
        make_result().plot("sigma", "t")


def test_arrays_are_read_only_but_not_those_of_the_caller():
    t = np.zeros(2)
    result = SimulationResult(t, {"sigma": np.zeros(2)}, [SPECS[-1]])
    with pytest.raises(ValueError, match="read-only"):
        result["sigma"][0] = 1.0
    t[0] = 1.0


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({}, "contains sigma"),
        ({"sigma": np.zeros(3)}, "shape"),
        ({"sigma": np.zeros((2, 2))}, "shape"),
    ],
)
def test_inconsistent_signals_are_rejected(arrays, message):
    with pytest.raises(ValueError, match=message):
        SimulationResult([0.0, 1.0], arrays, [SPECS[-1]])


@pytest.mark.parametrize("t", [0.5, [[0.0, 1.0]], [[0.0], [1.0]]])
def test_times_in_a_table_are_rejected(t):
    with pytest.raises(DrakeTeleopError, match=r"t: has shape .* instead of \(N,\); give one time"):
        SimulationResult(t, {"sigma": np.zeros(np.shape(t)[:1] or 1)}, [SPECS[-1]])


def test_a_signal_needs_a_unit_for_every_component():
    with pytest.raises(ValueError, match="3 components, but 2 units"):
        Signal("force", XYZ, ("N", "N"))


def test_dataframe_columns():
    result = make_result()
    table = result.to_dataframe()
    assert table.columns[:3] == ["t", "measured_wrench_S.f_x", "measured_wrench_S.f_y"]
    assert table.columns[-1] == "sigma.sigma"
    np.testing.assert_array_equal(
        table["measured_wrench_S.tau_z"].to_numpy(), result["measured_wrench_S"][:, 5]
    )


def test_parquet_round_trip_keeps_values_units_and_descriptions(tmp_path):
    result = make_result()
    result.write_parquet(tmp_path / "log.parquet")
    back = SimulationResult.read_parquet(tmp_path / "log.parquet")
    assert back.specs == result.specs
    np.testing.assert_array_equal(back.t, result.t)
    for name in result:
        np.testing.assert_array_equal(back[name], result[name])


def test_same_data_same_bytes_other_data_other_bytes(tmp_path):
    # More samples than a row group contains, so that its size matters.
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        make_result(70_000, seed).write_parquet(tmp_path / name)
    a, b, c = ((tmp_path / name).read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_other_and_absent_files_give_one_error(tmp_path):
    pl.DataFrame({"t": [0.0]}).write_parquet(tmp_path / "foreign.parquet")
    (tmp_path / "text.parquet").write_text("no table at all")
    names = ["foreign.parquet", "text.parquet", "absent.parquet"]
    for spoilt in ("{", "3", '[{"name": "x"}]', "[" * 2000):
        names.append(f"{len(names)}.parquet")
        metadata = {"drake_teleop.station.signals": spoilt}
        pl.DataFrame({"t": [0.0]}).write_parquet(tmp_path / names[-1], metadata=metadata)
    for name in names:
        with pytest.raises(DrakeTeleopError, match=f"{name}: is not a simulation result"):
            SimulationResult.read_parquet(tmp_path / name)


def test_sensor_log_is_the_canonical_table():
    result = make_result()
    log = result.sensor_log()
    assert log.columns == [
        "t", "f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z", "s_x", "s_y", "s_z",
        "omega_x", "omega_y", "omega_z", "alpha_x", "alpha_y", "alpha_z",
    ]  # fmt: skip
    np.testing.assert_array_equal(log["alpha_y"].to_numpy(), result["angular_acceleration_S"][:, 1])
    np.testing.assert_array_equal(log["t"].to_numpy(), result["sample_time"][:, 0])


def test_repeated_rows_are_merged_in_the_sensor_log():
    result = make_result(4)
    arrays = {name: result[name].repeat(2, axis=0) for name in result}
    fast = SimulationResult(np.arange(8) / 16000.0, arrays, SPECS)
    assert fast.sensor_log().equals(result.sensor_log())


def test_sensor_log_lists_missing_signals():
    result = SimulationResult([0.0], {"sigma": [0.0]}, [SPECS[-1]])
    with pytest.raises(DrakeTeleopError, match="measured_wrench_S"):
        result.sensor_log()


def test_plot_has_one_subplot_for_each_signal_and_unit():
    result = make_result()
    contact = np.zeros(50, bool)
    contact[10:20] = contact[30:35] = True
    figure = result.plot("measured_wrench_S", "sigma", contact=contact)
    assert [axes.get_ylabel() for axes in figure.axes] == ["N", "N m", ""]
    assert [len(axes.lines) for axes in figure.axes] == [3, 3, 1]
    assert figure.axes[-1].get_xlabel() == "t [s]"
    spans = [(patch.get_x(), patch.get_width()) for patch in figure.axes[0].patches]
    np.testing.assert_allclose(spans, [(10 / 8e3, 9 / 8e3), (30 / 8e3, 4 / 8e3)])


def test_repr_lists_signals_with_units():
    result = make_result()
    text = repr(result)
    assert "50 samples, 0 to 0.006125 s" in text
    assert "f_x, f_y, f_z [N], tau_x, tau_y, tau_z [N m]" in text
    assert "<code>angular_velocity_S</code>" in result._repr_html_()
    assert "no samples" in repr(SimulationResult([], {}, []))


@pytest.mark.pictures
def test_a_notebook_can_show_the_plot():
    assert make_result().plot("sigma")._repr_png_().startswith(b"\x89PNG")


def test_a_slice_is_a_result_with_these_rows():
    result = make_result()
    part = result[10:20:2]
    assert isinstance(part, SimulationResult) and part.specs == result.specs
    np.testing.assert_array_equal(part.t, result.t[10:20:2])
    for name in result:
        np.testing.assert_array_equal(part[name], result[name][10:20:2])


@pytest.mark.parametrize(
    ("specs", "name"),
    [
        ([Signal("a", ("x", "x"), "m")], "a.x"),
        ([Signal("a", ("x", "y"), "m"), Signal("a", ("u", "u"), "m")], "a.u"),
        ([Signal("t", ("x", "y"), "m")], "t"),
    ],
)
def test_equal_names_are_rejected(specs, name):
    """A table would lose a column without a message."""
    with pytest.raises(DrakeTeleopError, match=f"specs: the name '{name}' occurs more than once"):
        SimulationResult([0.0, 1.0], {specs[0].name: np.zeros((2, 2))}, specs)
