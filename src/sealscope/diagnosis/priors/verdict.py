"""Typed tables of `verdict/priors.toml`: the leak that a machine bears, and how often a verdict may be wrong."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Default repair limit, as the creep speed of the piston with its lines shut [mm/min]."""

    creep: float


class FalseAlarmPriors(PriorTable):
    """Default, smallest and largest probability of the verdict `leak` on a leak-free recording."""

    probability: float
    rarest: float
    largest: float


class VerdictPriors(PriorTable):
    """The tables of `verdict/priors.toml`."""

    repair: RepairPriors
    false_alarm: FalseAlarmPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
