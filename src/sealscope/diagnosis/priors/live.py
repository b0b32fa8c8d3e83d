"""Typed tables of `live/priors.toml`: assumptions on a running machine."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SampleClock(PriorTable):
    """Clock of the samples of a running machine."""

    # (low, high): time between successive samples, over the sampling interval; below it is a copy, above it a gap
    follows: tuple[float, ...]
    rate: float  # relative error of a stated sampling rate


class LiveBlocks(PriorTable):
    """Division of the samples of a running machine into blocks."""

    seconds: float  # [s] length of a block
    learned: int  # number of blocks before the first estimate
    rest_precision: float  # smallest precision of a block at standstill that is used, over that of a usual block
    standstill: float  # a machine stands still if the mean square of its motion is below this fraction of the usual one
    waking_blocks: int  # the machine is learned anew after this number of blocks with far more motion than ever before


class CoefficientMemory(PriorTable):
    """Memory of the estimated coefficients of a volume balance, in blocks."""

    memory: float  # age at which a block has the weight 1/e
    returns: float  # time constant of the return of the leakage estimates to the present coefficients
    jump: float  # standard deviations beyond which a residual is a glitch or a step


class StepPriors(PriorTable):
    """A step of the leak within the stream of blocks, and the random walk of a healthy machine's leakage.

    Variances are divided by the variance of a block's estimate.
    """

    walks: tuple[float, ...]  # variances of the random walk in one block, each equally likely
    sizes: tuple[float, ...]  # variances of the step, each equally likely
    parts: tuple[float, ...]  # fractions of the first block in which the leak is open, each equally likely
    changes: float  # probability per block that the random walk changes its size
    memory: float  # factor per block by which earlier blocks lose weight in the estimates of noise and random walk
    recent: int  # [blocks] age up to which all possible onsets are kept; of older ones only some are
    horizon: int  # [blocks] largest age of an onset
    stated: float  # [blocks] number whose observed variance weighs as much as the variance that an estimate states
    windows: int  # number of windows of blocks from which on they raise the threshold of the evidence


class WatchPriors(PriorTable):
    """Comparison of the blocks of a running machine with its baseline."""

    pause: float  # [s] longest pause across which blocks are compared
    margin: float  # pressure and flow may exceed the range of the baseline by this logarithm
    damped: float  # the pressure may fall below the range by this logarithm, as a leak lowers it
    # least, usual and largest ratio of what a leak to the outside loses to what the volume balance shows of it
    outside: tuple[float, float, float]
    law: float  # relative standard deviation of a leak's flow by the volume balance, as its law is unknown
    group: int  # number of blocks whose mean is compared with the baseline
    recent: int  # number of blocks whose mean is stated as the present leak
    step: float  # fraction of the false alarms for the test for a step
    level: float  # fraction of the false alarms for the test against the baseline


class StreamRecordingPriors(PriorTable):
    """Recordings into which a stream is cut, to be judged as a whole."""

    gap: float  # [s] longest gap within a recording
    lengths: tuple[float, float]  # [s] shortest recording that is judged, and longest that may be asked for
    share: float  # fraction of the false alarms for the recordings; the blocks of the stream get the others


class RiseExplanationPriors(PriorTable):
    """Search for the cause of an increase of the leakage in the blocks around it."""

    window: int  # number of blocks that are stored
    fewest_blocks: int  # number of blocks since the onset before a cause is looked for
    rare: float  # largest p-value (probability in a healthy machine) of a change that shows in the blocks
    start: int  # [blocks] time after a pause within which an increase is due to the start of the machine
    settles: int  # number of blocks since the onset after which the explanation is final
    outside: int  # [blocks] number since the onset after which a leak may turn out to be one to the outside


class LivePriors(PriorTable):
    """All tables of `live/priors.toml`, the assumptions on a running machine."""

    samples: SampleClock
    block: LiveBlocks
    coefficients: CoefficientMemory
    step: StepPriors
    explanation: RiseExplanationPriors
    watch: WatchPriors
    recording: StreamRecordingPriors


LIVE = read_priors("sealscope.diagnosis.live", LivePriors)
