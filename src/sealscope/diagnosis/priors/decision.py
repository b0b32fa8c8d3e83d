"""Typed tables of `decision/priors.toml`: priors of decisions."""

from sealscope.storage.toml_file import PriorTable, read_priors


class NullPriors(PriorTable):
    """Laws of statistics on healthy recordings."""

    fails: float
    inflation: float
    largest: float


class QuestionPriors(PriorTable):
    """Shares of the false-alarm probability."""

    within: float


class ExplanationPriors(PriorTable):
    """Probabilities from which an explanation is named."""

    heading: float
    leak: float
    named: float
    sure: float
    misfit: float


class WorthPriors(PriorTable):
    """Bounds worth stating."""

    share: float
    unjudged: float


class DecisionPriors(PriorTable):
    """The tables of `decision/priors.toml`."""

    null: NullPriors
    questions: QuestionPriors
    explanation: ExplanationPriors
    worth: WorthPriors


DECISION = read_priors("sealscope.diagnosis.decision", DecisionPriors)
