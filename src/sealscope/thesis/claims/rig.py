"""Claims of chapters 1, 5 and 6 that the sheet is silent on, judged by the simulated rig, with controls."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from sealscope.parameters import load_rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.signals.filters import decomposition_filters, reach
from sealscope.signals.windows import WINDOW_SIZE
from sealscope.thesis.chapters.appendix_c_runs import column
from sealscope.thesis.chapters.success_rates import CLAIMED
from sealscope.thesis.claims.evidence import NO_SHEET, ClaimEvidence, counted_share, fired_share
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.engine.texts import judge_claim
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG

#: How near an estimated onset must come [s].
_NEAR = 10.0


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge claims of the abstract and of chapters 1, 5 and 6 that only a simulation, or nothing here, can judge."""
    return (
        judge_claim("1.3.1", [None]),
        *_method(),
        *_shown_tests(evidence),
        *_leak(evidence),
        _throttles(evidence),
        _similar(evidence),
    )


def _method() -> Iterator[Claim]:
    """Judge the claims on the wavelet and its cost."""
    shares = {}
    for order in (1, 2, 4, 8):
        response = np.abs(np.fft.rfft(decomposition_filters(f"db{order}")[1], 4096)) ** 2
        shares[order] = float(response[: response.size // 2].sum() / response.sum())
    falls = [lower < higher for higher, lower in itertools.pairwise(shares.values())]
    yield judge_claim(
        "5.7.5", falls, shares=", ".join(f"db{order} {100 * share:.1f} %" for order, share in shares.items())
    )
    rate = load_rig(BENCH_RIG).daq.sample_rate
    operations, wait = 4 * 2 * decomposition_filters("db8")[0].size, int(reach("db8", 4)[-1][1])
    yield judge_claim(
        "a.3",
        [operations * rate < 1e7],
        operations=operations,
        millions=operations * rate / 1e6,
        rate=rate,
        wait=wait,
        wait_s=wait / rate,
        window_s=WINDOW_SIZE / rate,
    )


def _change(pair: tuple[float, float]) -> float:
    """Compute the change from without to with the leak [%]."""
    return 100.0 * (pair[1] / pair[0] - 1.0)


def _between(values: Iterable[float]) -> str:
    values = list(values)
    return f"{min(values):+.2f} to {max(values):+.2f} %"


def _shown_tests(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims on the ten tests shown."""
    tests = evidence.shown
    speed_changes = {name: abs(_change(test.speed)) for name, test in tests.items()}
    worst = max(speed_changes, key=lambda name: speed_changes[name])
    small = [change < 1.0 for change in speed_changes.values()]
    yield judge_claim("5.7.1", small, moved=speed_changes[worst], worst=worst, tests=len(speed_changes))
    drifts = [[1e3 * drift for drift in test.drift] for test in (tests["5.2a"], evidence.control)]
    fell, fell_anyway = (abs(before) - abs(after) for before, after in drifts)
    more = fell - fell_anyway > 0.1 * abs(fell_anyway)
    yield judge_claim("5.7.2", [more], leaking=drifts[0], control=drifts[1])
    velocity = [_change(test.velocity) for test in tests.values()]
    pressure = [_change(test.range_MPa[c]) for test in tests.values() for c in CHAMBERS]
    severe = [max(np.abs(change)) > 5.0 for change in (velocity, pressure)]
    yield judge_claim("6.1.2", severe, velocity=_between(velocity), pressure=_between(pressure))
    ranges = tests["5.3a"].range_MPa
    texts = [f"{c} {1e3 * ranges[c][0]:.1f} to {1e3 * ranges[c][1]:.1f} kPa" for c in CHAMBERS]
    yield judge_claim("5.7.3", [abs(_change(ranges[c])) > 5.0 for c in CHAMBERS], ranges=", ".join(texts))
    texts, parts = [], []
    for chamber in CHAMBERS:
        errors = [abs(test.step_s[chamber] - test.test.half) for test in tests.values()]
        near = [error <= _NEAR for error in errors]
        texts.append(
            f"{chamber}: {counted_share(near)}, median error {np.median(errors):.0f} s, worst {max(errors):.0f} s"
        )
        parts.append(all(near))
    yield judge_claim("5.7.4", parts, near=_NEAR, errors="; ".join(texts))


def _leak(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge whether the fall of d3 on P_A is the sign of a leak."""
    controls = [float(CLAIMED[0].fires(sheet).mean()) < 0.05 for sheet in (evidence.still, evidence.drift)]
    counts = {name: fired_share(getattr(evidence, name), CLAIMED[0]) for name in ("leak", "still", "drift")}
    yield judge_claim("5.7.6", controls, **counts)


def _throttles(evidence: ClaimEvidence) -> Claim:
    """Judge by the leak-free pressure range of each command with open and with the most closed throttles."""
    ranges = np.stack([column(evidence.table, f"{chamber} range [MPa]") for chamber in CHAMBERS])
    closed_pct = np.array([row.closed_pct for row in APPENDIX_C])
    texts, rises, grown = [], [], []
    for command in sorted({row.command for row in APPENDIX_C}):
        rows = np.array([row.command == command for row in APPENDIX_C])
        most = closed_pct[rows].max()
        opened, throttled = (ranges[:, rows & (closed_pct == end)].mean(axis=1) for end in (0.0, most))
        rise = throttled - opened
        texts.append(f"{command} {1e3 * rise[0]:+.2f} and {1e3 * rise[1]:+.2f} kPa at {most:g} %")
        rises += list(rise > 0.01 * opened)
        if most == 75.0:
            grown.append((float(command.split(maxsplit=1)[0]), float(np.mean(rise))))
    ordered = [rise for _, rise in sorted(grown)]
    return judge_claim("6.1.3", [*rises, ordered == sorted(ordered)], rises="; ".join(texts))


def _similar(evidence: ClaimEvidence) -> Claim:
    measured, leak = evidence.measured, evidence.leak
    if measured is None:
        return judge_claim("6.1.4", [], compared="compared with the sheet only", sheet=NO_SHEET)
    ratios = {
        f"{c} {name}": float(np.exp(np.mean(np.log(leak.rms[c][name][:, 0] / measured.rms[c][name][:, 0]))))
        for c in CHAMBERS
        for name in ("d1", "d2", "d3", "d4")
    }
    same_sign = np.sign(leak.log_change("p_A", "d3")) == np.sign(measured.log_change("p_A", "d3"))
    text = (
        f"leak-free RMS over the sheet's: {', '.join(f'{name} {ratio:.2f}' for name, ratio in ratios.items())}; "
        f"d3 of P_A moves the same way in {int(same_sign.sum())} of {same_sign.size}"
    )
    parts = [1 / 1.25 <= ratio <= 1.25 for ratio in ratios.values()] + [bool(same_sign.sum() >= 39)]
    return judge_claim("6.1.4", parts, compared=text, sheet="the reference")
