"""Typed tables of `trend/priors.toml`: assumptions on a machine's leakage from recording to recording."""

from sealscope.storage.toml_file import PriorTable, read_priors


class LevelDeviation(PriorTable):
    """Scatter of a machine's leakage level (conductance or log RMS of wavelet details) between its recordings."""

    volume_balance: float  # standard deviation of the conductance, over its usual level
    hold_test: float  # the same between hold tests, whose duty is not known beyond the pressure
    ringing: float  # standard deviation of the logarithm of the RMS of the pressures' wavelet details (their ringing)
    nodes: int  # number of values of the standard deviation, on a grid, over which results are averaged
    freedom: float  # degrees of freedom of the prior
    lasting_share: tuple[float, ...]  # fractions of the variance that are correlated over time, each equally likely
    times: tuple[float, ...]  # [d] correlation times


class LevelError(PriorTable):
    """Errors of the leakage level (conductance or log RMS of wavelet details) of a single recording."""

    ringing: float  # standard error of the logarithm of the RMS of the pressures' wavelet details (their ringing)
    # recordings are compared if their ratios of displacement to area, sorted by size, differ between neighbours by at
    # most `scale` (relative), plus `scatter` times the median difference if there are at least `fewest` differences
    scale: float
    scatter: float
    fewest: int


class ChangeScales(PriorTable):
    """Scales of the half-normal priors on a change of the leakage level.

    A step is stated in standard deviations between recordings, the time of a growth in intervals between recordings.
    """

    steps: tuple[float, ...]  # sizes of a step of the leakage level
    intervals: tuple[float, ...]  # time in which a growth reaches one standard deviation
    wait: float  # [d] longest wait between recordings that counts as running time


class HistoryPriors(PriorTable):
    """Limits of the distance of a recording, in standard deviations between recordings, and of predictions."""

    outlier: float  # distance of the level from those before, beyond which the recording is an outlier
    furthest: float  # [d] longest time that is predicted


class TrendPriors(PriorTable):
    """All tables of `trend/priors.toml`, the assumptions on the leakage of a machine from recording to recording."""

    between: LevelDeviation
    reading: LevelError
    change: ChangeScales
    history: HistoryPriors


TREND = read_priors("sealscope.diagnosis.trend", TrendPriors)
