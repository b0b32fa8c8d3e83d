"""Typed tables of `commissioned/priors.toml`: a machine's smallest detectable leak, and its proposed repair limit."""

from sealscope.storage.toml_file import PriorTable, read_priors


class SmallestLeakPriors(PriorTable):
    """Definition of the smallest detectable leak of a machine."""

    power: float  # probability with which the next recording shows this leak
    repeats: tuple[int, ...]  # factors on the number of healthy recordings, tried to find the one that halves this leak


class LimitPriors(PriorTable):
    """Repair limit that is proposed for a machine."""

    share: float  # leak over the pump's flow in motion


class CommissionedPriors(PriorTable):
    """All tables of `commissioned/priors.toml`."""

    smallest: SmallestLeakPriors
    limit: LimitPriors


COMMISSIONED = read_priors("sealscope.diagnosis.commissioned", CommissionedPriors)
