"""`drake-teleop ros2`: `compensate` as a ROS 2 node with services and parameters."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.interruption import delayed_signals
from drake_teleop.load.identification import Identification
from drake_teleop.robots.calibration import DEFAULT_TOLERANCES_TEXT
from drake_teleop.robots.compensate import run_compensate_command
from drake_teleop.robots.compensator import SCALE_NAMES, Compensator
from drake_teleop.robots.ros2 import (
    SOURCE_ADDRESS_PARAMETERS,
    domain_of_address,
    parse_ros2_address,
    shared_node,
)

_CALIBRATION_STOP_TIMEOUT_S = 3.0  # longest time for the last evaluation of a calibration [s]
_CALIBRATE_PYTHON_CODE = "import sys; from drake_teleop.cli.main import main; main(sys.argv[1:])"


class ServedCompensator:
    """Compensator whose load and scales are set by services and parameters of a node.

    `make` returns the compensator of a load; `calibrate` returns, for tolerance and seconds, the
    arguments of the command `calibrate`, whose results are in `out`.
    """

    @delayed_signals()
    def __init__(
        self,
        node: Any,
        make: Callable[[Identification], Compensator],
        load: Path,
        calibrate: Callable[[str, float], list[str]],
        out: Path,
        scales: dict[str, float],
    ) -> None:
        from std_srvs.srv import Trigger

        self._node, self._make, self._calibrate, self._out = node, make, calibrate, out
        self._current = make(Identification.load(load))
        self._pool = ThreadPoolExecutor(1)
        self._process: subprocess.Popen[str] | None = None
        for name in SCALE_NAMES:
            node.declare_parameter(name, float(scales[name]))
        node.declare_parameter("load", str(load))
        node.declare_parameter("until", DEFAULT_TOLERANCES_TEXT)
        node.declare_parameter("seconds", 120.0)
        node.add_on_set_parameters_callback(self._check_and_apply_scale_parameters)
        for service, answer in (
            ("~/tare", self._make_service_callback(lambda: self._current.tare())),
            ("~/load", self._make_service_callback(self._reload_compensator)),
            ("~/calibrate", self._answer_calibration_request),
        ):
            node.create_service(Trigger, service, answer)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._current, name)

    def close(self) -> None:
        if (process := self._process) is not None:
            process.terminate()
            try:
                process.wait(_CALIBRATION_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
        self._pool.shutdown()

    def _parameter_value(self, name: str) -> Any:
        return self._node.get_parameter(name).value

    def _apply_scale_parameters(self, compensator: Compensator, **changes: float) -> None:
        values = {name: self._parameter_value(name) for name in SCALE_NAMES} | changes
        sigma, gamma, *others = values.values()
        weight, inertia = (None if value < 0.0 else value for value in others)
        compensator.set_scales(sigma, gamma, weight, inertia)

    def _check_and_apply_scale_parameters(self, parameters: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        scales = [each for each in parameters if each.name in SCALE_NAMES]
        for each in scales:
            lowest = -math.inf if each.name in SCALE_NAMES[2:] else 0.0
            if not (math.isfinite(each.value) and each.value >= lowest):
                reason = f"{each.name}: {each.value} is outside {lowest:g} to inf"
                return SetParametersResult(successful=False, reason=reason)
        try:
            self._apply_scale_parameters(self._current, **{x.name: x.value for x in scales})
        except DrakeTeleopError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _make_service_callback(self, action: Callable[[], str]) -> Callable[[Any, Any], Any]:
        def answer(_request: Any, response: Any) -> Any:
            try:
                response.message = action()
            except DrakeTeleopError as error:
                response.message = f"refused: {error}"
            response.success = not response.message.startswith("refused")
            return response

        return answer

    def _reload_compensator(self) -> str:
        compensator = self._make(load := Identification.load(self._parameter_value("load")))
        self._apply_scale_parameters(compensator)
        self._current = compensator
        return f"done: {load.mass:.4g} kg"

    async def _answer_calibration_request(self, _request: Any, response: Any) -> Any:
        from rclpy.parameter import Parameter
        from rclpy.task import Future

        if self._process is not None:
            response.message = "refused: a calibration runs already"
            return response
        words = [sys.executable, "-c", _CALIBRATE_PYTHON_CODE]
        words += self._calibrate(self._parameter_value("until"), self._parameter_value("seconds"))
        # In a new session there is one signal, from `close`, also at Ctrl-C in a terminal.
        options: Any = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
        process = self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, **options)
        ended: Any = Future(executor=self._node.executor)
        self._pool.submit(lambda: ended.set_result(process.communicate()[1]))
        lines, status = (await ended).strip().splitlines(), process.returncode
        self._process = None
        if status == 0:
            path = str(self._out / "identification.json")
            self._node.set_parameters([Parameter("load", value=path)])
            return self._make_service_callback(self._reload_compensator)(None, response)
        advice = "interrupted"
        if status == 1 and not any(line.startswith("Traceback") for line in lines):
            summary = json.loads((self._out / "summary.json").read_text(encoding="utf-8"))
            advice = f"the tolerance is not met: {summary['advice'] or summary['doubts']}"
        elif lines:
            advice = lines[-1]
        response.message = f"refused: {advice}"
        return response


def run_ros2_command(
    source: str,
    load: Path,
    sink: str,
    out: Path,
    *,
    calibrate: Callable[[str, float], list[str]],
    **options: Any,
) -> None:
    """Run the command `ros2` until SIGINT or SIGTERM."""
    for address in (source, sink):
        if not address.startswith("ros2://"):
            what = "is not an address of a ROS topic"
            raise DrakeTeleopError(what, where=address, remedy="give ros2://TOPIC")
    node = shared_node(domain_of_address(parse_ros2_address(source, SOURCE_ADDRESS_PARAMETERS)))
    scales = {k: -1.0 if options.get(k) is None else options[k] for k in SCALE_NAMES}
    served: list[ServedCompensator] = []

    def serve_compensator(make: Callable[[Identification], Compensator]) -> Any:
        served.append(ServedCompensator(node.node, make, load, calibrate, out, scales))
        return served[0]

    try:
        run_compensate_command(source, load, sink, attach=serve_compensator, **options)
    finally:
        for each in served:
            each.close()
        node.close()
