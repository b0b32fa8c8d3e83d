"""Judge the testable sentences of chapter 4.

Claims on the orifices are judged on converged runs under both interpretations ("readings") of the throttles' equations
(`cases.Reading`); the results of RK4 at 1e-4 s, the thesis's solver, are stated for comparison.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from sealscope.parameters import load_rig
from sealscope.physics.rig import throttle_coefficients
from sealscope.recordings.channels import CHAMBERS, PRESSURES
from sealscope.signals.windows import rms
from sealscope.simulation.commands import Sine, parse_command
from sealscope.thesis.chapters.chapter4 import cases
from sealscope.thesis.chapters.chapter4.friction import falling_friction_limit, friction_at_threshold
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, ThesisTable
from sealscope.thesis.engine.texts import format_note, format_range, judge_claim
from sealscope.thesis.sines import sine_fit

#: A change of drift counts if it exceeds this fraction of the drift without orifices.
DRIFT_FRACTION = 0.01
#: Peaks of the pressures in the thesis's figures [MPa].
_PRINTED_PEAK_MPA = 0.4
#: Largest residual of the speed from a sine, and largest difference of the two flows, as fractions of the rms.
_MAX_RESIDUAL, _MAX_FLOW_DIFFERENCE = 0.05, 0.05
_T = TypeVar("_T")
#: Summaries of runs (`cases.summarise_run`) with several commands or closings.
Rows = list[dict[str, float]]
#: The summaries by solver and by interpretation of the throttles' equations.
RowsByReading = dict[cases.Solver, dict[cases.Reading, Rows]]


def ringing(run: SimulatedRun, window: float = 0.05, after: float = 0.3) -> float:
    """Compute the median peak-to-peak ringing [Pa] of the noise-free p_A after the pump's reversals.

    The ringing is p_A minus its moving mean over `window` [s], from `window` to `after` [s] after each reversal of the
    pump's direction; the mean then contains nothing from before the reversal.
    """
    rate = 1.0 / float(run.t[1] - run.t[0])
    p_A, omega = run.outputs["p_A"], run.outputs["omega"]
    n_window = max(3, round(window * rate) | 1)  # odd, so that the mean is centred
    moving_mean = np.convolve(np.pad(p_A, n_window // 2, mode="edge"), np.full(n_window, 1.0 / n_window), mode="valid")
    ringing_part = p_A - moving_mean
    reversals = np.flatnonzero(np.diff(np.sign(omega)) != 0)
    n_after = round(after * rate)
    last = p_A.size - n_window
    # without the first second, in which the run starts, and without the ends of the moving mean
    used = [k for k in reversals if run.t[k] > 1.0 and k + n_after < last]
    return float(np.median([np.ptp(ringing_part[k + n_window : k + n_after]) for k in used]))


def _judge_cases_without_orifices(context: Context) -> Iterator[Claim]:
    """Judge claims 4.2 and 4.4 to 4.6 on the cases without orifices, listed in Table 4.2.

    - 4.2: the motor's speed is a sine, with a residual below 5 % of the sine's rms.
    - 4.4, on measured displacements, cannot be tested.
    - 4.5: without noise the pressure p_A does not ring visibly after a reversal.
    - 4.6: without Coulomb friction the drift of the piston changes by more than 1 %.
    """
    runs = {command: context.run(cases.make_experiment(command, None)) for command in cases.COMMANDS}
    fits, tests = [], []
    for name, run in runs.items():
        command = parse_command(name)
        assert isinstance(command, Sine)
        fit = sine_fit(run.t[cases.steady_mask(run)], cases.steady_output(run, "omega"), command.omega)
        amplitude = float(np.abs(fit.amplitudes[0]))
        residual_ratio = rms(fit.residual) / (amplitude / math.sqrt(2.0))
        speed_ratio = amplitude / (command.amplitude * load_rig("thesis").motor.omega_per_volt)
        residual = f"{residual_ratio * 100:.2f} % rms residual from the sine"
        fits.append(f"{name}: {residual}, {speed_ratio * 100:.0f} % of the commanded speed")
        tests.append(residual_ratio < _MAX_RESIDUAL)
    yield judge_claim("4.2", tests, fits="; ".join(fits))
    spans = "; ".join(f"{name}: {cases.steady_range(run, 'x') * 1e3:.1f} mm peak to peak" for name, run in runs.items())
    yield judge_claim("4.4", [], spans=spans)
    noise = cases.visible_pressure()
    rings = {name: ringing(run) for name, run in runs.items()}
    text = ", ".join(f"{ring * 1e-3:.1f} kPa ({name})" for name, ring in rings.items())
    yield judge_claim("4.5", [ring < noise for ring in rings.values()], rings=text, noise=noise * 1e-3)

    def drift_mm(**overrides: float) -> float:
        """Compute the drift [mm] of the piston in a run of 60 s, with some of the rig's parameters replaced."""
        experiment = cases.make_drift_experiment(
            cases.DEFAULT_READING, closed_pct=None, solver="converged", **overrides
        )
        return 1e3 * cases.piston_drift(context.run(experiment))

    # F_pr and F_cfr: Coulomb force without pressure, and its increase with pressure; breakaway is a multiple of both
    baseline = drift_mm()
    without_friction = drift_mm(F_pr=0.0, F_cfr=0.0)
    without_integral = drift_mm(K_i=0.0)  # without the integral gain of the speed loop; only stated in the text
    tests = [abs(baseline - without_friction) > DRIFT_FRACTION * abs(baseline)]
    yield judge_claim("4.6", tests, baseline=baseline, smooth=without_friction, unintegrated=without_integral)


