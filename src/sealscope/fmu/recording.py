"""Record a functional mock-up unit (FMU): FMPy runs it, and the simulated instruments of a rig read its outputs."""

from __future__ import annotations

import hashlib
import io
import math
import os
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call, suggestion
from sealscope.errors import InputError, SimulationFailed
from sealscope.fmu.variables import INPUTS
from sealscope.parameters.parts import Sensors
from sealscope.recordings.channels import CHANNEL_UNITS, Array
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import FILTER_REACH, Experiment
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import RunInputs, steps_per_output
from sealscope.units import from_si, to_si

if TYPE_CHECKING:
    from sealscope.simulation.integrate import Progress

#: Longest communication step [s], during which the inputs are constant, and as a fraction of the sampling interval: the
#: anti-alias filter needs several outputs for each sample.
_MAX_STEP, _MAX_STEP_FRACTION = 5e-4, 0.25
_INPUT_NAMES = ("u", "G", "C", "F")
_MEASURED_NAMES = tuple(name for name in CHANNEL_UNITS if name not in ("u", "omega"))  # omega is read off the encoder
#: Channels without an instrument in a rig: the FMU's outputs are recorded without noise or quantisation.
_WITHOUT_INSTRUMENT = tuple(name for name in _MEASURED_NAMES if name not in Sensors.model_fields)


