"""The testable sentences of chapter 4, each judged by number.

Those on the orifices are judged on converged runs under every reading of the equations; what RK4 at 1e-4 s gives stands
beside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.chapter4 import cases
from sealscope.thesis.chapters.chapter4.cases import (
    CLOSINGS,
    COMMAND,
    COMMANDS,
    OURS,
    SOLVERS,
    Reading,
    RunNumbers,
    Solver,
    spec,
    steady_output,
    throttled,
)
from sealscope.thesis.chapters.chapter4.friction import falls_up_to, jumps_at_threshold, thesis_rig
from sealscope.thesis.claims.judged import judged
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, ThesisTable

#: Share of the drift without orifices that a change of drift must reach to count.
DRIFT_SHARE = 0.01
_T = TypeVar("_T")


def sine_fit(t: Array, values: Array, omega: float) -> tuple[float, float]:
    """Fit a sine of frequency `omega` [rad/s]; return its amplitude and what is left over it (rms, relative)."""
    basis = np.stack([np.sin(omega * t), np.cos(omega * t), np.ones_like(t)], axis=1)
    fitted = np.linalg.lstsq(basis, values, rcond=None)[0]
    amplitude = float(np.hypot(fitted[0], fitted[1]))
    return amplitude, float(np.sqrt(np.mean((values - basis @ fitted) ** 2)) / (amplitude / math.sqrt(2.0)))


def ringing(run: SimulatedRun, window: float = 0.05, after: float = 0.3) -> float:
    """Return the median peak-to-peak [Pa] of p_A's fast part within `after` [s] of the pump's reversals.

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
    """Judge what is said of cases 4.2 a) to c)."""
    from sealscope.simulation.commands import Sine, parse_command

    runs = {command: context.run(spec(command, None)) for command in COMMANDS}
    fits, tests = [], []
    for name, run in runs.items():
        command = parse_command(name)
        assert isinstance(command, Sine)
        amplitude, rest = sine_fit(run.t[cases.steady(run)], steady_output(run, "omega"), command.omega)
        share = amplitude / (command.amplitude * thesis_rig().motor.omega_per_volt)
        fits.append(f"{name}: {rest * 100:.2f} % beside the sine, {share * 100:.0f} % of the commanded speed")
        tests.append(rest < 0.05)
    yield judged("4.2", tests, fits="; ".join(fits))
    spans = "; ".join(f"{name}: {cases.span(run, 'x') * 1e3:.1f} mm peak to peak" for name, run in runs.items())
    yield judged("4.4", [None], spans=spans)
    noise, rings = cases.visible_pressure(), {name: ringing(run) for name, run in runs.items()}
    text = ", ".join(f"{ring * 1e-3:.1f} kPa ({name})" for name, ring in rings.items())
    yield judged("4.5", [ring < noise for ring in rings.values()], rings=text, noise=noise * 1e-3)
    changed: tuple[dict[str, str | float], ...] = ({}, {"F_pr": 0.0, "F_cfr": 0.0}, {"K_i": 0.0})
    drifts = [cases.piston_drift(context.run(cases.drift_spec(OURS, None, "converged", **of))) * 1e3 for of in changed]
    usual, smooth, unintegrated = drifts
    tests = [abs(usual - smooth) > DRIFT_SHARE * abs(usual)]
    yield judged("4.6", tests, usual=usual, smooth=smooth, unintegrated=unintegrated)