def _judge_step_and_gains(context: Context) -> Iterator[Claim]:
    """Judge claims 4.1 and 4.3: halving the thesis's step of 1e-4 s changes a run by no more than the tolerance.

    The runs are all cases of Tables 4.2 and 4.3 for claim 4.1, and two with the gains of the thesis's drive for 4.3.
    """
    runs = {case: context.run(cases.make_experiment(*case, solver="as_published")) for case in cases.CASES.values()}

    def format_largest_change(*, with_throttles: bool) -> str:
        """Format the largest rms change of a pressure by halving the step; "diverged" if there is none."""
        # `closed` is None in a case without throttles
        matching_runs = [run for (_, closed), run in runs.items() if (closed is not None) == with_throttles]
        changes = [run.step_changes[name] for run in matching_runs for name in PRESSURES if name in run.step_changes]
        return f"{max(changes):.3g} Pa rms" if changes else "diverged"

    tests = [run.resolved is True for run in runs.values()]
    plain, throttled = format_largest_change(with_throttles=False), format_largest_change(with_throttles=True)
    yield judge_claim("4.1", tests, plain=plain, throttled=throttled, passed=sum(tests), cases=len(tests))
    drive_gains = {"motor.k_p": 50000.0, "motor.K_i": 100.0}  # section 4.2.1, in internal units
    texts, tests = [], []
    for name, limits in (
        ("with the drive's voltage and current limits", {}),
        ("without limits", {"motor.V_max": 1e5, "motor.i_max": 1e5}),
    ):
        gains_and_limits = {**drive_gains, **limits}
        run = context.run(
            cases.make_experiment(
                cases.COMMANDS[0], None, cases.DEFAULT_READING, "as_published", cases.DURATION, **gains_and_limits
            )
        )
        change = f"halving the step moves the speed by {run.step_changes.get('omega', math.nan):.3g} rad/s rms"
        texts.append(f"{name}: {run.diverged or change}")
        tests.append(run.resolved is True)
    speed_change = runs[cases.COMMANDS[0], None].step_changes.get("omega", math.nan)  # with the rig's gains
    yield judge_claim("4.3", tests, runs="; ".join(texts), rig_gains=speed_change)


