"""What chapter 4 says of its method, motor, friction and cylinder, and what only its rig could tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sealscope.recordings.chambers import PRESSURES
from sealscope.recordings.recording import Array
from sealscope.thesis.chapters.chapter4.cases import (
    CASES,
    OURS,
    literal,
    pair,
    settled,
    span,
    spec,
    steady,
    visible_pressure,
)
from sealscope.thesis.chapters.chapter4.friction import falls_up_to, jumps_at_threshold
from sealscope.thesis.chapters.chapter4.variants import drift, drift_spec
from sealscope.thesis.claims.chapter4.orifices import DRIFT_SHARE, SHEET
from sealscope.thesis.claims.judging import verdict_of
from sealscope.thesis.engine.context import Context, SimulatedRun
from sealscope.thesis.engine.products import Claim

_PLAIN = tuple(case for case in CASES.values() if case.closed_pct is None)
_THROTTLED = tuple(case for case in CASES.values() if case.closed_pct is not None)
_NO_CURVES = "the measured curves of chapter 4 are printed as pictures only"


def plain_claims(context: Context) -> tuple[Claim, ...]:
    """Claims 4.1-4.7, 4.13, 4.17, 4.20, 4.22 and 4.23."""
    return (
        _step(context),
        _speed(context),
        _gains(context),
        _displacement(context),
        _reversals(context),
        _friction_and_drift(context),
        _level(context),
        _diameter(),
        _measured_openings(),
        _bracket(),
        _tracking(),
        _one_way(),
    )


def _step(context: Context) -> Claim:
    plain = [context.run(literal(spec(case.command, None))) for case in _PLAIN]
    throttled = [pair(context, case).literal for case in _THROTTLED]
    tests = [run.resolved for run in (*plain, *throttled)]

    def worst(runs: list[SimulatedRun]) -> str:
        moved = [run.proof[name] for run in runs for name in PRESSURES if name in run.proof]
        return f"{max(moved):.3g} Pa rms" if moved else "diverged"

    return Claim(
        "claim-4.1",
        "section 4.1.1",
        "The equations are solved with the Runge-Kutta method and a step of 0.0001 s.",
        SHEET,
        f"halving that step moves a pressure by up to {worst(plain)} in the cases without orifices and by up to "
        f"{worst(throttled)} in those with; {sum(one is True for one in tests)} of {len(tests)} cases pass the halving "
        "test",
        verdict_of(tests),
        "The slope of the square root at zero is infinite: with the orifices in, the line volumes answer within "
        "microseconds, and a step of 1e-4 s settles on pressures that solve the method and not the equations.",
    )


def sine_fit(t: Array, values: Array, omega: float) -> tuple[float, float]:
    """Amplitude of the sine of frequency `omega` [rad/s] in `values`, and what is left over it (rms, relative)."""
    basis = np.stack([np.sin(omega * t), np.cos(omega * t), np.ones_like(t)], axis=1)
    fitted = np.linalg.lstsq(basis, values, rcond=None)[0]
    amplitude = float(np.hypot(fitted[0], fitted[1]))
    return amplitude, float(np.sqrt(np.mean((values - basis @ fitted) ** 2)) / (amplitude / math.sqrt(2.0)))


def _speed(context: Context) -> Claim:
    from sealscope.parameters import load_rig
    from sealscope.simulation.commands import Sine, parse_command

    per_volt = load_rig("thesis").motor.omega_per_volt
    told, tests = [], []
    for case in _PLAIN:
        run = pair(context, case).converged
        command = parse_command(case.command)
        assert isinstance(command, Sine)
        amplitude, rest = sine_fit(run.t[steady(run)], settled(run, "omega"), command.omega)
        share = amplitude / (command.amplitude * per_volt)
        told.append(f"{case.command}: {rest * 100:.2f} % beside the sine, {share * 100:.0f} % of the commanded speed")
        tests.append(rest < 0.05)
    return Claim(
        "claim-4.2",
        "section 4.2.1, Figs. 4.4, 4.6, 4.8",
        "The simulated motor speed is a sine of the command's own pattern.",
        SHEET,
        "; ".join(told),
        verdict_of(tests),
        "A sine when at most 5 % (rms) stands beside it. With the gains 1.2 and 0.1 the speed stays well below the "
        "commanded one; whether the measured speed lags behind it cannot be tested.",
    )


def _gains(context: Context) -> Claim:
    base = spec(_PLAIN[0].command, None)
    own = context.run(literal(base))
    unlimited = (("motor.k_p", 50000.0), ("motor.K_i", 100.0), ("motor.V_max", 1e5), ("motor.i_max", 1e5))
    limited = unlimited[:2]
    runs = {
        "with the drive's voltage and current limits": context.run(
            literal(replace(base, values=(*base.values, *limited)))
        ),
        "without limits": context.run(literal(replace(base, values=(*base.values, *unlimited)))),
    }
    told = []
    for name, run in runs.items():
        if run.diverged:
            told.append(f"{name}: {run.diverged}")
            continue
        moved = run.proof.get("omega", math.nan)
        told.append(f"{name}: halving the step moves the speed by {moved:.3g} rad/s rms")
    return Claim(
        "claim-4.3",
        "section 4.2.1 a), c)",
        "The loop around the equations is closed with the drive's gains, 50 000 and 100.",
        SHEET,
        "50 000 V s/rad and 100 V/rad with RK4 at 1e-4 s, "
        + "; ".join(told)
        + f"; with 1.2 and 0.1 by {own.proof.get('omega', math.nan):.2g} rad/s",
        verdict_of([run.resolved is True for run in runs.values()]),
        "The drive's gains are in its internal units; in the units of eqs. (4.3), (4.4) the speed loop is far faster "
        "than the step. The text itself names 1.2 and 0.1 for the software later.",
    )


def _displacement(context: Context) -> Claim:
    told = [f"{case.command}: {span(pair(context, case).converged, 'x') * 1e3:.1f} mm peak to peak" for case in _PLAIN]
    return Claim(
        "claim-4.4",
        "section 4.2.1, Figs. 4.4, 4.6, 4.8",
        "The measured displacement differs from the simulated one by 30, 20 and 15 % in cases a), b), c), because of "
        "friction and of the small amplitude.",
        SHEET,
        "; ".join(told) + ", all in proportion to the speed per volt, which the thesis does not give",
        verdict_of([None]),
        _NO_CURVES,
    )


def ringing(run: SimulatedRun, window: float = 0.05, after: float = 0.3) -> float:
    """Peak-to-peak [Pa] of p_A's fast part (less its mean over `window` [s]) within `after` [s] of the pump's
    reversals, the median over them; no noise in it."""
    rate = 1.0 / float(run.t[1] - run.t[0])
    p_A, omega = run.outputs["p_A"], run.outputs["omega"]
    wide = max(3, round(window * rate) | 1)
    fast = p_A - np.convolve(np.pad(p_A, wide // 2, mode="edge"), np.full(wide, 1.0 / wide), mode="valid")
    turns = np.flatnonzero(np.diff(np.sign(omega)) != 0)
    skip, long = wide, round(after * rate)
    found = [float(np.ptp(fast[k + skip : k + long])) for k in turns if run.t[k] > 1.0 and k + long < p_A.size - wide]
    return float(np.median(found))


def _reversals(context: Context) -> Claim:
    limit = visible_pressure()
    rings = {case.command: ringing(pair(context, case).converged) for case in _PLAIN}
    return Claim(
        "claim-4.5",
        "section 4.2.1 a), Fig. 4.5; 4.2.2 a)",
        "What looks like noise at the peaks of the pressures, where the motion reverses, comes from the sensors and "
        "from the lack of a position controller.",
        SHEET,
        "without any noise the pressure in A rings after a reversal by "
        + ", ".join(f"{one * 1e-3:.1f} kPa ({command})" for command, one in rings.items())
        + f" peak to peak; a transducer's noise is {limit * 1e-3:.1f} kPa",
        verdict_of([one < limit for one in rings.values()]),
        "Friction that falls with velocity rings the piston on its oil columns at each reversal. The part on the "
        "missing controller cannot be tested.",
    )


def _friction_and_drift(context: Context) -> Claim:
    usual = drift(context.run(drift_spec(OURS, None, "converged")))
    smooth = drift(context.run(drift_spec(OURS, None, "converged", F_pr=0.0, F_cfr=0.0)))
    unintegrated = drift(context.run(drift_spec(OURS, None, "converged", K_i=0.0)))
    return Claim(
        "claim-4.6",
        "section 4.2.1 a), Fig. 4.4",
        "The drift of the piston's displacement is the effect of friction.",
        SHEET,
        f"drift of the simulated piston over 60 s: {usual * 1e3:.3f} mm; without Coulomb and breakaway friction "
        f"{smooth * 1e3:.3f} mm; without the integral gain of the speed loop {unintegrated * 1e3:.3f} mm",
        verdict_of([abs(usual - smooth) > DRIFT_SHARE * abs(usual)]),
        "Nothing controls the position, so the slow settling of the speed loop's integral after the start stays in it. "
        "Whether the measured piston drifts for another reason cannot be tested.",
    )


def _level(context: Context) -> Claim:
    from sealscope.parameters import load_rig

    charge = load_rig("thesis").fluid.p_charge
    run = pair(context, CASES["4.3-a"]).converged
    peaks = [float(settled(run, name).max()) for name in PRESSURES]
    return Claim(
        "claim-4.7",
        "section 4.2.2 a), Figs. 4.10, 4.11",
        "The pressures at pump and cylinder reach 0.4 MPa.",
        SHEET,
        f"peaks of {min(peaks) * 1e-6:.3f} to {max(peaks) * 1e-6:.3f} MPa with a charge pressure of "
        f"{charge * 1e-6:g} MPa; 0.4 MPa would need {charge * 1e-6 + 0.4 - max(peaks) * 1e-6:.3f} MPa",
        verdict_of([None]),
        "The charge pressure is not given, and ours was chosen after these peaks; friction alone lifts a pressure by "
        f"{(max(peaks) - charge) * 1e-6:.3f} MPa above it.",
    )


def _diameter() -> Claim:
    from sealscope.parameters import load_rig

    line = load_rig("thesis").line
    area = (3.75 / 5.0) ** 2
    return Claim(
        "claim-4.13",
        "section 4.2.2 a)",
        "An orifice closed by 25 % of its area measures 3.75 mm of the line's 5 mm.",
        SHEET,
        f"3.75 mm of 5 mm leave {area:.4f} of the area, which closes {1 - area:.1%}; Table 4.1 gives a line of "
        f"{line.d_line * 1e3:g} mm",
        verdict_of([math.isclose(area, 0.75, rel_tol=0.01), math.isclose(line.d_line, 5e-3)]),
        "Eq. (4.8) makes the opening a share of the area, the sentence a share of the diameter.",
    )


def _measured_openings() -> Claim:
    return Claim(
        "claim-4.17",
        "section 4.3 b), Figs. 4.37-4.40",
        "Measured on the rig, the range of the pressures rises as the orifices are tightened.",
        SHEET,
        "not a matter of simulation; for the simulated pressures see claim 4.16",
        verdict_of([None]),
        _NO_CURVES,
    )


def _bracket() -> Claim:
    from sealscope.parameters import load_rig

    F_pr = load_rig("thesis").friction.F_pr
    jumps = jumps_at_threshold(F_pr)
    tests = [math.isclose(at, above, rel_tol=1e-6) for at, above in jumps.values()]
    told = [f"{name} bracket: {at:.1f} N at v_th, {above:.1f} N above" for name, (at, above) in jumps.items()]
    return Claim(
        "claim-4.20",
        "section 4.1.4, eqs. (4.21), (4.22)",
        "The linear part near rest keeps the friction force without a jump.",
        SHEET,
        "; ".join(told) + f"; friction falls with velocity up to {falls_up_to(F_pr):.4f} m/s",
        verdict_of(tests),
        "At v = 0 there is no jump under either bracketing. Eq. (4.22) lacks a closing bracket; closed before F_v v_th "
        "it meets eq. (4.21) at v_th, around all of it it does not.",
    )


def _tracking() -> Claim:
    return Claim(
        "claim-4.22",
        "sections 4.2, 4.4, Figs. 4.4-4.32",
        "Measured and simulated speed, displacement and pressures track each other, within 5 % at the peaks in e).",
        SHEET,
        "not a matter of simulation alone",
        verdict_of([None]),
        _NO_CURVES,
    )


def _one_way() -> Claim:
    from sealscope.parameters import load_rig
    from sealscope.physics.rig import throttle_coefficients

    closed: dict[str, float | int | str] = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    told, tests = [], []
    for metering in ("literal", "meter-out"):
        rig = load_rig("thesis").with_overrides({**closed, "metering": metering})
        A_in, A_out, B_in, B_out = throttle_coefficients(rig)
        sides = (A_in > A_out, B_in > B_out)
        words = ["free to the cylinder" if free else "throttled to the cylinder" for free in sides]
        name = "as printed" if metering == "literal" else "with the areas of side B swapped"
        told.append(f"{name}: side A {words[0]}, side B {words[1]}")
        if metering == "literal":
            tests += list(sides)
    return Claim(
        "claim-4.23",
        "section 4.1.2, eqs. (4.9)-(4.12), Appendix A",
        "Both orifices let oil flow freely to the cylinder and throttle it on the way back.",
        SHEET,
        "; ".join(told),
        verdict_of(tests),
        "Eq. (4.11) gives the flow out of chamber B the whole area of the line. The simulation swaps the two areas "
        "unless told otherwise.",
    )
