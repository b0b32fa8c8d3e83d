"""Typed tables of `live/priors.toml`: assumptions on a running machine."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SampleClock(PriorTable):
    """Clock of the samples of a running machine.

    - `follows`: smallest and largest time between successive samples, over the sampling interval. Nearer samples are
      copies, farther ones have a gap between them.
    - `rate`: relative error of a stated sampling rate.
    """

    follows: tuple[float, ...]
    rate: float


class LiveBlocks(PriorTable):
    """Blocks that the samples of a running machine are divided into.

    - `seconds` [s]: length of a block.
    - `learned` [blocks]: number of blocks before the first estimate.
    - `tells`: a block at standstill is used if the precision of its estimate of the leak is at least this fraction of a
      usual block's precision.
    - `standstill`: a machine stands still if the mean square of its motion is below this fraction of the usual one.
    - `wakes` [blocks]: the machine is learned anew after this number of blocks with far more motion than ever before.
    """

    seconds: float
    learned: int
    tells: float
    standstill: float
    wakes: int


class CoefficientMemory(PriorTable):
    """Memory of the estimated coefficients of a volume balance.

    - `memory` [blocks]: age at which a block has the weight 1/e.
    - `returns` [blocks]: time constant with which the series of leakage estimates returns to the level given by the
      present coefficients.
    - `jump`: standard deviations beyond which a residual is a glitch or a step.
    """

    memory: float
    returns: float
    jump: float


class StepPriors(PriorTable):
    """A step of the leak within the stream of blocks, and the random walk of a healthy machine's leakage.

    Variances are divided by the variance of a block's estimate.

    - `walks`: variances of the random walk in one block, each equally likely.
    - `sizes`: variances of the step, each equally likely.
    - `parts`: fractions of the first block in which the leak is open, each equally likely.
    - `changes`: probability per block that the random walk changes its size.
    - `memory`: factor per block by which earlier blocks lose weight in the estimates of noise and random walk.
    - `recent` [blocks]: age up to which all possible onsets are kept; of older ones only some are.
    - `horizon` [blocks]: largest age of an onset.
    - `stated` [blocks]: the variance that an estimate states weighs as much as that observed in so many blocks.
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
    - `inside`: smallest fraction of a leak, as estimated from the pressures, that flows past the piston.
    - `group` [blocks]: number of blocks whose mean is compared with the baseline.
    - `recent` [blocks]: number of blocks whose mean is stated as the present leak.
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
    """Search for the cause of an increase of the leakage in the blocks around it.

    - `window` [blocks]: number of blocks that are stored.
    - `shows` [blocks]: number of blocks since the onset before a cause is looked for.
    - `rare`: largest p-value (probability in a healthy machine) of a change that shows in the blocks.
    - `start` [blocks]: time after a pause within which an increase is due to the start of the machine.
    - `settles` [blocks]: number of blocks since the onset after which the explanation is final.
    """

    window: int
    shows: int
    rare: float
    start: int
    settles: int


class LiveResponse(PriorTable):
    """Fit of a model of the pressure response to a running machine.

    - `seconds` [s]: length of a block.
    - `begins` [s]: length of the first fit.
    - `settling`, `resuming` [blocks]: time until the simulated states have settled, after the start and after a gap.
    - `described`: the model describes a block if its chi square exceeds its mean by fewer standard deviations.
    - `lost` [blocks]: the fit starts anew after this number of successive blocks that the model does not describe.
    - `usual` [blocks]: time over which the usual variance of the residuals is averaged.
    """

    seconds: float
    begins: float
    settling: int
    resuming: int
    described: float
    lost: int
    usual: int


class LivePriors(PriorTable):
    """All tables of `live/priors.toml`, the assumptions on a running machine."""

    samples: SampleClock
    block: LiveBlocks
    coefficients: CoefficientMemory
    step: StepPriors
    explanation: RiseExplanationPriors
    watch: WatchPriors
    response: LiveResponse


LIVE = read_priors("sealscope.diagnosis.live", LivePriors)
