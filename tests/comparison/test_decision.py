"""Verdicts of the decision table, and runs with letting go and taps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drake_teleop.lab.comparison import compare_passivity
from drake_teleop.lab.comparison.compare_passivity import simulate_release_and_taps
from drake_teleop.lab.comparison.one_dof import AT_SLAVE
from drake_teleop.lab.comparison.report import (
    draw_decision_table,
    draw_energy_traces,
    draw_force_traces,
    stability_table,
)
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig


def summary(hands_leaked: float = 0.0, **second_leaf: object) -> dict[str, object]:
    """Return a good result of one method on two leaves, with changes to the second."""
    good = {"method": "tdpa", "network": "lan", "stable": True, "felt_force": 3.9}
    good |= {"pressed_force": 4.0, "left_behind": 1e-3, "leaked": 0.0, "fast_force": 0.049}
    good |= {"hunting": 1e-5, "turning": 1e-4}
    return {
        "methods": ["tdpa"],
        "networks": ["lan"],
        "station": [good, good | second_leaf],
        "hands": [{"method": "tdpa", "network": "lan", "leaked": hands_leaked}],
    }


@pytest.mark.parametrize(
    ("changes", "words", "share"),
    [
        ({}, "holds", "98%"),
        ({"felt_force": 6.0, "pressed_force": 8.0}, "holds", "75%"),
        ({"leaked": 0.9e-3, "left_behind": 4.9e-3}, "holds", "98%"),
        ({"leaked": 0.01234}, "leaks 12 mJ", "98%"),
        ({"hands_leaked": 2.345}, "leaks 2.3 J", "98%"),
        ({"hands_leaked": 1.0, "fast_force": 0.051}, "chatters", "98%"),
        ({"fast_force": 1.0, "left_behind": 5.1e-3}, "position error", "98%"),
        ({"stable": False, "left_behind": 1.0, "leaked": 1.0}, "unstable", ""),
        # A run that ended early.
        (
            {"stable": False, "felt_force": None, "left_behind": None, "leaked": None}
            | {"hunting": None, "turning": None},
            "unstable",
            "",
        ),
    ],
)
def test_cell_has_the_first_verdict_that_applies(changes, words, share):
    (cell,) = stability_table(summary(**changes)).values()
    assert (cell.verdict_text, cell.least_displayed_share_text) == (words, share)
    (axes,) = draw_decision_table(summary(**changes)).axes
    written = [text.get_text() for text in axes.texts]
    assert words in written[0] and len(written) == 3


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"hunting": 0.0517, "turning": 0.1}, "moves by 52 mm"),
        ({"hunting": 1e-5, "turning": 0.1083}, "turns by 110 mrad"),
        ({"hunting": None, "turning": None}, "ended early"),
    ],
)
def test_unstable_cell_has_leaf_and_motion(figures, words):
    (axes,) = draw_decision_table(summary(stable=False, **figures)).axes
    assert [text.get_text() for text in axes.texts][1:] == ["at rest", words]


def test_letting_go_accelerates_the_device_without_a_method():
    none, ledger = (
        simulate_release_and_taps("none", "internet"),
        simulate_release_and_taps("ledger", "internet"),
    )
    assert none.release_speed > 1.0 and none.leaked > 1.0 and none.release_way > 1.0
    assert ledger.release_speed < 0.3 and ledger.leaked <= 1e-6
    assert ledger.release_force > 2.5 and ledger.release_way < 0.1
    # Without a method every impulse arrives, also with a delay of half a tap.
    for shown in (none, simulate_release_and_taps("none", "geostationary")):
        assert shown.tap_shares == pytest.approx((1.0, 1.0), abs=0.02)
    assert ledger.tap_shares == pytest.approx((1.0, 1.0), abs=0.25)


def test_impulses_count_from_the_delay_of_one_way(monkeypatch):
    """Each impulse arrives, 0.3 s late, but not that of the first contact."""

    def run(model, passivity, network, *, intent, **_):
        wall = np.minimum(1e3 * intent[:, 0], 0.0)
        felt = np.concatenate([np.zeros(300), model.force_scale * model.gamma * wall[:-300]])
        felt[: 500 + 333 + 310] = 0.0
        return SimpleNamespace(
            wall_force=wall,
            hand_force=felt,
            master_position=intent[:, 0],
            least_energy_sum=lambda place: -0.1 * place,
        )

    monkeypatch.setattr(compare_passivity.one_dof, "run_one_dof", run)
    monkeypatch.setitem(compare_passivity.PRESETS, "late", NetworkConfig(delay=0.3))
    monkeypatch.setattr(compare_passivity, "Channel", lambda **_: Channel())
    monkeypatch.setattr(compare_passivity, "TAP_RATES_HZ", (1.5,))
    found = simulate_release_and_taps("none", "late")
    assert found.tap_shares == pytest.approx((1.0,), abs=1e-9)
    assert found.leaked == pytest.approx(0.1 * AT_SLAVE)


@pytest.mark.parametrize("draw", [draw_force_traces, draw_energy_traces])
def test_title_of_a_figure_with_one_network_fits(draw):
    figure = draw({"methods": ["none"], "networks": ["lan"]}, {})
    figure.draw_without_rendering()
    (title,) = [text for text in figure.texts if text.get_text() == figure.get_suptitle()]
    assert 0.0 < title.get_window_extent().x1 < figure.bbox.x1
