"""Gallery: order of its scripts, plot style, and the picture of each script."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt
from sphinx_gallery.scrapers import figure_rst

from drake_teleop.common.style import PAGE_DPI, plot_style

with plot_style():
    _OURS = dict(mpl.rcParams)
_STYLE = {name: value for name, value in _OURS.items() if value != mpl.rcParams[name]}


def set_style(_settings: dict[str, Any], _file: str) -> None:
    """Set the plot style of the project for all scripts of the gallery."""
    mpl.rcParams.update(_STYLE)


def picture(_block: Any, names: dict[str, Any], settings: dict[str, Any]) -> str:
    """Save the object `figure` of a script as its picture, with or without pyplot."""
    path = Path(next(names["image_path_iterator"]))
    figure = names["example_globals"]["figure"]
    figure.savefig(path, dpi=PAGE_DPI)
    plt.close("all")
    return figure_rst([str(path)], settings["src_dir"], Path(names["src_file"]).stem)


class Order:
    """Order of the gallery's scripts; a script that is not listed here is an error."""

    STORY = (
        *(
            "free_motion",
            "contact",
            "sigma",
            "grasp",
            "load_change",
            "task",
            "own_arm",
            "own_device",
            "own_block",
            "own_plant",
        ),
        *(
            "log_identification",
            "log_contact",
            "dataset",
            "conventions",
            "excitation",
            "sensor_noise",
        ),
        *("networks", "energy", "passivity_methods", "ledger_under_loss", "letting_go"),
        *("stability_map", "felt_impedance", "z_width", "study", "live_drive"),
    )

    def __init__(self, folder: str) -> None:
        """Accept the folder of scripts, which is not used."""

    def __call__(self, name: str) -> int:
        """Return the position of a script."""
        return self.STORY.index(Path(name).stem)

    def __repr__(self) -> str:
        """Return the same text in every build, so that a second build reuses the pictures."""
        return f"<{self.STORY}>"
