"""The soft sensor of an FMU: the stream's program in C99 (`emit`), and the functions by which the unit calls it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from sealscope.emit.c_export import render_c
from sealscope.emit.stream_program import StreamProgram
from sealscope.fmu.description import templates
from sealscope.fmu.variables import SENSOR_RESULTS, VALUES, Variable, input_variables, output_variables, rig_variable
from sealscope.parameters import Rig
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES

#: Failures of the unit's functions: code and message.
FAILURES: Mapping[int, str] = {1: "pump.q_b must be > 0 m^3/rev"}
#: The only parameter of the rig that the balance reads, without a meter of its flow: the pump's displacement [m^3/rev].
DISPLACEMENT = "pump.q_b"


def variables(rig: Rig, channels: tuple[str, ...]) -> Iterator[Variable]:
    """Yield the variables of a soft sensor's FMU: measurements, displacement but with a flow meter, and leakage."""
    yield from input_variables({name: (CHANNEL_UNITS[name], f"reading: {LONG_NAMES[name]}") for name in channels})
    if "q_pump" not in channels:
        yield from filter(None, [rig_variable(rig, DISPLACEMENT, "fixed")])
    yield from output_variables(SENSOR_RESULTS)


def sensor_sources(unit: StreamProgram, title: str) -> dict[str, str]:
    """Render the C sources of a soft sensor by file name.

    The memory `y` of its functions begins with the time to the next sample [s], after which the state stands.
    """
    files = render_c(unit, prefix="leak", title=title, origin="a unit", alarm_rate=1.0)
    interval = 1.0 / unit.settings.rate
    glue = (
        templates()
        .get_template("sensor.c.j2")
        .render(
            index=VALUES.index(DISPLACEMENT),
            has_meter="q_pump" in unit.settings.channels,
            full_turn=2.0 * math.pi,
            interval=interval,
            tolerance=1e-6 * interval,
            n_results=len(SENSOR_RESULTS),
        )
    )
    return {"leak.h": files["leak.h"], "leak.c": files["leak.c"], "sensor.c": glue}


def memory_size(unit: StreamProgram) -> int:
    """Compute the doubles that hold the state and the time to the next sample."""
    return 2 + sum(field.size or 1 for field in unit.program.fields)