def _step_and_gains(context: Context) -> Iterator[Claim]:
    """Judge what is said of the method, its step, and the gains of the speed loop."""
    runs = [(case, context.run(spec(case.command, case.closed_pct, solver="literal"))) for case in cases.CASES.values()]

    def worst(throttles: bool) -> str:
        proofs = [run.proof for case, run in runs if (case.closed_pct is not None) == throttles]
        moved = [proof[name] for proof in proofs for name in PRESSURES if name in proof]
        return f"{max(moved):.3g} Pa rms" if moved else "diverged"

    tests = [run.resolved for _, run in runs]
    passed = sum(test is True for test in tests)
    yield judged("4.1", tests, plain=worst(False), throttled=worst(True), passed=passed, cases=len(tests))
    base = spec(COMMANDS[0], None, solver="literal")
    gains = (("motor.k_p", 50000.0), ("motor.K_i", 100.0))
    texts, tests = [], []
    for name, limits in (
        ("with the drive's voltage and current limits", ()),
        ("without limits", (("motor.V_max", 1e5), ("motor.i_max", 1e5))),
    ):
        run = context.run(replace(base, values=(*base.values, *gains, *limits)))
        moved = f"halving the step moves the speed by {run.proof.get('omega', math.nan):.3g} rad/s rms"
        texts.append(f"{name}: {run.diverged or moved}")
        tests.append(run.resolved is True)
    yield judged("4.3", tests, runs="; ".join(texts), own=context.run(base).proof.get("omega", math.nan))


def _printed(context: Context) -> Iterator[Claim]:
    """Judge what the equations and tables themselves decide."""
    from sealscope.physics.rig import throttle_coefficients

    rig = thesis_rig()
    charge, run = rig.fluid.p_charge * 1e-6, context.run(spec(COMMANDS[0], 25.0))
    peaks = [float(steady_output(run, name).max()) * 1e-6 for name in PRESSURES]
    low, high = min(peaks), max(peaks)
    yield judged("4.7", [None], low=low, high=high, charge=charge, needed=charge + 0.4 - high, lift=high - charge)
    area, d_line = (3.75 / 5.0) ** 2, rig.line.d_line
    tests = [math.isclose(area, 0.75, rel_tol=0.01), math.isclose(d_line, 5e-3)]
    yield judged("4.13", tests, area=area, closed=1 - area, d_line=d_line * 1e3)
    yield from (judged("4.17", [None]), judged("4.22", [None]))
    F_pr = rig.friction.F_pr
    jumps = jumps_at_threshold(F_pr)
    tests = [math.isclose(at, above, rel_tol=1e-6) for at, above in jumps.values()]
    texts = [f"{name} bracket: {at:.1f} N at v_th, {above:.1f} N above" for name, (at, above) in jumps.items()]
    yield judged("4.20", tests, jumps="; ".join(texts), falls=falls_up_to(F_pr))
    texts, free = [], {}
    for metering, name in (("literal", "as printed"), ("meter-out", "with the areas of side B swapped")):
        closed: dict[str, float | int | str] = {
            "orifices": "present",
            "closed_A": 0.5,
            "closed_B": 0.5,
            "metering": metering,
        }
        A_in, A_out, B_in, B_out = throttle_coefficients(rig.with_overrides(closed))
        free[metering] = (A_in > A_out, B_in > B_out)
        A, B = ("free to the cylinder" if side else "throttled to the cylinder" for side in free[metering])
        texts.append(f"{name}: side A {A}, side B {B}")
    yield judged("4.23", free["literal"], sides="; ".join(texts))


def passed(tests: Mapping[Reading, tuple[bool, ...]]) -> str:
    """Count how many single tests passed under how many readings, and name the readings under which all did."""
    every = [test for row in tests.values() for test in row]
    whole = [reading.title for reading, row in tests.items() if all(row)]
    text = f"{sum(every)} of {len(every)} tests pass"
    if not any(every) or all(every):
        return text
    return f"{text}, all of them under {len(whole)} of {len(tests)} readings" + (
        f" ({'; '.join(whole)})" if 0 < len(whole) <= 3 else ""
    )


def _over(
    number: int,
    numbers: Mapping[Solver, Mapping[Reading, _T]],
    test: Callable[[_T], Iterable[bool]],
    text: Callable[[list[_T]], str],
) -> Claim:
    """Judge a claim by the tests of its numbers under every reading; the converged runs decide."""
    tests = {solver: {r: tuple(test(of)) for r, of in numbers[solver].items()} for solver in SOLVERS}
    simulation = "; ".join(
        f"{cases.SOLVER_TEXT[solver]}: {text(list(numbers[solver].values()))}, {passed(tests[solver])}"
        for solver in SOLVERS
    )
    every = [test for row in tests["converged"].values() for test in row]
    return judged(f"4.{number}", every, simulation=simulation, noise=cases.visible_pressure() * 1e-3)


