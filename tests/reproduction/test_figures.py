"""Layout of the figures: equal scales, axis of the master, marks."""

from __future__ import annotations

import io

import numpy as np
import pytest

from drake_teleop.lab.reproduction.figures import contact_figure, scaling_figure

T = np.linspace(0, 0.8, 801)
RAW = 100 * np.sin(10 * T)


def scaling(t=T, downscaling=17.5):
    values = [RAW, 0.5 * RAW, 0.01 * RAW]
    return scaling_figure(t, values, [1, 0.5, 0], symbol="$f_z$", unit="N", downscaling=downscaling)


def contact(**changes):
    touched = (T > 0.22) & (T < 0.26)
    settings = {
        "symbol": "$f_z$",
        "contact": touched,
        "detected_s": 0.225,
        "threshold": 3.0,
        "turning_s": 0.6,
    }
    return contact_figure(T, RAW + 20 * touched, 20.0 * touched, **(settings | changes))


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
        ("no contact", 600.0),
        ("contact", pytest.approx(221.0)),
        ("no contact", 600.0),
        ("detected", 225.0),
    ]
    assert "threshold 3.00 N" in lower.get_title("right")


def test_figure_without_contact_has_no_contact_mark():
    upper, lower = contact(contact=np.zeros(len(T), bool), turning_s=None).axes
    assert not upper.patches and not upper.texts
    assert [text.get_text() for text in lower.texts] == ["detected"]


@pytest.mark.slow
@pytest.mark.pictures
def test_picture_is_reproducible():
    assert render(scaling()) == render(scaling())
    assert render(contact()) != render(contact(detected_s=0.3))
