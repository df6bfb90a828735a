"""Export, connection and recording of the ports of a station."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import LogVectorOutput, Multiplexer

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import signal_sizes_of_sample
from drake_teleop.station.signals import LOG_BLOCK_NAME, MOVING_BODY_POSE_PREFIX, SIGNALS

#: Ports with several signals, in the order of `SIGNALS`: reading one port is faster than its parts.
SIGNALS_OF_COMBINED_PORT = {
    "sample": (*signal_sizes_of_sample(0), "sample_time"),
    "scaled_contact_and_fault": ("scaled_wrench_S", "contact_wrench_S", "fault"),
    "displayed_and_fault": ("force_to_master", "fault_at_hand"),
}


def export_outputs(builder: DiagramBuilder, block: System, *names: str, **renamed: str) -> None:
    """Export output ports by name; keyword `new_name="port"` exports under another name."""
    for name, port in (dict(zip(names, names, strict=True)) | renamed).items():
        builder.ExportOutput(block.GetOutputPort(port), name)


def connect_ports(
    builder: DiagramBuilder, source: System, output_name: str, target: System, input_name: str
) -> None:
    """Connect output port `output_name` of the source to input port `input_name` of the target.

    A DrakeTeleopError is raised if a port is missing or the sizes differ.
    """
    remedy = "give it the ports of this side in docs/station.md"
    for has_port, port_text, block in (
        (source.HasOutputPort(output_name), f"output port '{output_name}'", source),
        (target.HasInputPort(input_name), f"input port '{input_name}'", target),
    ):
        if not has_port:
            what = f"the block has no {port_text}"
            raise DrakeTeleopError(what, where=block.get_name(), remedy=remedy)
    output, port = source.GetOutputPort(output_name), target.GetInputPort(input_name)
    if output.size() != port.size():
        what = f"its output port '{output_name}' has {output.size()} numbers, but input port"
        what = f"{what} '{input_name}' of {target.get_name()} expects {port.size()}"
        raise DrakeTeleopError(what, where=source.get_name(), remedy=remedy)
    builder.Connect(output, port)


def connect_matching_inputs(
    builder: DiagramBuilder, block: System, sources: Mapping[str, OutputPort]
) -> None:
    """Connect the output ports `sources` to inputs of `block` by name, skipping absent inputs."""
    for name, port in sources.items():
        if block.HasInputPort(name):
            builder.Connect(port, block.GetInputPort(name))


def build_with_log(
    builder: DiagramBuilder, title: str, sides: Iterable[System], log_hz: float
) -> Diagram:
    """Return the diagram that exports the sides' signals and records them at `log_hz`."""
    outputs = {
        port.get_name(): port
        for side in sides
        for port in (side.get_output_port(i) for i in range(side.num_output_ports()))
    }
    signals = [name for name in SIGNALS if name in outputs]
    signals += [name for name in outputs if name.startswith(MOVING_BODY_POSE_PREFIX)]
    for name in signals:
        builder.ExportOutput(outputs[name], name)
    wide = dict[str, str]()
    for port, parts in SIGNALS_OF_COMBINED_PORT.items():
        wide |= dict.fromkeys(parts, port) if {port, *parts} <= outputs.keys() else {}
    ports = [outputs[name] for name in dict.fromkeys(wide.get(name, name) for name in signals)]
    # One log for all ports: at 8 kHz each system with events costs time at every step.
    row = builder.AddNamedSystem("log_input", Multiplexer([port.size() for port in ports]))
    for index, port in enumerate(ports):
        builder.Connect(port, row.get_input_port(index))
    log = LogVectorOutput(row.get_output_port(), builder, 1 / log_hz)
    log.set_name(LOG_BLOCK_NAME)
    diagram = builder.Build()
    diagram.set_name(title)
    return diagram
