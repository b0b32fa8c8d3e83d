"""Typed tables of `rms_change/priors.toml`: priors on the RMS of the details of healthy machines."""

from sealscope.storage.toml_file import PriorTable, read_priors


class WalkPriors(PriorTable):
    """Random walk of the log RMS levels over time.

    `machine`, `noise`, `duty`: half-Cauchy scales of the deviation gained in `time` [s], [1 in 90 s]; `tried`: number
    of rates tried; `least`: smallest fraction of a level that is due to the machine.
    """

    machine: float
    noise: float
    duty: float
    tried: int
    time: float
    least: float


class DutyExponents(PriorTable):
    """Prior standard deviations of the exponents in the power law of a detail's RMS over the duty."""

    command: float
    rate: float
    load: float
    direction: float


class LevelScatter(PriorTable):
    """Scatter of the log RMS from recording to recording; `pause` [s], the other fields have no unit."""

    scatter: float
    session: float
    pause: float
    error: float
    freedom: float
    worth: float


class RmsBlockPriors(PriorTable):
    """Blocks of a recording; `seconds`, `settling` [s], the other fields have no unit."""

    seconds: float
    samples: int
    most: int
    fewest: int
    settling: float
    settling_cycles: float
    standstill: float


class RingingRates(PriorTable):
    """Lowest sampling rates [Hz] at which the machine's and a hydraulic line's ringing are recorded."""

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
