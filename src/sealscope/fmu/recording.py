"""Record another program's unit: FMPy runs it, the instruments of a rig read it."""

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

from sealscope.calls import checked_call, closest
from sealscope.errors import InputError, SimulationFailed
from sealscope.fmu.variables import INPUTS
from sealscope.recordings.channels import CHANNEL_UNITS, Array
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import FILTER_REACH, record
from sealscope.simulation.integrate import RunInputs, oversampling_of
from sealscope.units import from_si, to_si

if TYPE_CHECKING:
    from sealscope.simulation.simulate import Progress

#: Communication step [s] that is taken where the samples are further apart.
SPAN = 5e-4
_DRIVING = ("u", "G", "C", "F")
_MEASURED = tuple(name for name in CHANNEL_UNITS if name not in ("u", "omega"))  # omega is read off the encoder
#: Channels that no instrument of a rig reads: they are recorded as the unit gives them.
_AS_GIVEN = ("q_comp", "q_pump", "T_oil")


@checked_call
def record_fmu(
    path: str | os.PathLike[str],
    experiment: Experiment,
    *,
    map: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Run a functional mock-up unit under an experiment's command and record it by the instruments of its rig.

    The unit is a machine of somebody else: of the experiment's rig only the instruments are used; flows and temperature
    that they do not read (``q_comp``, ``q_pump``, ``T_oil``) are recorded as the unit gives them. A unit is a program,
    and runs with all rights of this one.

    Parameters
    ----------
    path : str or path-like
        A unit of FMI 1 to 3 for co-simulation or model exchange, with an input ``u`` and outputs under the names of
        channels (``p_A``, ``p_B``, ``x``, ``theta``, ...); what it does not have is not recorded.
    experiment : Experiment
        Command, duration, rate, seed and instruments; a leak as a conductance (``"G = 6e-13 from 20 s"``) where the
        unit has the input ``G`` or ``C``, a load where it has ``F``, faults of sensors.
    map : mapping of str to str, optional
        The unit's own names of channels and inputs: ``{"p_A": "cylinder.pA"}``.
    progress : callable, optional
        Called with what is being done (str) and how far it is (0 to 1).

    Returns
    -------
    Recording
        What the instruments recorded; its provenance names the unit.

    Raises
    ------
    InputError
        The unit cannot be read, lacks an input that the experiment needs, or has no chamber pressure.
    SimulationFailed
        The unit failed within the run.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.record_fmu("plant.fmu", ss.Experiment.of(command="3 sin(4t)", duration="20 s"))  # doctest: +SKIP
    """
    path = Path(path)
    if not isinstance(experiment, Experiment):
        raise InputError(f"experiment must be an Experiment (Experiment.of(...) makes one), got {experiment!r}")
    _check(experiment)
    description = _description(path)
    variables = {variable.name: variable for variable in description.modelVariables}
    names = _names(path, variables, dict(map or {}))
    measured = {channel: names[channel] for channel in _MEASURED if channel in names}
    if not {"p_A", "p_B"} <= set(measured):
        raise InputError(
            f"a unit must have the outputs p_A and p_B, got {', '.join(sorted(variables)[:12])} ({path}); name them "
            "with --map p_A=NAME"
        )
    rate = experiment.rate
    factor = oversampling_of(rate, SPAN)
    n = round(experiment.duration * rate)
    t = np.arange((n + FILTER_REACH) * factor + 1) / (rate * factor)
    driven = _driven(path, experiment, names, variables, t)
    rows = _run(path, t, driven, list(measured.values()), experiment.duration, progress)
    outputs = {}
    for name, variable in measured.items():
        unit = variables[variable].unit or CHANNEL_UNITS[name]  # what has no unit is taken to be in SI units
        outputs[name] = to_si(rows[variable], unit, CHANNEL_UNITS[name], name=f"{variable} of {path.name}")
    volts = experiment.commanded.volts(t[: n * factor : factor])
    everything = {name: outputs.get(name, np.zeros(t.size)) for name in _MEASURED}
    recorded = record(experiment.rig, everything, volts, factor, experiment.seed, experiment.readings())
    recorded_names = {"u", *measured} | ({"omega"} if "theta" in measured else set())
    channels = {name: values for name, values in recorded.channels.items() if name in recorded_names}
    channels |= {name: outputs[name][: n * factor : factor] for name in _AS_GIVEN if name in outputs}
    source = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "name": description.modelName}
    provenance: dict[str, Any] = {"origin": "fmu", "unit": source, "experiment": experiment.describe()}
    return replace(
        recorded,
        channels=channels,
        units={name: CHANNEL_UNITS[name] for name in channels},
        provenance=provenance,
        history=(f"unit {path.name} run with communication steps of {1.0 / (rate * factor):.4g} s",),
    )


def _check(experiment: Experiment) -> None:
    """Raise InputError for settings of an experiment that a foreign machine cannot have."""
    if experiment.target is not None:
        raise InputError(f"a unit must have a command, not a target, got {experiment.command}")
    if experiment.effects():
        raise InputError("of faults and drifts a unit can have those of sensors only: the machine is its own")
    for leak in experiment.leaks:
        if leak.coefficient is None:
            raise InputError(
                f"a unit's leak must be a conductance, 'G = 6e-13 from 20 s' or 'C = 2e-10', got {leak}: its flow "
                "follows from the unit"
            )


def _description(path: Path) -> Any:
    try:
        import fmpy
    except ImportError:
        raise InputError("running a unit needs FMPy: pip install 'sealscope[fmu]'") from None
    try:
        return fmpy.read_model_description(str(path))
    except Exception as error:  # of the archive, of XML, of FMPy's checks
        raise InputError(
            f"cannot read the unit {path}: {str(error).splitlines()[0] if str(error) else error!r}"
        ) from error


def _names(path: Path, variables: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, str]:
    """Find the unit's own name of each channel and input that it has."""
    wanted_names = {*_DRIVING, *_MEASURED}
    for channel, variable in names.items():
        if channel not in wanted_names:
            raise InputError(
                f"--map must name a channel or an input, got {channel!r}{closest(channel, sorted(wanted_names))}"
            )
        if variable not in variables:
            raise InputError(f"{path} has no variable {variable!r}{closest(variable, sorted(variables))}")
    return {name: names.get(name, name) for name in wanted_names if names.get(name, name) in variables}


def _driven(
    path: Path, experiment: Experiment, names: Mapping[str, str], variables: Mapping[str, Any], t: Array
) -> Array:
    """Build the inputs over time for FMPy: a row a communication point.

    An input is held over a step, at its value in the middle of it, which is right to the second order.
    """
    half = 0.5 * (t[1] - t[0])
    u, G, C = (values[:, 0] for values in RunInputs(experiment, experiment.leaks).at_nodes(t, np.array([half])))
    if experiment.load is not None and experiment.load.tables() is not None:
        raise InputError(f"a unit takes its load over time, got one over position or velocity ({experiment.load})")
    load = np.zeros(t.size) if experiment.load is None else np.asarray(experiment.load.value_at(t + half))
    inputs = {"u": u, "G": G, "C": C, "F": load}
    columns: dict[str, Array] = {}
    for name, values in inputs.items():
        if name in names:
            variable = variables[names[name]]
            unit = INPUTS[name][0]
            columns[names[name]] = from_si(values, variable.unit, unit, name=name) if variable.unit else values
        elif name == "u" or np.any(values):
            raise InputError(f"the experiment needs the input {name} ({INPUTS[name][1]}), which {path} does not have")
    rows = np.empty(t.size, dtype=[(name, float) for name in ("time", *columns)])
    for name, values in {"time": t, **columns}.items():
        rows[name] = values
    return rows


def _run(path: Path, t: Array, driven: Array, outputs: list[str], duration: float, progress: Progress | None) -> Any:
    """Run the unit; return its outputs at the communication points `t` [s]."""
    import fmpy

    def tell(time: float, _recorder: Any) -> bool:
        if progress is not None:
            progress("running the unit", min(1.0, time / duration))
        return True

    span, log = float(t[1] - t[0]), io.StringIO()
    try:
        with redirect_stdout(log):  # FMPy prints what the unit logs
            rows = fmpy.simulate_fmu(
                str(path), start_time=0.0, stop_time=float(t[-1]), step_size=span, output_interval=span, input=driven,
                output=outputs, step_finished=tell, validate=False,
            )  # fmt: skip
    except Exception as error:  # of the unit's code, of FMPy, of a library for another system
        logged = [line.removeprefix("[ERROR] ") for line in log.getvalue().splitlines() if line.startswith("[")]
        raise SimulationFailed(f"the unit {path.name} failed: {'; '.join([*logged[-1:], str(error)])}") from error
    if len(rows) < t.size or not all(math.isfinite(rows[name][-1]) for name in outputs):
        raise SimulationFailed(f"the unit {path.name} ended at t = {rows['time'][-1]:.4g} s of {t[-1]:.4g} s")
    return rows[: t.size]
