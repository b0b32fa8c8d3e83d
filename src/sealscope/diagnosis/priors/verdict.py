"""Typed table of `verdict/priors.toml`: the default repair limit."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Default repair limit."""

    creep: float  # [mm/min] creep speed of the piston with its lines shut
    watch: float  # fraction of the limit under which a leak only has the level "monitor"


class VerdictPriors(PriorTable):
    """The table of `verdict/priors.toml`, which is the default repair limit."""

    repair: RepairPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
