"""Typed tables of `verdict/priors.toml`: how a valve's supply is recognised, and the default repair limit."""

from sealscope.storage.toml_file import PriorTable, read_priors


class RepairPriors(PriorTable):
    """Default repair limit."""

    creep: float  # [mm/min] creep speed of the piston with its lines shut
    watch: float  # fraction of the limit under which a leak only has the level "monitor"


class SupplyPriors(PriorTable):
    """Pressure of a valve's supply."""

    above: float  # smallest fraction of a recording in which p_1 is above both chamber pressures by the margin
    margin: float  # [Pa] smallest difference that counts


class VerdictPriors(PriorTable):
    """The tables of `verdict/priors.toml`."""

    repair: RepairPriors
    supply: SupplyPriors


VERDICT = read_priors("sealscope.diagnosis.verdict", VerdictPriors)