def _judge_equations_and_tables(context: Context) -> Iterator[Claim]:
    """Judge claims 4.13, 4.20 and 4.23 by the thesis's equations and tables; 4.7, 4.17 and 4.22 cannot be tested.

    4.13: a throttle of 3.75 mm in the line of 5 mm closes 25 % of its area. 4.7 claims pressure peaks, which depend on
    the unknown charge pressure; its text states the charge pressure that would give them. 4.20: the friction does not
    jump at the threshold velocity, whichever way eq. (4.22) is read. 4.23: the throttles as printed let oil flow to the
    cylinder with less resistance than back, on both sides.
    """
    rig = load_rig("thesis")
    charge = rig.fluid.p_charge * 1e-6  # [MPa]
    run = context.run(cases.make_experiment(cases.COMMANDS[0], closed_pct=25.0))
    peaks = [float(cases.steady_output(run, name).max()) * 1e-6 for name in PRESSURES]
    low, high = min(peaks), max(peaks)
    needed = charge + _PRINTED_PEAK_MPA - high  # charge pressure with which the peaks are as printed
    yield judge_claim("4.7", [], low=low, high=high, charge=charge, needed=needed, lift=high - charge)
    open_area, d_line = (3.75 / 5.0) ** 2, rig.line.d_line  # 3.75 mm of 5 mm, printed as 25 % closed
    tests = [math.isclose(open_area, 0.75, rel_tol=0.01), math.isclose(d_line, 5e-3)]
    yield judge_claim("4.13", tests, area=open_area, closed=1 - open_area, d_line=d_line * 1e3)
    yield from (judge_claim("4.17", []), judge_claim("4.22", []))
    F_pr = rig.friction.F_pr
    jumps = friction_at_threshold(F_pr)
    tests = [math.isclose(force, above, rel_tol=1e-6) for force, above in jumps.values()]
    texts = [f"{name} bracket: {force:.1f} N at v_th, {above:.1f} N above" for name, (force, above) in jumps.items()]
    yield judge_claim("4.20", tests, jumps="; ".join(texts), falls=falling_friction_limit(F_pr))
    texts, is_free = [], {}
    for metering, name in (("literal", "as printed"), ("meter-out", "with the areas of side B swapped")):
        throttled = rig.with_overrides({"orifices": "present", "closed_A": 0.5, "closed_B": 0.5, "metering": metering})
        A_in, A_out, B_in, B_out = throttle_coefficients(throttled)
        is_free[metering] = (A_in > A_out, B_in > B_out)  # whether flow to the cylinder meets less resistance
        A, B = ("free to the cylinder" if free else "throttled to the cylinder" for free in is_free[metering])
        texts.append(f"{name}: side A {A}, side B {B}")
    yield judge_claim("4.23", is_free["literal"], sides="; ".join(texts))


def count_passed(tests: Mapping[cases.Reading, tuple[bool, ...]]) -> str:
    """Format the number of passed tests; if only some passed, with the interpretations under which all of them do."""
    results = [test for row in tests.values() for test in row]
    passing_readings = [reading.title for reading, row in tests.items() if all(row)]
    text = f"{sum(results)} of {len(results)} tests pass"
    if not any(results) or all(results):
        return text
    return f"{text}, all of them under {'; '.join(passing_readings) or 'neither reading'}"


def _judge_runs(
    claim_number: int,
    results: Mapping[cases.Solver, Mapping[cases.Reading, _T]],
    test: Callable[[_T], Iterable[bool]],
    format_results: Callable[[list[_T]], str],
) -> Claim:
    """Judge claim 4.`claim_number` by the runs with the converged solver, and state the results of both solvers.

    `results`: results of the runs by solver and interpretation (`Reading`); `test`: yields True or False for each test
    on the results under one interpretation; `format_results`: formats the results under all interpretations. Results of
    a run that diverged are NaN, which passes no test.
    """
    texts: list[str] = []
    passed: dict[cases.Solver, Iterable[bool]] = {}
    for solver in cases.SOLVERS:
        tests = {reading: tuple(test(values)) for reading, values in results[solver].items()}
        texts.append(f"{cases.LABELS[solver]}: {format_results(list(results[solver].values()))}, {count_passed(tests)}")
        passed[solver] = itertools.chain.from_iterable(tests.values())
    noise = cases.visible_pressure() * 1e-3  # [kPa]; many texts state this limit of a visible change
    return judge_claim(f"4.{claim_number}", passed["converged"], simulation="; ".join(texts), noise=noise)


def _range_formatter(head: str, values: Callable[[Rows], Iterable[float]]) -> Callable[[list[Rows]], str]:
    """Build a function that formats the smallest and the largest of some numbers [kPa] under all interpretations.

    `values`: computes the numbers [Pa] from the runs' summaries under one interpretation; `head`: text before them.
    """
    return lambda all_rows: f"{head} {format_range((v for rows in all_rows for v in values(rows)), 'kPa', 1e-3)}"


def _changes(rows: Rows, statistic: str, names: Iterable[str] = PRESSURES) -> list[float]:
    """Compute the changes [Pa] of each pressure's `statistic` ("peak" or "range") from the first run to each other."""
    keys = [f"{statistic} of {name}" for name in names]
    return [row[key] - rows[0][key] for row in rows[1:] for key in keys]


def _run_cases(context: Context, *commands_and_closings: tuple[str, float]) -> RowsByReading:
    """Simulate cases under all `READINGS` with both solvers, and summarise the runs (`summarise_run`).

    A case is (command, closing [%] of both throttles).
    """
    return {
        solver: {
            reading: [
                cases.summarise_run(context.run(cases.make_experiment(command, closed, reading, solver)))
                for command, closed in commands_and_closings
            ]
            for reading in cases.READINGS
        }
        for solver in cases.SOLVERS
    }


