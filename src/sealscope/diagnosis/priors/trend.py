"""Typed tables of `trend/priors.toml`: priors on the levels of a machine from recording to recording."""

from sealscope.storage.toml_file import PriorTable, read_priors


class LevelDeviation(PriorTable):
    """Scatter of a level from recording to recording: its size, and the times [d] for which a part of it lasts."""

    volume_balance: float
    ringing: float
    nodes: int
    freedom: float
    lasts: tuple[float, ...]
    times: tuple[float, ...]


class LevelError(PriorTable):
    """Errors stated for a single recording, of its ringing level (logarithm) and of its scale (relative)."""

    ringing: float
    scale: float


class ChangeScales(PriorTable):
    """Scales of a change's half-normal priors; `wait` [d].

    `steps` in deviations between recordings, `intervals` in intervals between recordings.
    """

    steps: tuple[float, ...]
    intervals: tuple[float, ...]
    wait: float


class HistoryPriors(PriorTable):
    """Limits of a fitted history: `outlier` [deviations between recordings]; `furthest` [d]."""

    outlier: float
    furthest: float


class TrendPriors(PriorTable):
    """The tables of `trend/priors.toml`."""

    between: LevelDeviation
    reading: LevelError
    change: ChangeScales
    history: HistoryPriors


TREND = read_priors("sealscope.diagnosis.trend", TrendPriors)
