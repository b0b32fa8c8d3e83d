"""Evaluate the rig `thesis-calibrated`, which was fitted to the leak-free tests of Appendix C.

The package contains the fitted rig and its evaluation; `docs/explanation/calibrated-rig.md` gives the method, the
results and their limits. Simulated pressures are noise-free, and the RMS with noise follows without random numbers:
white noise of standard deviation sigma has the RMS sigma in each detail d_j and is independent of the pressure, so that
the RMS is ``sqrt(m_j + sigma^2)`` with m_j the noise-free mean square. For the product d_3 d_4, whose bands are
disjoint so that their noise is uncorrelated, it is ``sqrt(m_34 + sigma^2 m_3 + sigma^2 m_4 + sigma^4)``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sealscope.parameters import Rig, load_rig
from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES, details, mean_squares
from sealscope.simulation.experiment import Experiment, throttle_values
from sealscope.simulation.instruments import decimate
from sealscope.simulation.integrate import oversampling, run_with_sized_leaks
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, ThesisTable
from sealscope.thesis.engine.texts import format_note, load_texts
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG, GROUPS, Condition, DataSheet, log_change_to_percent
from sealscope.units import PSI

#: Start-up that is left out, and length of the analysed part [s]: two cycles of the slowest command (2 pi s each).
SETTLING, ANALYSED = 7.2, 4.0 * np.pi
#: Largest relative error of a mean RMS that counts as agreement.
_MAX_ERROR = 0.25


def noise_free_mean_squares(
    rig: Rig,
    condition: Condition,
    *,
    leak: str | None = None,
    x_0: float = 0.0,
    values: Mapping[str, float | str] | None = None,
) -> Array:
    """Simulate a test of Appendix C without noise, and compute the mean squares of its wavelet details.

    Returns (chambers, 5): the mean squares of d1..d4 [psi^2] and of d3d4 [psi^4] over `ANALYSED` [s] after `SETTLING`,
    at the rig's sampling rate. `leak`: such as "0.01 L/min laminar", None for no leak; `x_0` [m]: initial position of
    the piston; `values`: by name, parameters that replace those of the test.
    """
    duration = ANALYSED + SETTLING + 128.0 / rig.daq.sample_rate  # 128: more than the 120 later samples of d4
    values = {**throttle_values(condition.closed_pct / 100.0), **(values or {})}
    experiment = Experiment.of(rig=rig, command=condition.command, set=values, leak=leak, duration=duration, x_0=x_0)
    _, trajectory = run_with_sized_leaks(experiment)
    factor = oversampling(experiment)  # outputs of the solver for each sample
    rate = experiment.rate
    bounds = [round(SETTLING * rate), round((SETTLING + ANALYSED) * rate)]  # samples at the ends of the analysed part
    sampled = (decimate(trajectory[chamber], factor, round(duration * rate)) / PSI for chamber in CHAMBERS)
    return np.concatenate([mean_squares(details(pressure), bounds) for pressure in sampled])


def log_rms(squares: Array, sigma: float) -> Array:
    """Compute log RMS (..., 5) of d1..d4 and d3d4 of pressures with white noise, by the formulas of this module's text.

    `squares` (..., 5): mean squares without noise, m_1 to m_4 [psi^2] and m_34 [psi^4]; `sigma`: standard deviation
    [psi] of the noise in the pressure.
    """
    variance = np.square(sigma)
    d1, d2, d3, d4, d3d4 = np.moveaxis(squares, -1, 0)
    product = d3d4 + variance * d3 + variance * d4 + variance**2
    noisy = np.stack([d1 + variance, d2 + variance, d3 + variance, d4 + variance, product], axis=-1)
    return np.asarray(0.5 * np.log(noisy))


def pressure_noise(rig: Rig, chamber: str) -> float:
    """Compute the noise [psi] of a sample of a chamber's pressure: sensor, common noise, quantisation (step^2/12)."""
    sensor, daq = getattr(rig.sensors, chamber), rig.daq
    # step of the conversion in Pa: its volts, times the sensor's range over the sensor's voltage span
    step = daq.step * (sensor.range_hi - sensor.range_lo) / (daq.sensor_volts_hi - daq.sensor_volts_lo)
    return math.sqrt(sensor.noise**2 + rig.sensors.common_noise**2 + step**2 / 12.0) / PSI