def _judge_opening(context: Context) -> Iterator[Claim]:
    """Judge claims 4.8 to 4.12 on orifices that are 25 % closed.

    4.8 and 4.10 compare the run with one with open orifices; the other claims need the run alone. Changes and drops are
    visible if they exceed a transducer's noise (`visible_pressure`).

    - 4.8: no pressure's peak or range changes visibly.
    - 4.9: rms(Q_A - Q_B) is below 5 % of rms(Q_A).
    - 4.10: the peak of each pressure changes visibly. The thesis states both 4.8 and 4.10; at most one can hold.
    - 4.11: the mean of p_1 is visibly below the mean of p_A.
    - 4.12: the mean of p_2 is visibly above the mean of p_B.
    """
    min_visible = cases.visible_pressure()
    # by interpretation: rows[0] is the run with open orifices, rows[1] that with orifices that are 25 % closed
    opening = _run_cases(context, (cases.COMMANDS[0], 0.0), (cases.COMMANDS[0], 25.0))
    drop_1, drop_2, flows = "mean of p_1 - p_A", "mean of p_2 - p_B", "flow difference"  # keys of a run's summary

    def peak_and_range_changes(rows: Rows) -> list[float]:
        """Compute the changes of all pressures' peaks and ranges [Pa] from open orifices to 25 % closed."""
        return _changes(rows, "peak") + _changes(rows, "range")

    def format_flow_difference(all_rows: list[Rows]) -> str:
        """Format the largest rms(Q_A - Q_B) / rms(Q_A) with orifices that are 25 % closed."""
        return f"rms of Q_A - Q_B over rms of Q_A at most {100 * max(rows[1][flows] for rows in all_rows):.2f} %"

    format_changes = _range_formatter("25 % against open, peaks and ranges", peak_and_range_changes)
    yield _judge_runs(8, opening, lambda rows: np.abs(peak_and_range_changes(rows)) < min_visible, format_changes)
    yield _judge_runs(10, opening, lambda rows: np.abs(_changes(rows, "peak")) > min_visible, format_changes)
    yield _judge_runs(9, opening, lambda rows: [rows[1][flows] < _MAX_FLOW_DIFFERENCE], format_flow_difference)
    # two tests each, so that the claim holds in part if the mean drop has the stated sign but is not visible
    format_drop = _range_formatter(drop_1, lambda rows: [rows[1][drop_1]])
    yield _judge_runs(11, opening, lambda rows: (rows[1][drop_1] < 0, rows[1][drop_1] < -min_visible), format_drop)
    format_drop = _range_formatter(drop_2, lambda rows: [rows[1][drop_2]])
    yield _judge_runs(12, opening, lambda rows: (rows[1][drop_2] > 0, rows[1][drop_2] > min_visible), format_drop)


def _judge_larger_closings(context: Context) -> Iterator[Claim]:
    """Judge claims 4.14 to 4.16 and 4.21 on larger commands and closings of the orifices.

    The pressures' ranges (maximum minus minimum) grow from the smallest to the largest command (4.14); tighter orifices
    raise the chamber pressures' peaks (4.15) and the ranges of all four pressures (4.16); the largest drop at the
    orifices is visible at each closing (4.21). Changes and drop must exceed a transducer's noise (`visible_pressure`).
    """
    min_visible = cases.visible_pressure()
    by_command = _run_cases(context, *((command, 50.0) for command in cases.COMMANDS))
    fast_by_closing = _run_cases(context, *((cases.COMMANDS[2], closed) for closed in cases.CLOSINGS))
    slow_by_closing = _run_cases(context, *((cases.COMMAND, closed) for closed in cases.CLOSINGS))

    def range_changes(rows: Rows) -> list[float]:
        """Compute the changes of all pressures' ranges [Pa] from the first run to the last."""
        return _changes([rows[0], rows[-1]], "range")

    def judge_increase(number: int, runs: RowsByReading, head: str, values: Callable[[Rows], Iterable[float]]) -> Claim:
        """Judge claim 4.`number`, that the `values` [Pa] of the runs exceed the limit of a visible change."""
        return _judge_runs(
            number, runs, lambda rows: (value > min_visible for value in values(rows)), _range_formatter(head, values)
        )

    def ranges_grow(rows: Rows) -> Iterator[bool]:
        """Yield for each pressure True if its range grows from 25 to 50 and to 75 %, and visibly from 25 to 75 %."""
        for name in PRESSURES:
            at_25, at_50, at_75 = (row[f"range of {name}"] for row in rows)
            yield at_25 < at_50 < at_75 and at_75 - at_25 > min_visible

    head = f"{cases.COMMANDS[2]} against {cases.COMMANDS[0]}, 50 % closed, ranges"
    yield judge_increase(14, by_command, head, range_changes)
    head = f"50 and 75 against 25 % closed, {cases.COMMANDS[2]}, peaks"
    yield judge_increase(15, fast_by_closing, head, lambda rows: _changes(rows, "peak", CHAMBERS))
    format_changes = _range_formatter("75 against 25 % closed, ranges", range_changes)
    yield _judge_runs(16, slow_by_closing, ranges_grow, format_changes)
    head = f"largest drop at 25, 50, 75 % under {cases.COMMAND}"
    yield judge_increase(21, slow_by_closing, head, lambda rows: [row["largest drop"] for row in rows])