def _range(values: Iterable[float], unit: str = "kPa", factor: float = 1e-3) -> str:
    scaled = [value * factor for value in values]
    return f"{min(scaled):+.2f} to {max(scaled):+.2f} {unit}"


def _at_25_percent(context: Context, under: Callable[..., Any]) -> Iterator[Claim]:
    """Judge what is said of 3 sin(4t) with the orifices open and 25 % closed; `under` gives numbers by reading."""
    limit = cases.visible_pressure()
    pairs = under(lambda r, solver: [throttled(context, r, closed, solver, COMMANDS[0]) for closed in (0.0, 25.0)])

    def changes(pair: list[RunNumbers]) -> list[float]:
        """Change of the four peaks and of the four ranges."""
        return [getattr(pair[1], of)[p] - getattr(pair[0], of)[p] for of in ("peak", "span") for p in PRESSURES]

    def text(rows: list[list[RunNumbers]]) -> str:
        return "25 % against open, peaks and ranges " + _range(change for row in rows for change in changes(row))

    yield _over(8, pairs, lambda pair: (abs(change) < limit for change in changes(pair)), text)
    yield _over(10, pairs, lambda pair: (abs(change) > limit for change in changes(pair)[:4]), text)
    yield _over(
        9,
        pairs,
        lambda pair: (pair[1].flows_differ < 0.05,),
        lambda rows: f"rms of Q_A - Q_B over rms of Q_A at most {max(n.flows_differ for _, n in rows) * 100:.2f} %",
    )
    yield _over(
        11,
        pairs,
        lambda pair: (pair[1].p_1_less_p_A < 0, pair[1].p_1_less_p_A < -limit),
        lambda rows: "mean of p_1 - p_A " + _range(n.p_1_less_p_A for _, n in rows),
    )
    yield _over(
        12,
        pairs,
        lambda pair: (pair[1].p_2_less_p_B > 0, pair[1].p_2_less_p_B > limit),
        lambda rows: "mean of p_2 - p_B " + _range(n.p_2_less_p_B for _, n in rows),
    )


def _over_openings(context: Context, under: Callable[..., Any]) -> Iterator[Claim]:
    """Judge what is said of amplitudes and of tighter orifices; `under` gives numbers by reading and solver."""
    limit = cases.visible_pressure()

    def growths(rows: list[RunNumbers]) -> list[float]:
        return [rows[2].span[name] - rows[0].span[name] for name in PRESSURES]

    def rises(rows: list[RunNumbers]) -> list[float]:
        return [row.peak[name] - rows[0].peak[name] for row in rows[1:] for name in CHAMBERS]

    def widened(rows: list[RunNumbers]) -> Iterator[bool]:
        for name in PRESSURES:
            a, b, c = (row.span[name] for row in rows)
            yield a < b < c and c - a > limit

    commands = under(lambda r, solver: [throttled(context, r, 50.0, solver, command) for command in COMMANDS])
    seven = under(lambda r, solver: [throttled(context, r, closed, solver, COMMANDS[2]) for closed in CLOSINGS])
    five = under(lambda r, solver: [throttled(context, r, closed, solver) for closed in CLOSINGS])
    for number, numbers, measured, head in (
        (14, commands, growths, f"{COMMANDS[2]} against {COMMANDS[0]}, 50 % closed, ranges "),
        (15, seven, rises, f"50 and 75 against 25 % closed, {COMMANDS[2]}, peaks "),
        (21, five, lambda rows: [n.largest_drop for n in rows], f"largest drop at 25, 50, 75 % under {COMMAND} "),
    ):
        yield _over(
            number,
            numbers,
            lambda rows, of=measured: (value > limit for value in of(rows)),  # type: ignore[misc]
            lambda every, of=measured, head=head: head + _range(value for rows in every for value in of(rows)),  # type: ignore[misc]
        )
    yield _over(
        16,
        five,
        widened,
        lambda every: "75 against 25 % closed, ranges " + _range(value for rows in every for value in growths(rows)),
    )


