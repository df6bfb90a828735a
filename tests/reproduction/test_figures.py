"""Layout of the figures: equal scales, axis of the master, marks."""

from __future__ import annotations

import io

import numpy as np
import pytest

from drake_teleop.lab.reproduction.experiments import MotionRun, RunsWithAndWithoutContact
from drake_teleop.lab.reproduction.report import FORCE_Z_INDEX, contact_figure, scaling_figure
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.signals import SIGNALS

T = np.linspace(0, 0.8, 801)
RAW = 100 * np.sin(10 * T)
TOUCHED = (T > 0.22) & (T < 0.26)


def vertical(force):
    """Return a wrench (N, 6) with this f_z (N,)."""
    return np.asarray(force, float)[:, np.newaxis] * np.eye(6)[FORCE_Z_INDEX]


def motion_run(wrenches, t=T, touched=0 * T):
    name = "true_contact_wrench_W"
    result = SimulationResult(t, {name: vertical(touched)}, [SIGNALS[name]])
    scaled = {sigma: vertical(force) for sigma, force in wrenches.items()}
    return MotionRun(LoadScenario("free_motion_force"), result, scaled)


def scaling(t=T):
    run = motion_run({1.0: RAW, 0.5: 0.5 * RAW, 0.0: 0.01 * RAW}, t)
    return scaling_figure(run, FORCE_Z_INDEX, "$f_z$", "N")


def contact(touched=TOUCHED, detected_s=0.225):
    with_contact = motion_run({1.0: RAW + 20 * touched, 0.0: 20.0 * touched}, touched=touched)
    free = motion_run({1.0: RAW, 0.0: np.full(len(T), 2.0)})
    return contact_figure(RunsWithAndWithoutContact(with_contact, free), detected_s)


def render(figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def test_subplots_share_a_scale_that_contains_all_data():
    figure = scaling()
    low, high = figure.axes[0].get_ylim()
    assert all(axes.get_ylim() == (low, high) for axes in figure.axes)
    assert low < RAW.min() and high > RAW.max()
    assert len(figure.axes) == 3
    np.testing.assert_array_equal(figure.axes[1].lines[0].get_ydata(), 0.5 * RAW)


@pytest.mark.slow
@pytest.mark.pictures
def test_right_axis_shows_values_at_the_master():
    figure = scaling()
    render(figure)  # drawing sets the limits of secondary axes
    (right,) = figure.axes[0].child_axes
    np.testing.assert_allclose(np.array(right.get_ylim()) * 17.5, figure.axes[0].get_ylim())
    assert right.get_ylabel() == "at the master [N]"


def test_notes_contain_peaks_and_titles_contain_sigma():
    first, middle, last = scaling().axes
    assert first.get_title("right").startswith("peak 100 N")
    assert "5.71 N at the master" in first.get_title("right")
    assert "50% of the non-contact part" in middle.get_title("left")
    assert last.get_title("left").startswith("σ = 0")
    assert last.get_title("right").startswith("peak 1.00 N")


@pytest.mark.parametrize(("stretch", "unit", "end"), [(1, "t [ms]", 800.0), (5, "t [s]", 4.0)])
def test_time_axis_is_in_milliseconds_up_to_two_seconds(stretch, unit, end):
    bottom = scaling(stretch * T).axes[-1]
    assert bottom.get_xlabel() == unit
    assert bottom.get_xlim() == (0, end)


def test_contact_is_shaded_and_marked():
    upper, lower = contact().axes
    assert upper.get_ylim() == lower.get_ylim()
    for axes in (upper, lower):
        (shade,) = axes.patches
        assert shade.get_x() == pytest.approx(221.0)
        assert shade.get_x() + shade.get_width() == pytest.approx(259.0)
    marks = [(text.get_text(), text.xy[0]) for text in (*upper.texts, *lower.texts)]
    assert marks == [
        ("no contact", pytest.approx(471.0)),
        ("contact", pytest.approx(221.0)),
        ("no contact", pytest.approx(471.0)),
        ("detected", 225.0),
    ]
    assert "threshold 3.00 N" in lower.get_title("right")


def test_figure_without_contact_has_no_contact_mark():
    upper, lower = contact(touched=0 * T).axes
    assert not upper.patches and not upper.texts
    assert [text.get_text() for text in lower.texts] == ["detected"]


@pytest.mark.slow
@pytest.mark.pictures
def test_picture_is_reproducible():
    assert render(scaling()) == render(scaling())
    assert render(contact()) != render(contact(detected_s=0.3))
