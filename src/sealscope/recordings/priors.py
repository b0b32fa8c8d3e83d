"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """Limits for the clock of a logger."""

    scatter: float  # rms deviation of intervals from which sampling is irregular [sampling steps]
    rate: float  # relative error of a stated rate
    near: float  # longest interval that is interpolated [usual intervals]
    lost: float  # largest fraction of samples lost in gaps
    late: float  # largest fraction of samples out of order


class StalePriors(PriorTable):
    """Limits for samples that repeat the one before."""

    runs: int  # fewest runs, or samples, for an estimate
    spread: float  # largest relative deviation of a run's duration from the median
    share: float  # smallest fraction of runs within `spread`
    repeats: float  # smallest ratio of repeated rows to those expected by chance
    fewest: float  # smallest fraction of rows expected by chance
    moves: float  # fraction of a channel's range that is motion
    leap: float  # quantile of a channel's changes that a jump exceeds
    stuck: float  # largest fraction of stuck samples in a pressure that is used
    shortest: float  # shortest period for which a channel holds a sample [s]


class SpikePriors(PriorTable):
    """Limits for samples that leap and return."""

    times: float  # smallest ratio of a spike to other changes
    share: float  # largest fraction of spikes in a channel


class UnsignedPriors(PriorTable):
    """Limits for a speed that counts pulses and so has no sign."""

    noise: float  # noise on the other side of zero, as a fraction of the largest value
    half: float  # half the time over which the piston's speed is taken [s]
    least: float  # smallest ratio of the motion one way to that the other way
    correlation: float  # smallest correlation with the speed of the piston


class HumPriors(PriorTable):
    """Limits for hum of the mains."""

    loud: float  # fraction of the power over `lowest` from which hum disturbs
    alone: float  # the same, from which there is little else
    lowest: float  # frequency from which the power counts [Hz]
    around: float  # frequencies on either side that a line is compared with [Hz]
    over_rest: float  # smallest ratio of a line to the largest amplitude there
    over_median: float  # smallest ratio of a line to the median amplitude there


class CreepPriors(PriorTable):
    """Limits for a drift of the mean pressure of both chambers."""

    rate: float  # smallest drift that is reported [Pa/s]
    seconds: float  # shortest recording in which it is searched for [s]


class HoldPriors(PriorTable):
    """Longest run of equal readings of a pressure; a longer one, by both limits, is held."""

    seconds: float
    samples: int


class ReadingPriors(PriorTable):
    """Limits for pressures and speeds of one machine."""

    noise: float  # largest fraction of white noise in the variance of a pressure
    rate: float  # rate at which speed and angle are compared [Hz]
    samples: int  # fewest samples at this rate
    correlation: float  # smallest correlation of the speed with the angle's derivative
    misfit: float  # largest ratio of the two speeds


class OilRange(PriorTable):
    """Temperatures that an oil has: `coldest`, `hottest` [K]."""

    coldest: float
    hottest: float


class CyclePriors(PriorTable):
    """Limits for the cycle of a duty."""

    longest: float  # longest period [s]
    correlation: float  # smallest autocorrelation at the period
    rate: float  # rate at which cycles are compared [Hz]


class GapPriors(PriorTable):
    """Lengths of gaps [s]."""

    motion: float  # longest gap of a position, angle, speed or flow that is filled by a line
    hole: float  # longest bridged gap whose rows are weighted in full


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
