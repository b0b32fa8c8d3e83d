"""Typed tables of `rms_change/priors.toml`: priors on the RMS of the details of healthy machines."""

from sealscope.storage.toml_file import PriorTable, read_priors


class WalkPriors(PriorTable):
    """Walk of the levels: scales of half-Cauchy laws, gained in `time` [s]: `machine`, `noise`, `duty` [1 in 90 s]."""

    machine: float
    noise: float
    duty: float
    tried: int
    time: float
    least: float


class DutyExponents(PriorTable):
    """Exponents by which a detail's RMS goes with the duty (standard deviation)."""

    command: float
    rate: float
    load: float
    direction: float


class LevelScatter(PriorTable):
    """Scatter of the levels from recording to recording (logarithms): `pause` [s]; the others are numbers."""

    scatter: float
    session: float
    pause: float
    error: float
    freedom: float
    worth: float


class RmsBlockPriors(PriorTable):
    """Blocks of a recording: `seconds`, `settling` [s]; the others are numbers."""

    seconds: float
    samples: int
    most: int
    fewest: int
    settling: float
    settling_cycles: float
    standstill: float


class RingingRates(PriorTable):
    """Sampling rates that show the ringing: `ringing`, `slowest` [Hz]."""

    ringing: float
    slowest: float


class RmsChangePriors(PriorTable):
    """The tables of `rms_change/priors.toml`."""

    walk: WalkPriors
    duty: DutyExponents
    recordings: LevelScatter
    blocks: RmsBlockPriors
    rate: RingingRates


RMS_PRIORS = read_priors("sealscope.diagnosis.rms_change", RmsChangePriors)