@checked_call
def record_fmu(
    path: str | os.PathLike[str],
    experiment: Experiment,
    *,
    map: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Run a functional mock-up unit under an experiment's command, and record it with the instruments of its rig.

    The unit replaces the machine: only the instruments of the experiment's rig are used. Channels without an
    instrument (``q_comp``, ``q_pump``, ``q_supply``, ``T_oil``) are recorded as the unit outputs them. A unit is a
    program, which runs with all rights of the calling program.

    Parameters
    ----------
    path : str or path-like
        A unit of FMI 1 to 3 for co-simulation or model exchange, with an input ``u`` and outputs named like channels
        (``p_A``, ``p_B``, ``x``, ``theta``, ...); channels that it does not have are not recorded.
    experiment : Experiment
        Command, duration, rate, seed and instruments; faults of sensors; a leak as a conductance (``"G = 6e-13 from
        20 s"``) if the unit has the input ``G`` or ``C``; a load if it has ``F``.
    map : mapping of str to str, optional
        Names of channels and inputs in the unit: ``{"p_A": "cylinder.pA"}``.
    progress : callable, optional
        Called with the name of the current task (str) and its completed fraction (0 to 1).

    Returns
    -------
    Recording
        The readings of the instruments; its provenance names the unit.

    Raises
    ------
    InputError
        The unit cannot be read, or lacks a chamber pressure or an input that the experiment needs.
    SimulationFailed
        The unit failed during the run.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.record_fmu("plant.fmu", ss.Experiment.of(command="3 sin(4t)", duration="20 s"))  # doctest: +SKIP
    """
    path = Path(path)
    if not isinstance(experiment, Experiment):
        raise InputError(f"experiment must be an Experiment (Experiment.of(...) makes one), got {experiment!r}")
    _check_experiment(experiment)
    description = _read_description(path)
    variables = {variable.name: variable for variable in description.modelVariables}
    names = _map_variables(path, variables, dict(map or {}))
    measured = {channel: names[channel] for channel in _MEASURED_NAMES if channel in names}
    if not {"p_A", "p_B"} <= set(measured):
        raise InputError(
            f"an FMU must have the outputs p_A and p_B, got {', '.join(sorted(variables)[:12])} ({path}); name them "
            "with --map p_A=NAME"
        )
    rate, n = experiment.rate, round(experiment.duration * experiment.rate)  # n: samples of the recording
    factor = steps_per_output(rate, min(_MAX_STEP, _MAX_STEP_FRACTION / rate))  # communication steps per sample
    # communication points, with those that the anti-alias filter needs after the last sample
    t = np.arange((n + FILTER_REACH) * factor + 1) / (rate * factor)
    input_table = _build_input_table(path, experiment, names, variables, t)
    rows = _run_unit(path, t, input_table, list(measured.values()), experiment.duration, progress)
    outputs = {}
    for name, variable in measured.items():
        unit = variables[variable].unit or CHANNEL_UNITS[name]  # no unit stated: SI units
        outputs[name] = to_si(rows[variable], unit, CHANNEL_UNITS[name], name=f"{variable} of {path.name}")
    volts = experiment.voltage_command.volts(t[: n * factor : factor])
    # zeros stand for channels that the unit lacks, which are not recorded
    all_outputs = {name: outputs.get(name, np.zeros(t.size)) for name in _MEASURED_NAMES}
    recorded = record(experiment, all_outputs, volts, factor)
    recorded_names = {"u", *measured} | ({"omega"} if "theta" in measured else set())
    channels = {name: values for name, values in recorded.channels.items() if name in recorded_names}
    channels |= {name: outputs[name][: n * factor : factor] for name in _WITHOUT_INSTRUMENT if name in outputs}
    source = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "name": description.modelName}
    provenance: dict[str, Any] = {"origin": "fmu", "unit": source, "experiment": experiment.describe()}
    return replace(
        recorded,
        channels=channels,
        units={name: CHANNEL_UNITS[name] for name in channels},
        provenance=provenance,
        history=(f"unit {path.name} run with communication steps of {1.0 / (rate * factor):.4g} s",),
    )


def _check_experiment(experiment: Experiment) -> None:
    """Raise InputError for an experiment that an FMU cannot run."""
    if experiment.target is not None:
        raise InputError(f"an FMU must have a command, not a target, got {experiment.command}")
    if experiment.effects():  # drifts and faults of the machine, not of its instruments
        raise InputError(
            "an experiment with an FMU may have faults and drifts of sensors only: the FMU contains the machine"
        )
    for leak in experiment.leaks:
        if leak.coefficient is None:  # the leak is stated by its flow
            raise InputError(
                f"an FMU's leak must be a conductance, 'G = 6e-13 from 20 s' or 'C = 2e-10', got {leak}: the FMU "
                "computes its flow"
            )


def _read_description(path: Path) -> Any:
    """Read the description of an FMU with FMPy; raise InputError if FMPy is not installed or cannot read it."""
    try:
        import fmpy
    except ImportError:
        raise InputError("running an FMU needs FMPy: pip install 'sealscope[fmu]'") from None
    try:
        return fmpy.read_model_description(str(path))
    except Exception as error:  # from the archive, its XML or FMPy's checks
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise InputError(f"cannot read the unit {path}: {reason}") from error


def _map_variables(path: Path, variables: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, str]:
    """Find the FMU's variable for each channel and input that it has; return the variables' names by channel or input.

    `path`: the FMU's file, for messages; `variables`: all its variables by name; `names`: variables of those channels
    and inputs that have another name in the FMU. Raises InputError if `names` has an unknown channel or variable.
    """
    valid_names = {*_INPUT_NAMES, *_MEASURED_NAMES}
    for channel, variable in names.items():
        if channel not in valid_names:
            raise InputError(
                f"--map must name a channel or an input, got {channel!r}{suggestion(channel, sorted(valid_names))}"
            )
        if variable not in variables:
            raise InputError(f"{path} has no variable {variable!r}{suggestion(variable, sorted(variables))}")
    return {name: names.get(name, name) for name in valid_names if names.get(name, name) in variables}


def _build_input_table(
    path: Path, experiment: Experiment, names: Mapping[str, str], variables: Mapping[str, Any], t: Array
) -> Array:
    """Build the table of inputs that FMPy takes, with a row for each communication point `t` [s].

    FMPy keeps an input constant during a step, so each row has the value in the middle of the step, for second-order
    accuracy. `path`: the FMU's file, for messages; `names`: name of the FMU's variable for each channel and input;
    `variables`: FMPy's description of each variable, by name.
    """
    half_step = 0.5 * (t[1] - t[0])
    # in each step, the inputs are needed at one time only, its middle
    u, G, C = (values[:, 0] for values in RunInputs(experiment, experiment.leaks).at_nodes(t, np.array([half_step])))
    if experiment.load is not None and experiment.load.tables() is not None:
        raise InputError(f"an FMU needs a load over time, got one over position or velocity ({experiment.load})")
    load = np.zeros(t.size) if experiment.load is None else np.asarray(experiment.load.value_at(t + half_step))
    columns: dict[str, Array] = {"time": t}
    for name, values in {"u": u, "G": G, "C": C, "F": load}.items():
        si_unit, meaning = INPUTS[name]
        if name in names:
            unit = variables[names[name]].unit
            columns[names[name]] = from_si(values, unit, si_unit, name=name) if unit else values
        elif name == "u" or np.any(values):
            raise InputError(f"the experiment needs the input {name} ({meaning}), which {path} does not have")
    rows = np.empty(t.size, dtype=[(name, float) for name in columns])
    for name, values in columns.items():
        rows[name] = values
    return rows


def _run_unit(
    path: Path, t: Array, input_table: Array, outputs: list[str], duration: float, progress: Progress | None
) -> Any:
    """Run the FMU with a table of inputs; return a structured array of `outputs` at the communication points `t` [s].

    `duration` [s]: length of the recording. Raises SimulationFailed if the FMU fails, ends early, or ends with an
    output that is not finite.
    """
    import fmpy

    def report_step(time: float, _recorder: Any) -> bool:
        if progress is not None:
            progress("running the unit", min(1.0, time / duration))
        return True  # tells FMPy to continue

    communication_step = float(t[1] - t[0])
    log = io.StringIO()
    try:
        with redirect_stdout(log):  # FMPy prints what the unit logs
            rows = fmpy.simulate_fmu(
                str(path), start_time=0.0, stop_time=float(t[-1]), step_size=communication_step,
                output_interval=communication_step, input=input_table, output=outputs, step_finished=report_step,
                validate=False,  # `_read_description` has checked it
            )  # fmt: skip
    except Exception as error:  # from the unit's code, FMPy, or a library for another system
        logged = [line.removeprefix("[ERROR] ") for line in log.getvalue().splitlines() if line.startswith("[")]
        # [-1:]: the last line that the unit logged, if any
        raise SimulationFailed(f"the unit {path.name} failed: {'; '.join([*logged[-1:], str(error)])}") from error
    if len(rows) < t.size or not all(math.isfinite(rows[name][-1]) for name in outputs):
        raise SimulationFailed(f"the unit {path.name} ended at t = {rows['time'][-1]:.4g} s of {t[-1]:.4g} s")
    return rows[: t.size]  # without rows after the last communication point
