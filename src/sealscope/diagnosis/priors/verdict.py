"""Typed tables of `verdict/priors.toml`: the default repair limit, and false-alarm probabilities."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Default repair limit.

    - `creep` [mm/min]: creep speed of the piston with its lines shut.
    """

    creep: float


class FalseAlarmPriors(PriorTable):
    """Probability of the verdict "leak" on a leak-free recording.

    - `probability`: default.
    - `rarest`, `largest`: limits of what a caller may ask for.
    """

    probability: float
    rarest: float
    largest: float


class VerdictPriors(PriorTable):
    """The tables of `verdict/priors.toml`."""

    repair: RepairPriors
    false_alarm: FalseAlarmPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
