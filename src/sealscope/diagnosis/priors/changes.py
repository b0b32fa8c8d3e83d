"""Typed tables of `inference/changes/priors.toml`: assumptions on signals that a leak does not change."""

from sealscope.diagnosis.priors.inference import StepSize
from sealscope.storage.toml_file import PriorTable, read_priors


class SignalPriors(PriorTable):
    """Features of the signals, such as their noise and hum, and their change in a healthy machine."""

    blocks: int  # most blocks that a recording is divided into
    order: int  # number of successive differences of a signal, which leave its noise and remove motion and ringing
    mains: tuple[float, ...]  # [Hz] frequencies of the electric grids
    highest: float  # highest frequency at which hum is looked for, over the sampling rate
    neighbours: tuple[float, ...]  # [spectral bins] distances of the lines with which a line of hum is compared
    shortest: float  # [s] shortest block
    busy: float  # a block counts as in motion if it moves for at least this fraction of the time of the busiest block
    wander: float  # scale of the slow change of a feature's logarithm within a recording, even or as a random walk


class PressureLevelPriors(PriorTable):
    """Blocks in which the mean pressures during forward and backward motion are compared."""

    blocks: tuple[int, ...]  # numbers of blocks that a recording may be divided into, tried from the largest on
    least: float  # smallest fraction of a block's time that the machine must move in each direction
    slowest: float  # lowest speed that counts as motion, over the highest speed
    freedom: float  # degrees of freedom of the t distribution of the differences between blocks


class HealthyLevelPriors(PriorTable):
    """Friction of a recording and drift of its pressure sensors, in the comparison with healthy recordings."""

    slowest: float  # lowest speed that counts as motion, over the mean speed in motion, sum(v^2) / sum(abs(v))
    friction_error: float  # standard error of the logarithm of a recording's friction
    friction_scatter: float  # standard deviation of this logarithm between days
    recordings: float  # the prior on the scatter weighs as much as this number of recordings
    drift: float  # [Pa] drift of a pressure sensor's zero within a recording, a standard deviation between days
    drift_recordings: float  # the prior on this scatter weighs as much as this number of recordings
    drift_inflation: float  # largest factor by which the standard errors of the drifts may be too small


class OctavePriors(PriorTable):
    """Ratio of the spectra of two channels, such as p_A and p_B, in octaves, compared with healthy recordings."""

    # [Hz] limits of the frequencies that are compared
    lowest: float
    highest: float
    share: float  # further upper limit of these frequencies, over the sampling rate
    busy: float  # quantile of the windows' powers that represents the recording; the machine may often rest
    seconds: float  # [s] length of a window, of which a spectrum is computed
    error: float  # standard error of the logarithm of the ratio in one recording
    scatter: float  # standard deviation of this logarithm between days
    recordings: float  # the prior on the scatter weighs as much as this number of recordings
    neighbours: float  # number of octaves over which the correlation of the scatter falls by the factor e


class PhasePriors(PriorTable):
    """Phase [rad] between two channels, such as p_A and p_B, in octaves, compared with healthy recordings."""

    error: float  # [rad] standard error of the phase that a filter of known cut-off frequency causes in an octave
    scatter: float  # [rad] standard deviation of the phase between days
    recordings: float  # the prior on the scatter weighs as much as this number of recordings
    uniform: float  # fraction of the phases that may have any value and therefore say nothing


class FilteredPriors(PriorTable):
    """Low-pass filter of one pressure, such as a clogged line of its sensor."""

    # [Hz] limits of the cut-off frequency
    lowest: float
    highest: float
    # the sensor's white noise, which is not filtered, is tried at these fractions of the lowest power per frequency
    noises: tuple[float, ...]


class ChargePriors(PriorTable):
    """Drift of the charge pressure, seen in the lowest pressures of the chambers."""

    share: float  # smallest fraction of the samples in which a chamber fed at the charge pressure is low
    band: float  # [Pa] a pressure is low if it exceeds the chamber's lowest pressure by at most this difference
    range: float  # largest change by a drift over the recording, over `band`
    seconds: float  # [s] time over which pressures are averaged
    steady: float  # [Pa/s] a low pressure that changes faster is not the charge pressure
    scatter: float  # [Pa/s] standard deviation of the drift between days
    recordings: float  # the prior on the scatter weighs as much as this number of recordings
    deflation: float  # largest factor by which the standard errors of the drifts may be too large
    unlike: float  # fraction of the recordings in which the charge pressure changes for another cause


class ChangePriors(PriorTable):
    """All tables of `inference/changes/priors.toml`, the assumptions on signals that a leak does not change.

    The last three are log-normal priors: `accumulator` on the gas volume of the accumulator over the exponent of its
    expansion [m^3], `charge_fall` on the fall of the charge pressure by an external leak [Pa/s], and `zero_drift` on
    the drift of the zero of a failing pressure sensor [Pa/s].
    """

    features: SignalPriors
    levels: PressureLevelPriors
    healthy: HealthyLevelPriors
    octaves: OctavePriors
    phases: PhasePriors
    filtered: FilteredPriors
    charge: ChargePriors
    accumulator: StepSize
    charge_fall: StepSize
    zero_drift: StepSize


CHANGES = read_priors("sealscope.diagnosis.inference.changes", ChangePriors)
