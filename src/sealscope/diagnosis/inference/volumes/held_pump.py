"""Leakage of a pump that is still connected to a loaded cylinder, just before shut valves take over the load.

A press builds up its pressure, the pump maintains it for some tenths of a second, and then the valves shut. In this
time nearly all of the pump's flow q leaks. In the time `held_oil.time_before` (`priors.toml`) before each hold,

    q = G (p_A - p_B) + A v + C d(p_A - p_B)/dt,

with the speed v of the piston. The conductance G, the area A and the compliance C are the same in all holds of a
recording. The fit is robust, since the pump's flow falls within the last tenth of a second while the valves shut. G
contains every leak of the loaded side; without those that the holds measure, it is the pump's own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.changes.motion_fit import fit_robustly
from sealscope.diagnosis.inference.circuit.holds.leaks import HeldLeaks
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import LockedHold
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.smoothing import average_over

#: Averaging time of flow, speed and pressures [s]. Rate [Hz] to which samples are thinned, or up to twice as much.
AVERAGING_TIME, MAX_RATE = 0.1, 50.0
#: Minimum number of samples of the fit.
MIN_SAMPLES = 30


def estimate_pump_leakage(
    recording: Recording, pumped: Array, holds: Sequence[LockedHold], leaks: HeldLeaks
) -> Estimate | None:
    """Estimate the leakage conductance of the pump [m^3/(s Pa)] from the time just before each hold.

    `pumped` (n - 1,): volume that the pump delivers between the samples of the recording [m^3]; `leaks`: leaks measured
    in the holds, of which those past the piston and to the outside from the loaded side are subtracted. Return None for
    fewer than two holds or `MIN_SAMPLES` samples, without any flow or pressure, or if the result is not finite.
    """
    rate, t = recording.rate, 0.5 * (recording.t[1:] + recording.t[:-1])
    difference = recording["p_A"] - recording["p_B"]
    signals = (pumped * rate, np.diff(recording["x"]) * rate, np.diff(difference) * rate, difference[1:])
    flow, speed, pressure_rate, pressure = (average_over(AVERAGING_TIME, values, rate) for values in signals)
    is_known = np.isfinite(flow) & np.isfinite(speed) & np.isfinite(pressure_rate)
    windows, last_end = [], -np.inf
    for hold in holds:
        begin = max(last_end, hold.t[0] - INFERENCE.held_oil.time_before)  # not within the previous hold
        first, last = int(np.searchsorted(t, begin, side="right")), int(np.searchsorted(t, hold.t[0]))
        samples = first + np.flatnonzero(is_known[first:last])
        windows.append(samples[:: max(1, int(rate / MAX_RATE))])
        last_end = hold.t[-1]
    rows = np.concatenate(windows)
    if len(holds) < 2 or len(rows) < MIN_SAMPLES:  # the errors below are those of fits without one hold each
        return None
    mean_pressure, mean_flow = (float(np.abs(values[rows]).mean()) for values in (pressure, flow))
    if not (mean_pressure > 0.0 and mean_flow > 0.0):
        return None
    # the flow is scaled to a pressure, since the robust fit has a smallest residual in Pa
    conductance = mean_flow / mean_pressure
    values = flow[rows] / conductance
    design = np.column_stack([pressure[rows], speed[rows], pressure_rate[rows]])  # column 0: leakage
    groups = np.repeat(np.arange(len(windows)), [len(samples) for samples in windows])
    (leakage,) = fit_robustly(design, values, [0], groups)
    is_A_loaded = float(np.median(pressure[rows])) > 0.0
    outside, outside_deviation = (
        (leaks.outside_A, leaks.deviation_A) if is_A_loaded else (leaks.outside_B, leaks.deviation_B)
    )
    value = conductance * leakage.value - leaks.piston - outside
    deviation = float(np.linalg.norm([conductance * leakage.deviation, leaks.deviation, outside_deviation]))
    return Estimate(value, deviation) if np.isfinite([value, deviation]).all() else None
