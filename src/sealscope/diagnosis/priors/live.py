"""Typed tables of `live/priors.toml`: priors on a running machine."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SampleClock(PriorTable):
    """Clock of a stream's samples."""

    follows: tuple[float, ...]
    rate: float


class LiveBlocks(PriorTable):
    """Blocks of a stream: `seconds` [s]; `learned`, `wakes` [blocks]."""

    seconds: float
    learned: int
    tells: float
    standstill: float
    wakes: int


class CoefficientMemory(PriorTable):
    """Memory of the coefficients: `memory`, `returns` [blocks]."""

    memory: float
    returns: float
    jump: float


class StepPriors(PriorTable):
    """Step of a leak within a stream: `recent`, `horizon`, `stated` [blocks]."""

    walks: tuple[float, ...]
    sizes: tuple[float, ...]
    parts: tuple[float, ...]
    changes: float
    memory: float
    recent: int
    horizon: int
    stated: float


class WatchPriors(PriorTable):
    """Comparison with the baseline: `pause` [s]; `group`, `recent` [blocks]."""

    pause: float
    margin: float
    damped: float
    inside: float
    group: int
    recent: int
    step: float
    level: float


class RiseExplanationPriors(PriorTable):
    """Explanation of a rise: `window`, `shows`, `start`, `settles` [blocks]."""

    window: int
    shows: int
    rare: float
    start: int
    settles: int


class LiveResponse(PriorTable):
    """Response of the pressures: `seconds`, `begins` [s]; `settling`, `resuming`, `lost`, `usual` [blocks]."""

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
