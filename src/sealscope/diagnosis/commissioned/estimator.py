"""A commissioned machine as an estimator of scikit-learn's kind: `fit` on healthy recordings, `predict` on others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.commissioned.machine import CommissionedMachine, commission
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Files of recordings, as `sealscope.commission` takes them.
Paths = Sequence[str | os.PathLike[str]]


class LeakDetector:
    """Outlier detector of recordings, with scikit-learn's methods and parameters; it needs no scikit-learn.

    What is fitted on are files of recordings, not a matrix, so that checks of scikit-learn which feed arrays of numbers
    do not apply; `sklearn.base.clone`, pipelines' parameters and scorers do.

    Parameters
    ----------
    rig, map, rate, limit : optional
        As for `sealscope.commission`.
    false_alarm_probability : float, optional
        Probability of an outlier on a healthy recording.

    Attributes
    ----------
    machine_ : CommissionedMachine
        What was learnt; set by `fit`.
    """

    _estimator_type = "outlier_detector"
    _parameters = ("rig", "map", "rate", "limit", "false_alarm_probability")

    def __init__(
        self,
        rig: Any = None,
        map: Any = None,
        rate: float | None = None,
        limit: str | None = None,
        false_alarm_probability: float = 0.01,
    ) -> None:
        self.rig, self.map, self.rate, self.limit = rig, map, rate, limit
        self.false_alarm_probability = false_alarm_probability

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the parameters by name."""
        return {name: getattr(self, name) for name in self._parameters}

    def set_params(self, **params: Any) -> Self:
        """Set parameters by name; InputError for one that is not known."""
        for name, value in params.items():
            if name not in self._parameters:
                raise InputError(f"a parameter must be one of {', '.join(self._parameters)}, got {name!r}")
            setattr(self, name, value)
        return self

    def fit(self, X: Paths, y: object = None) -> Self:
        """Learn from files of healthy recordings `X`; `y` is ignored."""
        self.machine_: CommissionedMachine = commission(X, rig=self.rig, map=self.map, rate=self.rate, limit=self.limit)
        return self

    def decision_function(self, X: Paths) -> Array:
        """Return threshold less score of each file: < 0 for a leak, nan where the recording cannot be judged."""
        answers = [self._diagnosis(path) for path in X]
        scores = [np.nan if d.score is None or d.threshold is None else d.threshold - d.score for d in answers]
        return np.array(scores, dtype=float)

    def predict(self, X: Paths) -> NDArray[np.int64]:
        """Return -1 for each file with a leak, 1 for one without, 0 where it cannot be told."""
        labels = {"leak": -1, "no leak": 1, "cannot tell": 0}
        return np.array([labels[self._diagnosis(path).verdict] for path in X], dtype=np.int64)

    def _diagnosis(self, path: str | os.PathLike[str]) -> Any:
        if not hasattr(self, "machine_"):
            raise InputError("a LeakDetector must be fitted before it predicts: call fit on healthy recordings")
        return self.machine_.diagnose(path, false_alarm_probability=self.false_alarm_probability)
