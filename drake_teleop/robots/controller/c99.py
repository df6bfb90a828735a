"""C99 code of the compensation of a load, with a test vector from Python."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from drake_teleop.common.html import render_page
from drake_teleop.common.numeric import Array
from drake_teleop.common.version import __version__
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensator import STALE_AGE_S, Compensator
from drake_teleop.robots.streams import NUM_READING_VALUES, Reading

TEMPLATE_PACKAGE = "drake_teleop.robots.controller"
CFLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
"""Options of a C compiler for the bits of Python."""
_TEST_SCALES = {"sigma_weight": 0.25, "sigma_inertia": 1.5, "gamma": 0.75}
_NUM_TEST_READINGS = 1000
_TEST_WRENCH_AMPLITUDES = np.repeat([1.0, 0.05], 3)

Files = Mapping[str, str | bytes]


class ControllerTarget(NamedTuple):
    """Load, rate, low-pass and sensor of an export.

    Attributes:
        dt: period of the readings [s].
        sign: -1 if the sensor reports the wrench of the load on the sensor, else 1.
        notes: warnings for the user.
    """

    load: Identification
    dt: float
    cutoff_hz: float | None
    sensor_range: Array | None
    sign: int
    notes: list[str]

    def settings_initializer(self, largest: Array | None = None, **scales: Any) -> str:
        """Return the C initializer of `wrench_compensator_settings`, in the order of its fields."""
        others = self.make_compensator(largest, **scales).c_settings
        values = {name: others.pop(name) for name in ("phi", "offsets")}
        values |= {"sigma_weight": 0.0, "sigma_inertia": 0.0, "gamma": 1.0, **scales, **others}
        return "".join(f"    {_c_literal(each)}, /* {name} */\n" for name, each in values.items())

    def make_compensator(self, largest: Array | None = None, **scales: Any) -> Compensator:
        largest = self.sensor_range if largest is None else largest
        return Compensator(self.load, self.dt, cutoff_hz=self.cutoff_hz, largest=largest, **scales)


def c99_files(target: ControllerTarget) -> Files:
    return {
        **kernel_files(target),
        "test_vector.h": _test_vector_header(target),
        "test_wrench_compensator.c": read_template("test_wrench_compensator.c"),
        "CMakeLists.txt": read_template("CMakeLists.txt"),
        "README.md": render_template(
            "README.c99.md",
            rate=f"{1.0 / target.dt:g}",
            period=f"{target.dt:g}",
            notes=target.notes,
            count=_NUM_TEST_READINGS,
        ),
    }


def kernel_files(target: ControllerTarget) -> Files:
    settings, dt = target.settings_initializer(), repr(target.dt)
    return {
        "wrench_compensator.h": read_template("wrench_compensator.h"),
        "wrench_compensator.c": render_template("wrench_compensator.c"),
        "load.h": render_template("load.h", dt=dt, settings=settings, notes=target.notes),
    }


def read_template(name: str) -> str:
    return resources.files(TEMPLATE_PACKAGE).joinpath(f"templates/{name}").read_text("utf-8")


def render_template(name: str, **values: Any) -> str:
    """Return a shipped template with inserted values; nothing is escaped."""

    def keep_unescaped(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [keep_unescaped(each) for each in value]
        return Markup(value) if isinstance(value, str) else value

    values = {key: keep_unescaped(value) for key, value in values.items()}
    values.setdefault("version", __version__)
    return render_page(TEMPLATE_PACKAGE, f"templates/{name}.j2", **values) + "\n"


def _test_vector_header(target: ControllerTarget) -> str:
    inputs, largest = _simulated_readings_and_sensor_range(target)
    python = target.make_compensator(largest, **_TEST_SCALES)
    outputs = [
        python.step(Reading(k, t, row[:NUM_READING_VALUES], gravity=row[NUM_READING_VALUES:]), t)
        for k, (t, row) in enumerate(zip(target.dt * np.arange(len(inputs)), inputs, strict=True))
    ]
    return render_template(
        "test_vector.h",
        settings=target.settings_initializer(largest, **_TEST_SCALES),
        inputs=[_c_literal(row) for row in inputs],
        outputs=[_c_literal(np.concatenate([out.contact, out.scaled])) for out in outputs],
        flags="{" + ", ".join(str(out.flags) for out in outputs) + "}",
    )


def _simulated_readings_and_sensor_range(target: ControllerTarget) -> tuple[Array, Array]:
    phase = 2.0 * np.pi * np.arange(_NUM_TEST_READINGS)[:, None] / _NUM_TEST_READINGS
    omega = np.sin(3.0 * phase + [0.0, 1.0, 2.0])
    alpha = 6.0 * np.cos(5.0 * phase + [2.0, 1.0, 0.0])
    down = np.array([3.0, -4.0, -8.0]) + omega
    motion = 5.0 * alpha - down, omega, alpha
    contact = 40.0 * np.maximum(np.sin(4.0 * phase + np.arange(6.0)), 0.0) * _TEST_WRENCH_AMPLITUDES
    wrench = non_contact_wrench(*motion, target.load.phi) + target.load.offsets + contact
    readings = np.round(np.hstack([wrench, *motion, down]), 6)
    largest = 0.95 * np.abs(readings[:, :6]).max(axis=0)
    readings[100:103, 7], readings[200, 0], readings[201, 12] = np.nan, np.inf, 1e7
    first = _NUM_TEST_READINGS // 2
    readings[first : first + round(2.0 * STALE_AGE_S / target.dt) + 2, 5] = np.nan
    return readings, largest


def _c_literal(value: Any) -> str:
    if isinstance(value, np.ndarray):
        text = ", ".join(repr(float(x)) for x in value)
        return "{" + text.replace("nan", "NAN").replace("inf", "INFINITY") + "}"
    return repr(value)
