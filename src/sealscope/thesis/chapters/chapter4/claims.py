"""The testable sentences of chapter 4, each judged by number.

Those on the orifices are judged on converged runs under both readings of the equations; what RK4 at 1e-4 s gives stands
beside.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from sealscope.physics.rig import throttle_coefficients
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.signals.windows import rms
from sealscope.simulation.commands import Sine, parse_command
from sealscope.thesis.chapters.chapter4 import cases
from sealscope.thesis.chapters.chapter4.cases import (
    CLOSINGS,
    COMMAND,
    COMMANDS,
    OURS,
    READINGS,
    SOLVERS,
    Reading,
    Solver,
    spec,
    steady_output,
)
from sealscope.thesis.chapters.chapter4.friction import falls_up_to, jumps_at_threshold, thesis_rig
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, ThesisTable
from sealscope.thesis.engine.texts import judge_claim, note
from sealscope.thesis.sines import sine_fit

#: Share of the drift without orifices that a change of drift must reach to count.
DRIFT_SHARE = 0.01
_T = TypeVar("_T")
#: Numbers of several commands or closings, by name.
Rows = list[dict[str, float]]


def ringing(run: SimulatedRun, window: float = 0.05, after: float = 0.3) -> float:
    """Compute the median peak-to-peak [Pa] of p_A's fast part within `after` [s] of the pump's reversals.

    The fast part is p_A less its mean over `window` [s]; there is no noise in it.
    """
    rate = 1.0 / float(run.t[1] - run.t[0])
    p_A, omega = run.outputs["p_A"], run.outputs["omega"]
    wide = max(3, round(window * rate) | 1)
    fast = p_A - np.convolve(np.pad(p_A, wide // 2, mode="edge"), np.full(wide, 1.0 / wide), mode="valid")
    turns = np.flatnonzero(np.diff(np.sign(omega)) != 0)
    long = round(after * rate)
    rings = [float(np.ptp(fast[k + wide : k + long])) for k in turns if run.t[k] > 1.0 and k + long < p_A.size - wide]
    return float(np.median(rings))


def _without_orifices(context: Context) -> Iterator[Claim]:
    """Judge the claims on cases 4.2 a) to c)."""
    runs = {command: context.run(spec(command, None)) for command in COMMANDS}
    fits, tests = [], []
    for name, run in runs.items():
        command = parse_command(name)
        assert isinstance(command, Sine)
        fit = sine_fit(run.t[cases.steady(run)], steady_output(run, "omega"), command.omega)
        amplitude = float(np.abs(fit.amplitudes[0]))
        rest = rms(fit.left) / (amplitude / math.sqrt(2.0))
        share = amplitude / (command.amplitude * thesis_rig().motor.omega_per_volt)
        fits.append(f"{name}: {rest * 100:.2f} % beside the sine, {share * 100:.0f} % of the commanded speed")
        tests.append(rest < 0.05)
    yield judge_claim("4.2", tests, fits="; ".join(fits))
    spans = "; ".join(f"{name}: {cases.span(run, 'x') * 1e3:.1f} mm peak to peak" for name, run in runs.items())
    yield judge_claim("4.4", [None], spans=spans)
    noise, rings = cases.visible_pressure(), {name: ringing(run) for name, run in runs.items()}
    text = ", ".join(f"{ring * 1e-3:.1f} kPa ({name})" for name, ring in rings.items())
    yield judge_claim("4.5", [ring < noise for ring in rings.values()], rings=text, noise=noise * 1e-3)
    changed: tuple[dict[str, str | float], ...] = ({}, {"F_pr": 0.0, "F_cfr": 0.0}, {"K_i": 0.0})
    drifts = [
        cases.piston_drift(context.run(cases.drift_spec(OURS, None, "converged", **overrides))) * 1e3
        for overrides in changed
    ]
    usual, smooth, unintegrated = drifts
    tests = [abs(usual - smooth) > DRIFT_SHARE * abs(usual)]
    yield judge_claim("4.6", tests, usual=usual, smooth=smooth, unintegrated=unintegrated)


def _step_and_gains(context: Context) -> Iterator[Claim]:
    """Judge the claims on the method, its step, and the gains of the speed loop."""
    runs = {case: context.run(spec(*case, solver="literal")) for case in cases.CASES.values()}

    def worst(throttles: bool) -> str:
        proofs = [run.proof for (_, closed), run in runs.items() if (closed is not None) == throttles]
        moved = [proof[name] for proof in proofs for name in PRESSURES if name in proof]
        return f"{max(moved):.3g} Pa rms" if moved else "diverged"

    tests = [run.resolved is True for run in runs.values()]
    yield judge_claim("4.1", tests, plain=worst(False), throttled=worst(True), passed=sum(tests), cases=len(tests))
    gains, texts, tests = {"motor.k_p": 50000.0, "motor.K_i": 100.0}, [], []
    for name, limits in (
        ("with the drive's voltage and current limits", {}),
        ("without limits", {"motor.V_max": 1e5, "motor.i_max": 1e5}),
    ):
        run = context.run(spec(COMMANDS[0], None, solver="literal", changed={**gains, **limits}))
        moved = f"halving the step moves the speed by {run.proof.get('omega', math.nan):.3g} rad/s rms"
        texts.append(f"{name}: {run.diverged or moved}")
        tests.append(run.resolved is True)
    moved_speed = runs[COMMANDS[0], None].proof.get("omega", math.nan)
    yield judge_claim("4.3", tests, runs="; ".join(texts), own=moved_speed)


def _printed(context: Context) -> Iterator[Claim]:
    """Judge the claims that the equations and tables themselves decide."""
    rig = thesis_rig()
    charge, run = rig.fluid.p_charge * 1e-6, context.run(spec(COMMANDS[0], 25.0))
    peaks = [float(steady_output(run, name).max()) * 1e-6 for name in PRESSURES]
    low, high = min(peaks), max(peaks)
    yield judge_claim("4.7", [None], low=low, high=high, charge=charge, needed=charge + 0.4 - high, lift=high - charge)
    area, d_line = (3.75 / 5.0) ** 2, rig.line.d_line
    tests = [math.isclose(area, 0.75, rel_tol=0.01), math.isclose(d_line, 5e-3)]
    yield judge_claim("4.13", tests, area=area, closed=1 - area, d_line=d_line * 1e3)
    yield from (judge_claim("4.17", [None]), judge_claim("4.22", [None]))
    F_pr = rig.friction.F_pr
    jumps = jumps_at_threshold(F_pr)
    tests = [math.isclose(force, above, rel_tol=1e-6) for force, above in jumps.values()]
    texts = [f"{name} bracket: {force:.1f} N at v_th, {above:.1f} N above" for name, (force, above) in jumps.items()]
    yield judge_claim("4.20", tests, jumps="; ".join(texts), falls=falls_up_to(F_pr))
    texts, free = [], {}
    for metering, name in (("literal", "as printed"), ("meter-out", "with the areas of side B swapped")):
        half = rig.with_overrides({"orifices": "present", "closed_A": 0.5, "closed_B": 0.5, "metering": metering})
        A_in, A_out, B_in, B_out = throttle_coefficients(half)
        free[metering] = (A_in > A_out, B_in > B_out)
        A, B = ("free to the cylinder" if side else "throttled to the cylinder" for side in free[metering])
        texts.append(f"{name}: side A {A}, side B {B}")
    yield judge_claim("4.23", free["literal"], sides="; ".join(texts))


def passed(tests: Mapping[Reading, tuple[bool, ...]]) -> str:
    """Count the single tests that passed, and name the readings under which all did."""
    every = [test for row in tests.values() for test in row]
    passing_readings = [reading.title for reading, row in tests.items() if all(row)]
    text = f"{sum(every)} of {len(every)} tests pass"
    if not any(every) or all(every):
        return text
    return f"{text}, all of them under {'; '.join(passing_readings) or 'neither reading'}"


def _over(
    number: int,
    numbers: Mapping[Solver, Mapping[Reading, _T]],
    test: Callable[[_T], Iterable[bool]],
    text: Callable[[list[_T]], str],
) -> Claim:
    """Judge a claim by the tests of its numbers under both readings; the converged runs decide."""
    tests = {solver: {r: tuple(test(row_numbers)) for r, row_numbers in numbers[solver].items()} for solver in SOLVERS}
    simulation = "; ".join(
        f"{cases.SOLVER_TEXT[solver]}: {text(list(numbers[solver].values()))}, {passed(tests[solver])}"
        for solver in SOLVERS
    )
    every = [test for row in tests["converged"].values() for test in row]
    return judge_claim(f"4.{number}", every, simulation=simulation, noise=cases.visible_pressure() * 1e-3)


def _range(values: Iterable[float], unit: str = "kPa", factor: float = 1e-3) -> str:
    scaled = [value * factor for value in values]
    return f"{min(scaled):+.2f} to {max(scaled):+.2f} {unit}"


def _ranges(head: str, values: Callable[[Rows], Iterable[float]]) -> Callable[[list[Rows]], str]:
    return lambda every: f"{head} {_range(value for rows in every for value in values(rows))}"


def _changes(rows: Rows, kind: str, names: Iterable[str] = PRESSURES) -> list[float]:
    """Compute the change of each later row against the first, in the `kind` of number of the named pressures."""
    keys = [f"{kind} of {name}" for name in names]
    return [row[key] - rows[0][key] for row in rows[1:] for key in keys]


def _orifices(context: Context) -> Iterator[Claim]:
    """Judge the claims on the orifices under several commands and closings."""
    limit = cases.visible_pressure()

    def numbers_under(*cases_to_run: tuple[str, float]) -> dict[Solver, dict[Reading, Rows]]:
        """Compute the numbers of each command and closing, under both readings and solvers."""
        return {
            solver: {
                reading: [cases.numbers_of(context.run(spec(*case, reading, solver))) for case in cases_to_run]
                for reading in READINGS
            }
            for solver in SOLVERS
        }

    def both(rows: Rows) -> list[float]:
        return _changes(rows, "peak") + _changes(rows, "range")

    def widest(rows: Rows) -> list[float]:
        return _changes([rows[0], rows[-1]], "range")

    def widened(rows: Rows) -> Iterator[bool]:
        for name in PRESSURES:
            a, b, c = (row[f"range of {name}"] for row in rows)
            yield a < b < c and c - a > limit

    def rises(rows: Rows) -> list[float]:
        return _changes(rows, "peak", CHAMBERS)

    def drops(rows: Rows) -> list[float]:
        return [row["largest drop"] for row in rows]

    def most_unlike(every: list[Rows]) -> str:
        return f"rms of Q_A - Q_B over rms of Q_A at most {100 * max(rows[1][flows] for rows in every):.2f} %"

    opened = numbers_under((COMMANDS[0], 0.0), (COMMANDS[0], 25.0))
    commands = numbers_under(*((command, 50.0) for command in COMMANDS))
    seven, five = (numbers_under(*((command, closed) for closed in CLOSINGS)) for command in (COMMANDS[2], COMMAND))
    p_1, p_2, flows = "mean of p_1 - p_A", "mean of p_2 - p_B", "flows differ"
    text = _ranges("25 % against open, peaks and ranges", both)
    yield _over(8, opened, lambda rows: (abs(change) < limit for change in both(rows)), text)
    yield _over(10, opened, lambda rows: (abs(change) > limit for change in _changes(rows, "peak")), text)
    yield _over(9, opened, lambda rows: [rows[1][flows] < 0.05], most_unlike)
    text = _ranges(p_1, lambda rows: [rows[1][p_1]])
    yield _over(11, opened, lambda rows: (rows[1][p_1] < 0, rows[1][p_1] < -limit), text)
    text = _ranges(p_2, lambda rows: [rows[1][p_2]])
    yield _over(12, opened, lambda rows: (rows[1][p_2] > 0, rows[1][p_2] > limit), text)
    text = _ranges(f"{COMMANDS[2]} against {COMMANDS[0]}, 50 % closed, ranges", widest)
    yield _over(14, commands, lambda rows: (growth > limit for growth in widest(rows)), text)
    text = _ranges(f"50 and 75 against 25 % closed, {COMMANDS[2]}, peaks", rises)
    yield _over(15, seven, lambda rows: (rise > limit for rise in rises(rows)), text)
    yield _over(16, five, widened, _ranges("75 against 25 % closed, ranges", widest))
    text = _ranges(f"largest drop at 25, 50, 75 % under {COMMAND}", drops)
    yield _over(21, five, lambda rows: (drop > limit for drop in drops(rows)), text)


def _drift(context: Context) -> Iterator[Claim]:
    """Judge the claims on the piston's drift."""

    def drift(reading: Reading, closed: float | None, solver: Solver) -> float:
        return cases.piston_drift(context.run(cases.drift_spec(reading, closed, solver)))

    drift_without = drift(OURS, None, "converged")
    least = DRIFT_SHARE * abs(drift_without)
    drifts = {
        solver: {reading: [drift(reading, closed, solver) for closed in CLOSINGS] for reading in READINGS}
        for solver in SOLVERS
    }

    def gained(rows: list[list[float]]) -> str:
        parts = (_range([row[k] - drift_without for row in rows], "mm", 1e3) for k in range(len(CLOSINGS)))
        return ", ".join(f"{closed:g} % closed {part}" for closed, part in zip(CLOSINGS, parts, strict=True))

    heads = {
        18: f"drift over 60 s without orifices {drift_without * 1e3:.3f} mm, in addition at",
        19: "drift over 60 s beyond that without orifices, at",
    }
    tests: dict[int, Callable[[list[float]], Iterable[bool]]] = {
        18: lambda row: (abs(drift - drift_without) > least for drift in row),
        19: lambda row: (abs(row[1]) - abs(row[0]) > least, abs(row[2]) - abs(row[1]) > least),
    }
    for number, test in tests.items():
        yield _over(number, drifts, test, lambda rows, head=heads[number]: f"{head} {gained(rows)}")  # type: ignore[misc]


