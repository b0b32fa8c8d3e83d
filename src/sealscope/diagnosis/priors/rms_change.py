"""Typed tables of `rms_change/priors.toml`: assumptions on the RMS of wavelet details of healthy machines."""

from sealscope.storage.toml_file import PriorTable, read_priors


class WalkPriors(PriorTable):
    """Random walk of the logarithm of the RMS over time.

    - `machine`, `noise`, `duty` [1 in 90 s]: half-Cauchy scales of the standard deviation of its change in `time`. They
      are the parts due to the machine, to noise and to a duty (motion and load) that does not repeat.
    - `tried`: number of rates of the walk between recordings that are tried.
    - `time` [s]: time for which the scales are stated.
    - `least`: smallest fraction of a wavelet detail's energy that is due to the machine.
    """

    machine: float
    noise: float
    duty: float
    tried: int
    time: float
    least: float


class DutyExponents(PriorTable):
    """Exponents of power laws for the RMS of a wavelet detail over the duty (how the machine is moved and loaded).

    Each field is a prior standard deviation of the exponent of one quantity.

    - `command`: RMS of the command.
    - `rate`: RMS of the command's rate of change.
    - `load`: RMS of the pressure difference.
    - `direction`: mean pressure difference over its RMS.
    """

    command: float
    rate: float
    load: float
    direction: float


class LevelScatter(PriorTable):
    """Scatter of the logarithm of the RMS between recordings.

    - `scatter`: standard deviation between recordings of one session.
    - `session`: standard deviation between sessions.
    - `pause` [s]: time without a recording that separates sessions.
    - `error`: standard error of a recording.
    - `freedom`: degrees of freedom of the prior on the scatter.
    - `worth`: size of a change that is worth finding.
    """

    scatter: float
    session: float
    pause: float
    error: float
    freedom: float
    worth: float


class RmsBlockPriors(PriorTable):
    """Division of a recording into blocks.

    - `seconds` [s]: shortest block.
    - `samples`: fewest samples of a block.
    - `most`: largest number of blocks.
    - `fewest`: smallest number of blocks in which a change is looked for.
    - `settling` [s]: time in which pressures and speed settle after a start.
    - `settling_cycles`: the same in cycles of the duty.
    - `standstill`: RMS of a command at standstill over that of the whole recording.
    """

    seconds: float
    samples: int
    most: int
    fewest: int
    settling: float
    settling_cycles: float
    standstill: float


class RingingRates(PriorTable):
    """Lowest sampling rates at which a recording contains the ringing, an oscillation of the pressures.

    - `ringing` [Hz]: for the oscillation of the piston's mass on the oil.
    - `slowest` [Hz]: for the oscillation of the oil in a hydraulic line; lower rates are not used.
    """

    ringing: float
    slowest: float


class RmsChangePriors(PriorTable):
    """All tables of `rms_change/priors.toml`, the assumptions on the RMS of the pressures' wavelet details."""

    walk: WalkPriors
    duty: DutyExponents
    recordings: LevelScatter
    blocks: RmsBlockPriors
    rate: RingingRates


RMS_PRIORS = read_priors("sealscope.diagnosis.rms_change", RmsChangePriors)
