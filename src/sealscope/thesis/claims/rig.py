"""What chapters 1, 5 and 6 say that the sheet is silent on, judged by the simulated rig, with controls."""

from __future__ import annotations

import itertools

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.thesis.chapters.appendix_c.simulation import column
from sealscope.thesis.chapters.appendix_c.success_rates import CLAIMED
from sealscope.thesis.claims.evidence import NO_SHEET, NOT_ON_SHEET, ClaimEvidence, by_simulation, counted_share, fired
from sealscope.thesis.engine.products import Claim, verdict_of
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG

#: How near an estimated onset must come [s].
_NEAR = 10.0
_LEVELS = ("d1", "d2", "d3", "d4")


def _change(pair: tuple[float, float]) -> float:
    """Return the change from without to with the leak [%]."""
    return 100.0 * (pair[1] / pair[0] - 1.0)


def _speed(evidence: ClaimEvidence) -> Claim:
    moved = {name: _change(test.speed) for name, test in evidence.shown.items()}
    worst = max(moved, key=lambda name: abs(moved[name]))
    return by_simulation(
        "claim-5.7.1",
        "section 5.2 a",
        "The motor's own loop keeps its speed unchanged when the leak opens.",
        f"RMS speed moves by at most {abs(moved[worst]):.2f} % (test {worst}) over the {len(moved)} tests",
        [abs(change) < 1.0 for change in moved.values()],
        "A part for each test: less than 1 %.",
    )


def _drifting(evidence: ClaimEvidence) -> Claim:
    leaking, control = evidence.shown["5.2a"].drift, evidence.control.drift
    fell, fell_anyway = (abs(pair[0]) - abs(pair[1]) for pair in (leaking, control))
    return by_simulation(
        "claim-5.7.2",
        "section 5.2 a, Fig. 5.1",
        "The piston drifts, and stops drifting because of the leak.",
        f"drift {1e3 * leaking[0]:.1f} um/s before and {1e3 * leaking[1]:.1f} after the leak opens; the same run "
        f"without a leak {1e3 * control[0]:.1f} and {1e3 * control[1]:.1f}",
        [fell - fell_anyway > 0.1 * abs(fell_anyway)],
        "Because of the leak: it falls by a tenth more than in the same time without one. Where both fall alike, it is "
        "the speed loop's integral term that settles, and the drift with it.",
    )


def _performance(evidence: ClaimEvidence) -> Claim:
    tests = evidence.shown.values()
    velocity = [_change(test.velocity) for test in tests]
    pressure = [_change(test.range_MPa[c]) for test in tests for c in CHAMBERS]
    return by_simulation(
        "claim-6.1.2",
        "section 6.1",
        "Internal leakage severely affects the piston's displacement and velocity and the pressures' fluctuation.",
        f"RMS velocity moves by {min(velocity):+.2f} to {max(velocity):+.2f} %, the pressures' range by "
        f"{min(pressure):+.2f} to {max(pressure):+.2f} % over the ten tests",
        [max(np.abs(velocity)) > 5.0, max(np.abs(pressure)) > 5.0],
        "Parts: more than 5 % in any test. The velocity falls by the leak's share of the pump's flow.",
    )


def _visible(evidence: ClaimEvidence) -> Claim:
    ranges = evidence.shown["5.3a"].range_MPa
    texts = [f"{c} {1e3 * ranges[c][0]:.1f} to {1e3 * ranges[c][1]:.1f} kPa" for c in CHAMBERS]
    return by_simulation(
        "claim-5.7.3",
        "section 5.3 a, Fig. 5.23",
        "The change of the pressures' wave after the leak opens is fairly visible.",
        f"5 to 95 % range: {', '.join(texts)}",
        [abs(ranges[c][1] / ranges[c][0] - 1.0) > 0.05 for c in CHAMBERS],
        "A part for each chamber: the range moves by more than 5 %, about the least an eye sees in such a plot.",
    )


def _onset(evidence: ClaimEvidence) -> Claim:
    texts, parts = [], []
    for chamber in CHAMBERS:
        errors = [abs(test.step_s[chamber] - test.onset_s) for test in evidence.shown.values()]
        near = [error <= _NEAR for error in errors]
        texts.append(
            f"{chamber}: {counted_share(near)}, median error {np.median(errors):.0f} s, worst {max(errors):.0f} s"
        )
        parts.append(all(near))
    return by_simulation(
        "claim-5.7.4",
        "sections 1.4 and 5.7",
        "The details tell when the leak began: they change at that moment and as long as it lasts.",
        f"a single step fitted to the windowed RMS of d3 lies within {_NEAR:g} s of the onset in {'; '.join(texts)}",
        parts,
        "A part for each chamber: within 10 s in all ten tests. The sheet holds only means of the two halves.",
    )


