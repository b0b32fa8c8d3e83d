"""Typed tables of `verdict/priors.toml`: the leak that a machine bears, and how often a verdict may be wrong."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Limit from which a machine is repaired: `creep` [mm/min]."""

    creep: float


class FalseAlarmPriors(PriorTable):
    """Probability of `leak` on a leak-free recording."""

    probability: float
    rarest: float
    largest: float


class VerdictPriors(PriorTable):
    """The tables of `verdict/priors.toml`."""

    repair: RepairPriors
    false_alarm: FalseAlarmPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
