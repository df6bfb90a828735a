"""Common style of all figures."""

from __future__ import annotations

from contextlib import AbstractContextManager
from io import BytesIO
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from drake_teleop.common.numeric import contact_spans

# Okabe and Ito (2008): distinguishable with common colour deficiencies, and in grey.
BLUE, VERMILION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
PURPLE, SKY, BLACK, GREY = "#CC79A7", "#56B4E9", "#1A1A1A", "#6B7280"
COLOURS = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)

#: Resolution of pictures in HTML pages [dots per inch].
PAGE_DPI = 160

_PLOT_STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "figure.constrained_layout.use": True,
    "font.family": "sans-serif",
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.edgecolor": "#9CA3AF",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E5E7EB",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": BLACK,
    "ytick.labelcolor": BLACK,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def plot_style() -> AbstractContextManager[None]:
    return mpl.rc_context({**_PLOT_STYLE, "axes.prop_cycle": cycler(color=COLOURS)})


class Picture(Figure):
    """Figure that notebooks show as the value of a cell, without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def shade_contact(axes: Axes, t: ArrayLike, contact: ArrayLike) -> None:
    """Shade the time spans in which `contact` (N,) is true; `t` (N,) are the times [s]."""
    for start, stop in contact_spans(t, contact):
        axes.axvspan(start, stop, color=ORANGE, alpha=0.18, linewidth=0)
