"""Typed tables of `commissioned/priors.toml`: how the smallest detectable leak of a machine is defined."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SmallestLeakPriors(PriorTable):
    """Definition of the smallest detectable leak of a machine."""

    power: float  # probability with which the next recording shows this leak
    repeats: tuple[int, ...]  # factors on the number of healthy recordings, tried to find the one that halves this leak


class CommissionedPriors(PriorTable):
    """The only table of `commissioned/priors.toml`, which defines the smallest detectable leak of a machine."""

    smallest: SmallestLeakPriors


COMMISSIONED = read_priors("sealscope.diagnosis.commissioned", CommissionedPriors)
