"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """The sampling times of a data logger."""

    regular: tuple[float, float]  # [sampling steps] smallest and largest regular interval; a longer one is a gap
    scatter: float  # [sampling steps] standard deviation of the intervals above which sampling is irregular
    rate: float  # largest relative error of the stated rate
    near: float  # [usual intervals, i.e. medians] longest interval in which no sample is missing
    lost: float  # largest fraction of lost samples in one recording
    late: float  # largest fraction of samples with a time that is not later than all before
    leap: float  # [s] smallest step of a clock that was set, and did not wait
    pause: float  # [s] pause of unknown length before a logger that restarts
    meet: tuple[float, float]  # [usual intervals] mean step between late rows that are sorted to their places


class AnglePriors(PriorTable):
    """An angle that begins anew after a period."""

    period: float  # relative rounding error of the period
    measured: float  # largest scatter of a period that leaps measure, relative to it
    spoilt: float  # largest fraction of leaps that are not from one end of the range to the other
    slow: float  # largest step that shows that an angle wraps, whatever its period, over the period
    fast: float  # step, over the period, from which its direction must be told by another channel
    most: float  # quantile of the steps that stands for the largest
    reset: float  # smallest ratio of a step back to the first value to the usual largest step


class StalePriors(PriorTable):
    """Samples that repeat the previous sample instead of a new reading."""

    # the time for which a channel repeats its samples, estimated from runs of equal values
    runs: int  # fewest runs
    spread: float  # largest relative deviation of a regular run's duration from the median
    share: float  # smallest fraction of the runs that must be regular
    shortest: float  # [s] shortest time that matters
    # repeated rows and stuck channels
    repeats: float  # smallest ratio of the number of repeated rows to that expected by chance
    fewest: float  # smallest fraction of all rows that is assumed to repeat by chance
    moves: float  # smallest range over a run that counts as motion, as a fraction of the channel's range
    leap: float  # quantile of a channel's changes that a jump exceeds
    stuck: float  # largest fraction of stuck samples in a pressure that is used


class SpikePriors(PriorTable):
    """Spikes, i.e. single samples that leap and return at once."""

    times: float  # smallest ratio of a spike to the changes around it
    share: float  # largest fraction of samples that a logger gets wrong, on average
    tail: float  # smallest probability of as many errors as spikes; below it, the spikes are a signal


class UnsignedPriors(PriorTable):
    """A motor speed or flow that is recorded without its sign."""

    noise: float  # largest magnitude on the other side of zero, relative to the largest magnitude
    half: float  # [s] time on either side of a sample over which the piston speed is taken
    nearby: float  # [s] time on either side of a sample over which noise is averaged
    error: float  # relative error of the flow computed from the position
    changes: float  # [1/s] usual number of reversals per second
    least: float  # smallest ratio of the motion in the less used direction to that in the other
    correlation: float  # smallest correlation of the magnitude with the absolute piston speed or command
    # smallest logarithm of the ratio of flow over speed in one direction to that in the other, i.e. of the areas of a
    # single rod
    unlike: float
    passes: float  # smallest flow at rest, over the mean flow in motion, that shows a meter in a valve's supply line
    rests: float  # largest speed at rest, over the mean speed in motion


class HumPriors(PriorTable):
    """Hum of the electric mains in a channel."""

    lowest: float  # [Hz] frequency from which the power of the channel is counted
    loud: float  # fraction of this power from which hum is a warning
    alone: float  # fraction of this power from which the sensor may be disconnected
    around: float  # [Hz] the spectrum up to this distance from a line of hum is its background
    over_rest: float  # smallest ratio of the line to the largest background amplitude
    over_median: float  # smallest ratio of the line to the median background amplitude
    shortest: float  # [s] shortest channel that is searched for hum


class CreepPriors(PriorTable):
    """A steady drift of the mean chamber pressure."""

    rate: float  # [Pa/s] smallest drift that is reported
    seconds: float  # [s] shortest recording in which it is searched for
    parts: int  # number of parts of the recording whose mean pressures are compared
    even: tuple[float, float]  # smallest and largest step from part to part, over the median step


class RailPriors(PriorTable):
    """Marks of a rail, i.e. an end of its range at which a pressure is clipped."""

    samples: int  # fewest samples at the rail
    crowd: float  # smallest ratio of these samples to those at any of the values next to it
    zero: float  # [Pa] highest reading at a transducer's zero, where its range begins
    jump: float  # [quantisation steps] smallest jump to or from it
    run: int  # [samples] length of a run from which a smaller jump suffices
    long_jump: float  # [quantisation steps] smallest jump to or from such a long run


class HoldPriors(PriorTable):
    """Lengths beyond which a run of equal samples of a pressure is not a reading; the run must exceed both."""

    seconds: float  # [s]
    samples: int


class ReadingPriors(PriorTable):
    """Limits beyond which pressures and speeds cannot come from one hydraulic machine."""

    noise: float  # white noise's share of the variance of a pressure, above which it is taken for mere noise
    pressure: float  # [Pa] pressures that stay below it are in another unit
    # the comparison of the motor speed with the rate of the motor angle
    rate: float  # [Hz] both are averaged to this rate
    samples: int  # fewest samples for the comparison
    correlation: float  # smallest correlation of the two
    misfit: float  # ratio of the two above which a unit is wrong


class OilRange(PriorTable):
    """Range of temperatures [K] that hydraulic oil can have."""

    coldest: float
    hottest: float


class CyclePriors(PriorTable):
    """The duty cycle of a machine."""

    longest: float  # [s] longest period
    correlation: float  # smallest autocorrelation at a lag of one period
    rate: float  # [Hz] rate to which the signal is averaged before it is analysed


class GapPriors(PriorTable):
    """Gaps in a recording, and sensors without a supply."""

    motion: float  # [s] longest gap that is interpolated by a line in positions, angles, speeds and flows
    hole: float  # [s] length above which a filled gap has less weight in the diagnosis
    few: float  # largest fraction of defective samples that no verdict depends on
    usual: float  # largest ratio of a logger's usual defects to those in the healthy recordings
    live_zero: float  # smallest distance below zero, over its range, of a 4 to 20 mA sensor's reading without a supply
    dead: float  # largest variation of such a reading, over its distance from all other readings


class RecordingPriors(PriorTable):
    """All tables of `recordings/priors.toml`, the assumptions on loggers, sensors and machines."""

    clock: ClockPriors
    angle: AnglePriors
    stale: StalePriors
    spike: SpikePriors
    unsigned: UnsignedPriors
    hum: HumPriors
    creep: CreepPriors
    rail: RailPriors
    hold: HoldPriors
    readings: ReadingPriors
    oil: OilRange
    cycle: CyclePriors
    gaps: GapPriors
    possible: Mapping[str, float]  # SI unit, "any" for all others -> largest magnitude that any sensor reads in it


RECORDINGS = read_priors("sealscope.recordings", RecordingPriors)
