"""Typed tables of `inference/changes/priors.toml`: assumptions on signals that a leak does not change."""

from sealscope.diagnosis.priors.inference import StepSize
from sealscope.storage.toml_file import PriorTable, read_priors


class SignalPriors(PriorTable):
    """Features of the signals, such as noise and hum, and how much they change in a healthy machine.

    - `blocks`: most blocks that a recording is divided into.
    - `order`: number of successive differences of a signal, which leave its noise and remove motion and ringing.
    - `mains` [Hz]: frequencies of the electric grids.
    - `highest`: highest frequency at which hum is looked for, over the sampling rate.
    - `neighbours` [bins]: a spectral line of hum is compared with the lines at these distances from it.
    - `shortest` [s]: shortest block.
    - `busy`: a block counts as in motion if it moves for at least this fraction of the time of the busiest block.
    - `wander`: change of the logarithm of a feature within a recording, a standard deviation.
    """

    blocks: int
    order: int
    mains: tuple[float, ...]
    highest: float
    neighbours: tuple[float, ...]
    shortest: float
    busy: float
    wander: float


class PressureLevelPriors(PriorTable):
    """Blocks in which the mean pressures during forward and backward motion are compared.

    - `blocks`: numbers of blocks that a recording may be divided into, tried from the largest on.
    - `least`: smallest fraction of a block's time that the machine must move in each direction.
    - `slowest`: lowest speed that counts as motion, over the highest one.
    """

    blocks: tuple[int, ...]
    least: float
    slowest: float


class HealthyLevelPriors(PriorTable):
    """Friction of a recording and drift of its pressures, in the comparison with healthy recordings.

    - `slowest`: lowest speed that counts as motion, over the mean speed in motion, sum(v^2) / sum(abs(v)).
    - `friction_error`: standard error of the logarithm of a recording's friction.
    - `friction_scatter`: standard deviation of this logarithm between days.
    - `recordings`: the prior on the scatter weighs as much as this number of recordings.
    - `load_seconds` [s]: time in which the load of a machine at work changes.
    - `drift` [Pa]: standard deviation of the drift of a pressure sensor's zero within a recording.
    - `drift_recordings`: the prior on this scatter weighs as much as this number of recordings.
    - `drift_inflation`: largest factor by which the standard errors of drifts may be too small.
    """

    slowest: float
    friction_error: float
    friction_scatter: float
    recordings: float
    load_seconds: float
    drift: float
    drift_recordings: float
    drift_inflation: float


class OctavePriors(PriorTable):
    """Ratio of the spectra of two channels, such as p_A and p_B, in octaves, in the comparison with healthy recordings.

    - `lowest`, `highest` [Hz]: limits of the frequencies that are compared.
    - `share`: highest frequency that is compared, over the sampling rate.
    - `busy`: quantile of the windows' powers that represents the recording, high because the machine may often rest.
    - `seconds` [s]: length of a window, of which a spectrum is computed.
    - `error`: standard error of the logarithm of the ratio in one recording.
    - `scatter`: standard deviation of this logarithm between days.
    - `recordings`: the prior on the scatter weighs as much as this number of recordings.
    - `neighbours`: number of octaves over which the correlation of the scatter falls by the factor e.
    """

    lowest: float
    highest: float
    share: float
    busy: float
    seconds: float
    error: float
    scatter: float
    recordings: float
    neighbours: float


class PhasePriors(PriorTable):
    """Phase between two channels, such as p_A and p_B, in octaves, in the comparison with healthy recordings.

    - `error` [rad]: standard error of the phase that a filter of known cut-off frequency causes in an octave.
    - `scatter` [rad]: standard deviation of the phase between days.
    - `recordings`: the prior on the scatter weighs as much as this number of recordings.
    - `uniform`: fraction of the phases that may have any value and therefore say nothing.
    """

    error: float
    scatter: float
    recordings: float
    uniform: float


class FilteredPriors(PriorTable):
    """Low-pass filter of one pressure, such as a clogged line of its sensor.

    - `lowest`, `highest` [Hz]: limits of the cut-off frequency.
    - `noises`: possible values of the fraction of power that is noise of the sensor, in the octave with the least power
      per frequency.
    """

    lowest: float
    highest: float
    noises: tuple[float, ...]


class ChargePriors(PriorTable):
    """Drift of the charge pressure, seen in the lowest pressures of the chambers.

    - `share`: smallest fraction of the samples in which a chamber fed at the charge pressure is low.
    - `near` [Pa]: a pressure is low if it exceeds the lowest pressure by at most this difference.
    - `seconds` [s]: averaging time.
    - `scatter` [Pa/s]: standard deviation of the drift between days.
    - `recordings`: the prior on the scatter weighs as much as this number of recordings.
    - `unlike`: fraction of the recordings in which the charge pressure changes for another cause.
    """

    share: float
    near: float
    seconds: float
    scatter: float
    recordings: float
    unlike: float


class ChangePriors(PriorTable):
    """All tables of `inference/changes/priors.toml`, the assumptions on signals that a leak does not change.

    The last three are log-normal priors. `accumulator`: gas volume of the accumulator over the exponent of its
    expansion [m^3]; `charge_fall`: fall of the charge pressure by an external leak [Pa/s]; `zero_drift`: drift of the
    zero of a failing pressure sensor [Pa/s].
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
