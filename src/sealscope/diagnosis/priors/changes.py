"""Typed tables of `inference/changes/priors.toml`: assumptions on signals that a leak does not change."""

from sealscope.diagnosis.priors.inference import StepSize
from sealscope.storage.toml_file import PriorTable, read_priors


class SignalPriors(PriorTable):
    """Features of the signals, such as noise and hum, and how much they change in a healthy machine.

    - `blocks`: most blocks that a recording is divided into.
    - `order`: number of differences by which noise is told from motion and ringing.
    - `mains` [Hz]: frequencies of the electric grids.
    - `highest`: highest frequency over the sampling rate at which a hum is looked for.
    - `neighbours` [bins]: distances of the spectral lines that a line of hum is compared with.
    - `shortest` [s]: shortest block.
    - `busy`: smallest time in motion, over that of the busiest block, with which a block counts as in motion.
    - `wander`: change of the logarithm of a feature within a recording.
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
    """Mean pressures in either direction of motion.

    - `blocks`: numbers of blocks that are tried, the largest first.
    - `least`: smallest fraction of a block's time for which it moves in either direction.
    - `slowest`: lowest speed that counts as motion, over the highest one.
    """

    blocks: tuple[int, ...]
    least: float
    slowest: float


class HealthyLevelPriors(PriorTable):
    """Friction and drift of a pressure, compared with healthy recordings.

    - `slowest`: lowest speed that counts as motion, over the highest one.
    - `friction`: standard error of the logarithm of a recording's friction.
    - `scatter`: standard deviation of this logarithm between days.
    - `recordings`: number of recordings that the prior on the scatter counts for.
    - `drift` [Pa]: standard deviation of a transducer's zero within a recording.
    """

    slowest: float
    friction: float
    scatter: float
    recordings: float
    drift: float


class OctavePriors(PriorTable):
    """Spectra of both pressures in octaves, compared with healthy recordings.

    - `lowest`, `highest` [Hz]: limits of the frequencies that are compared.
    - `share`: highest frequency over the sampling rate.
    - `busy`: quantile of the windows' powers that counts.
    - `seconds` [s]: length of a window.
    - `error`: standard error of the ratio of a recording.
    - `scatter`: standard deviation of the ratio between days.
    - `recordings`: number of recordings that the prior on the scatter counts for.
    """

    lowest: float
    highest: float
    share: float
    busy: float
    seconds: float
    error: float
    scatter: float
    recordings: float


class FilteredPriors(PriorTable):
    """Change of the spectrum's tilt that a filter or a clogged line of a transducer causes.

    - `size`: median size.
    - `spread`: standard deviation of the logarithm of the size.
    """

    size: float
    spread: float


class ChargePriors(PriorTable):
    """Drifts of the low values of the pressures.

    - `share`: smallest fraction of the samples in which a chamber fed at the charge pressure is low.
    - `near` [Pa]: range of the low values above the lowest one.
    - `seconds` [s]: averaging time.
    - `scatter` [Pa/s]: standard deviation of the drift between days.
    - `recordings`: number of recordings that the prior on the scatter counts for.
    """

    share: float
    near: float
    seconds: float
    scatter: float
    recordings: float


class ChangePriors(PriorTable):
    """The tables of `inference/changes/priors.toml`."""

    features: SignalPriors
    levels: PressureLevelPriors
    healthy: HealthyLevelPriors
    octaves: OctavePriors
    filtered: FilteredPriors
    charge: ChargePriors
    charge_fall: StepSize
    zero_drift: StepSize


CHANGES = read_priors("sealscope.diagnosis.inference.changes", ChangePriors)
