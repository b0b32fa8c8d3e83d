"""Typed tables of `trend/priors.toml`: assumptions on a machine's leakage from recording to recording."""

from sealscope.storage.toml_file import PriorTable, read_priors


class LevelDeviation(PriorTable):
    """Scatter between recordings of one machine of its leakage level, a conductance or the log RMS of details.

    - `volume_balance`: standard deviation over the usual level, for the volume balance.
    - `ringing`: standard deviation of the logarithm of the RMS of the pressures' wavelet details (their ringing).
    - `nodes`: number of values of the standard deviation, on a grid, over which results are averaged.
    - `freedom`: degrees of freedom of the prior.
    - `lasts`: fractions of the variance that are correlated over time, each equally likely.
    - `times` [d]: correlation times.
    """

    volume_balance: float
    ringing: float
    nodes: int
    freedom: float
    lasts: tuple[float, ...]
    times: tuple[float, ...]


class LevelError(PriorTable):
    """Errors of the leakage level (conductance or log RMS of wavelet details) of a single recording.

    - `ringing`: standard error of the logarithm of the RMS of the pressures' wavelet details (their ringing).
    - `scale`: largest relative difference of the ratio of displacement to area between recordings that are compared.
    """

    ringing: float
    scale: float


class ChangeScales(PriorTable):
    """Scales of the half-normal priors on a change of the leakage level.

    - `steps` [deviations between recordings]: sizes of a step.
    - `intervals` [intervals between recordings]: time in which a growth reaches one standard deviation.
    - `wait` [d]: longest wait between recordings that counts as running time.
    """

    steps: tuple[float, ...]
    intervals: tuple[float, ...]
    wait: float


class HistoryPriors(PriorTable):
    """Limits of a machine's history that is fitted to its recordings.

    - `outlier` [deviations between recordings]: distance beyond which a single recording is an outlier.
    - `furthest` [d]: longest time that is predicted.
    """

    outlier: float
    furthest: float


class TrendPriors(PriorTable):
    """All tables of `trend/priors.toml`, the assumptions on the leakage of a machine from recording to recording."""

    between: LevelDeviation
    reading: LevelError
    change: ChangeScales
    history: HistoryPriors


TREND = read_priors("sealscope.diagnosis.trend", TrendPriors)