def log_residuals(rig: Rig, sheet: DataSheet) -> Array:
    """Compute log(simulated RMS / measured RMS) without the leak in each test of Appendix C, (tests, chambers, 5)."""
    group_squares = {}
    for command, closed_pct in GROUPS:
        # number, leak and level have no effect on a simulation without the leak
        condition = Condition(number=0, command=command, closed_pct=closed_pct, mean_leak_lpm=0.0, level="")
        group_squares[condition.group] = noise_free_mean_squares(rig, condition)
    squares = np.array([group_squares[condition.group] for condition in APPENDIX_C])
    simulated = [log_rms(squares[:, k], pressure_noise(rig, chamber)) for k, chamber in enumerate(CHAMBERS)]
    leak_free = [[sheet.rms[chamber][name][:, 0] for name in QUANTITIES] for chamber in CHAMBERS]
    measured = np.moveaxis(np.array(leak_free), -1, 0)  # (tests, chambers, 5)
    return np.asarray(np.stack(simulated, axis=1) - np.log(measured))


@dataclass(frozen=True)
class Hypothesis:
    """A possible difference between the real rig and the rig that was fitted to the tests of Appendix C.

    The fitted rig is symmetric: a leak damps both pressures alike. In Appendix C, however, the RMS of the wavelet
    detail d3 of p_A falls with the leak while the RMS of d4 of p_B rises.

    - `overrides`, `factors`: values of parameters, and factors on parameters, in both halves of a test
    - `leaking_factors`: further factors in the half with the leak
    - `x_0`, `x_0_leaking` [m]: start of the piston in the half without and in the half with the leak
    - `extra_closing_B`: closed fraction of throttle B minus that of A
    - `gain_B`: gain of the pressure sensor B
    - `law`: law of the leak's flow, "laminar" or "orifice"
    """

    name: str
    overrides: Mapping[str, float | str] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    leaking_factors: Mapping[str, float] = field(default_factory=dict)
    x_0: float = 0.0
    x_0_leaking: float = 0.0
    extra_closing_B: float = 0.0
    gain_B: float = 1.0
    law: Literal["laminar", "orifice"] = "laminar"


#: The hypotheses on what the symmetric rig does not explain; the first is the fitted rig itself, unchanged.
HYPOTHESES = tuple(Hypothesis(name, **values) for name, values in load_texts("hypotheses.toml").items())


def predicted_sheet(
    rig: Rig, hypothesis: Hypothesis = HYPOTHESES[0], conditions: tuple[Condition, ...] = APPENDIX_C
) -> DataSheet:
    """Simulate tests of Appendix C, without and with their leaks, on a rig changed according to a hypothesis."""
    h = hypothesis
    healthy_rig = _scale_parameters(rig.with_overrides(h.overrides), h.factors)
    leaking_rig = _scale_parameters(healthy_rig, h.leaking_factors)
    leak_free: dict[tuple[str, float], Array] = {}  # mean squares by operating condition, which several tests share
    # d1..d4 squared scale with the gain of sensor B squared, d3d4 squared with its fourth power; noise does not
    scales = np.array([[1.0] * 5, [h.gain_B**2] * 4 + [h.gain_B**4]])
    rms = np.empty((len(conditions), 2, len(CHAMBERS), len(QUANTITIES)))  # 2: without and with the leak
    for row, condition in enumerate(conditions):
        # throttle A is closed as in the test, and B at most 0.99, as a closed throttle would stop the flow
        closed = {"line.closed_B": min(0.99, condition.closed_pct / 100.0 + h.extra_closing_B)}
        if condition.group not in leak_free:
            leak_free[condition.group] = noise_free_mean_squares(healthy_rig, condition, x_0=h.x_0, values=closed)
        leak = f"{condition.mean_leak_lpm} L/min {h.law}"
        leaking = noise_free_mean_squares(leaking_rig, condition, leak=leak, x_0=h.x_0_leaking, values=closed)
        for half, squares in enumerate((leak_free[condition.group], leaking)):
            for k, chamber in enumerate(CHAMBERS):
                rms[row, half, k] = np.exp(log_rms(squares[k] * scales[k], pressure_noise(rig, chamber)))
    return DataSheet({c: {q: rms[:, :, k, j] for j, q in enumerate(QUANTITIES)} for k, c in enumerate(CHAMBERS)})


