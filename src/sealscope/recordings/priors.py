"""Typed tables of `recordings/priors.toml`: what is assumed of loggers, sensors and machines before an inspection."""

from collections.abc import Mapping

from sealscope.storage.toml_file import PriorTable, read_priors


class ClockPriors(PriorTable):
    """Assumptions on the clock of a data logger.

    `scatter` [sampling steps]: standard deviation of the intervals above which sampling is irregular; `rate`: largest
    relative error of the stated rate; `near` [usual intervals]: longest interval in which no sample is missing;
    `lost`: largest fraction of lost samples in one recording; `late`: largest fraction of samples with a time before
    an earlier one.
    """

    scatter: float
    rate: float
    near: float
    lost: float
    late: float


class StalePriors(PriorTable):
    """Assumptions on samples that repeat the previous sample.

    To estimate the time for which a channel repeats its samples: `runs`: fewest runs of equal values; `spread`:
    largest relative deviation of a run's duration from the median; `share`: fraction of the runs that must be within
    it; `shortest` [s]: shortest time that matters. Rows are repeated if they are `repeats` times as many as expected
    by chance, which is at least the fraction `fewest` of all rows. `moves`: smallest range over a run that counts as
    motion, as a fraction of the channel's range; `leap`: quantile of a channel's changes that a jump exceeds;
    `stuck`: largest fraction of stuck samples in a pressure that is used.
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
    """Assumptions on spikes, samples that leap and return at once; both fields are dimensionless.

    `times`: smallest ratio of a spike to the changes around it; `share`: largest fraction of spikes in a channel.
    """

    times: float
    share: float


class UnsignedPriors(PriorTable):
    """Assumptions on a motor speed that is recorded without its sign.

    `noise`: largest speed of the other sign, relative to the largest speed; `half` [s]: time on either side of a
    sample over which the piston speed is taken; `nearby` [s]: time on either side over which noise is averaged;
    `error`: relative error of the flow computed from the position; `changes` [1/s]: usual number of reversals per
    second; `least`: smallest ratio of the motions in the two directions; `correlation`: smallest correlation of speed
    and motion.
    """

    noise: float
    half: float
    nearby: float
    error: float
    changes: float
    least: float
    correlation: float


class HumPriors(PriorTable):
    """Assumptions on hum of the mains in a channel.

    `lowest` [Hz]: frequency from which the power of the channel is counted; `loud`: fraction of this power from which
    hum is a warning; `alone`: fraction from which the sensor may be disconnected; `around` [Hz]: distance on either
    side of a line over which the spectrum is its background; `over_rest`, `over_median`: smallest ratios of a line to
    the largest and to the median amplitude of the background.
    """

    loud: float
    alone: float
    lowest: float
    around: float
    over_rest: float
    over_median: float


class CreepPriors(PriorTable):
    """Assumptions on a mean chamber pressure that drifts steadily.

    `rate` [Pa/s]: smallest drift that is reported; `seconds` [s]: shortest recording in which it is searched for.
    """

    rate: float
    seconds: float


class HoldPriors(PriorTable):
    """Lengths beyond which equal samples of a pressure are no reading: both `seconds` [s] and `samples` [samples]."""

    seconds: float
    samples: int


class ReadingPriors(PriorTable):
    """Assumptions on pressures and speeds that come from one machine.

    `noise` [share of the variance]: white noise above which a pressure contains nothing else. The motor speed is
    compared with the rate of the motor angle, both averaged to `rate` [Hz], if there are `samples` [samples] or more:
    `correlation`: smallest correlation of the two; `misfit`: ratio of the two above which a unit is wrong.
    """

    noise: float
    rate: float
    samples: int
    correlation: float
    misfit: float


class OilRange(PriorTable):
    """Range of temperatures that oil can have, from `coldest` [K] to `hottest` [K]."""

    coldest: float
    hottest: float


class CyclePriors(PriorTable):
    """Assumptions on the duty cycle of a machine.

    `longest` [s]: longest period; `correlation`: smallest autocorrelation at a lag of one period; `rate` [Hz]: rate
    to which the signal is averaged before it is analysed.
    """

    longest: float
    correlation: float
    rate: float


class GapPriors(PriorTable):
    """Assumptions on gaps in a recording.

    `motion` [s]: longest gap that is interpolated by a line in positions, angles, speeds and flows; `hole` [s]:
    length above which a bridged gap has less weight in the diagnosis.
    """

    motion: float
    hole: float


class RecordingPriors(PriorTable):
    """All tables of `recordings/priors.toml`.

    `possible`: SI unit -> largest magnitude that any sensor reads in it; "any" stands for all other units.
    """

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