def _throttles(evidence: ClaimEvidence) -> Claim:
    """Judge by the leak-free pressure range of each command with open and with the most closed throttles."""
    ranges = {chamber: column(evidence.table, f"{chamber} range [MPa]") for chamber in CHAMBERS}
    texts, rises, grown = [], [], []
    for command in sorted({row.command for row in APPENDIX_C}):
        closings = [row.closed_pct if row.command == command else None for row in APPENDIX_C]
        most = max(closed for closed in closings if closed is not None)
        opened, throttled = (
            {c: float(np.mean(ranges[c][[k for k, closed in enumerate(closings) if closed == end]])) for c in CHAMBERS}
            for end in (0.0, most)
        )
        rise = [throttled[c] - opened[c] for c in CHAMBERS]
        texts.append(f"{command} {1e3 * rise[0]:+.2f} and {1e3 * rise[1]:+.2f} kPa at {most:g} %")
        rises += [of > 0.01 * opened[c] for of, c in zip(rise, CHAMBERS, strict=True)]
        if most == 75.0:
            grown.append((float(command.split(maxsplit=1)[0]), float(np.mean(rise))))
    ordered = [rise for _, rise in sorted(grown)]
    return by_simulation(
        "claim-6.1.3",
        "section 6.1",
        "The orifices raise the pressure at both ends of the cylinder, the more the larger the command's amplitude.",
        f"range of p_A and p_B without a leak, closed less open: {'; '.join(texts)}",
        [*rises, ordered == sorted(ordered)],
        "Parts: each chamber's range rises by 1 % or more for each command, and at 75 % closed it rises more the "
        "larger the amplitude. A commanded pump pushes the same flow through; friction alone sets the difference of "
        "the two chambers.",
    )


def _overlap(evidence: ClaimEvidence) -> Claim:
    from sealscope.signals.filters import decomposition_filters

    shares = {}
    for order in (1, 2, 4, 8):
        response = np.abs(np.fft.rfft(decomposition_filters(f"db{order}")[1], 4096)) ** 2
        shares[order] = float(response[: response.size // 2].sum() / response.sum())
    values = list(shares.values())
    return by_simulation(
        "claim-5.7.5",
        "section 5.1",
        "Daubechies' wavelet of order 8 keeps neighbouring frequency bands apart better than lower orders.",
        "share of the high-pass filter's energy below its band: "
        + ", ".join(f"db{order} {100 * of:.1f} %" for order, of in shares.items()),
        [lower < higher for higher, lower in itertools.pairwise(values)],
        "A part for each step up in order. Longer filters go on improving, so this does not single out order 8.",
    )


def _fast(evidence: ClaimEvidence) -> Claim:
    from sealscope.parameters import load_rig
    from sealscope.signals.filters import decomposition_filters, reach
    from sealscope.signals.windows import WINDOW_SIZE

    rate = load_rig(BENCH_RIG).daq.sample_rate
    taps = decomposition_filters("db8")[0].size
    operations, wait = 4 * 2 * taps, int(reach("db8", 4)[-1][1])
    return by_simulation(
        "claim-a.3",
        "abstract",
        "The method is fast and easy to implement.",
        f"{operations} multiply-adds a sample for four levels of db8, {operations * rate / 1e6:.2f} million a second "
        f"at {rate:g} Hz; d4 waits {wait} samples ({wait / rate:.2f} s), a window {WINDOW_SIZE / rate:.1f} s",
        [operations * rate < 1e7],
        "Fast: under ten million operations a second, which a small controller does. What a decision waits for is the "
        "window and the length of baseline its false-alarm rate needs.",
    )


def _sign_means_leak(evidence: ClaimEvidence) -> Claim:
    rule = CLAIMED[0]
    still, drift = (float(rule.fires(sheet).mean()) for sheet in (evidence.still, evidence.drift))
    return by_simulation(
        "claim-5.7.6",
        "section 5.6",
        "A fall of the RMS of d3 on P_A after the first half is the sign of a leak.",
        f"fires in {fired(evidence.leak, rule)} with leak, {fired(evidence.still, rule)} with nothing, "
        f"{fired(evidence.drift, rule)} with drift alone",
        [still < 0.05, drift < 0.05],
        "Parts: it fires in under 5 % of tests without a leak, still or drifting. The bench had no leak-free test, and "
        "the leak always came second.",
    )


def _similar(evidence: ClaimEvidence) -> Claim:
    measured, leak = evidence.measured, evidence.leak
    text, parts, sheet = "compared with the sheet only", [], NO_SHEET
    if measured is not None:
        ratios = {
            (c, name): float(np.exp(np.mean(np.log(leak.rms[c][name][:, 0] / measured.rms[c][name][:, 0]))))
            for c in CHAMBERS
            for name in _LEVELS
        }
        same = np.sign(leak.log_change("p_A", "d3")) == np.sign(measured.log_change("p_A", "d3"))
        text = (
            f"leak-free RMS over the sheet's: {', '.join(f'{c} {name} {of:.2f}' for (c, name), of in ratios.items())}; "
            f"d3 of P_A moves the same way in {int(same.sum())} of {same.size}"
        )
        parts = [1 / 1.25 <= of <= 1.25 for of in ratios.values()] + [bool(same.sum() >= 39)]
        sheet = "the reference"
    return Claim(
        "claim-6.1.4",
        "section 6.1",
        "Model and rig behave alike.",
        sheet,
        text,
        verdict_of(parts),
        f"Rig {BENCH_RIG}. Parts: each detail's leak-free RMS within 25 % in the geometric mean, and the way of d3 on "
        "P_A in 39 of 41 tests. The thesis gives no recorded series to compare with.",
    )


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge claims of the abstract and of chapters 1, 5 and 6 that only a simulation, or nothing here, can judge."""
    return (
        _fast(evidence),
        Claim(
            "claim-1.3.1",
            "section 1.3 c",
            "The method finds leaks that no earlier method could.",
            NOT_ON_SHEET,
            "not simulated",
            "cannot be tested",
            "No earlier method was run on these tests, and their records are not published.",
        ),
        _overlap(evidence),
        _speed(evidence),
        _drifting(evidence),
        _visible(evidence),
        _onset(evidence),
        _sign_means_leak(evidence),
        _performance(evidence),
        _throttles(evidence),
        _similar(evidence),
    )