def _scale_parameters(rig: Rig, factors: Mapping[str, float]) -> Rig:
    """Multiply some parameters of a rig by `factors`, given by parameter name."""
    return rig.with_overrides({name: float(rig[name]) * factor for name, factor in factors.items()})


def parameters_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the parameters in which the fitted rig differs from the thesis's, with sources; `context` is unused."""
    fitted = load_rig(BENCH_RIG)
    thesis_rows = {row.name: row for row in load_rig("thesis").table()}
    rows = [
        (row.name, row.meaning, thesis_rows[row.name].text, row.text, row.source)
        for row in fitted.table()
        if row.text != thesis_rows[row.name].text
    ]
    sigma = ", ".join(f"{pressure_noise(fitted, chamber):.2f} psi in {chamber}" for chamber in CHAMBERS)
    return (item.table(rows, f"Noise of a sample, all sources together: {sigma}."),)


def fit_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the ratio of simulated to measured leak-free RMS of each wavelet detail, for the fitted rig.

    The first table has geometric mean and standard deviation over all tests, the second one the geometric mean over the
    tests of each operating condition.
    """
    assert context.sheet is not None  # the item needs the measured data sheet
    residuals = log_residuals(load_rig(BENCH_RIG), context.sheet)
    columns = [(c, q, residuals[:, k, j]) for k, c in enumerate(CHAMBERS) for j, q in enumerate(QUANTITIES)]
    rows: list[tuple[Cell, ...]] = []
    for chamber, name, log_ratios in columns:
        mean, scatter = float(np.exp(log_ratios.mean())), float(np.exp(log_ratios.std(ddof=1)))
        rows.append((chamber, name, mean, "yes" if abs(mean - 1.0) <= _MAX_ERROR else "no", scatter))
    by_condition: list[tuple[Cell, ...]] = []
    for group in GROUPS:
        is_member = np.array([condition.group == group for condition in APPENDIX_C])
        ratios = np.exp(residuals[is_member].mean(axis=0)).ravel().tolist()
        by_condition.append((*group, int(is_member.sum()), *ratios))
    heads = ("input", "closed [%]", "tests", *(f"{c} {q} simulated / measured" for c, q, _ in columns))
    title = f"{item.title}, by operating condition"
    return item.table(rows, format_note("fit")), item.table(by_condition, "", heads, tail="-conditions", title=title)


def hypotheses_table(context: Context, item: Item) -> tuple[ThesisTable, ...]:
    """Tabulate the agreement of the fitted rig, changed according to each hypothesis, with the measured data sheet.

    The columns are ratios of simulated to measured RMS without the leak and changes of the simulated RMS with the leak
    (geometric means), and numbers of tests whose RMS moves as measured. A quick reproduction has two hypotheses only.
    """
    assert context.sheet is not None  # the item needs the measured data sheet
    sheet = context.sheet
    change_columns = [(c, q) for c in CHAMBERS for q in ("d2", "d3", "d4")]  # chamber and quantity
    level_columns = [(c, q) for c, q in change_columns if q != "d2"]
    heads = ["hypothesis", *(f"{c} {q} simulated / measured, leak-free" for c, q in level_columns)]
    heads += [f"{c} {q} change with leak [%]" for c, q in change_columns]
    heads += [f"{c} {q} sign right [of 41]" for c, q in level_columns]

    measured = [log_change_to_percent(sheet.log_change(c, q)) for c, q in change_columns]
    n = len(level_columns)
    # the sheet agrees with itself: all ratios are 1, and all tests have the same sign
    rows: list[tuple[Cell, ...]] = [("the sheet", *[1.0] * n, *measured, *[sheet.tests] * n)]
    rig = load_rig(BENCH_RIG)
    for hypothesis in HYPOTHESES[:2] if context.quick else HYPOTHESES:
        predicted = predicted_sheet(rig, hypothesis)
        ratios = [float(np.exp(np.mean(predicted.log_ratio(sheet, c, q)))) for c, q in level_columns]
        changes = [log_change_to_percent(predicted.log_change(c, q)) for c, q in change_columns]
        same_signs = [predicted.count_same_signs(sheet, c, q) for c, q in level_columns]
        rows.append((hypothesis.name, *ratios, *changes, *same_signs))
    return (item.table(rows, format_note("hypotheses"), heads),)
