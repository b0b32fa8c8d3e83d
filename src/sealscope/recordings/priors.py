"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """The clock of a logger: `scatter` [sampling steps]; `near` [usual intervals]; the others are numbers."""

    scatter: float
    rate: float
    near: float
    lost: float
    late: float


class StalePriors(PriorTable):
    """Samples that repeat the one before: `shortest` [s]; the others are numbers."""

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
    """A speed that counts pulses: `half`, `nearby` [s], `changes` [1/s]; the others are numbers."""

    noise: float
    half: float
    nearby: float
    error: float
    changes: float
    least: float
    correlation: float


class HumPriors(PriorTable):
    """Hum of the mains: `lowest`, `around` [Hz]; the others are numbers."""

    loud: float
    alone: float
    lowest: float
    around: float
    over_rest: float
    over_median: float


class CreepPriors(PriorTable):
    """A mean pressure of both chambers that creeps: `rate` [Pa/s]; `seconds` [s]."""

    rate: float
    seconds: float


class HoldPriors(PriorTable):
    """Equal samples that are no reading of a pressure: `seconds` [s]; `samples` [samples]."""

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
    """The cycle of a duty: `longest` [s]; `rate` [Hz]; the others are numbers."""

    longest: float
    correlation: float
    rate: float


class GapPriors(PriorTable):
    """Gaps that are filled by a line: `motion`, `hole` [s]."""

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
