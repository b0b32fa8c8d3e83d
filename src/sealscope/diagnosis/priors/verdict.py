"""Typed tables of `verdict/priors.toml`: the default repair limit, and false-alarm probabilities."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Default repair limit.

    - `creep` [mm/min]: creep speed of the piston with its lines shut.
    - `watch`: fraction of the limit under which a leak only has the level "monitor".
    """

    creep: float
    watch: float


class FalseAlarmPriors(PriorTable):
    """Probability of the verdict "leak" on a leak-free recording.

    - `probability`: default value.
    - `rarest`, `largest`: limits of the values that a caller may choose.
    """

    probability: float
    rarest: float
    largest: float


class VerdictPriors(PriorTable):
    """All tables of `verdict/priors.toml`, which are the default repair limit and the false-alarm probabilities."""

    repair: RepairPriors
    false_alarm: FalseAlarmPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
