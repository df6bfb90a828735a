"""Export of an identified load with code that compensates it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, replace_file_on_success
from drake_teleop.load.identification import Identification
from drake_teleop.logs.processing import notes_on_undetermined_load
from drake_teleop.robots.controller import c99
from drake_teleop.robots.controller.fmu import fmu_files
from drake_teleop.robots.export import refuse_removed_weight, unused_sensor_pose_error

_FILTER_NAME = "wrench_compensator_filter"
_FILTER_TEMPLATE_FOLDER = "ros2_filter"


def ros2_filter_files(target: c99.ControllerTarget) -> c99.Files:
    """Return the files of a ROS 2 package with a filter of wrenches."""
    shipped = {
        f"{_FILTER_NAME}.xml": f"{_FILTER_NAME}.xml",
        "package.xml": "package.xml",
        "CMakeLists.txt": "CMakeLists.txt",
        f"src/{_FILTER_NAME}.cpp": f"{_FILTER_NAME}.cpp",
    }
    kernel = dict(c99.kernel_files(target))
    sign = f"#define WRENCH_COMPENSATOR_SIGN {target.sign}.0\n\n#endif"
    kernel["load.h"] = sign.join(str(kernel["load.h"]).rsplit("#endif", 1))
    values = {"rate": f"{1.0 / target.dt:g}", "sign": str(target.sign), "notes": target.notes}
    folder = _FILTER_TEMPLATE_FOLDER
    return {
        **{name: c99.read_template(f"{folder}/{file}") for name, file in shipped.items()},
        **{f"src/{name}": text for name, text in kernel.items()},
        "README.md": c99.render_template(f"{folder}/README.md", **values),
    }


CONTROLLER_FORMATS: dict[str, Callable[[c99.ControllerTarget], c99.Files]] = {
    "c99": c99.c99_files,
    "fmu": fmu_files,
    "ros2_filter": ros2_filter_files,
}
"""Functions that return the files of a format."""


def export_controller(
    found: Identification,
    to: str,
    out: Path,
    *,
    rate_hz: float | None,
    cutoff_hz: float | None = 30.0,
    largest: tuple[float, float] | None = None,
    sensor_pose: Sequence[float] | None = None,
    sign: int = -1,
) -> list[str]:
    """Write the files of the format `to` into the folder `out`; return warnings.

    `sign` is -1 if the sensor reports the wrench of load on sensor (usual), else 1.
    """
    if rate_hz is None:
        what, remedy = f"missing, but required by {to}", "give the readings' rate in Hz"
        raise DrakeTeleopError(what, where="rate", remedy=remedy)
    if sensor_pose is not None:
        raise unused_sensor_pose_error(to)
    refuse_removed_weight(found, to)
    notes = list(notes_on_undetermined_load(found))
    if largest is None:
        notes.append("no range of the sensor was given: saturation is not detected; give --range")
    whole = None if largest is None else np.repeat(np.array(largest, float), 3)
    target = c99.ControllerTarget(found, 1.0 / rate_hz, cutoff_hz, whole, sign, notes)
    for name, content in CONTROLLER_FORMATS[to](target).items():
        path = out / name
        make_folder(path.parent)
        with replace_file_on_success(path) as temporary:
            data = content.encode() if isinstance(content, str) else content
            temporary.write_bytes(data)
    return notes
