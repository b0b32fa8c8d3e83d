"""Chambers that valves shut: a piston leak moves oil from one to the other, a rod seal takes it from one alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from sealscope.diagnosis.inference.circuit.holds.chambers import HeldChambers
from sealscope.diagnosis.inference.circuit.holds.hold_oil import CylinderSides, OilRegression, fit_leak
from sealscope.diagnosis.inference.circuit.holds.leaks import BOTH, PistonLeak, SideSupply, UnitLeak, growth_factor
from sealscope.diagnosis.inference.circuit.holds.onset_sums import score_onsets
from sealscope.diagnosis.inference.circuit.holds.recorded_hold import (
    estimate_hold_offsets,
    find_charge_pressure,
    find_locked_holds,
)
from sealscope.diagnosis.inference.hypotheses import GROWTHS
from sealscope.diagnosis.inference.machine_states import extend_rests
from sealscope.diagnosis.inference.volumes.recorded import log_area_ratio
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array
from sealscope.units import P_ATM

from ..representatives import few

RATE, CYCLE, HELD = 100.0, 20.0, (4.0, 16.0)
AREA_A, AREA_B, STROKE, FRAME = 9e-3, 4.6e-3, 0.2, 3e8
KAPPA, CHARGE, DEAD = 7e-10, 5e5, 0.25
LOADED = 1.5e7
#: A conductance past the piston whose time constant is about that of a hold.
SEAL = 2e-13


def held_press(
    seed: int = 0,
    piston: float = 0.0,
    outside: float = 0.0,
    since: float = 0.0,
    exponent: float = 1.0,
    zero: float = 0.0,
    gain: float = 1.0,
    loads: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0),
    noise_level: float = 3e3,
    charge: float = CHARGE,
    growth: float = 0.0,
    vented: bool = False,
) -> HeldChambers:
    """Record four cycles of a press whose frame gives and whose valves shut for twelve seconds of each.

    A_A dx + V_A kappa dp_A = -q - e p_A and -A_B dx + V_B kappa dp_B = q, x as the frame gives; check valves keep both
    chambers at the pressure `charge` at least. `gain` is that of the sensor of p_B, `loads` the load of each cycle,
    `noise_level` the standard deviation of the sensors' noise [Pa], `growth` the piston leak's from `since` to the end.
    A `vented` side B is open to the tank.
    """
    random, count = np.random.default_rng(seed), round(4 * CYCLE * RATE)
    t = np.arange(count) / RATE
    phase = t % CYCLE
    rests = (phase > HELD[0]) & (phase < HELD[1])
    p_A, p_B, x = np.empty((3, count))
    middle = 0.9 * STROKE
    volumes = AREA_A * (middle + DEAD * STROKE), AREA_B * (STROKE - middle + DEAD * STROKE)
    areas = np.array([AREA_A, -AREA_B])
    give = np.linalg.inv(np.outer(areas, areas) / FRAME + np.diag(volumes) * KAPPA) / (20.0 * RATE)
    (give_AA, give_AB), (give_BA, give_BB) = give.tolist()  # floats: 96 000 steps
    for k in range(count):
        if not k or not rests[k]:
            loaded = LOADED * loads[int(t[k] / CYCLE)]
            p_A[k], p_B[k] = (loaded, charge) if HELD[0] - 1.0 < phase[k] < HELD[1] else (charge, charge)
            x[k] = middle + (p_A[k] * AREA_A - p_B[k] * AREA_B) / FRAME if phase[k] < HELD[1] else 0.05 * STROKE
            continue
        a, b = float(p_A[k - 1]), float(p_B[k - 1])
        grown = 1.0 + growth * (t[k] - since) / (t[-1] - since)
        seal, lost = (piston * grown * 1e7 ** (1.0 - exponent), outside) if t[k] >= since else (0.0, 0.0)
        for _ in range(20 if seal or lost else 0):
            flow = math.copysign(seal * abs(a - b) ** exponent, a - b)
            into_A = -flow - lost * a
            a, b = (
                max(a + give_AA * into_A + give_AB * flow, charge),
                charge if vented else max(b + give_BA * into_A + give_BB * flow, charge),
            )
        p_A[k], p_B[k] = a, b
        x[k] = middle + (a * AREA_A - b * AREA_B) / FRAME
    noise = random.standard_normal((3, count))
    pressures = p_A + zero + P_ATM + noise_level * noise[0], gain * p_B + P_ATM + noise_level * noise[1]
    channels = (t, *pressures, x + 2e-6 * noise[2])
    holds = find_locked_holds(channels, rests[1:], RATE)
    sides = CylinderSides(AREA_A, AREA_B, 0.05 * STROKE, float(x.max()))
    found = find_charge_pressure(np.minimum(*pressures), rests[1:], RATE)
    return HeldChambers(holds, sides, float(t[0]), float(t[-1]), found)


@pytest.mark.slow
def test_a_hold_of_twelve_seconds_sees_no_leak_where_there_is_none() -> None:
    for seed in range(3):
        chambers = held_press(seed)
        leaks = chambers.leaks
        assert chambers.total_leak().value < 0.01 * SEAL
        assert leaks.piston < 1e-3 * SEAL
        assert max(leaks.outside_A, leaks.outside_B) < 1e-3 * SEAL


@pytest.mark.parametrize(
    ("size", "zero"), few([(0.1, -2e5), (1.0, 2e5), (0.1, 0.0), (1.0, 0.0), (0.1, 2e5), (1.0, -2e5)])
)
def test_the_piston_takes_from_one_side_what_it_brings_to_the_other(size: float, zero: float) -> None:
    """The zero of p_A - p_B shows where the pressures have become equal."""
    chambers = held_press(piston=size * SEAL, zero=zero)
    assert chambers.leaks.piston == pytest.approx(size * SEAL, rel=0.25)
    assert max(chambers.leaks.outside_A, chambers.leaks.outside_B) < 0.05 * size * SEAL
    if size == 1.0:
        assert chambers.piston_fit.offset == pytest.approx(zero, abs=6e4)


@pytest.mark.parametrize(("charge", "noise_level"), few([(CHARGE, 3e3), (0.0, 1e5), (CHARGE, 1e5)]))
def test_a_rod_seal_takes_from_one_side_alone(charge: float, noise_level: float) -> None:
    """Side B stays at the charge pressure: a check valve feeds it as the piston gives way, whatever a sample's noise.

    The leak passed for the piston's where the noise is as large as the margin above the charge pressure. At a tank's
    pressure B may as well be open to the tank, and take what leaks past the piston.
    """
    leaks = held_press(outside=SEAL, noise_level=noise_level, charge=charge).leaks
    assert leaks.outside_A == pytest.approx(SEAL, rel=0.35)
    assert leaks.outside_B < 0.05 * SEAL
    assert leaks.piston < (0.05 if charge else 0.5) * SEAL


def test_a_side_that_is_open_to_the_charge_line_leaves_the_piston_possible() -> None:
    """Only the loaded side has a holding valve: B tells nothing, at a pressure far above that of a tank."""
    chambers = held_press(piston=SEAL, vented=True, charge=CHARGE)
    assert SideSupply.OPEN in chambers.piston_fit.supplies
    assert 0.05 < chambers.piston_leak.probability < 0.95
    assert chambers.piston_leak.fit.value == pytest.approx(SEAL, rel=0.35)


def test_a_side_that_a_leak_fills_in_every_hold_is_not_open() -> None:
    """A clamp with a leak of 8 % was bounded at a thousandth: its rod side, at 40 bar, passed for an open one."""
    chambers = held_press(piston=30.0 * SEAL, charge=0.0)
    assert all(SideSupply.OPEN not in supplies for supplies in chambers._possible_supplies)
    assert chambers.piston_leak.probability > 0.95


def test_a_side_that_is_open_to_the_tank_leaves_the_piston_possible() -> None:
    """A loses oil in any case; B tells nothing, at the pressure of a tank."""
    chambers = held_press(piston=SEAL, vented=True, charge=0.0)
    assert 0.05 < chambers.piston_leak.probability < 0.95
    assert chambers.piston_leak.fit.value == pytest.approx(SEAL, rel=0.35)
    assert held_press(piston=SEAL, charge=CHARGE).piston_fit.supplies != BOTH


def test_a_leak_that_begins_within_the_recording_is_dated_by_the_holds() -> None:
    chambers = held_press(piston=SEAL, since=47.0)
    found = chambers.piston_fit
    assert found.onset == pytest.approx(47.0, abs=3.0)
    assert chambers.fit_piston_leak(found).value == pytest.approx(SEAL, rel=0.3)


def test_a_large_leak_that_equalises_the_pressures_at_once_is_found() -> None:
    chambers = held_press(piston=100.0 * SEAL, since=32.7, zero=-4e4)
    onset = chambers.piston_onset
    assert onset is not None and onset.low <= 32.7 <= onset.high
    assert chambers.leaks.piston > SEAL
    assert chambers.piston_leak.probability > 0.99


@pytest.mark.parametrize("exponent", [1.0, 0.5])
def test_the_faster_a_leak_equalises_the_pressures_the_less_its_size_is_known(exponent: float) -> None:
    """The relative error is that of a start some tenth of a second off, over the time in which the leak flows."""
    errors = []
    for size in (0.01, 1.0, 100.0):
        chambers = held_press(piston=size * SEAL, exponent=exponent)
        leak = next(leak for leak in chambers.piston_fits if leak.exponent == exponent)
        errors.append(chambers.start_error(leak))
    held_s = HELD[1] - HELD[0]
    assert errors[0] == pytest.approx(INFERENCE.held_oil.shutting_time / held_s / len(chambers.holds) ** 0.5, rel=0.2)
    assert errors[0] < errors[1] < errors[2]
    assert errors[2] > 0.3


@pytest.mark.parametrize("gain", few([0.995, 1.0, 1.005], 1))
def test_equalised_pressures_tell_a_leak_though_the_gains_of_the_sensors_differ(gain: float) -> None:
    """A difference of gains of half a percent is another zero in each hold, as the load falls from cycle to cycle."""
    chambers = held_press(piston=10.0 * SEAL, gain=gain, loads=(1.0, 0.8, 0.6, 0.4))
    fit = chambers.piston_leak.fit
    assert chambers.leaks.piston == pytest.approx(10.0 * SEAL, rel=0.15)  # the dead volume is half the usual one
    assert abs(fit.value - 10.0 * SEAL) < 2.0 * math.hypot(fit.deviation, fit.by_oil)
    assert chambers.piston_leak.probability > 0.99


def test_pressures_that_a_leak_equalised_drive_no_flow_if_the_offset_is_exactly_their_difference() -> None:
    chambers = held_press(piston=100.0 * SEAL)
    offset, _, is_equalised = estimate_hold_offsets(*chambers.holds[0].last_pressures, 0.0)
    assert is_equalised
    first = slice(len(chambers.holds[0].t))
    pressures = [chambers.driving_pressure(value)[first] for value in (float(offset), float(offset) + 1e-3)]
    np.testing.assert_allclose(*pressures, atol=1.0)


def test_pressures_that_decay_tell_the_law_of_the_leak() -> None:
    for exponent, other in ((1.0, 0.5), (0.5, 1.0)):
        chambers = held_press(piston=SEAL, exponent=exponent)
        likelihoods = {e: chambers.fit_piston_leak(PistonLeak(e)).log_likelihood for e in (1.0, 0.5)}
        assert likelihoods[exponent] > likelihoods[other] + 5.0


def test_holds_tell_how_a_leak_grows() -> None:
    """The conductance of each hold is that of its time; one conductance for all holds fits worse by far."""
    growth = 2.0 * INFERENCE.growth.most / 3.0
    chambers = held_press(piston=5.0 * SEAL, growth=growth)
    best = max(chambers.law_fits, key=lambda fit: fit.log_weight)
    assert (best.leak.exponent, best.leak.growth) == (1.0, pytest.approx(growth, rel=0.3))
    assert best.fit.value == pytest.approx(5.0 * SEAL, rel=0.2)
    steady = chambers.law_fits[0]
    assert (steady.leak.exponent, steady.leak.growth) == (1.0, 0.0)
    assert best.log_weight > steady.log_weight + 5.0


def test_a_leak_that_equalises_the_pressures_while_the_valves_shut_shows_on_the_side_it_fills() -> None:
    """Within 0.1 s p_B rises to p_A: the loaded side, which valves may still connect with the pump, tells nothing."""
    chambers = held_press(piston=100.0 * SEAL)
    hold = chambers.holds[0]
    equal = float((hold.p_A - hold.p_B)[hold.edges[1] :].max())
    assert hold.is_A_loaded
    assert equal < 0.1 * LOADED
    assert chambers.piston_leak.probability > 0.99
    without_settling = [replace(hold, edges=hold.edges[1:]) for hold in chambers.holds]
    assert replace(chambers, holds=without_settling).leaks.piston < chambers.leaks.piston


def test_a_check_valve_feeds_the_larger_side_that_a_leak_does_not_fill() -> None:
    """A weight on B creeps down by a leak into A, whose area is larger: oil from the charge pressure fills the rest."""
    t = np.arange(3000) / RATE
    rests = (t > 2.0) & (t < 28.0)
    below = 7e5  # p_B - p_A [Pa]
    leak = 1e-11
    x = 0.05 + leak * below / AREA_B * np.clip(t - 2.0, 0.0, 26.0)
    noise = np.random.default_rng(1).standard_normal((3, t.size))
    p_A = CHARGE + P_ATM + 3e3 * noise[0]
    channels = t, p_A, CHARGE + below + P_ATM + 3e3 * noise[1], x + 2e-6 * noise[2]
    sides = CylinderSides(AREA_A, AREA_B, 0.0, STROKE)
    chambers = HeldChambers(find_locked_holds(channels, rests[1:], RATE), sides, 0.0, float(t[-1]), CHARGE + P_ATM)
    assert chambers.piston_fit.supplies == (SideSupply.CHECK, SideSupply.SHUT)
    assert chambers.fit_piston_leak(chambers.piston_fit).value == pytest.approx(leak, rel=0.1)


def test_an_area_that_is_not_measured_is_varied() -> None:
    chambers = held_press(piston=SEAL)
    assert chambers.area_variants() == [(1.0, chambers)]
    unknown = replace(chambers, sides=chambers.sides._replace(area_A=0.8 * AREA_A, deviation_A=0.25))
    variants = unknown.area_variants()
    assert sum(probability for probability, _ in variants) == pytest.approx(1.0)
    logs = np.array([np.log(variant.sides.area_A / AREA_A) for _, variant in variants])
    probabilities = np.array([probability for probability, _ in variants])
    mean = probabilities @ logs
    assert (mean, probabilities @ (logs - mean) ** 2) == pytest.approx((np.log(0.8), 0.25**2))
    leaks = [variant.leaks.piston for _, variant in variants]
    assert min(leaks) < SEAL < max(leaks)


@pytest.mark.parametrize(
    ("measured", "share", "is_larger", "ratio"),
    [(0.6, 0.9, False, 0.6), (1.0, 0.95, True, 1.0), (1.3, 1.0, True, 1.3)],
)
def test_the_ratio_of_the_areas_is_that_of_a_side_that_surely_carries(measured, share, is_larger, ratio) -> None:
    estimate = log_area_ratio(measured, share, is_larger=is_larger)
    assert np.exp(estimate.value) == pytest.approx(ratio, rel=0.05)
    assert estimate.deviation < 0.05


def test_motion_that_may_be_of_the_other_side_says_little_of_the_ratio_of_the_areas() -> None:
    """A press that moves at a bar or two: zeros of the sensors decide which side seems to carry."""
    unsure, unknown = log_area_ratio(1.0, 0.002, is_larger=True), log_area_ratio(0.0, 0.0, is_larger=True)
    prior = INFERENCE.held_oil
    expected = prior.log_area_ratio, prior.log_area_ratio_deviation
    assert (unknown.value, unknown.deviation) == pytest.approx(expected, rel=0.02)
    assert 0.0 < unsure.value < prior.log_area_ratio
    assert unsure.deviation > 0.5 * prior.log_area_ratio_deviation
    assert log_area_ratio(0.0, 0.0, is_larger=False).value == pytest.approx(-prior.log_area_ratio, rel=0.02)


def test_a_hold_with_a_missing_sample_and_one_that_is_short_are_left_out() -> None:
    t: Array = np.arange(3000) / RATE
    p = np.full(3000, 1e6)
    x = np.full(3000, 0.1)
    rests = ((t > 2.0) & (t < 4.0)) | ((t > 10.0) & (t < 10.7)) | ((t > 15.0) & (t < 20.0))
    holds = find_locked_holds((t, p, p, x), rests[1:], RATE)
    assert [round(float(hold.t[0])) for hold in holds] == [2, 15]
    p = p.copy()
    p[250] = np.nan
    assert len(find_locked_holds((t, p, x, x), rests[1:], RATE)) == 1


def test_what_passes_an_open_valve_and_the_resting_pump_is_no_oil_that_does_not_compress() -> None:
    """Side B empties into A, which stays at the charge pressure, as it does not behind valves that are shut.

    No leak of a cut-off cylinder fits. A fit whose oil hardly compresses, so that nothing leaves B, did.
    """
    tau, after = 4.0, 0.1  # time constant of the pump's slip and B's volume, and stroke left of A [s, m]
    phase = np.arange(0.0, 10.0, 1.0 / RATE)
    p_A, x = np.full(phase.size, CHARGE + P_ATM), np.full(phase.size, after)
    p_B = p_A + 1e6 * np.exp(-phase / tau)
    t = np.concatenate([k * 20.0 + phase for k in range(4)])
    rests = np.ones(t.size, dtype=bool)
    rests[:: phase.size] = False
    noise = np.random.default_rng(3).standard_normal((2, t.size))
    channels = t, np.tile(p_A, 4) + 3e3 * noise[0], np.tile(p_B, 4) + 3e3 * noise[1], np.tile(x, 4)
    sides = CylinderSides(AREA_A, AREA_B, 0.0, STROKE)
    chambers = HeldChambers(find_locked_holds(channels, rests[1:], RATE), sides, 0.0, float(t[-1]), CHARGE + P_ATM)
    usual_slip = AREA_B * (STROKE - after + 0.3 * STROKE) * 8e-10 / tau  # oil as the priors expect it, no air
    total = chambers.total_leak()
    assert 0.5 * usual_slip < total.value < 4.0 * usual_slip
    assert total.value > 5.0 * total.deviation


@pytest.mark.parametrize("size", few([0.02, 0.1], 1))
def test_the_onset_is_stated_where_a_hold_was_tight_before(size: float) -> None:
    assert held_press(piston=size * SEAL).piston_onset is None
    for since in (32.0, 47.0, 50.0, 66.0):
        onset = held_press(piston=size * SEAL, since=since).piston_onset
        assert onset is not None
        assert onset.low <= since <= onset.high
        assert onset.high - onset.low < CYCLE


def test_a_leak_that_begins_between_holds_may_have_begun_at_any_time_between_them() -> None:
    """It shows where the next hold begins, and an onset right after that fits as well."""
    for since in (16.2, 23.8):
        onset = held_press(piston=20.0 * SEAL, since=since).piston_onset
        assert onset is not None
        assert onset.low <= since <= onset.high


@pytest.mark.parametrize("since", few([27.0, 33.0, 46.0], 1))
def test_the_growth_of_a_leak_moves_no_onset(since: float) -> None:
    """A leak that triples shows most after the hold in which it begins; one that stays the same would begin later."""
    chambers = held_press(piston=0.3 * SEAL, since=since, growth=INFERENCE.growth.most)
    onset = chambers.piston_onset
    assert onset is not None
    assert onset.low <= since <= onset.high
    best = max(chambers.law_fits, key=lambda fit: fit.log_weight)
    assert best.leak.growth > 0.5 * INFERENCE.growth.most
    assert best.leak.onset == pytest.approx(since, abs=2.0)


def lost_volumes(chambers: HeldChambers, leak: UnitLeak, onset: float) -> Array:
    """Return the volume lost up to each reading (r,) since an onset, one hold and one side after the other."""
    columns, first = [], 0
    for hold in chambers.holds:
        for is_A, flow in zip((True, False), leak.flows[:, first : first + len(hold.t)], strict=True):
            volume = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(hold.t))])
            since = np.where(hold.t >= onset, volume - np.interp(onset, hold.t, volume), 0.0)
            readings, n_skipped = hold.mean(since), int(hold.is_A_loaded == is_A)
            columns.append(np.append(np.zeros(n_skipped), readings[n_skipped:] - readings[n_skipped:].mean()))
        first += len(hold.t)
    return np.concatenate(columns)


@pytest.mark.parametrize(("k", "growth"), [(0, 0.0), (4, list(GROWTHS)[4])])
def test_products_of_all_onsets_are_those_of_each_onset_by_itself(k: int, growth: float) -> None:
    chambers = held_press(piston=0.3 * SEAL)
    leak = chambers._unit_piston_leak(PistonLeak(supplies=BOTH))
    sums = chambers._sum_products(leak)[..., k]
    regressors = chambers._regressions[BOTH].regressors
    for onset, found in zip(chambers.onsets.tolist(), sums, strict=True):
        flows = leak.flows * growth_factor(chambers._samples.t, growth, onset, chambers.end)
        column = lost_volumes(chambers, leak._replace(flows=flows), onset)
        expected = np.append(column @ regressors, column @ column)
        # the kink of a growing leak at the onset lies between two samples
        assert found == pytest.approx(expected, rel=1e-3 if growth else 1e-9, abs=1e-12 * np.abs(sums).max())


@pytest.mark.parametrize("exponent", [1.0, 0.75])
def test_offsets_are_scored_together_as_each_by_itself(exponent: float) -> None:
    chambers = held_press(piston=3.0 * SEAL, gain=0.995, loads=(1.0, 0.8, 0.6, 0.4))
    for supplies in chambers._possible_supplies:
        leak = PistonLeak(exponent, supplies=supplies)
        offsets = np.linspace(-2e5, 3e4, 35)  # more than are summed at once
        together = chambers._find_onsets(leak, offsets)
        for offset, (score, found) in zip(offsets.tolist(), together, strict=True):
            sums = chambers._sum_products(chambers._unit_piston_leak(leak._replace(offset=offset)))
            alone = chambers._onset_posteriors(supplies, sums)[0]
            assert found == leak._replace(offset=offset, onset=float(chambers.onsets[alone.argmax()]))
            share = 0.5 * chambers.n_readings * math.log(chambers._closed_share(supplies))
            expected = alone.max() + chambers._conditions_log_prior(found) + share
            assert score == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", few([0, 1, 2, 3, 4], 2))
def test_a_leak_and_the_oil_are_fitted_as_by_a_general_least_squares(seed: int) -> None:
    """The oracle minimises the squares of all readings and of the priors, weighted by the fitted variance."""
    random, prior = np.random.default_rng(seed), INFERENCE.held_oil
    chambers = held_press(seed, piston=SEAL * 10.0 ** random.uniform(-1.0, 1.0))
    regression = chambers._regressions[BOTH]
    leak = chambers._unit_piston_leak(PistonLeak(supplies=BOTH))
    column = lost_volumes(chambers, leak, 0.0)
    sums = np.append(column @ regression.regressors, column @ column)
    fit = fit_leak(regression, sums, chambers.n_readings)
    deviations = np.array(
        [prior.deviation, prior.dead_volume_deviation, prior.dead_volume_deviation, prior.air_deviation]
    )
    unit = np.sqrt(fit.variance)
    scale = np.linalg.norm(regression.displaced) / np.linalg.norm(column)

    def residuals(numbers: Array) -> Array:
        """Return the residuals of readings and priors, in standard deviations of a reading."""
        oil, dead_A, dead_B, air = numbers[1:]
        volumes = np.array([1.0, 1.0 + dead_A, 1.0 + dead_B])
        lost = regression.displaced - (np.exp(oil) * regression.strained + np.exp(air) * regression.aired) @ volumes
        weights = np.sqrt(regression.inflation) / deviations
        return np.append((lost - numbers[0] * scale * column) / unit, numbers[1:] * weights)

    least_dead = prior.least_dead_volume / prior.dead_volume - 1.0
    bounds = ([-np.inf, -np.inf, least_dead, least_dead, -np.inf], np.inf)
    oracle = least_squares(residuals, np.array([0.0, 0.0, 0.0, 0.0, 0.0]), bounds=bounds, xtol=1e-14, ftol=1e-14)
    deviation = math.hypot(fit.by_noise**0.5, fit.by_oil**0.5)
    assert abs(fit.coefficient - scale * oracle.x[0]) < 0.02 * deviation
    covariance = np.linalg.inv(oracle.jac.T @ oracle.jac) * regression.inflation
    if (oracle.x[2:4] > least_dead + 1e-6).all():
        assert deviation == pytest.approx(scale * covariance[0, 0] ** 0.5, rel=0.02)


@pytest.mark.parametrize("seed", few([0, 1, 2, 3, 4], 2))
def test_the_least_squares_of_each_onset_are_those_within_the_limits_of_the_oil(seed: int) -> None:
    """A slow oracle solves the same problem, with no negative leak, dead volume, air or compressibility."""
    random, prior = np.random.default_rng(seed), INFERENCE.held_oil
    n_rows, n_onsets, n_readings, misfit, inflation = 40, 6, 8.0, 0.1, 4.0
    strained, aired = random.standard_normal((2, n_rows, 3))
    regression = OilRegression(random.standard_normal(n_rows) * 3.0, strained, aired, inflation, misfit)
    columns = random.standard_normal((n_rows, n_onsets))
    sums = np.column_stack([columns.T @ regression.regressors, (columns**2).sum(axis=0)])
    scores = score_onsets(regression.onset_priors(variance=0.5, n_readings=n_readings), sums[..., None])[0]
    least_dead = prior.least_dead_volume / prior.dead_volume - 1.0
    deviations = np.array(
        [prior.deviation, prior.dead_volume_deviation, prior.dead_volume_deviation, prior.air_deviation]
    )
    least = np.expm1(-2.0 * deviations)  # of compressibility and air, whose changes are logarithms
    lowest = np.array([least[0], max(least_dead, least[1]), max(least_dead, least[2]), least[3], 0.0])
    left = regression.displaced - (strained + aired).sum(axis=1)
    dead = strained[:, 1:] + aired[:, 1:]
    oil = np.column_stack([strained.sum(axis=1), dead, aired.sum(axis=1)])

    def least_squares_of_onsets(variance: float) -> Array:
        """Return the residual sum of squares (o,) with priors that are weighted by a variance of a reading."""
        squares = []
        for column in columns.T:
            priors = np.diag((variance * inflation) ** 0.5 / deviations)
            rows = np.column_stack([np.vstack([oil, priors]), np.append(column, np.zeros(4))])
            oracle = lsq_linear(rows, np.append(left, np.zeros(4)), bounds=(lowest, np.inf), tol=1e-12)
            squares.append(2.0 * oracle.cost + misfit * n_rows)
        return np.array(squares)

    # the priors are weighted by the variance without a leak, then by that of the best onset
    squares = least_squares_of_onsets(least_squares_of_onsets(0.5).min() / n_rows)
    assert scores == pytest.approx(-0.5 * n_readings * np.log(squares), rel=1e-6)


@pytest.mark.parametrize(("piston", "gain"), [(10.0, 0.995), (0.3, 1.0), (0.0, 1.0)])
def test_some_of_the_last_readings_tell_the_offset_as_all_do(
    piston: float, gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each hold has an offset of its own, near that of the recording: not every last reading need be tried."""
    loads = (1.0, 0.8, 0.6, 0.4)
    by_all = held_press(piston=piston * SEAL, gain=gain, loads=loads)
    expected, n_offsets = by_all.piston_leak.fit, len(by_all._offset_grid)
    monkeypatch.setattr("sealscope.diagnosis.inference.circuit.holds.chambers.MAX_ENDS", 2)
    by_some = held_press(piston=piston * SEAL, gain=gain, loads=loads)
    assert len(by_some._offset_grid) == n_offsets - 2
    difference = by_some.piston_leak.fit.value - expected.value
    assert abs(difference) < 0.2 * math.hypot(expected.deviation, expected.by_oil)


def test_a_rest_begins_as_the_flow_has_fallen_to_half() -> None:
    """The flow, averaged over 0.2 s, finds it 0.15 s too late."""
    t = np.arange(0.0, 10.0, 1.0 / RATE)
    flow = np.where(t < 3.0, 1.0, 0.5 ** ((t - 3.0) / 0.02)) * np.where(t < 1.0, 0.0, 1.0)
    rests = (t > 3.17) | (t < 0.5)
    extended = extend_rests(rests, flow, RATE)
    assert t[extended & (t > 1.0)][0] == pytest.approx(3.02, abs=1.5 / RATE)
    assert (extended[t < 1.0] == rests[t < 1.0]).all()
    assert (extend_rests(rests, np.zeros(len(t)), RATE) >= rests).all()
