"""Common style of all figures."""

from __future__ import annotations

from contextlib import AbstractContextManager
from io import BytesIO
from pathlib import Path

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


def plot_style() -> AbstractContextManager[None]:
    sheet = Path(__file__).with_name("figures.mplstyle")
    style = mpl.rc_params_from_file(sheet, use_default_template=False)
    return mpl.rc_context({**style, "axes.prop_cycle": cycler(color=COLOURS)})


class Picture(Figure):
    """Figure that notebooks show as the value of a cell, without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def shade_contact(axes: Axes, t: ArrayLike, contact: ArrayLike) -> None:
    for start, stop in contact_spans(t, contact):
        axes.axvspan(start, stop, color=ORANGE, alpha=0.18, linewidth=0)
