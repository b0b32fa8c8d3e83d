"""Typed tables of `decision/priors.toml`: probabilities that a decision rests on."""

from sealscope.storage.toml_file import PriorTable, read_priors


class FalseAlarmPriors(PriorTable):
    """Probability of the verdict "leak" on a leak-free recording.

    - `probability`: default value.
    - `rarest`, `largest`: limits of the values that a caller may choose.
    """

    probability: float
    rarest: float
    largest: float


class NullPriors(PriorTable):
    """Prior on the error of the p-values that a detector states for the scores of healthy recordings.

    A surprisal is -log(p-value), with a mean of 1 if the p-values are right. If they are not, its mean is larger by a
    factor.

    - `fails`: fraction of machines on which the p-values of a statistic are wrong.
    - `inflation`: exponential scale of the logarithm of the factor.
    - `largest`: largest factor.
    """

    fails: float
    inflation: float
    largest: float


class QuestionPriors(PriorTable):
    """Division of the false-alarm probability of a diagnosis among its tests.

    - `within`: fraction that the test for a change within the recording gets. Without healthy recordings, the test of
      the leakage against the limit in the rig's file gets it.
    """

    within: float


class ExplanationPriors(PriorTable):
    """Probabilities from which a leak is stated, excluded, or replaced by another explanation.

    - `heading`: allowed probability of naming another event for a healthy recording, over the allowed
      probability of a false leak.
    - `leak`: probability from which a change is called a leak.
    - `named`: probability from which a cause other than a leak is named, of all causes of the change.
    - `happened`: probability from which such a cause is named, of all causes of the change and chance.
    - `sure`: a leak is excluded if its probability is below 1 - `sure`.
    - `combined`: smallest logarithm of the Bayes factor with which an event is combined with others.
    - `misfit`: smallest relative error with which a term of the model is assumed to describe the data.
    """

    heading: float
    leak: float
    named: float
    happened: float
    sure: float
    combined: float
    misfit: float


class WorthPriors(PriorTable):
    """Limits beyond which the verdict "no leak" would say too little and is not stated.

    - `share`: largest upper bound of an undetected leak, over the pump's mean flow.
    - `unjudged`: largest fraction of a recording after its last judged sample.
    """

    share: float
    unjudged: float


class DecisionPriors(PriorTable):
    """All tables of `decision/priors.toml`, the probabilities on which a decision rests."""

    false_alarm: FalseAlarmPriors
    null: NullPriors
    questions: QuestionPriors
    explanation: ExplanationPriors
    worth: WorthPriors


DECISION = read_priors("sealscope.diagnosis.decision", DecisionPriors)
