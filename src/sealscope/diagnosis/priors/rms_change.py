"""Typed tables of `rms_change/priors.toml`: assumptions on the RMS of wavelet details of healthy machines."""

from sealscope.storage.toml_file import PriorTable, read_priors


class WalkPriors(PriorTable):
    """Random walk of the logarithm of the RMS within a recording and between recordings."""

    # half-Cauchy scales of its change in the time `time` [1 in 90 s]
    machine: float  # of the machine's ringing
    noise: float  # of the noise
    duty: float  # of the ringing in a duty that does not repeat
    tried: int  # number of rates of the walk between recordings that are tried
    time: float  # [s] time for which the scales are stated
    least: float  # smallest fraction of a wavelet detail's energy that is due to the machine


class DutyExponents(PriorTable):
    """Prior standard deviations of the exponents with which the RMS of a wavelet detail grows with motion and load."""

    command: float  # exponent of the RMS of the command
    rate: float  # exponent of the RMS of the command's rate of change
    load: float  # exponent of the RMS of the pressure difference
    direction: float  # factor of the mean pressure difference over its RMS, in the logarithm of the detail's RMS


class LevelScatter(PriorTable):
    """Scatter of the logarithm of the RMS between recordings."""

    scatter: float  # standard deviation between recordings of one session
    session: float  # standard deviation between sessions
    pause: float  # [s] time without a recording that separates sessions
    error: float  # standard error of a recording's value
    freedom: float  # degrees of freedom of the prior on the scatter
    worth: float  # change of the logarithm that must not remain undetected for the verdict "no leak"


class RmsBlockPriors(PriorTable):
    """Division of a recording into blocks."""

    # a block is as long as the longer of these, before it is adapted to the cycle of the duty and to `most`
    seconds: float  # [s]
    samples: int  # number of samples
    most: int  # largest number of blocks
    fewest: int  # smallest number of blocks in which a change is looked for
    settling: float  # [s] time in which pressures and speed settle after a start
    settling_cycles: float  # the same in cycles of the duty
    standstill: float  # RMS of the command, its rate and the load at standstill, over that of the whole recording


class RingingRates(PriorTable):
    """Lowest sampling rates [Hz] at which a recording contains the ringing, an oscillation of the pressures."""

    ringing: float  # for the oscillation of the piston's mass on the oil
    slowest: float  # for the oscillation of the oil in a hydraulic line; lower rates are not used


class RmsChangePriors(PriorTable):
    """All tables of `rms_change/priors.toml`, the assumptions on the RMS of the pressures' wavelet details."""

    walk: WalkPriors
    duty: DutyExponents
    recordings: LevelScatter
    blocks: RmsBlockPriors
    rate: RingingRates


RMS_PRIORS = read_priors("sealscope.diagnosis.rms_change", RmsChangePriors)