def _drift(context: Context) -> Iterator[Claim]:
    def drift(reading: Reading, closed: float | None, solver: Solver) -> float:
        return cases.piston_drift(context.run(cases.drift_spec(reading, closed, solver)))

    without = drift(OURS, None, "converged")
    least = DRIFT_SHARE * abs(without)
    moved = {
        solver: {
            r: [drift(r, closed, solver) for closed in CLOSINGS]
            for r in cases.readings(context.quick or solver == "literal")
        }
        for solver in SOLVERS
    }

    def gained(rows: list[list[float]]) -> str:
        return ", ".join(
            f"{closed:g} % closed {_range((row[k] - without for row in rows), 'mm', 1e3)}"
            for k, closed in enumerate(CLOSINGS)
        )

    yield _over(
        18,
        moved,
        lambda row: (abs(drift - without) > least for drift in row),
        lambda rows: f"drift over 60 s without orifices {without * 1e3:.3f} mm, in addition at {gained(rows)}",
    )
    yield _over(
        19,
        moved,
        lambda row: (abs(row[1]) - abs(row[0]) > least, abs(row[2]) - abs(row[1]) > least),
        lambda rows: f"drift over 60 s beyond that without orifices, at {gained(rows)}",
    )


def claims(context: Context, item: Item) -> tuple[ThesisTable | Claim, ...]:
    """Make the table of all readings, closings and solvers, and judge the claims of chapter 4."""

    def under(of: Callable[[Reading, Solver], Any]) -> dict[Solver, dict[Reading, Any]]:
        return {solver: {r: of(r, solver) for r in cases.readings(context.quick)} for solver in SOLVERS}

    judgements = (
        *_without_orifices(context),
        *_step_and_gains(context),
        *_printed(context),
        *_at_25_percent(context, under),
        *_over_openings(context, under),
        *_drift(context),
    )
    ordered = sorted(judgements, key=lambda claim: int(claim.id.rpartition(".")[2]))
    rows = [
        (reading.title, closed, cases.SOLVER_TEXT[solver], *_row(throttled(context, reading, closed, solver)))
        for reading in cases.readings(context.quick)
        for solver in SOLVERS
        for closed in (0.0, *CLOSINGS)
    ]
    notes = (
        f"Numbers {cases.WINDOW}. Q_A unlike Q_B: rms of their difference over the rms of Q_A. Rows that did not pass "
        "the halving test show the step, not the rig."
    )
    ids = tuple(claim.id for claim in ordered)
    return (ThesisTable(item.id, item.title, _COLUMNS, tuple(rows), ids, None, notes), *ordered)


_COLUMNS = (
    *("reading", "closed [%]", "solver", *(f"range of {name} [MPa]" for name in PRESSURES), "least pressure [MPa]"),
    *("mean of p_1 - p_A [kPa]", "mean of p_2 - p_B [kPa]", "largest drop [kPa]", "Q_A unlike Q_B [%]", "halving test"),
)


def _row(numbers: RunNumbers) -> tuple[Cell, ...]:
    MPa = (*numbers.span.values(), min(numbers.least.values()))
    kPa = (numbers.p_1_less_p_A, numbers.p_2_less_p_B, numbers.largest_drop)
    values = (*(of * 1e-6 for of in MPa), *(of * 1e-3 for of in kPa), numbers.flows_differ * 100.0)
    tested = {True: "passed", False: "not passed", None: "not made"}[numbers.resolved]
    return (*(value if math.isfinite(value) else None for value in values), tested)


ITEMS: tuple[Item, ...] = (
    Item("chapter-4-claims", 4, "claims", f"Chapter 4 under every reading of its equations, {COMMAND}", claims),
)
