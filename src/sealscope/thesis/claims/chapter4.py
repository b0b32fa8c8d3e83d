"""The testable sentences of chapter 4, each judged by number.

Those on the orifices are judged on converged runs under every reading of the equations; what RK4 at 1e-4 s gives stands
beside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.chapter4.cases import (
    AS_PRINTED,
    CASES,
    CLOSINGS,
    COMMAND,
    COMMANDS,
    OURS,
    SOLVER_TEXT,
    SOLVERS,
    WINDOW,
    Reading,
    RunNumbers,
    Solver,
    drift_spec,
    over_closings,
    piston_drift,
    readings,
    span,
    spec,
    steady,
    steady_output,
    throttled,
    visible_pressure,
)
from sealscope.thesis.chapters.chapter4.friction import falls_up_to, jumps_at_threshold
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Cell, Claim, ThesisTable, verdict_of

SHEET = "the sheet holds no pressures, flows or positions of chapter 4"
#: Share of the drift without orifices that a change of drift must reach to count.
DRIFT_SHARE = 0.01
_PLAIN = tuple(case for case in CASES.values() if case.closed_pct is None)
_THROTTLED = tuple(case for case in CASES.values() if case.closed_pct is not None)
_NO_CURVES = "the measured curves of chapter 4 are printed as pictures only"


def _claim(number: int, where: str, claim: str, simulation: str, tests: Iterable[bool | None], why: str) -> Claim:
    return Claim(f"claim-4.{number}", where, claim, SHEET, simulation, verdict_of(tests), why)


def _step(context: Context) -> Claim:
    plain, throttled = (
        [context.run(spec(case.command, case.closed_pct, solver="literal")) for case in cases]
        for cases in (_PLAIN, _THROTTLED)
    )
    tests = [run.resolved for run in (*plain, *throttled)]

    def worst(runs: list[SimulatedRun]) -> str:
        moved = [run.proof[name] for run in runs for name in PRESSURES if name in run.proof]
        return f"{max(moved):.3g} Pa rms" if moved else "diverged"

    return _claim(
        1,
        "section 4.1.1",
        "The equations are solved with the Runge-Kutta method and a step of 0.0001 s.",
        f"halving that step moves a pressure by up to {worst(plain)} in the cases without orifices and by up to "
        f"{worst(throttled)} in those with; {sum(test is True for test in tests)} of {len(tests)} cases pass the "
        "halving test",
        tests,
        "The slope of the square root at zero is infinite: with the orifices in, the line volumes answer within "
        "microseconds, and a step of 1e-4 s settles on pressures that solve the method and not the equations.",
    )


def sine_fit(t: Array, values: Array, omega: float) -> tuple[float, float]:
    """Fit a sine of frequency `omega` [rad/s]; return its amplitude and what is left over it (rms, relative)."""
    basis = np.stack([np.sin(omega * t), np.cos(omega * t), np.ones_like(t)], axis=1)
    fitted = np.linalg.lstsq(basis, values, rcond=None)[0]
    amplitude = float(np.hypot(fitted[0], fitted[1]))
    return amplitude, float(np.sqrt(np.mean((values - basis @ fitted) ** 2)) / (amplitude / math.sqrt(2.0)))


def _speed(context: Context) -> Claim:
    from sealscope.parameters import load_rig
    from sealscope.simulation.commands import Sine, parse_command

    per_volt = load_rig("thesis").motor.omega_per_volt
    texts, tests = [], []
    for case in _PLAIN:
        run = context.run(spec(case.command, None))
        command = parse_command(case.command)
        assert isinstance(command, Sine)
        amplitude, rest = sine_fit(run.t[steady(run)], steady_output(run, "omega"), command.omega)
        share = amplitude / (command.amplitude * per_volt)
        texts.append(f"{case.command}: {rest * 100:.2f} % beside the sine, {share * 100:.0f} % of the commanded speed")
        tests.append(rest < 0.05)
    return _claim(
        2,
        "section 4.2.1, Figs. 4.4, 4.6, 4.8",
        "The simulated motor speed is a sine of the command's own pattern.",
        "; ".join(texts),
        tests,
        "A sine when at most 5 % (rms) stands beside it. With the gains 1.2 and 0.1 the speed stays well below the "
        "commanded one; whether the measured speed lags behind it cannot be tested.",
    )


def _gains(context: Context) -> Claim:
    base = spec(_PLAIN[0].command, None, solver="literal")
    own = context.run(base)
    gains = (("motor.k_p", 50000.0), ("motor.K_i", 100.0))
    runs = {
        name: context.run(replace(base, values=(*base.values, *gains, *limits)))
        for name, limits in (
            ("with the drive's voltage and current limits", ()),
            ("without limits", (("motor.V_max", 1e5), ("motor.i_max", 1e5))),
        )
    }
    texts = [
        f"{name}: {run.diverged}"
        if run.diverged
        else f"{name}: halving the step moves the speed by {run.proof.get('omega', math.nan):.3g} rad/s rms"
        for name, run in runs.items()
    ]
    return _claim(
        3,
        "section 4.2.1 a), c)",
        "The loop around the equations is closed with the drive's gains, 50 000 and 100.",
        "50 000 V s/rad and 100 V/rad with RK4 at 1e-4 s, "
        + "; ".join(texts)
        + f"; with 1.2 and 0.1 by {own.proof.get('omega', math.nan):.2g} rad/s",
        [run.resolved is True for run in runs.values()],
        "The drive's gains are in its internal units; in the units of eqs. (4.3), (4.4) the speed loop is far faster "
        "than the step. The text itself names 1.2 and 0.1 for the software later.",
    )


def _displacement(context: Context) -> Claim:
    spans = {case.command: span(context.run(spec(case.command, None)), "x") * 1e3 for case in _PLAIN}
    return _claim(
        4,
        "section 4.2.1, Figs. 4.4, 4.6, 4.8",
        "The measured displacement differs from the simulated one by 30, 20 and 15 % in cases a), b), c), because of "
        "friction and of the small amplitude.",
        "; ".join(f"{command}: {of:.1f} mm peak to peak" for command, of in spans.items())
        + ", all in proportion to the speed per volt, which the thesis does not give",
        [None],
        _NO_CURVES,
    )


def ringing(run: SimulatedRun, window: float = 0.05, after: float = 0.3) -> float:
    """Return the median peak-to-peak [Pa] of p_A's fast part within `after` [s] of the pump's reversals.

    The fast part is p_A less its mean over `window` [s]; there is no noise in it.
    """
    rate = 1.0 / float(run.t[1] - run.t[0])
    p_A, omega = run.outputs["p_A"], run.outputs["omega"]
    wide = max(3, round(window * rate) | 1)
    fast = p_A - np.convolve(np.pad(p_A, wide // 2, mode="edge"), np.full(wide, 1.0 / wide), mode="valid")
    turns = np.flatnonzero(np.diff(np.sign(omega)) != 0)
    skip, long = wide, round(after * rate)
    rings = [float(np.ptp(fast[k + skip : k + long])) for k in turns if run.t[k] > 1.0 and k + long < p_A.size - wide]
    return float(np.median(rings))


def _reversals(context: Context) -> Claim:
    limit = visible_pressure()
    rings = {case.command: ringing(context.run(spec(case.command, None))) for case in _PLAIN}
    return _claim(
        5,
        "section 4.2.1 a), Fig. 4.5; 4.2.2 a)",
        "What looks like noise at the peaks of the pressures, where the motion reverses, comes from the sensors and "
        "from the lack of a position controller.",
        "without any noise the pressure in A rings after a reversal by "
        + ", ".join(f"{ring * 1e-3:.1f} kPa ({command})" for command, ring in rings.items())
        + f" peak to peak; a transducer's noise is {limit * 1e-3:.1f} kPa",
        [ring < limit for ring in rings.values()],
        "Friction that falls with velocity rings the piston on its oil columns at each reversal. The part on the "
        "missing controller cannot be tested.",
    )


def _friction_and_drift(context: Context) -> Claim:
    usual = piston_drift(context.run(drift_spec(OURS, None, "converged")))
    smooth = piston_drift(context.run(drift_spec(OURS, None, "converged", F_pr=0.0, F_cfr=0.0)))
    unintegrated = piston_drift(context.run(drift_spec(OURS, None, "converged", K_i=0.0)))
    return _claim(
        6,
        "section 4.2.1 a), Fig. 4.4",
        "The drift of the piston's displacement is the effect of friction.",
        f"drift of the simulated piston over 60 s: {usual * 1e3:.3f} mm; without Coulomb and breakaway friction "
        f"{smooth * 1e3:.3f} mm; without the integral gain of the speed loop {unintegrated * 1e3:.3f} mm",
        [abs(usual - smooth) > DRIFT_SHARE * abs(usual)],
        "Nothing controls the position, so the slow settling of the speed loop's integral after the start stays in it. "
        "Whether the measured piston drifts for another reason cannot be tested.",
    )


def _level(context: Context) -> Claim:
    from sealscope.parameters import load_rig

    charge = load_rig("thesis").fluid.p_charge
    run = context.run(spec(CASES["4.3-a"].command, CASES["4.3-a"].closed_pct))
    peaks = [float(steady_output(run, name).max()) for name in PRESSURES]
    return _claim(
        7,
        "section 4.2.2 a), Figs. 4.10, 4.11",
        "The pressures at pump and cylinder reach 0.4 MPa.",
        f"peaks of {min(peaks) * 1e-6:.3f} to {max(peaks) * 1e-6:.3f} MPa with a charge pressure of {charge * 1e-6:g} "
        f"MPa; 0.4 MPa would need {charge * 1e-6 + 0.4 - max(peaks) * 1e-6:.3f} MPa",
        [None],
        "The charge pressure is not given, and ours was chosen after these peaks; friction alone lifts a pressure by "
        f"{(max(peaks) - charge) * 1e-6:.3f} MPa above it.",
    )


def _diameter() -> Claim:
    from sealscope.parameters import load_rig

    line = load_rig("thesis").line
    area = (3.75 / 5.0) ** 2
    return _claim(
        13,
        "section 4.2.2 a)",
        "An orifice closed by 25 % of its area measures 3.75 mm of the line's 5 mm.",
        f"3.75 mm of 5 mm leave {area:.4f} of the area, which closes {1 - area:.1%}; Table 4.1 gives a line of "
        f"{line.d_line * 1e3:g} mm",
        [math.isclose(area, 0.75, rel_tol=0.01), math.isclose(line.d_line, 5e-3)],
        "Eq. (4.8) makes the opening a share of the area, the sentence a share of the diameter.",
    )


def _measured_only() -> tuple[Claim, ...]:
    return (
        _claim(
            17,
            "section 4.3 b), Figs. 4.37-4.40",
            "Measured on the rig, the range of the pressures rises as the orifices are tightened.",
            "not a matter of simulation; for the simulated pressures see claim 4.16",
            [None],
            _NO_CURVES,
        ),
        _claim(
            22,
            "sections 4.2, 4.4, Figs. 4.4-4.32",
            "Measured and simulated speed, displacement and pressures track each other, within 5 % at the peaks in e).",
            "not a matter of simulation alone",
            [None],
            _NO_CURVES,
        ),
    )


def _bracket() -> Claim:
    from sealscope.parameters import load_rig

    F_pr = load_rig("thesis").friction.F_pr
    jumps = jumps_at_threshold(F_pr)
    tests = [math.isclose(at, above, rel_tol=1e-6) for at, above in jumps.values()]
    texts = [f"{name} bracket: {at:.1f} N at v_th, {above:.1f} N above" for name, (at, above) in jumps.items()]
    return _claim(
        20,
        "section 4.1.4, eqs. (4.21), (4.22)",
        "The linear part near rest keeps the friction force without a jump.",
        "; ".join(texts) + f"; friction falls with velocity up to {falls_up_to(F_pr):.4f} m/s",
        tests,
        "At v = 0 there is no jump under either bracketing. Eq. (4.22) lacks a closing bracket; closed before F_v v_th "
        "it meets eq. (4.21) at v_th, around all of it it does not.",
    )


def _one_way() -> Claim:
    from sealscope.parameters import load_rig
    from sealscope.physics.rig import throttle_coefficients

    closed: dict[str, float | int | str] = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    texts, tests = [], []
    for metering, name in (("literal", "as printed"), ("meter-out", "with the areas of side B swapped")):
        rig = load_rig("thesis").with_overrides({**closed, "metering": metering})
        A_in, A_out, B_in, B_out = throttle_coefficients(rig)
        free = (A_in > A_out, B_in > B_out)
        A, B = ("free to the cylinder" if side else "throttled to the cylinder" for side in free)
        texts.append(f"{name}: side A {A}, side B {B}")
        if metering == "literal":
            tests += list(free)
    return _claim(
        23,
        "section 4.1.2, eqs. (4.9)-(4.12), Appendix A",
        "Both orifices let oil flow freely to the cylinder and throttle it on the way back.",
        "; ".join(texts),
        tests,
        "Eq. (4.11) gives the flow out of chamber B the whole area of the line. The simulation swaps the two areas "
        "unless told otherwise.",
    )


Tests = Mapping[Reading, tuple[bool, ...]]
_T = TypeVar("_T")


def passed(tests: Tests) -> str:
    """Count how many single tests passed under how many readings, and name the readings under which all did."""
    every = [test for row in tests.values() for test in row]
    whole = [reading.title for reading, row in tests.items() if all(row)]
    text = f"{sum(every)} of {len(every)} tests pass"
    if not any(every) or all(every):
        return text
    return f"{text}, all of them under {len(whole)} of {len(tests)} readings" + (
        f" ({'; '.join(whole)})" if 0 < len(whole) <= 3 else ""
    )


def _under_readings(context: Context, of: Callable[[Reading, Solver], _T]) -> dict[Solver, dict[Reading, _T]]:
    return {solver: {reading: of(reading, solver) for reading in readings(context.quick)} for solver in SOLVERS}


def _judged(
    number: int,
    where: str,
    claim: str,
    numbers: Mapping[Solver, Mapping[Reading, _T]],
    test: Callable[[_T], Iterable[bool]],
    text: Callable[[list[_T]], str],
    why: str,
) -> Claim:
    """Judge a claim by the tests of its numbers under every reading; the converged runs decide."""
    tests = {solver: {r: tuple(test(of)) for r, of in numbers[solver].items()} for solver in SOLVERS}
    simulation = "; ".join(
        f"{SOLVER_TEXT[solver]}: {text(list(numbers[solver].values()))}, {passed(tests[solver])}" for solver in SOLVERS
    )
    verdict = verdict_of(test for row in tests["converged"].values() for test in row)
    return Claim(f"claim-4.{number}", where, claim, SHEET, simulation, verdict, why)


def _range_text(values: Iterable[float], unit: str = "kPa", factor: float = 1e-3) -> str:
    scaled = [value * factor for value in values]
    return f"{min(scaled):+.2f} to {max(scaled):+.2f} {unit}"


def _slightly_closed(context: Context) -> tuple[Claim, ...]:
    limit = visible_pressure()
    runs = _under_readings(
        context, lambda r, solver: [throttled(context, r, closed, solver, COMMANDS[0]) for closed in (0.0, 25.0)]
    )
    changes = {
        solver: {
            r: [getattr(closed, what)[p] - getattr(opened, what)[p] for what in ("peak", "span") for p in PRESSURES]
            for r, (opened, closed) in of.items()
        }
        for solver, of in runs.items()
    }

    def text(rows: list[list[float]]) -> str:
        return "25 % against open, peaks and ranges " + _range_text(change for row in rows for change in row)

    noise = f"A change counts when it exceeds a transducer's noise ({limit * 1e-3:.1f} kPa)."
    return (
        _judged(
            8,
            "section 4.2.2 a), Figs. 4.10, 4.11",
            "An orifice closed by 25 % makes no difference to the pressures at pump and cylinder.",
            changes,
            lambda row: (abs(change) < limit for change in row),
            text,
            f"{noise} The drop over the orifice is far below the friction's pressure. It contradicts claim 4.10.",
        ),
        _judged(
            10,
            "section 4.2.2 a), Figs. 4.13, 4.14",
            "Closing the orifices by 25 % has a significant impact on the peaks of all four simulated pressures.",
            changes,
            lambda row: (abs(change) > limit for change in row[:4]),
            text,
            f"{noise} What RK4 at 1e-4 s shows here is its own step: each orifice settles on a drop that solves the "
            "method's equations and not the rig's. It contradicts claim 4.8.",
        ),
        _judged(
            9,
            "section 4.2.2 a), Fig. 4.12",
            "The flows through both orifices behave alike.",
            runs,
            lambda pair: (pair[1].flows_differ < 0.05,),
            lambda pairs: (
                f"rms of Q_A - Q_B over rms of Q_A at most {max(pair[1].flows_differ for pair in pairs) * 100:.2f} %"
            ),
            "Alike within 5 %: both carry the pump's flow, and the oil between takes up little.",
        ),
    )


def _across_the_orifice(context: Context) -> tuple[Claim, ...]:
    limit = visible_pressure()
    numbers = _under_readings(context, lambda r, solver: throttled(context, r, 25.0, solver, COMMANDS[0]))
    closings = _under_readings(context, lambda r, solver: over_closings(context, r, solver))

    def largest_drops(rows: Mapping[float, RunNumbers]) -> list[float]:
        return [rows[closed].largest_drop for closed in CLOSINGS]

    noise = f"a transducer's noise ({limit * 1e-3:.1f} kPa)"
    rule = f"Two tests a reading: the sign of the mean, and whether it exceeds {noise}."
    return (
        _judged(
            11,
            "section 4.2.2 a), Fig. 4.13",
            "With the orifices 25 % closed p_1 is below p_A.",
            numbers,
            lambda n: (n.p_1_less_p_A < 0, n.p_1_less_p_A < -limit),
            lambda rows: "mean of p_1 - p_A " + _range_text(n.p_1_less_p_A for n in rows),
            f"{rule} Side A is throttled on the return under every reading, so the sign is right in the mean; during "
            "the stroke that fills chamber A p_1 is above p_A.",
        ),
        _judged(
            12,
            "section 4.2.2 a), Fig. 4.14",
            "With the orifices 25 % closed p_2 is above p_B.",
            numbers,
            lambda n: (n.p_2_less_p_B > 0, n.p_2_less_p_B > limit),
            lambda rows: "mean of p_2 - p_B " + _range_text(n.p_2_less_p_B for n in rows),
            f"{rule} The sign follows from eqs. (4.11), (4.12) as printed, which throttle side B on the way to the "
            "cylinder; with the throttled return of the text p_2 is below p_B.",
        ),
        _judged(
            21,
            "section 4.1.2",
            "The flow through the orifice has a huge impact on the pressures.",
            closings,
            lambda rows: (drop > limit for drop in largest_drops(rows)),
            lambda every: (
                f"largest drop at 25, 50, 75 % under {COMMAND} "
                + _range_text(drop for rows in every for drop in largest_drops(rows))
            ),
            f"A drop counts when it exceeds {noise}. At the rig's few litres a minute only the smallest openings reach "
            "that.",
        ),
    )


def _over_commands(context: Context) -> tuple[Claim, ...]:
    limit = visible_pressure()
    noise = f"a transducer's noise ({limit * 1e-3:.1f} kPa)"
    commands = _under_readings(
        context, lambda r, solver: [throttled(context, r, 50.0, solver, command) for command in COMMANDS]
    )
    closings = _under_readings(
        context, lambda r, solver: [throttled(context, r, closed, solver, COMMANDS[2]) for closed in CLOSINGS]
    )

    def growths(rows: list[RunNumbers]) -> list[float]:
        return [rows[2].span[name] - rows[0].span[name] for name in PRESSURES]

    def rises(rows: list[RunNumbers]) -> list[float]:
        return [row.peak[name] - rows[0].peak[name] for row in rows[1:] for name in CHAMBERS]

    return (
        _judged(
            14,
            "section 4.2.2 f), Figs. 4.25, 4.26",
            "The range of the pressures grows with the amplitude of the command.",
            commands,
            lambda rows: (growth > limit for growth in growths(rows)),
            lambda every: (
                f"{COMMANDS[2]} against {COMMANDS[0]}, 50 % closed, ranges "
                + _range_text(growth for rows in every for growth in growths(rows))
            ),
            f"A growth counts when it exceeds {noise}. Breakaway friction sets the range, and it does not know the "
            "speed; only the smallest openings add to it.",
        ),
        _judged(
            15,
            "section 4.2.2 f), Fig. 4.26",
            "A tighter orifice raises the peaks of the cylinder's pressures by back pressure.",
            closings,
            lambda rows: (rise > limit for rise in rises(rows)),
            lambda every: (
                f"50 and 75 against 25 % closed, {COMMANDS[2]}, peaks "
                + _range_text(rise for rows in every for rise in rises(rows))
            ),
            f"A rise counts when it exceeds {noise}. The humps of the simulated pressures are friction's: they stand "
            "there without orifices, too.",
        ),
    )


def _over_openings(context: Context) -> Claim:
    limit = visible_pressure()

    def rises(rows: Mapping[float, RunNumbers]) -> Iterator[bool]:
        for name in PRESSURES:
            a, b, c = (rows[closed].span[name] for closed in CLOSINGS)
            yield a < b < c and c - a > limit

    return _judged(
        16,
        "section 4.3 a), Figs. 4.33-4.36",
        "Tightening the orifices from 25 to 50 to 75 % closed raises the range of all four pressures markedly.",
        _under_readings(context, lambda r, solver: over_closings(context, r, solver)),
        rises,
        lambda every: (
            "75 against 25 % closed, ranges "
            + _range_text(rows[75.0].span[p] - rows[25.0].span[p] for rows in every for p in PRESSURES)
        ),
        f"A range must rise from opening to opening, and in all by more than a transducer's noise ({limit * 1e-3:.1f} "
        "kPa). In the converged runs only the smallest openings and only the pump's side come near; with RK4 at 1e-4 s "
        "the step makes most of the rise.",
    )


def _drift_over_openings(context: Context) -> tuple[Claim, ...]:
    without = piston_drift(context.run(drift_spec(OURS, None, "converged")))
    least = DRIFT_SHARE * abs(without)
    chosen: dict[Solver, tuple[Reading, ...]] = {"converged": readings(context.quick), "literal": (OURS, AS_PRINTED)}
    moved = {
        solver: {r: [piston_drift(context.run(drift_spec(r, c, solver))) for c in CLOSINGS] for r in chosen[solver]}
        for solver in SOLVERS
    }

    def gained(rows: list[list[float]]) -> str:
        return ", ".join(
            f"{closed:g} % closed {_range_text((row[k] - without for row in rows), 'mm', 1e3)}"
            for k, closed in enumerate(CLOSINGS)
        )

    return (
        _judged(
            18,
            "section 4.4",
            "The orifices make the piston's position drift.",
            moved,
            lambda row: (abs(drift - without) > least for drift in row),
            lambda rows: f"drift over 60 s without orifices {without * 1e3:.3f} mm, in addition at {gained(rows)}",
            f"A change counts beyond {DRIFT_SHARE:.0%} of the drift without orifices. The piston drifts without them, "
            "too (claim 4.6). RK4 at 1e-4 s is tried under two readings only.",
        ),
        _judged(
            19,
            "section 4.4",
            "The tighter the orifices, the more the piston drifts.",
            moved,
            lambda row: (abs(row[1]) - abs(row[0]) > least, abs(row[2]) - abs(row[1]) > least),
            lambda rows: f"drift over 60 s beyond that without orifices, at {gained(rows)}",
            f"Each step from one opening to the next must add {DRIFT_SHARE:.0%} of the drift without orifices. RK4 at "
            "1e-4 s is tried under two readings only.",
        ),
    )


def claims(context: Context, item: Item) -> tuple[ThesisTable | Claim, ...]:
    """Make the table of all readings, closings and solvers, and judge the claims of chapter 4."""
    judged = (
        _step(context),
        _speed(context),
        _gains(context),
        _displacement(context),
        _reversals(context),
        _friction_and_drift(context),
        _level(context),
        _diameter(),
        _bracket(),
        _one_way(),
        *_measured_only(),
        *_slightly_closed(context),
        *_across_the_orifice(context),
        *_over_commands(context),
        _over_openings(context),
        *_drift_over_openings(context),
    )
    ordered = sorted(judged, key=lambda claim: int(claim.id.rpartition(".")[2]))
    rows = [
        (reading.title, closed, SOLVER_TEXT[solver], *_row(numbers))
        for reading in readings(context.quick)
        for solver in SOLVERS
        for closed, numbers in over_closings(context, reading, solver).items()
    ]
    notes = (
        f"Numbers {WINDOW}. Q_A unlike Q_B: rms of their difference over the rms of Q_A. Rows that did not pass the "
        "halving test show the step, not the rig."
    )
    ids = tuple(claim.id for claim in ordered)
    return (ThesisTable(item.id, item.title, _COLUMNS, tuple(rows), ids, None, notes), *ordered)


_COLUMNS = (
    "reading",
    "closed [%]",
    "solver",
    *(f"range of {name} [MPa]" for name in PRESSURES),
    "least pressure [MPa]",
    "mean of p_1 - p_A [kPa]",
    "mean of p_2 - p_B [kPa]",
    "largest drop [kPa]",
    "Q_A unlike Q_B [%]",
    "halving test",
)


def _row(numbers: RunNumbers) -> tuple[Cell, ...]:
    values = (
        *(numbers.span[name] * 1e-6 for name in PRESSURES),
        min(numbers.least.values()) * 1e-6,
        numbers.p_1_less_p_A * 1e-3,
        numbers.p_2_less_p_B * 1e-3,
        numbers.largest_drop * 1e-3,
        numbers.flows_differ * 100.0,
    )
    tested = {True: "passed", False: "not passed", None: "not made"}[numbers.resolved]
    return (*(value if math.isfinite(value) else None for value in values), tested)


ITEMS: tuple[Item, ...] = (
    Item("chapter-4-claims", 4, "claims", f"Chapter 4 under every reading of its equations, {COMMAND}", claims),
)
