"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """Priors on a logger's clock.

    `scatter`: of irregular intervals [sampling steps]; `near`: longest interval without a loss [usual intervals]; the
    others are dimensionless.
    """

    scatter: float
    rate: float
    near: float
    lost: float
    late: float


class StalePriors(PriorTable):
    """Priors on samples that repeat the one before; `shortest` is in s, the others are dimensionless."""

    runs: int
    spread: float
    share: float
    repeats: float
    fewest: float
    moves: float
    leap: float
    stuck: float
    shortest: float


class SpikePriors(PriorTable):
    """Samples that leap and return."""

    times: float
    share: float


class UnsignedPriors(PriorTable):
    """Priors on a speed without a sign.

    `half`, `nearby` in s, `changes` in 1/s, the others dimensionless.
    """

    noise: float
    half: float
    nearby: float
    error: float
    changes: float
    least: float
    correlation: float


class HumPriors(PriorTable):
    """Priors on hum of the mains; `lowest`, `around` in Hz, the others dimensionless."""

    loud: float
    alone: float
    lowest: float
    around: float
    over_rest: float
    over_median: float


class CreepPriors(PriorTable):
    """Priors on a mean chamber pressure that creeps.

    `rate`: smallest rate [Pa/s]; `seconds`: shortest recording [s].
    """

    rate: float
    seconds: float


class HoldPriors(PriorTable):
    """Lengths beyond which equal pressure samples are no reading, in `seconds` [s] and in `samples`."""

    seconds: float
    samples: int


class ReadingPriors(PriorTable):
    """Pressures and speeds of one machine.

    `noise` [share of the variance]; `rate` [Hz]; `samples` [samples]; the others are numbers.
    """

    noise: float
    rate: float
    samples: int
    correlation: float
    misfit: float


class OilRange(PriorTable):
    """Temperatures that an oil has: `coldest`, `hottest` [K]."""

    coldest: float
    hottest: float


class CyclePriors(PriorTable):
    """Priors on the duty cycle; `longest` in s, `rate` in Hz, `correlation` dimensionless."""

    longest: float
    correlation: float
    rate: float


class GapPriors(PriorTable):
    """Lengths of gaps [s].

    `motion`: longest gap of a channel that is interpolated by a line; `hole`: length over which a bridged gap has less
    weight.
    """

    motion: float
    hole: float


class RecordingPriors(PriorTable):
    """The tables of `recordings/priors.toml`."""

    clock: ClockPriors
    stale: StalePriors
    spike: SpikePriors
    unsigned: UnsignedPriors
    hum: HumPriors
    creep: CreepPriors
    hold: HoldPriors
    readings: ReadingPriors
    oil: OilRange
    cycle: CyclePriors
    gaps: GapPriors
    possible: Mapping[str, float]


RECORDINGS = read_priors("sealscope.recordings", RecordingPriors)
