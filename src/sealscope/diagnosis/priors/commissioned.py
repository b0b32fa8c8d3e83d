"""Typed tables of `commissioned/priors.toml`: requirements on the smallest leak that a machine's file states."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SmallestLeakPriors(PriorTable):
    """Requirements on the smallest detectable leak: detection probability, and multiples of healthy days tried."""

    power: float
    repeats: tuple[int, ...]


class CommissionedPriors(PriorTable):
    """The table of `commissioned/priors.toml`."""

    smallest: SmallestLeakPriors


COMMISSIONED = read_priors("sealscope.diagnosis.commissioned", CommissionedPriors)
