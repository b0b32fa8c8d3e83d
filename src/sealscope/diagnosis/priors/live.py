"""Typed tables of `live/priors.toml`: assumptions on a running machine."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SampleClock(PriorTable):
    """Clock of the samples of a running machine.

    - `follows`: smallest and largest step between successive samples, over the sampling interval.
    - `rate`: relative error of a stated sampling rate.
    """

    follows: tuple[float, ...]
    rate: float


class LiveBlocks(PriorTable):
    """Blocks that the samples of a running machine are divided into.

    - `seconds` [s]: length of a block.
    - `learned` [blocks]: number of blocks before the first estimate.
    - `tells`: smallest precision of a block at standstill, over that of a usual block, with which it counts.
    - `standstill`: mean square of the motion, over the usual one, below which a machine stands still.
    - `wakes` [blocks]: number of blocks with far more motion than ever before from which the machine is learned anew.
    """

    seconds: float
    learned: int
    tells: float
    standstill: float
    wakes: int


class CoefficientMemory(PriorTable):
    """Memory of the estimated coefficients.

    - `memory` [blocks]: time after which a block counts for 1/e.
    - `returns` [blocks]: time in which the series of estimates returns to the level that the coefficients give.
    - `jump`: standard deviations beyond which a residual is a glitch or a step.
    """

    memory: float
    returns: float
    jump: float


class StepPriors(PriorTable):
    """A step of the leak within the stream of blocks.

    - `walks`: variances of a healthy machine's random walk in a block, over that of a block's estimate, each equally
      likely.
    - `sizes`: variances of the step, over that of a block's estimate, each equally likely.
    - `parts`: fractions of the first block in which the leak is open, each equally likely.
    - `changes`: probability per block that the random walk changes its size.
    - `memory`: factor per block on the weight of earlier blocks for noise and random walk.
    - `recent` [blocks]: time for which all onsets are kept.
    - `horizon` [blocks]: largest age of an onset.
    - `stated` [blocks]: number of blocks that the stated variance of an estimate counts for.
    """

    walks: tuple[float, ...]
    sizes: tuple[float, ...]
    parts: tuple[float, ...]
    changes: float
    memory: float
    recent: int
    horizon: int
    stated: float


class WatchPriors(PriorTable):
    """Comparison of a running machine with its baseline.

    - `pause` [s]: longest pause across which blocks are compared.
    - `margin`: logarithm by which pressure and flow may lie outside the range of the baseline.
    - `damped`: logarithm by which a leak may lower the pressure difference.
    - `inside`: smallest fraction of a leak, seen by the pressures, that is inside the actuator.
    - `group` [blocks]: number of blocks in a mean that is compared with the baseline.
    - `recent` [blocks]: number of blocks in the mean that is stated as the present leak.
    - `step`: fraction of the false alarms for the test for a step.
    - `level`: fraction of the false alarms for the test against the baseline.
    """

    pause: float
    margin: float
    damped: float
    inside: float
    group: int
    recent: int
    step: float
    level: float


class RiseExplanationPriors(PriorTable):
    """Explanation of an increase of the leakage by the blocks around it.

    - `window` [blocks]: number of blocks that are stored.
    - `shows` [blocks]: number of blocks since the onset before an explanation is looked for.
    - `rare`: largest chance with which a change shows in the blocks.
    - `start` [blocks]: time after a pause within which an increase is due to the start.
    - `settles` [blocks]: number of blocks since the onset after which the explanation is final.
    """

    window: int
    shows: int
    rare: float
    start: int
    settles: int


class LiveResponse(PriorTable):
    """Fit of the pressure response to a running machine.

    - `seconds` [s]: length of a block.
    - `begins` [s]: length of the first fit.
    - `settling`, `resuming` [blocks]: time until the simulated states have settled, at first and after a gap.
    - `described`: standard deviations of a block's chi square beyond which the model does not describe it.
    - `lost` [blocks]: number of successive blocks that are not described after which the fit is started anew.
    - `usual` [blocks]: time over which the usual variance is averaged.
    """

    seconds: float
    begins: float
    settling: int
    resuming: int
    described: float
    lost: int
    usual: int


class LivePriors(PriorTable):
    """The tables of `live/priors.toml`."""

    samples: SampleClock
    block: LiveBlocks
    coefficients: CoefficientMemory
    step: StepPriors
    explanation: RiseExplanationPriors
    watch: WatchPriors
    response: LiveResponse


LIVE = read_priors("sealscope.diagnosis.live", LivePriors)
