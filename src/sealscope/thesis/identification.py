"""The rig `thesis-calibrated`: its fit to the leak-free tests of Appendix C, the residuals, and its predictions.

The package holds the result of the fit, the rig's file, and what judges it: `docs/decisions/0006-calibration.md` gives
the method, the figures and the limits. The simulated trajectory carries no noise. White noise of standard deviation
sigma is independent of it and has the RMS sigma in each detail d_j, so the RMS with noise needs no draw:
``sqrt(m_j + sigma^2)`` with m_j the noise-free mean square. For the product, with d_3 and d_4 of the noise uncorrelated
(disjoint bands): ``sqrt(m_34 + sigma^2 m_3 + sigma^2 m_4 + sigma^4)``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sealscope.parameters import Rig, load_rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES, details, mean_squares
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import decimate
from sealscope.simulation.integrate import oversampling, sized_run
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import note, texts_of
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, Condition, DataSheet, experiment_values, groups
from sealscope.units import PSI

#: Part of a run that is used [s]: after the start-up, two of the slowest command's cycles (2 pi seconds each).
SETTLING, USED = 7.2, 4.0 * np.pi


def noise_free_squares(
    rig: Rig,
    condition: Condition,
    *,
    leak: str | None = None,
    x_0: float = 0.0,
    values: Mapping[str, float | str] | None = None,
) -> Array:
    """Simulate a condition; return the noise-free mean squares of d1..d4 [psi^2] and d3d4 [psi^4], (chambers, 5).

    Sampled as the instruments do (the rig's rate, its anti-alias filter), over `USED` seconds after the start-up. The
    rig itself sizes `leak`; `values` are set after those of the condition. Raises what simulating raises.
    """
    padded = USED + SETTLING + 128.0 / rig.daq.sample_rate  # the deepest detail looks 120 samples ahead
    values = {**experiment_values(condition), **(values or {})}
    experiment = Experiment.of(rig=rig, command=condition.command, set=values, leak=leak, duration=padded, x_0=x_0)
    _, path = sized_run(experiment)
    factor, rate = oversampling(experiment), experiment.rate
    bounds = [round(SETTLING * rate), round((SETTLING + USED) * rate)]
    sampled = (decimate(path[chamber], factor, round(padded * rate)) / PSI for chamber in CHAMBERS)
    return np.concatenate([mean_squares(details(pressure), bounds) for pressure in sampled])


def log_rms(squares: Array, sigma: float) -> Array:
    """Compute log RMS of d1..d4, d3d4 with white noise of deviation `sigma` [psi], (..., 5), from their squares."""
    s = np.square(sigma)
    product = squares[..., 4] + s * squares[..., 2] + s * squares[..., 3] + s * s
    return np.asarray(0.5 * np.log(np.concatenate([squares[..., :4] + s, product[..., None]], axis=-1)))


def noise_of(rig: Rig, chamber: str) -> float:
    """Compute the standard deviation [psi] of one sample of a chamber's pressure.

    Own noise, common noise and the conversion's step, white with variance step^2/12, add up in squares.
    """
    sensor, daq = getattr(rig.sensors, chamber), rig.daq
    step = daq.step * (sensor.range_hi - sensor.range_lo) / (daq.sensor_volts_hi - daq.sensor_volts_lo)
    return math.sqrt(sensor.noise**2 + rig.sensors.common_noise**2 + step**2 / 12.0) / PSI


def log_residuals(rig: Rig, sheet: DataSheet) -> Array:
    """Compute log(simulated/measured) of the leak-free RMS of every test, (tests, 2, 5), at the rig's rate."""
    of_group = {group: noise_free_squares(rig, Condition(0, *group, 0.0, "extra-small")) for group in groups()}
    squares = np.array([of_group[condition.group] for condition in APPENDIX_C])
    simulated = [log_rms(squares[:, k], noise_of(rig, chamber)) for k, chamber in enumerate(CHAMBERS)]
    measured = [[sheet.rms[chamber][name][:, 0] for name in QUANTITIES] for chamber in CHAMBERS]
    return np.asarray(np.stack(simulated, axis=1) - np.log(np.moveaxis(np.array(measured), -1, 0)))


@dataclass(frozen=True)
class Hypothesis:
    """A difference between the real rig and the identified one.

    The identified model is symmetric: both chambers ring alike, and a leak damps both. In Appendix C d3 of p_A falls
    with the leak and d4 of p_B rises. `always`: parameters in both halves of a test; `factors`: parameters multiplied
    in both, `then`: in the leaking half only; `x_0`, `x_0_then` [m]: where the piston starts in the two halves;
    `more_closed_B`: share of its bore by which throttle B stands further closed than A; `gain_B`: what sensor B reads
    of a true change; `law` of the leak.
    """

    name: str
    always: Mapping[str, float | str] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    then: Mapping[str, float] = field(default_factory=dict)
    x_0: float = 0.0
    x_0_then: float = 0.0
    more_closed_B: float = 0.0
    gain_B: float = 1.0
    law: Literal["laminar", "orifice"] = "laminar"


#: The hypotheses on what the symmetric rig leaves unexplained; the first is that rig itself.
HYPOTHESES = tuple(Hypothesis(name, **values) for name, values in texts_of("hypotheses.toml").items())


def predicted_sheet(
    rig: Rig, hypothesis: Hypothesis = HYPOTHESES[0], conditions: tuple[Condition, ...] = APPENDIX_C
) -> DataSheet:
    """Simulate the tests without and with their leaks on the rig under a hypothesis; return the sheet [psi]."""
    h = hypothesis
    before = _multiplied(rig.with_overrides(h.always) if h.always else rig, h.factors)
    after = _multiplied(before, h.then)
    leak_free: dict[tuple[str, float], Array] = {}
    rms = np.empty((len(conditions), 2, len(CHAMBERS), len(QUANTITIES)))
    for row, condition in enumerate(conditions):
        closed = {"line.closed_B": min(0.99, condition.closed_pct / 100.0 + h.more_closed_B)}
        if condition.group not in leak_free:
            leak_free[condition.group] = noise_free_squares(before, condition, x_0=h.x_0, values=closed)
        leak = f"{condition.mean_leak_lpm} L/min {h.law}"
        leaking = noise_free_squares(after, condition, leak=leak, x_0=h.x_0_then, values=closed)
        for half, squares in enumerate((leak_free[condition.group], leaking)):
            for k, chamber in enumerate(CHAMBERS):
                read = squares[k] * np.array([h.gain_B**2] * 4 + [h.gain_B**4]) if k else squares[k]
                rms[row, half, k] = np.exp(log_rms(read, noise_of(rig, chamber)))
    return DataSheet({c: {q: rms[:, :, k, j] for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)})


def _multiplied(rig: Rig, factors: Mapping[str, float]) -> Rig:
    return rig.with_overrides({name: float(rig[name]) * by for name, by in factors.items()}) if factors else rig


def parameters_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate every parameter in which the identified rig differs from the thesis's."""
    fitted, printed = load_rig(BENCH_RIG), {row.name: row for row in load_rig("thesis").table()}
    rows = [
        (row.name, row.meaning, printed[row.name].given, row.given, row.source)
        for row in fitted.table()
        if row.given != printed[row.name].given
    ]
    sigma = ", ".join(f"{noise_of(fitted, chamber):.2f} psi in {chamber}" for chamber in CHAMBERS)
    return (item.table(rows, f"Noise of a sample, all sources together: {sigma}."),)


def fit_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate simulated over measured leak-free RMS: geometric means over all tests, and by operating condition."""
    assert context.sheet is not None
    log = log_residuals(load_rig(BENCH_RIG), context.sheet)
    columns = [(c, q, log[:, k, j]) for k, c in enumerate(CHAMBERS) for j, q in enumerate(QUANTITIES)]
    rows: list[tuple[Cell, ...]] = []
    for chamber, name, logs in columns:
        mean, scatter = float(np.exp(logs.mean())), float(np.exp(logs.std(ddof=1)))
        rows.append((chamber, name, mean, "yes" if abs(mean - 1.0) <= 0.25 else "no", scatter))
    by_condition: list[tuple[Cell, ...]] = []
    for group in groups():
        members = np.array([condition.group == group for condition in APPENDIX_C])
        by_condition.append((*group, int(members.sum()), *np.exp(log[members].mean(axis=0)).ravel().tolist()))
    heads = ("input", "closed [%]", "tests", *(f"{c} {q} simulated / measured" for c, q, _ in columns))
    title = f"{item.title}, by operating condition"
    return item.table(rows, note("fit")), item.table(by_condition, "", heads, tail="-conditions", title=title)


def hypotheses_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate each hypothesis's leak-free level and its change with the leak, with those of the sheet."""
    assert context.sheet is not None
    sheet = context.sheet
    # d2 is shown in the changes only
    changed = [(c, q) for c in CHAMBERS for q in ("d2", "d3", "d4")]
    columns_shown = [(c, q) for c, q in changed if q != "d2"]
    heads = ["hypothesis", *(f"{c} {q} simulated / measured, leak-free" for c, q in columns_shown)]
    heads += [f"{c} {q} change with leak [%]" for c, q in changed]
    heads += [f"{c} {q} sign right [of 41]" for c, q in columns_shown]

    def signs(sheet: DataSheet, c: str, q: str) -> Array:
        return np.asarray(np.sign(sheet.rms[c][q][:, 1] - sheet.rms[c][q][:, 0]))

    measured = [float(100 * np.expm1(np.mean(sheet.log_change(c, q)))) for c, q in changed]
    rows: list[tuple[Cell, ...]] = [("the sheet", *[1.0] * 4, *measured, *[41] * 4)]
    rig = load_rig(BENCH_RIG)
    for hypothesis in HYPOTHESES[:2] if context.quick else HYPOTHESES:
        predicted = predicted_sheet(rig, hypothesis)
        levels = [np.mean(np.log(predicted.rms[c][q][:, 0] / sheet.rms[c][q][:, 0])) for c, q in columns_shown]
        changes = [100 * (float(np.exp(np.mean(predicted.log_change(c, q)))) - 1.0) for c, q in changed]
        same_sign = [int(np.sum(signs(predicted, c, q) == signs(sheet, c, q))) for c, q in columns_shown]
        rows.append((hypothesis.name, *(float(np.exp(level)) for level in levels), *changes, *same_sign))
    return (item.table(rows, note("hypotheses"), heads),)
