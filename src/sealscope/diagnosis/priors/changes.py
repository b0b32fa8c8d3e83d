"""Typed tables of `inference/changes/priors.toml`: priors on signals that a leak does not change."""

from sealscope.diagnosis.priors.inference import StepSize
from sealscope.storage.toml_file import PriorTable, read_priors


class SignalPriors(PriorTable):
    """Features of the signals: `mains` [Hz]; `neighbours` [bins]; `shortest` [s]; the others are numbers."""

    blocks: int
    order: int
    mains: tuple[float, ...]
    highest: float
    neighbours: tuple[float, ...]
    shortest: float
    busy: float
    wander: float


class PressureLevelPriors(PriorTable):
    """Mean pressures in either direction of motion."""

    blocks: tuple[int, ...]
    least: float
    slowest: float


class HealthyLevelPriors(PriorTable):
    """Friction and drifts compared with healthy recordings; `drift` [Pa], the others are numbers."""

    slowest: float
    friction: float
    scatter: float
    recordings: float
    drift: float


class OctavePriors(PriorTable):
    """Spectra of both pressures in octaves: `lowest`, `highest` [Hz], `seconds` [s]; the others are numbers."""

    lowest: float
    highest: float
    share: float
    seconds: float
    error: float
    scatter: float
    recordings: float


class FilteredPriors(PriorTable):
    """Size of the spectral tilt that a filter causes: median and spread of its logarithm."""

    size: float
    spread: float


class ChargePriors(PriorTable):
    """Drifts of the low values of the pressures.

    `near` [Pa]: range above the lowest value; `seconds` [s]: averaging time; `scatter` [Pa/s]: standard deviation
    between days, believed as if it came from `recordings` recordings.
    """

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
