"""Judge claims of chapters 1, 5 and 6 that the data sheet cannot decide, by simulations with and without the leak."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from sealscope.parameters import load_rig
from sealscope.recordings.channels import CHAMBERS
from sealscope.signals.details import decomposition_filters, reach
from sealscope.signals.windows import WINDOW_SIZE
from sealscope.thesis.chapters.appendix_c_runs import column
from sealscope.thesis.chapters.chapter5 import TESTS
from sealscope.thesis.chapters.success_rates import CLAIMED, FALSE_ALARMS
from sealscope.thesis.claims.evidence import NO_SHEET, ClaimEvidence, format_rate
from sealscope.thesis.engine.products import Claim
from sealscope.thesis.engine.texts import format_range, judge_claim
from sealscope.thesis.sheet import APPENDIX_C, BENCH_RIG

#: Changes [%] below which a quantity counts as unchanged, and above which a change counts as severe.
_NEGLIGIBLE_CHANGE, _SEVERE_CHANGE = 1.0, 5.0
#: A drift counts as lowered by the leak if it falls more than in the same run without the leak, by at least this
#: fraction of the latter fall.
_MIN_EXTRA_FALL = 0.1
#: Two RMS agree within this factor; two sheets agree in a sign if they do so in at least this number of the 41 tests.
_MAX_RMS_RATIO, _MIN_AGREEING_TESTS = 1.25, 39
#: Operations per second that any small controller can make.
_FEW_OPERATIONS = 1e7
#: Largest error of an estimated onset [s].
_ONSET_TOLERANCE = 10.0
#: Smallest rise of a pressure range, as a fraction of that with open throttles, that counts as raised.
_MIN_RELATIVE_RISE = 0.01
#: Closing [%] at which Appendix C has several amplitudes to compare.
_COMPARED_CLOSING = 75.0


def claims(evidence: ClaimEvidence) -> tuple[Claim, ...]:
    """Judge the claims of the abstract and of chapters 1, 5 and 6 that the data sheet alone cannot decide."""
    return (
        judge_claim("1.3.1", []),  # no test: it cannot be tested
        *_wavelet_claims(),
        *_printed_test_claims(evidence),
        _d3_sign_claim(evidence),
        _throttle_claim(evidence),
        _agreement_claim(evidence),
    )


def _wavelet_claims() -> Iterator[Claim]:
    """Judge claims 5.7.5 and a.3 on db8: it separates bands better than lower orders, and its computation is cheap."""
    overlaps = {}  # order -> fraction of the high-pass filter's energy below its band
    for order in (1, 2, 4, 8):
        _, high_pass = decomposition_filters(f"db{order}")
        energy = np.abs(np.fft.rfft(high_pass, 4096)) ** 2  # padded for a fine spectrum
        overlaps[order] = float(energy[: energy.size // 2].sum() / energy.sum())  # the band is the upper half
    falls = [later < earlier for earlier, later in itertools.pairwise(overlaps.values())]
    text = ", ".join(f"db{order} {100 * fraction:.1f} %" for order, fraction in overlaps.items())
    yield judge_claim("5.7.5", falls, shares=text)
    rate = load_rig(BENCH_RIG).daq.sample_rate
    # operations per sample: one for each coefficient of two filters at each of four levels
    operations = 4 * 2 * decomposition_filters("db8")[0].size
    _, wait = reach("db8", 4)[-1].tolist()  # number of later samples on which d4 depends
    yield judge_claim(
        "a.3",
        [operations * rate < _FEW_OPERATIONS],
        operations=operations,
        millions=operations * rate / 1e6,
        rate=rate,
        wait=wait,
        wait_s=wait / rate,
        window_s=WINDOW_SIZE / rate,
    )


def _percent_change(pair: tuple[float, float]) -> float:
    """Compute the relative change [%] from the first value of `pair` to the second."""
    before, after = pair
    return 100.0 * (after / before - 1.0)


def _printed_test_claims(evidence: ClaimEvidence) -> Iterator[Claim]:
    """Judge the claims on the ten tests whose figures chapter 5 prints, by measures of the simulated tests.

    With the leak:

    - 5.7.1: the RMS of the motor's speed changes by less than 1 % in each test.
    - 5.7.2: in test 5.2a the piston's drift falls by over 10 % more than without the leak.
    - 6.1.2: the piston's velocity and the range of a chamber pressure change by over 5 % in at least one test each.
    - 5.7.3: in test 5.3a the ranges of both chamber pressures change by over 5 %.
    - 5.7.4: the onset estimated from d3 is within 10 s of the true one in all tests, for both chambers.
    """
    tests = evidence.test_measures
    speed_changes = {name: abs(_percent_change(test.speed)) for name, test in tests.items()}
    worst = max(speed_changes, key=lambda name: speed_changes[name])
    is_small = [change < _NEGLIGIBLE_CHANGE for change in speed_changes.values()]
    yield judge_claim("5.7.1", is_small, moved=speed_changes[worst], worst=worst, tests=len(speed_changes))
    drifts = [[1e3 * drift for drift in test.drift] for test in (tests["5.2a"], evidence.no_leak_measures)]
    fall, fall_without_leak = (abs(before) - abs(after) for before, after in drifts)  # [um/s]
    falls_more = fall - fall_without_leak > _MIN_EXTRA_FALL * abs(fall_without_leak)
    yield judge_claim("5.7.2", [falls_more], leaking=drifts[0], control=drifts[1])
    velocity = [_percent_change(test.velocity) for test in tests.values()]
    pressure = [_percent_change(test.range_MPa[c]) for test in tests.values() for c in CHAMBERS]
    is_severe = [max(np.abs(changes)) > _SEVERE_CHANGE for changes in (velocity, pressure)]
    yield judge_claim("6.1.2", is_severe, velocity=format_range(velocity, "%"), pressure=format_range(pressure, "%"))
    ranges = tests["5.3a"].range_MPa
    texts = [f"{c} {1e3 * ranges[c][0]:.1f} to {1e3 * ranges[c][1]:.1f} kPa" for c in CHAMBERS]
    is_changed = [abs(_percent_change(ranges[c])) > _SEVERE_CHANGE for c in CHAMBERS]
    yield judge_claim("5.7.3", is_changed, ranges=", ".join(texts))
    texts, parts = [], []
    for chamber in CHAMBERS:
        errors = [abs(test.step_s[chamber] - TESTS[section].half) for section, test in tests.items()]
        is_near = [error <= _ONSET_TOLERANCE for error in errors]
        rate = format_rate(is_near)
        texts.append(f"{chamber}: {rate}, median error {np.median(errors):.0f} s, worst {max(errors):.0f} s")
        parts.append(all(is_near))
    yield judge_claim("5.7.4", parts, near=_ONSET_TOLERANCE, errors="; ".join(texts))


def _d3_sign_claim(evidence: ClaimEvidence) -> Claim:
    """Judge claim 5.7.6: a fall of d3 of p_A indicates a leak, since it is rare without one, with drift or without."""
    d3_rule = CLAIMED[0]  # d3 of p_A falls
    sheets = {"leak": evidence.leak_sheet, "no_leak": evidence.no_leak_sheet, "drift": evidence.drift_sheet}
    fires = {name: d3_rule.fires(sheet) for name, sheet in sheets.items()}
    is_rare = [float(fires[name].mean()) < FALSE_ALARMS for name in ("no_leak", "drift")]
    return judge_claim("5.7.6", is_rare, **{name: format_rate(tests) for name, tests in fires.items()})


def _throttle_claim(evidence: ClaimEvidence) -> Claim:
    """Judge claim 6.1.3: partly closed throttles raise the leak-free pressure ranges, more so at larger commands.

    For each command, the largest closing must raise the range of each chamber pressure by more than 1 %. Among the
    commands whose largest closing is 75 %, the mean rise of both chambers must grow with the amplitude.
    """
    ranges = np.stack([column(evidence.leak_table, f"{chamber} range [MPa]") for chamber in CHAMBERS])
    closed_pct = np.array([row.closed_pct for row in APPENDIX_C])
    texts, is_raised, amplitude_rises = [], [], []
    for command in sorted({row.command for row in APPENDIX_C}):
        is_command = np.array([row.command == command for row in APPENDIX_C])
        max_closed = closed_pct[is_command].max()
        range_open = ranges[:, is_command & (closed_pct == 0.0)].mean(axis=1)  # [MPa] for p_A, p_B
        range_throttled = ranges[:, is_command & (closed_pct == max_closed)].mean(axis=1)
        rise = range_throttled - range_open
        texts.append(f"{command} {1e3 * rise[0]:+.2f} and {1e3 * rise[1]:+.2f} kPa at {max_closed:g} %")
        is_raised += list(rise > _MIN_RELATIVE_RISE * range_open)
        if max_closed == _COMPARED_CLOSING:
            amplitude_V = float(command.split(maxsplit=1)[0])
            amplitude_rises.append((amplitude_V, float(np.mean(rise))))
    rises = [rise for _, rise in sorted(amplitude_rises)]
    grows_with_amplitude = rises == sorted(rises)
    return judge_claim("6.1.3", [*is_raised, grows_with_amplitude], rises="; ".join(texts))


def _agreement_claim(evidence: ClaimEvidence) -> Claim:
    """Judge claim 6.1.4: simulation and measurement agree.

    The RMS of each detail without leak, d1 to d4 of both chambers, must agree within a factor of 1.25 (geometric mean
    over the tests). In at least 39 of the 41 tests, the leak must move d3 of p_A in the same direction in both.
    """
    measured, leak = evidence.measured_sheet, evidence.leak_sheet
    if measured is None:
        return judge_claim("6.1.4", [], compared="compared with the sheet only", sheet=NO_SHEET)
    ratios = {}  # geometric mean ratio of the RMS without the leak, by chamber and detail
    for c, name in itertools.product(CHAMBERS, ("d1", "d2", "d3", "d4")):
        ratios[f"{c} {name}"] = float(np.exp(np.mean(leak.log_ratio(measured, c, name))))
    n_same = leak.count_same_signs(measured, "p_A", "d3")
    text = (
        f"leak-free RMS over the sheet's: {', '.join(f'{name} {ratio:.2f}' for name, ratio in ratios.items())}; "
        f"d3 of P_A moves the same way in {n_same} of {measured.tests}"
    )
    is_near = [1 / _MAX_RMS_RATIO <= ratio <= _MAX_RMS_RATIO for ratio in ratios.values()]
    parts = [*is_near, n_same >= _MIN_AGREEING_TESTS]
    return judge_claim("6.1.4", parts, compared=text, sheet="the reference")
