"""What chapter 4 says of its orifices, judged on converged runs under every reading; what RK4 at 1e-4 s gives stands
beside."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.thesis.chapters.chapter4.cases import AS_PRINTED, CLOSINGS, COMMANDS, OURS, Reading, visible_pressure
from sealscope.thesis.chapters.chapter4.variants import (
    COMMAND,
    SOLVER_TEXT,
    SOLVERS,
    Solver,
    Throttled,
    drift,
    drift_spec,
    one,
    over_closings,
    readings,
)
from sealscope.thesis.claims.judging import verdict_of
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.products import Claim

SHEET = "the sheet holds no pressures, flows or positions of chapter 4"
#: Share of the drift without orifices that a change of drift must reach to count.
DRIFT_SHARE = 0.01
Tests = Mapping[Reading, tuple[bool, ...]]


def orifice_claims(context: Context) -> tuple[Claim, ...]:
    """Claims 4.8-4.12, 4.14-4.16, 4.18, 4.19 and 4.21."""
    return (
        *_slightly_closed(context),
        *_across_the_orifice(context),
        *_over_commands(context),
        *_over_openings(context),
        *_drift(context),
    )


def passed(tests: Tests) -> str:
    """How many single tests passed under how many readings, and under which all did."""
    every = [test for row in tests.values() for test in row]
    whole = [reading.title for reading, row in tests.items() if all(row)]
    text = f"{sum(every)} of {len(every)} tests pass"
    if not any(every) or all(every):
        return text
    return f"{text}, all of them under {len(whole)} of {len(tests)} readings" + (
        f" ({'; '.join(whole)})" if 0 < len(whole) <= 3 else ""
    )


def _judged(
    claim_id: str,
    where: str,
    claim: str,
    make: Callable[[Solver], Tests],
    numbers: Callable[[Solver], str],
    why: str,
) -> Claim:
    """A claim with its tests made for both solvers; the converged ones decide."""
    tests = {solver: make(solver) for solver in SOLVERS}
    told = "; ".join(f"{SOLVER_TEXT[solver]}: {numbers(solver)}, {passed(tests[solver])}" for solver in SOLVERS)
    verdict = verdict_of([test for row in tests["converged"].values() for test in row])
    return Claim(claim_id, where, claim, SHEET, told, verdict, why)


def _range_text(values: list[float], unit: str, factor: float = 1e-3) -> str:
    low, high = min(values) * factor, max(values) * factor
    return f"{low:+.2f} to {high:+.2f} {unit}"


def _slightly_closed(context: Context) -> tuple[Claim, ...]:
    command, limit = COMMANDS[0], visible_pressure()
    chosen = readings(context.quick)
    found = {
        solver: {r: (one(context, r, 0.0, solver, command), one(context, r, 25.0, solver, command)) for r in chosen}
        for solver in SOLVERS
    }

    def changes(solver: Solver) -> dict[Reading, list[float]]:
        return {
            r: [
                getattr(closed, what)[name] - getattr(opened, what)[name]
                for what in ("peak", "span")
                for name in PRESSURES
            ]
            for r, (opened, closed) in found[solver].items()
        }

    def text(solver: Solver) -> str:
        return "25 % against open, peaks and ranges " + _range_text(
            [change for row in changes(solver).values() for change in row], "kPa"
        )

    noise = f"A change counts when it exceeds a transducer's noise ({limit * 1e-3:.1f} kPa)."
    return (
        _judged(
            "claim-4.8",
            "section 4.2.2 a), Figs. 4.10, 4.11",
            "An orifice closed by 25 % makes no difference to the pressures at pump and cylinder.",
            lambda solver: {r: tuple(abs(one) < limit for one in row) for r, row in changes(solver).items()},
            text,
            f"{noise} The drop over the orifice is far below the friction's pressure. It contradicts claim 4.10.",
        ),
        _judged(
            "claim-4.10",
            "section 4.2.2 a), Figs. 4.13, 4.14",
            "Closing the orifices by 25 % has a significant impact on the peaks of all four simulated pressures.",
            lambda solver: {r: tuple(abs(one) > limit for one in row[:4]) for r, row in changes(solver).items()},
            text,
            f"{noise} What RK4 at 1e-4 s shows here is its own step: each orifice settles on a drop that solves the "
            "method's equations and not the rig's. It contradicts claim 4.8.",
        ),
        _judged(
            "claim-4.9",
            "section 4.2.2 a), Fig. 4.12",
            "The flows through both orifices behave alike.",
            lambda solver: {r: (closed.flows_differ < 0.05,) for r, (_, closed) in found[solver].items()},
            lambda solver: (
                "rms of Q_A - Q_B over rms of Q_A at most "
                f"{max(closed.flows_differ for _, closed in found[solver].values()) * 100:.2f} %"
            ),
            "Alike within 5 %: both carry the pump's flow, and the oil between takes up little.",
        ),
    )


def _across_the_orifice(context: Context) -> tuple[Claim, ...]:
    command, limit = COMMANDS[0], visible_pressure()
    found = {solver: {r: one(context, r, 25.0, solver, command) for r in readings(context.quick)} for solver in SOLVERS}
    over = {solver: {r: over_closings(context, r, solver) for r in readings(context.quick)} for solver in SOLVERS}

    def lower(solver: Solver) -> Tests:
        return {r: (n.p_1_less_p_A < 0, n.p_1_less_p_A < -limit) for r, n in found[solver].items()}

    def higher(solver: Solver) -> Tests:
        return {r: (n.p_2_less_p_B > 0, n.p_2_less_p_B > limit) for r, n in found[solver].items()}

    def drops(solver: Solver) -> Tests:
        return {r: tuple(rows[c].largest_drop > limit for c in CLOSINGS) for r, rows in over[solver].items()}

    noise = f"a transducer's noise ({limit * 1e-3:.1f} kPa)"
    seen = f"Two tests a reading: the sign of the mean, and whether it exceeds {noise}."
    return (
        _judged(
            "claim-4.11",
            "section 4.2.2 a), Fig. 4.13",
            "With the orifices 25 % closed p_1 is below p_A.",
            lower,
            lambda solver: "mean of p_1 - p_A " + _range_text([n.p_1_less_p_A for n in found[solver].values()], "kPa"),
            f"{seen} Side A is throttled on the return under every reading, so the sign is right in the mean; during "
            "the stroke that fills chamber A p_1 is above p_A.",
        ),
        _judged(
            "claim-4.12",
            "section 4.2.2 a), Fig. 4.14",
            "With the orifices 25 % closed p_2 is above p_B.",
            higher,
            lambda solver: "mean of p_2 - p_B " + _range_text([n.p_2_less_p_B for n in found[solver].values()], "kPa"),
            f"{seen} The sign follows from eqs. (4.11), (4.12) as printed, which throttle side B on the way to the "
            "cylinder; with the throttled return of the text p_2 is below p_B.",
        ),
        _judged(
            "claim-4.21",
            "section 4.1.2",
            "The flow through the orifice has a huge impact on the pressures.",
            drops,
            lambda solver: (
                f"largest drop at 25, 50, 75 % under {COMMAND} "
                + _range_text([rows[c].largest_drop for rows in over[solver].values() for c in CLOSINGS], "kPa")
            ),
            f"A drop counts when it exceeds a transducer's noise ({limit * 1e-3:.1f} kPa). At the rig's few litres a "
            "minute only the smallest openings reach that.",
        ),
    )


def _over_commands(context: Context) -> tuple[Claim, ...]:
    limit = visible_pressure()
    noise = f"a transducer's noise ({limit * 1e-3:.1f} kPa)"
    few = readings(context.quick)
    found = {solver: {r: {c: one(context, r, 50.0, solver, c) for c in COMMANDS} for r in few} for solver in SOLVERS}
    peaks = {
        solver: {r: {closed: one(context, r, closed, solver, COMMANDS[2]) for closed in CLOSINGS} for r in few}
        for solver in SOLVERS
    }

    def growth(rows: Mapping[str, Throttled], name: str) -> float:
        return rows[COMMANDS[2]].span[name] - rows[COMMANDS[0]].span[name]

    def raised(rows: Mapping[float, Throttled]) -> tuple[float, ...]:
        return tuple(rows[c].peak[name] - rows[25.0].peak[name] for c in (50.0, 75.0) for name in CHAMBERS)

    return (
        _judged(
            "claim-4.14",
            "section 4.2.2 f), Figs. 4.25, 4.26",
            "The range of the pressures grows with the amplitude of the command.",
            lambda solver: {r: tuple(growth(rows, p) > limit for p in PRESSURES) for r, rows in found[solver].items()},
            lambda solver: (
                f"{COMMANDS[2]} against {COMMANDS[0]}, 50 % closed, ranges "
                + _range_text([growth(rows, p) for rows in found[solver].values() for p in PRESSURES], "kPa")
            ),
            f"A growth counts when it exceeds {noise}. Breakaway friction sets the range, and it does not know "
            "the speed; only the smallest openings add to it.",
        ),
        _judged(
            "claim-4.15",
            "section 4.2.2 f), Fig. 4.26",
            "A tighter orifice raises the peaks of the cylinder's pressures by back pressure.",
            lambda solver: {r: tuple(rise > limit for rise in raised(rows)) for r, rows in peaks[solver].items()},
            lambda solver: (
                f"50 and 75 against 25 % closed, {COMMANDS[2]}, peaks "
                + _range_text([rise for rows in peaks[solver].values() for rise in raised(rows)], "kPa")
            ),
            f"A rise counts when it exceeds {noise}. The humps of the simulated pressures are friction's: they "
            "stand there without orifices, too.",
        ),
    )


def _over_openings(context: Context) -> tuple[Claim, ...]:
    limit = visible_pressure()
    noise = f"a transducer's noise ({limit * 1e-3:.1f} kPa)"
    found = {solver: {r: over_closings(context, r, solver) for r in readings(context.quick)} for solver in SOLVERS}

    def rises(solver: Solver) -> Tests:
        tests: dict[Reading, tuple[bool, ...]] = {}
        for r, rows in found[solver].items():
            row: list[bool] = []
            for name in PRESSURES:
                a, b, c = (rows[closed].span[name] for closed in CLOSINGS)
                row.append(a < b < c and c - a > limit)
            tests[r] = tuple(row)
        return tests

    return (
        _judged(
            "claim-4.16",
            "section 4.3 a), Figs. 4.33-4.36",
            "Tightening the orifices from 25 to 50 to 75 % closed raises the range of all four pressures markedly.",
            rises,
            lambda solver: (
                "75 against 25 % closed, ranges "
                + _range_text(
                    [rows[75.0].span[p] - rows[25.0].span[p] for rows in found[solver].values() for p in PRESSURES],
                    "kPa",
                )
            ),
            f"A range must rise from opening to opening, and in all by more than {noise}. In the converged runs only "
            "the smallest openings and only the pump's side come near; with RK4 at 1e-4 s the step makes most of "
            "the rise.",
        ),
    )


def _drift(context: Context) -> tuple[Claim, ...]:
    without = drift(context.run(drift_spec(OURS, None, "converged")))
    least = DRIFT_SHARE * abs(without)
    chosen: dict[Solver, tuple[Reading, ...]] = {"converged": readings(context.quick), "literal": (OURS, AS_PRINTED)}
    moved = {
        solver: {r: [drift(context.run(drift_spec(r, c, solver))) for c in CLOSINGS] for r in chosen[solver]}
        for solver in SOLVERS
    }

    def more(solver: Solver) -> str:
        gained = [[one - without for one in row] for row in moved[solver].values()]
        return ", ".join(
            f"{closed:g} % closed {_range_text([row[k] for row in gained], 'mm', 1e3)}"
            for k, closed in enumerate(CLOSINGS)
        )

    return (
        _judged(
            "claim-4.18",
            "section 4.4",
            "The orifices make the piston's position drift.",
            lambda solver: {r: tuple(abs(one - without) > least for one in row) for r, row in moved[solver].items()},
            lambda solver: f"drift over 60 s without orifices {without * 1e3:.3f} mm, in addition at {more(solver)}",
            f"A change counts beyond {DRIFT_SHARE:.0%} of the drift without orifices. The piston drifts without them, "
            "too (claim 4.6). RK4 at 1e-4 s is tried under two readings only.",
        ),
        _judged(
            "claim-4.19",
            "section 4.4",
            "The tighter the orifices, the more the piston drifts.",
            lambda solver: {
                r: (abs(row[1]) - abs(row[0]) > least, abs(row[2]) - abs(row[1]) > least)
                for r, row in moved[solver].items()
            },
            lambda solver: f"drift over 60 s beyond that without orifices, at {more(solver)}",
            f"Each step from one opening to the next must add {DRIFT_SHARE:.0%} of the drift without orifices. RK4 at "
            "1e-4 s is tried under two readings only.",
        ),
    )