#: Numbers of a row of the table of readings, and the factor to their units.
_SHOWN: dict[str, float] = {
    **{f"range of {name}": 1e-6 for name in PRESSURES},
    "least pressure": 1e-6,
    **dict.fromkeys(("mean of p_1 - p_A", "mean of p_2 - p_B", "largest drop"), 1e-3),
    "flows differ": 100.0,
}
_TESTED = {True: "passed", False: "not passed", None: "not made"}


def claims(context: Context, item: Item) -> tuple[ThesisTable | Claim, ...]:
    """Make the table of both readings, all closings and solvers, and judge the claims of chapter 4."""
    parts = (_without_orifices, _step_and_gains, _printed, _orifices, _drift)
    judgements = [claim for part in parts for claim in part(context)]
    judgements.sort(key=lambda claim: int(claim.id.rpartition(".")[2]))
    rows: list[tuple[Cell, ...]] = []
    for reading, solver, closed in itertools.product(READINGS, SOLVERS, (0.0, *CLOSINGS)):
        run = context.run(spec(COMMAND, closed, reading, solver))
        numbers = cases.numbers_of(run)
        values = (numbers[name] * factor for name, factor in _SHOWN.items())
        cells = (value if math.isfinite(value) else None for value in values)
        rows.append((reading.title, closed, cases.SOLVER_TEXT[solver], *cells, _TESTED[run.resolved]))
    table = item.table(rows, note("readings", window=cases.WINDOW))
    return (replace(table, claims=tuple(claim.id for claim in judgements)), *judgements)
