"""The command `fmu`, which writes a rig, or a soft sensor of its leakage, as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Option, echo

from sealscope.cli.options import RigOption, SetOption, check_folder, declared_option, load_rig_with
from sealscope.errors import InputError

_PLATFORM = (
    "System it shall run on: linux, windows, macos; FMI 3 also macos-arm, linux-arm; repeat. By default this one; "
    "others need the extra `fmu`. source: its C sources alone."
)
_ERROR = "Error that a pressure may have, by which the solver's step is chosen (1 Pa)."
_SENSOR = (
    "Write a soft sensor of leakage instead: volume, which reads the chamber pressures, the pump's flow and the "
    "piston's position. --rig takes a machine's file, too."
)


def fmu(
    output: Annotated[Path, Option("--output", "-o", help="FMU file to write (.fmu).")],
    rig: RigOption = "thesis",
    overrides: SetOption = None,
    version: Annotated[int, Option("--fmi", help="Version of the interface, 2 or 3.")] = 2,
    platforms: Annotated[list[str] | None, Option("--platform", help=_PLATFORM)] = None,
    error: Annotated[str | None, Option(help=_ERROR)] = None,
    step: Annotated[str | None, declared_option("step")] = None,
    sensor: Annotated[str | None, Option(help=_SENSOR)] = None,
    rate: Annotated[str | None, Option(help="Sampling rate of the soft sensor (500 Hz).")] = None,
    flow: Annotated[str | None, Option(help="Its channel of the pump's flow: theta (default), omega, q_pump.")] = None,
) -> None:
    """Write a rig, or a soft sensor of its leakage, as an FMU for co-simulation that runs without Python.

    The rig has the inputs command, leak and load, and every parameter can be tuned. The soft sensor takes the
    readings of other sensors and gives the leakage in m^3/s with its 95 % interval.
    """
    from sealscope.fmu.build import ERROR, write_fmu, write_sensor_fmu
    from sealscope.units import parse_quantity

    check_folder(output)
    options: dict[str, Any] = {"rig": load_rig_with(rig, overrides), "fmi": version, "platforms": platforms or None}
    if sensor is None:
        for name, value in (("--rate", rate), ("--flow", flow)):
            if value is not None:
                raise InputError(f"{name} is for a soft sensor and needs --sensor")
        max_step = None if step is None else parse_quantity(step, "s", name="step")
        max_error = ERROR if error is None else parse_quantity(error, "Pa", name="error")
        variables = write_fmu(output, **options, error=max_error, step=max_step)
        longest_step_s = next(variable.start for variable in variables if variable.name == "step")
        timing = f"steps of at most {longest_step_s:.3g} s"
    else:
        for name, value in (("--step", step), ("--error", error)):
            if value is not None:
                raise InputError(f"{name} is for the solver of a rig, and not allowed with --sensor")
        rate_hz = 500.0 if rate is None else parse_quantity(rate, "Hz", name="rate")
        options |= {"sensor": sensor, "rate": rate_hz, "flow": flow or "theta"}
        variables = write_sensor_fmu(output, **options)
        timing = f"samples at {rate_hz:g} Hz, for {Path(rig).name}"
    kinds = ("input", "parameter", "output")
    counts = ", ".join(f"{sum(variable.causality == kind for variable in variables)} {kind}s" for kind in kinds)
    echo(f"{output}: FMI {version} for co-simulation,\n{counts}, {timing}")