def _judge_drift(context: Context) -> Iterator[Claim]:
    """Judge claims 4.18 and 4.19: orifices make the piston drift, and tighter orifices make it drift more.

    A change of the drift counts if it exceeds 1 % of the drift without orifices.
    """

    def drift(reading: cases.Reading, closed: float | None, solver: cases.Solver) -> float:
        """Compute the piston's drift [m] in a long run; `closed`: closing of the orifices [%], None for none."""
        return cases.piston_drift(context.run(cases.make_drift_experiment(reading, closed, solver)))

    drift_without = drift(cases.DEFAULT_READING, None, "converged")  # without orifices, readings do not differ
    min_change = DRIFT_FRACTION * abs(drift_without)
    drifts = {
        solver: {reading: [drift(reading, closed, solver) for closed in cases.CLOSINGS] for reading in cases.READINGS}
        for solver in cases.SOLVERS
    }

    def format_drifts(head: str, rows: list[list[float]]) -> str:
        """Format the drift [mm] due to the orifices at each closing, as its range over all interpretations (`rows`)."""
        drifts_by_closing = zip(cases.CLOSINGS, zip(*rows, strict=True), strict=True)
        texts = (
            f"{closed:g} % closed {format_range([value - drift_without for value in values], 'mm', 1e3)}"
            for closed, values in drifts_by_closing
        )
        return f"{head} {', '.join(texts)}"

    def differs(row: list[float]) -> Iterator[bool]:
        """Yield for each closing True if the drift [m] differs from that without orifices by over `min_change`."""
        return (abs(with_orifices - drift_without) > min_change for with_orifices in row)

    def grows(row: list[float]) -> Iterator[bool]:
        """Yield for each closing but the first True if |drift| [m] exceeds that before it by over `min_change`."""
        return (abs(later) - abs(earlier) > min_change for earlier, later in itertools.pairwise(row))

    head = f"drift over 60 s without orifices {drift_without * 1e3:.3f} mm, in addition at"
    yield _judge_runs(18, drifts, differs, partial(format_drifts, head))
    head = "drift over 60 s beyond that without orifices, at"
    yield _judge_runs(19, drifts, grows, partial(format_drifts, head))


#: Keys of a run's summary that the table of runs shows, and the factor from SI units to the table's units.
_TABLE_FACTORS: dict[str, float] = {
    **{f"range of {name}": 1e-6 for name in PRESSURES},
    "lowest pressure": 1e-6,
    **dict.fromkeys(("mean of p_1 - p_A", "mean of p_2 - p_B", "largest drop"), 1e-3),
    "flow difference": 100.0,
}
_HALVING_TEST = {True: "passed", False: "not passed", None: "not made"}


def claims(context: Context, item: Item) -> tuple[ThesisTable | Claim, ...]:
    """Judge the claims of chapter 4, and tabulate runs by interpretation of the equations, solver and closing."""
    without_orifices = (_judge_cases_without_orifices, _judge_step_and_gains, _judge_equations_and_tables)
    with_orifices = (_judge_opening, _judge_larger_closings, _judge_drift)
    judgements = [claim for judge in (*without_orifices, *with_orifices) for claim in judge(context)]
    judgements.sort(key=lambda claim: int(claim.id.rpartition(".")[2]))  # by the number after "4."
    rows: list[tuple[Cell, ...]] = []
    for reading, solver, closed in itertools.product(cases.READINGS, cases.SOLVERS, (0.0, *cases.CLOSINGS)):
        run = context.run(cases.make_experiment(cases.COMMAND, closed, reading, solver))
        numbers = cases.summarise_run(run)
        values = (numbers[name] * factor for name, factor in _TABLE_FACTORS.items())
        cells = (value if math.isfinite(value) else None for value in values)
        rows.append((reading.title, closed, cases.LABELS[solver], *cells, _HALVING_TEST[run.resolved]))
    table = item.table(rows, format_note("readings", window=cases.WINDOW))
    return (replace(table, claims=tuple(claim.id for claim in judgements)), *judgements)
