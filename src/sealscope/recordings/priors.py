"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """Assumptions on the sampling times of a data logger.

    - `regular` [sampling steps]: smallest and largest regular interval; a longer one is a gap.
    - `scatter` [sampling steps]: standard deviation of the intervals above which sampling is irregular.
    - `rate`: largest relative error of the stated rate.
    - `near` [usual intervals, i.e. medians]: longest interval in which no sample is missing.
    - `lost`: largest fraction of lost samples in one recording.
    - `late`: largest fraction of samples with a time that is not later than all before.
    """

    regular: tuple[float, float]
    scatter: float
    rate: float
    near: float
    lost: float
    late: float


class StalePriors(PriorTable):
    """Assumptions on samples that repeat the previous sample instead of a new reading.

    The time for which a channel repeats its samples is estimated from runs of equal values:

    - `runs`: fewest runs.
    - `spread`: largest relative deviation of a run's duration from the median.
    - `share`: fraction of the runs that must be within this deviation.
    - `shortest` [s]: shortest time that matters.

    Repeated rows and stuck channels:

    - `repeats`: smallest ratio of the number of repeated rows to that expected by chance.
    - `fewest`: smallest fraction of all rows that is assumed to repeat by chance.
    - `moves`: smallest range over a run that counts as motion, as a fraction of the channel's range.
    - `leap`: quantile of a channel's changes that a jump exceeds.
    - `stuck`: largest fraction of stuck samples in a pressure that is used.
    """

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
    """Assumptions on spikes, i.e. single samples that leap and return at once.

    - `times`: smallest ratio of a spike to the changes around it.
    - `share`: largest fraction of samples that a logger gets wrong, on average.
    - `tail`: smallest probability of as many errors as spikes; below it, the spikes are a signal.
    """

    times: float
    share: float
    tail: float


class UnsignedPriors(PriorTable):
    """Assumptions on a motor speed or flow that is recorded without its sign.

    - `noise`: largest magnitude on the other side of zero, relative to the largest magnitude.
    - `half` [s]: time on either side of a sample over which the piston speed is taken.
    - `nearby` [s]: time on either side of a sample over which noise is averaged.
    - `error`: relative error of the flow computed from the position.
    - `changes` [1/s]: usual number of reversals per second.
    - `least`: smallest ratio of the motion in the less used direction to that in the other.
    - `correlation`: smallest correlation of the magnitude with the absolute piston speed or command.
    - `unlike`: smallest logarithm of the ratio of flow over speed in one direction to that in the other, i.e. of the
      areas of a single rod.
    - `passes`: smallest flow at rest, over the mean flow in motion, that shows a meter in a valve's supply line.
    - `rests`: largest speed at rest, over the mean speed in motion.
    """

    noise: float
    half: float
    nearby: float
    error: float
    changes: float
    least: float
    correlation: float
    unlike: float
    passes: float
    rests: float


class HumPriors(PriorTable):
    """Assumptions on hum of the electric mains in a channel.

    - `lowest` [Hz]: frequency from which the power of the channel is counted.
    - `loud`: fraction of this power from which hum is a warning.
    - `alone`: fraction of this power from which the sensor may be disconnected.
    - `around` [Hz]: the spectrum up to this distance from a line of hum is its background.
    - `over_rest`, `over_median`: smallest ratios of the line to the largest and to the median background amplitude.
    - `shortest` [s]: shortest channel that is searched for hum.
    """

    loud: float
    alone: float
    lowest: float
    around: float
    over_rest: float
    over_median: float
    shortest: float


class CreepPriors(PriorTable):
    """Assumptions on a steady drift of the mean chamber pressure.

    - `rate` [Pa/s]: smallest drift that is reported.
    - `seconds` [s]: shortest recording in which it is searched for.
    - `parts`: number of parts of the recording whose mean pressures are compared.
    - `even`: smallest and largest step from part to part, over the median step.
    """

    rate: float
    seconds: float
    parts: int
    even: tuple[float, float]


class RailPriors(PriorTable):
    """Marks of a rail, i.e. an end of its range at which a pressure is clipped.

    - `samples` [samples]: fewest samples at the rail.
    - `crowd`: smallest ratio of these samples to those at any of the values next to it.
    - `jump` [quantisation steps]: smallest jump to or from it.
    - `run` [samples]: length of a run from which a smaller jump suffices.
    - `long_jump` [quantisation steps]: smallest jump to or from such a long run.
    """

    samples: int
    crowd: float
    jump: float
    run: int
    long_jump: float


class HoldPriors(PriorTable):
    """Lengths beyond which a run of equal samples of a pressure is not a reading; the run must exceed both.

    - `seconds` [s]: time.
    - `samples` [samples]: number of samples.
    """

    seconds: float
    samples: int


class ReadingPriors(PriorTable):
    """Limits beyond which pressures and speeds cannot come from one hydraulic machine.

    - `noise` [share of the variance]: white noise in a pressure, above which the pressure is taken for mere noise.
    - `pressure` [Pa]: pressures that stay below it are in another unit.

    The motor speed is compared with the rate of the motor angle:

    - `rate` [Hz]: both are averaged to this rate.
    - `samples` [samples]: fewest samples for the comparison.
    - `correlation`: smallest correlation of the two.
    - `misfit`: ratio of the two above which a unit is wrong.
    """

    noise: float
    rate: float
    samples: int
    correlation: float
    pressure: float
    misfit: float


class OilRange(PriorTable):
    """Range of temperatures that hydraulic oil can have.

    - `coldest`, `hottest` [K]: limits of the range.
    """

    coldest: float
    hottest: float


class CyclePriors(PriorTable):
    """Assumptions on the duty cycle of a machine.

    - `longest` [s]: longest period.
    - `correlation`: smallest autocorrelation at a lag of one period.
    - `rate` [Hz]: rate to which the signal is averaged before it is analysed.
    """

    longest: float
    correlation: float
    rate: float


class GapPriors(PriorTable):
    """Assumptions on gaps in a recording.

    - `motion` [s]: longest gap that is interpolated by a line in positions, angles, speeds and flows.
    - `hole` [s]: length above which a filled gap has less weight in the diagnosis.
    - `live_zero`: smallest distance below zero at which a sensor of 4 to 20 mA reads without a supply, over its range.
    - `dead`: largest variation of such a reading, over its distance from all other readings.
    """

    motion: float
    live_zero: float
    dead: float
    hole: float


class RecordingPriors(PriorTable):
    """All tables of `recordings/priors.toml`, the assumptions on loggers, sensors and machines.

    The table `possible` maps an SI unit, "any" for all others, to the largest magnitude that any sensor reads in it.
    """

    clock: ClockPriors
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
    possible: Mapping[str, float]


RECORDINGS = read_priors("sealscope.recordings", RecordingPriors)
