"""Typed tables of `commissioned/priors.toml`: how the smallest detectable leak of a machine is defined."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SmallestLeakPriors(PriorTable):
    """Definition of the smallest detectable leak of a machine.

    - `power`: probability with which the next recording shows it.
    - `repeats`: factors on the number of healthy recordings that are tried to halve it.
    """

    power: float
    repeats: tuple[int, ...]


class CommissionedPriors(PriorTable):
    """The table of `commissioned/priors.toml`."""

    smallest: SmallestLeakPriors


COMMISSIONED = read_priors("sealscope.diagnosis.commissioned", CommissionedPriors)
