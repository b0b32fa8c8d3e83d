"""Tests for a step of features that no volume balance contains: amplitude of motion, sensor noise, hum.

Each feature is one number in each block with motion, tested against its scatter between blocks. Blocks at rest, with a
pump's ripple, a held load or a drive that is off, cannot be compared with blocks in motion. A leak is not taken for
such a step:

- It changes the amplitude of the command or of the motion, not of both (`duty_observables`).
- It damps the ringing, but the noise is measured at higher frequencies.
- The hum is measured in p_A + p_B, which does not ring.
- With a leak, too, friction keeps p_A - p_B in phase with the flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, Information, StepTest, step_test
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.changes.level_changes import MOTIONS, level_tests, motion_speed, top_speed
from sealscope.diagnosis.inference.machine_states import is_in_motion, time_in_motion
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.motion import find_cycle
from sealscope.recordings.recording import Array, Recording, keep_with_recording
from sealscope.signals.smoothing import TINY, medians, quantiles

_PRIORS = CHANGES.features
BLOCKS, ORDER = _PRIORS.blocks, _PRIORS.order
#: Channels of the command, in the order of preference; a single channel stands for command and motion.
COMMANDS = ("u", "omega", "theta")
#: Minimum ratio of the smaller to the larger of two steps: half way, as an angle, between a single step and equal ones.
_MIN_STEP_RATIO = math.tan(math.pi / 8.0)
#: Distances [bins] from a spectral line to bins outside of its main lobe with a Hann window.
_NEIGHBOURS = _PRIORS.neighbours


def observe_duty(recording: Recording) -> Iterator[Observable]:
    """Test the amplitudes of command and motion for a sudden lasting change (`duty_observables`).

    The recording is divided into `BLOCKS` blocks of equal length, or with a position and a periodic motion into blocks
    of whole cycles.
    """
    length, cycle = len(recording) // BLOCKS, find_cycle(recording)  # [samples]; period [s], None if nothing repeats
    # Without a position, command and motion are both those of the drive, and a leak may change both a little and alike.
    # The amplitudes of whole cycles hardly scatter, so that this change would look like another duty. Blocks of equal
    # length also contain a part of a cycle, another one in each block: the amplitudes then scatter, which hides the
    # change.
    if "x" in recording and cycle is not None:
        cycle_samples = cycle * recording.rate
        length = round(max(1, math.ceil(length / cycle_samples)) * cycle_samples)
    time, blocks, is_moving = _split_blocks(recording, length)
    amplitudes = {name: values[is_moving] for name, values in log_amplitudes(blocks)}
    return duty_observables(time[is_moving], amplitudes)


def log_amplitudes(blocks: Mapping[str, Array]) -> Iterator[tuple[str, Array]]:
    """Yield the names "command" and "motion", each with the log amplitude (K,) of its channel in K blocks.

    The amplitude is the range from the 10 % to the 90 % quantile, which neither a short transient nor a short rest
    changes much. Its log is NaN for a block without samples, and -inf for constant samples. `blocks`: samples (K,
    length) by channel. A name is left out if none of its channels is recorded.
    """
    for name, candidates in (("command", COMMANDS), ("motion", MOTIONS)):
        if channel := next((candidate for candidate in candidates if candidate in blocks), None):
            yield name, np.log(_row_statistic(lambda rows: np.subtract(*quantiles(rows, 0.9, 0.1)), blocks[channel]))


def duty_observables(time: Array, amplitudes: Mapping[str, Array]) -> Iterator[Observable]:
    """Yield an observable if the machine's duty (commanded motion) changes suddenly, else nothing.

    `time` (K,): middles of the blocks [s]; `amplitudes`: log amplitudes (K,) of command and motion (`log_amplitudes`).
    Both must rise, or both fall, by similar amounts (`_MIN_STEP_RATIO`), since a leak changes only one amplitude; a
    motion without a recorded command is tested alone, and its fall, which a leak may cause, has a name of its own.
    Score, onset and size are those of the test with the lower score. The p-value is twice the higher one, since a step
    may be up or down. Nothing is yielded if an amplitude cannot be tested.
    """
    tests = [test for values in amplitudes.values() if (test := feature_step_test(time, values)) is not None]
    if len(tests) < len(amplitudes):
        return
    steps = np.abs([test.fitted.value for test in tests])
    has_one_sign = len({test.sign for test in tests}) == 1  # also false without any amplitude
    if has_one_sign and steps.min() > _MIN_STEP_RATIO * steps.max():
        weakest = min(tests, key=lambda test: test.score)
        least_certain = max(tests, key=lambda test: test.chance)
        yield Observable(
            name="size of the duty" if "command" in amplitudes or weakest.sign > 0.0 else "fall of the motion",
            data="duty",
            score=weakest.score,
            chance=min(1.0, 2.0 * least_certain.chance),
            onset=weakest.onset(),
            size=weakest.sign * weakest.fitted.value,
        )


def observe_sensors(recording: Recording) -> Iterator[Observable]:
    """Test features of the pressures, such as their noise, for a lasting change that no leak causes.

    Yields nothing if a chamber pressure is not recorded, or if p_A has no samples in one of the blocks.
    """
    if not {"p_A", "p_B"} <= recording.channels.keys():
        return
    time, blocks, is_moving = _split_blocks(recording, len(recording) // BLOCKS)
    if np.isnan(blocks["p_A"]).all(axis=1).any():  # a block without samples, in which no channel has any
        return
    features = {name: values[is_moving] for name, values in sensor_features(blocks, recording.rate)}
    yield from sensor_observables(time[is_moving], features)


def sensor_observables(time: Array, features: Mapping[str, Array]) -> Iterator[Observable]:
    """Test the values (K,) of each feature of the pressures (`sensor_features`) for a step between K blocks.

    `time` (K,): middles of the blocks [s]. The p-value is doubled, as each test is the better of two, for a step up and
    a step down. Features that cannot be tested are left out.
    """
    for name, values in features.items():
        test = feature_step_test(time, values)
        if test is None:
            continue
        scale = None
        if name == NOISE:  # log variance of p_A + that of p_B: a scale k of both adds 2 log(k) to each
            scale = Estimate(0.25 * test.sign * test.fitted.value, 0.25 * test.fitted.deviation)
        yield Observable.from_test(name, name.split()[0], test, n_tests=2.0, pressure_scale=scale)


def _split_blocks(recording: Recording, length: int) -> tuple[Array, dict[str, Array], NDArray[np.bool_]]:
    """Split the channels of a recording into K whole blocks of `length` samples.

    Returns the middles of the blocks (K,) [s], the samples (K, length) by channel name, NaN where missing, and flags
    (K,) of the blocks in which the piston moves, all if no motion is recorded.
    """
    count = len(recording) // length
    blocks = {name: values[: count * length].reshape(count, length) for name, values in recording.channels.items()}
    if recording.bridged is not None:
        missing = recording.bridged[: count * length].reshape(count, length)
        blocks = {name: np.where(missing, np.nan, values) for name, values in blocks.items()}
    speed = motion_speed(recording.channels, recording.rate)
    is_moving = np.ones(count, dtype=bool)
    if speed is not None:
        speeds = speed[: count * length].reshape(count, length)
        is_moving = is_in_motion(time_in_motion(speeds, top_speed(speed), recording.rate))
    return recording.t[0] + (np.arange(count) + 0.5) * length / recording.rate, blocks, is_moving


#: Name of the noise of both pressures together.
NOISE = "noise of the pressures"
#: Names of all that `sensor_features` yields, of which a running machine's blocks keep one number each.
SENSOR_FEATURES = (
    "sense of p_A - p_B",
    NOISE,
    "noise of p_A beside that of p_B",
    *(f"hum of {hertz:g} Hz" for hertz in _PRIORS.mains),
)


def sensor_features(blocks: Mapping[str, Array], rate: float) -> Iterator[tuple[str, Array]]:
    """Yield the name and the values (K,) of each feature of the pressures, which no leak shifts (`SENSOR_FEATURES`).

    The features are the sense of p_A - p_B, the log variance of the noise of both pressures, its difference between
    them, and the hum at the frequencies of the mains. With d, p_A - p_B minus its mean over all blocks, and the flow q
    into A, up to a factor, the sense is <d q> / sqrt(<d^2> <q^2>), with the mean <> over a block. The sense is left out
    if no motion is recorded, and a hum if the sampling rate is too low. The first word of a name is its kind of data
    (`Observable.data`). `blocks`: samples (K, length) by channel, NaN where missing; `rate`: sampling rate [Hz].
    """
    p_A, p_B = blocks["p_A"], blocks["p_B"]
    if channel := next((name for name in ("omega", "u", "theta", "x") if name in blocks), None):
        # friction puts p_A - p_B in phase with the flow into A, so that the sense is near 1; with exchanged or reversed
        # sensors it is near -1
        flow = blocks[channel] if channel in ("omega", "u") else np.gradient(blocks[channel], axis=1)
        # without a steady load or a sensor offset, which the mean over all blocks contains
        difference = p_A - p_B
        difference -= np.nanmean(difference)
        covariance, pressure_variance, flow_variance = (
            _row_statistic(lambda rows: np.asarray(rows.mean(axis=-1)), products)
            for products in (difference * flow, difference**2, flow**2)
        )
        yield "sense of p_A - p_B", covariance / np.sqrt(np.maximum(pressure_variance * flow_variance, TINY))
    # high-order differences contain little motion; median instead of mean, as pressure jumps at reversals are outliers
    noise_A, noise_B = (np.log(_row_statistic(medians, np.diff(p, ORDER, axis=1) ** 2)) for p in (p_A, p_B))
    yield NOISE, noise_A + noise_B
    yield "noise of p_A beside that of p_B", noise_A - noise_B
    bin_width = rate / (p_A.shape[1] // 2)  # [Hz], of the spectra of half a block
    for hertz in _PRIORS.mains:
        # line and neighbouring bins must be below the highest frequency that counts, a fraction of the sampling rate
        if hertz + _NEIGHBOURS[-1] * bin_width < _PRIORS.highest * rate:
            yield f"hum of {hertz:g} Hz", _log_hum(p_A + p_B, hertz / rate)


def _log_hum(blocks: Array, frequency: float) -> Array:
    """Compute the log power (K,) of a spectral line in blocks (K, n), relative to the power of the neighbouring bins.

    Ringing is wider than a line, so it raises the neighbouring bins as well and cancels. `frequency`: frequency of the
    line, divided by the sampling rate. The power is the mean over both halves of each block (Welch's estimate), NaN if
    a sample is missing.
    """
    length = blocks.shape[1] // 2
    halves = blocks[:, : 2 * length].reshape(-1, 2, length)
    halves = halves - halves.mean(axis=2, keepdims=True)
    log_power = np.log((np.abs(halves @ _line_and_neighbours(length, frequency)) ** 2).mean(axis=1))
    return np.asarray(log_power[:, 0] - log_power[:, 1:].mean(axis=1))


@lru_cache(maxsize=16)  # a stream asks for the same frequencies of the mains in each block
def _line_and_neighbours(length: int, frequency: float) -> NDArray[np.complex128]:
    """Compute the windowed Fourier factors (samples, bins) of a spectral line, bin 0, and of the bins beside it."""
    distances = np.array([0.0, *_NEIGHBOURS, *np.negative(_NEIGHBOURS)])  # [bins], from the line
    cycles = np.outer(np.arange(length), frequency + distances / length)
    return np.asarray(np.hanning(length)[:, None] * np.exp(-2j * np.pi * cycles))


def _row_statistic(statistic: Callable[[Array], Array], values: Array) -> Array:
    """Compute a statistic of the known values of each row (K, n); NaN for a row without known values.

    `statistic`: function of complete rows, such as `medians`; it is called for each row with missing values alone.
    """
    is_known = np.isfinite(values)
    if is_known.all():
        return statistic(values)
    results, is_complete = np.full(len(values), np.nan), is_known.all(axis=1)
    if is_complete.any():
        results[is_complete] = statistic(values[is_complete])
    for k in np.flatnonzero(is_known.any(axis=1) & ~is_complete):
        results[k] = statistic(values[k][~np.isnan(values[k])])
    return results


def feature_step_test(time: Array, values: Array) -> StepTest | None:
    """Test the values (K,) of a feature in K blocks for a step up or down, against their scatter between blocks.

    `time` (K,): middles of the blocks [s]. Return None if the values are constant, not finite or fewer than
    `MIN_BLOCKS`.
    """
    if len(values) < MIN_BLOCKS or not np.isfinite(values).all() or not np.ptp(values) > 0.0:
        return None
    drift = _PRIORS.wander  # prior scale of a healthy machine's slow change, linear or as a random walk
    # independent errors of equal variance, which the test estimates; precision times values are the values
    precision = np.eye(len(values))
    return step_test(Information(time, precision, vector=values, slope=drift, walk=drift), signs=(1.0, -1.0))


SIGNALS = "signals"


@keep_with_recording
@np.errstate(all="ignore")
def observe_signals(recording: Recording) -> Observed:
    """Test command, sensors and mean pressures of a recording for sudden lasting changes that no leak causes.

    The report only states a reason if the recording is too short. The result is cached with the recording.
    """
    shortest = CHANGES.features.shortest  # length of a block [s]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):  # differences of `ORDER` need samples
        return Observed(SIGNALS, lack="too short to test its signals for changes")
    observables = run_tests(
        lambda: observe_duty(recording),
        lambda: observe_sensors(recording),
        lambda: level_tests(recording),
    )
    return Observed(SIGNALS, observables)


def run_tests(*tests: Callable[[], Iterable[Observable]]) -> tuple[Observable, ...]:
    """Collect what all `tests` yield; a test in which numbers overflow or a matrix is singular ends early."""
    observables: list[Observable] = []
    for test in tests:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test()
    return tuple(observables)
