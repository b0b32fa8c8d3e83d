"""A commissioned machine as a scikit-learn estimator: `fit` on healthy recordings, `predict` on others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.commissioned.machine import CommissionedMachine, commission
from sealscope.diagnosis.diagnose import FALSE_ALARM_PROBABILITY
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK
from sealscope.errors import MissingExtra
from sealscope.recordings.recording import Array

try:
    from sklearn.base import BaseEstimator, OutlierMixin
    from sklearn.utils.validation import check_is_fitted
except ImportError:
    raise MissingExtra("LeakDetector needs scikit-learn: pip install 'sealscope[learn]'") from None

#: Files of recordings, as `sealscope.commission` takes them.
Paths = Sequence[str | os.PathLike[str]]


class LeakDetector(OutlierMixin, BaseEstimator):  # type: ignore[misc]
    """Detect leaking recordings among files, as outliers from the healthy recordings.

    Parameters
    ----------
    rig, map, rate, limit : optional
        Arguments of `sealscope.commission`.
    false_alarm_probability : float, optional
        Probability that a healthy recording is classified as an outlier.

    Attributes
    ----------
    machine_ : CommissionedMachine
        The machine that `fit` commissioned.
    """

    def __init__(
        self,
        rig: Any = None,
        map: Any = None,
        rate: float | None = None,
        limit: str | None = None,
        false_alarm_probability: float = FALSE_ALARM_PROBABILITY,
    ) -> None:
        self.rig, self.map, self.rate, self.limit = rig, map, rate, limit
        self.false_alarm_probability = false_alarm_probability

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.input_tags.one_d_array = tags.input_tags.string = True  # a sequence of paths
        return tags

    def fit(self, X: Paths, y: object = None) -> Self:
        """Learn the machine from the files of healthy recordings `X`, and return this detector; `y` is ignored."""
        self.machine_: CommissionedMachine = commission(X, rig=self.rig, map=self.map, rate=self.rate, limit=self.limit)
        return self

    def score_samples(self, X: Paths) -> Array:
        """Compute minus the leak score of each of n files, shape (n,), low for outliers; nan if not judged."""
        return -np.array([diagnosis.score for diagnosis in self._diagnoses(X)], dtype=float)

    def decision_function(self, X: Paths) -> Array:
        """Compute threshold minus leak score of each of n files, shape (n,): negative for alarms, nan if not judged."""
        diagnoses = self._diagnoses(X)
        score: Array = np.array([diagnosis.score for diagnosis in diagnoses], dtype=float)
        return np.array([diagnosis.threshold for diagnosis in diagnoses], dtype=float) - score

    def predict(self, X: Paths) -> NDArray[np.int64]:
        """Classify each of n files, shape (n,): -1 for a leak, 1 for no leak, 0 if the file cannot be judged."""
        labels = {LEAK: -1, NO_LEAK: 1, CANNOT_TELL: 0}
        return np.array([labels[diagnosis.verdict] for diagnosis in self._diagnoses(X)], dtype=np.int64)

    def _diagnoses(self, X: Paths) -> list[Diagnosis]:
        """Diagnose each of the files `X` with the machine that `fit` has learned."""
        check_is_fitted(self)
        probability = self.false_alarm_probability
        return [self.machine_.diagnose(path, false_alarm_probability=probability) for path in X]
