"""ROS 2 package of a filter that compensates wrenches."""

from __future__ import annotations

from drake_teleop.robots.controller.c99 import (
    ControllerTarget,
    Files,
    kernel_files,
    read_template,
    render_template,
)

_FILTER_NAME = "wrench_compensator_filter"
_TEMPLATE_FOLDER = "ros2_filter"


def ros2_filter_files(target: ControllerTarget) -> Files:
    shipped = {
        f"{_FILTER_NAME}.xml": f"{_FILTER_NAME}.xml",
        "package.xml": "package.xml",
        "CMakeLists.txt": "CMakeLists.txt",
        f"src/{_FILTER_NAME}.cpp": f"{_FILTER_NAME}.cpp",
    }
    kernel = dict(kernel_files(target))
    sign = f"#define WRENCH_COMPENSATOR_SIGN {target.sign}.0\n\n#endif"
    kernel["load.h"] = sign.join(str(kernel["load.h"]).rsplit("#endif", 1))
    values = {"rate": f"{1.0 / target.dt:g}", "sign": str(target.sign), "notes": target.notes}
    return {
        **{name: read_template(f"{_TEMPLATE_FOLDER}/{file}") for name, file in shipped.items()},
        **{f"src/{name}": text for name, text in kernel.items()},
        "README.md": render_template(f"{_TEMPLATE_FOLDER}/README.md", **values),
    }
