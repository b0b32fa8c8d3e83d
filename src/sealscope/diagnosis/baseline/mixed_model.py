"""Mixed model of leak-free recordings: the distribution of one more, in the same session or in another one.

A quantity that is measured once in every recording, such as the logarithm of a detail's RMS, is in recording i

    y_i = mu + beta c_i + d(t_i) + b_session(i) + e_i

with a covariate c (the pressure level), a drift d (a Gaussian process over time with the Matern 3/2 covariance
``s_d^2 (1 + a) exp(-a)``, ``a = sqrt(3) |t - t'|/drift_time``: smooth, as the temperature of the oil is, and bounded),
an effect b of the session (another day, another temperature, another specimen) of standard deviation s_b, and scatter e
of standard deviation s. All are normal and independent. mu and beta are estimated by generalised least squares. s, s_d
and s_b come from the restricted likelihood of the recordings times a prior of each (`Spread`), so that few recordings
rest on the prior and many on themselves. The posterior is a sum over a grid: of the ratios s_d/s and s_b/s, for each of
which least squares are solved once, and of s. The prediction of one more recording is the mixture of the grid's normal
predictions; without drift and sessions, and with a flat prior, that is Student's.

Sources: Harville, J. Am. Stat. Assoc. 72 (1977) 320-338, doi 10.1080/01621459.1977.10480998 (restricted likelihood and
prediction in mixed models); Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), sec. 2.7 (basis
functions with a flat prior) and eq. 4.17 (Matern 3/2); Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sec. 5.4
(posterior of the standard deviations on a grid).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.recording import Array
from sealscope.signals.filters import IntArray

#: Recordings from which on the dependence on the covariate is estimated; with fewer it is not in the model.
FEWEST_FOR_COVARIATE = 6
#: Sessions that show the spread between sessions; with fewer the stated spread of specimens counts.
FEWEST_SESSIONS = 3
#: Grid of a standard deviation over the scale of its prior, as logarithms: below, the prior vanishes.
_LOWEST, _HIGHEST, _STEP = -1.6, 4.0, 0.1
#: Grid of the drift's and the session's standard deviation over the scatter's.
_RATIOS = np.exp(np.arange(-3.5, 6.0, 0.5))
#: Grid points of less weight than this in every quantity are left out.
_LEAST_WEIGHT = 1e-9
_HALF_WIDTH_STEPS = 25


@dataclass(frozen=True)
class Spread:
    """Prior of a standard deviation s, scaled inverse chi-square: ``s^2 ~ freedom scale^2/chi^2_freedom``.

    It counts as `freedom` recordings that scatter by `scale`. No degree of freedom: flat in log s.
    """

    scale: float
    freedom: float

    def log_density(self, log_s: Array) -> Array:
        """Return the logarithm of the density of log s, but for a constant."""
        relative = log_s - np.log(self.scale)
        return np.asarray(-self.freedom * (relative + 0.5 * np.exp(-2.0 * relative)))

    def log_grid(self, range_of_values: float = 0.0) -> Array:
        """Return log s on a grid that holds the prior, and the scatter of values that lie so far apart."""
        highest = _HIGHEST + max(0.0, np.log(max(range_of_values / self.scale, 1e-300)))
        return np.asarray(np.log(self.scale) + np.arange(_LOWEST, highest, _STEP))


@dataclass(frozen=True)
class Prior:
    """What is assumed of a quantity before any recording of it is known.

    `scatter`: from one recording to the next under equal conditions; `drift`: over times much longer than `drift_time`
    [s]; `session`: between sessions where there are at least `FEWEST_SESSIONS`; `specimen`: the same where there are
    fewer, so that one session more may be that of another specimen.
    """

    scatter: Spread
    drift: Spread
    drift_time: float
    session: Spread
    specimen: Spread

    def scaled(self, factor: float) -> Prior:
        """Return the prior of a quantity that is `factor` times as large."""
        larger = [
            Spread(own.scale * factor, own.freedom) for own in (self.scatter, self.drift, self.session, self.specimen)
        ]
        return Prior(larger[0], larger[1], self.drift_time, larger[2], larger[3])


@dataclass(frozen=True)
class Prediction:
    """Distribution of f quantities of one more recording: a mixture of normal laws.

    `means` (g, f), `variances` (g, s) and `weights` (g, s, f) of its components; `extra` (k,): variances that are
    added, each with its share `shares` (k,).
    """

    means: Array
    variances: Array
    weights: Array
    extra: Array
    shares: Array

    @property
    def mean(self) -> Array:
        """Expected values (f,)."""
        return np.asarray(np.sum(self.weights.sum(axis=1) * self.means, axis=0))

    def z(self, values: Array, inflation: Array | float = 1.0) -> Array:
        """Return (f,) how far the values are from the expected ones, as standard normal deviates.

        ``z = -Phi^-1(p/2)``, p the probability of a distance as large on either side. `inflation` (f,): factor on all
        standard deviations.
        """
        return self._z(np.abs(values - self.mean) / inflation)

    def half_width(self, z: float) -> Array:
        """Return (f,) the distance from the expected values at which the deviate `z` is reached."""
        distance = np.full(self.means.shape[1], z * float(np.sqrt(np.median(self.variances))))
        for _ in range(_HALF_WIDTH_STEPS):
            distance = distance * z / np.maximum(self._z(distance), 1e-3)
        return distance

    def _z(self, distance: Array) -> Array:
        from scipy.special import log_ndtr, logsumexp, ndtri_exp

        shift = self.means - self.mean
        log_weights = np.log(np.maximum(self.weights, 1e-300))
        tails = []
        for variance, share in zip(self.extra, self.shares, strict=True):
            deviations = np.sqrt(self.variances + variance)[:, :, None]
            for side in (-1.0, 1.0):
                scaled = (-distance + side * shift)[:, None, :] / deviations
                tails.append(logsumexp(log_ndtr(scaled) + log_weights, axis=(0, 1)) + np.log(share))
        return np.asarray(-ndtri_exp(np.minimum(logsumexp(tails, axis=0) - np.log(2.0), -np.log(2.0))))


class BaselineModel:
    """Mixed model fitted to n leak-free recordings.

    Parameters
    ----------
    values : (n, f) array
        Each quantity of each recording.
    covariate : (n,) array
        The covariate c, in the model from `FEWEST_FOR_COVARIATE` recordings on.
    prior : Prior
        What is assumed of the quantities' standard deviations.
    times : (n,) array, optional
        When each recording was made [s]. None: without a drift.
    sessions : (n,) integers, optional
        The session of each recording. None: recordings are exchangeable, and one more is drawn as they were.

    Raises
    ------
    InputError
        Where there is no recording, or a value is not finite.
    """

    def __init__(
        self,
        values: Array,
        covariate: Array,
        prior: Prior,
        *,
        times: Array | None = None,
        sessions: IntArray | None = None,
    ) -> None:
        n = len(values)
        if n == 0 or not (np.all(np.isfinite(values)) and np.all(np.isfinite(covariate))):
            raise InputError(f"baseline values must be finite and of at least one recording, got {n} recordings")
        self.prior, self.times, self.sessions = prior, times, sessions
        count = 0 if sessions is None else len(np.unique(sessions))
        self._only_session = count == 1
        with_covariate = n >= FEWEST_FOR_COVARIATE and np.ptp(covariate) > 0
        self._centre = float(covariate.mean()) if with_covariate else None
        self._design = np.ones((n, 1))
        if with_covariate:
            self._design = np.stack([np.ones(n), covariate - covariate.mean()], axis=1)
        drift, session = np.meshgrid(
            _RATIOS if times is not None and n > 1 else [0.0], _RATIOS if count > 1 else [0.0], indexing="ij"
        )
        self._drift, self._session = drift.ravel() ** 2, session.ravel() ** 2
        covariance = np.eye(n) + np.zeros((self._drift.size, 1, 1))
        if times is not None:
            covariance += self._drift[:, None, None] * self._correlation(times[:, None] - times)
        if sessions is not None:
            covariance += self._session[:, None, None] * (sessions[:, None] == sessions)
        self._fit(values, covariance, prior.session if count >= FEWEST_SESSIONS else prior.specimen)

    def _correlation(self, delay: Array) -> Array:
        a = np.sqrt(3.0) * np.abs(delay) / self.prior.drift_time
        return np.asarray((1.0 + a) * np.exp(-a))

    def _fit(self, values: Array, covariance: Array, between_sessions: Spread) -> None:
        """Solve least squares for each pair of ratios, and weigh the grid (Harville 1977, eq. 4.2)."""
        log_determinant = np.linalg.slogdet(covariance)[1]
        inverse = np.linalg.inv(covariance)
        weighted = self._design.T @ inverse
        estimates = np.linalg.inv(weighted @ self._design)
        coefficients = estimates @ (weighted @ values)
        residual = values - self._design @ coefficients
        solved = inverse @ residual
        squares = np.einsum("gnf,gnf->gf", residual, solved)
        log_determinant = log_determinant - np.linalg.slogdet(estimates)[1]
        freedom = len(values) - self._design.shape[1]
        log_s = self.prior.scatter.log_grid(float(np.ptp(values, axis=0).max()))
        log_prior = np.zeros((self._drift.size, 1)) + self.prior.scatter.log_density(log_s)
        for ratios, law in ((self._drift, self.prior.drift), (self._session, between_sessions)):
            if np.any(ratios):
                log_prior = log_prior + law.log_density(log_s + 0.5 * np.log(ratios)[:, None])
        log_weights = (log_prior - 0.5 * log_determinant[:, None] - freedom * log_s)[:, :, None]
        log_weights = log_weights - 0.5 * squares[:, None, :] * np.exp(-2.0 * log_s)[:, None]
        weights = np.exp(log_weights - log_weights.max(axis=(0, 1)))
        weights /= weights.sum(axis=(0, 1))
        used = np.max(weights, axis=2) > _LEAST_WEIGHT
        rows, columns = np.any(used, axis=1), np.any(used, axis=0)
        self._weights, self._scatter = weights[rows][:, columns], np.exp(2.0 * log_s[columns])
        self._drift, self._session, self._between_sessions = self._drift[rows], self._session[rows], between_sessions
        self._inverse, self._weighted, self._estimates = inverse[rows], weighted[rows], estimates[rows]
        self._coefficients, self._solved = coefficients[rows], solved[rows]

    @property
    def fitted(self) -> Array:
        """What mu and the covariate alone make of the known recordings: (n, f)."""
        return np.asarray(self._design @ self._mean_coefficients())

    def at(self, covariate: float) -> Array:
        """Return what mu and the covariate alone make of one more recording: (f,)."""
        return np.asarray(self._row(covariate) @ self._mean_coefficients())

    def _mean_coefficients(self) -> Array:
        return np.asarray(np.einsum("gsf,gpf->pf", self._weights, self._coefficients))

    def _row(self, covariate: float) -> Array:
        return np.ones(1) if self._centre is None else np.array([1.0, covariate - self._centre])

    def predict(self, covariate: float, time: float | None = None, session: int | None = None) -> Prediction:
        """Return the distribution of one more recording.

        `time` [s]: when it was made, None for a time long before or after the others; `session`: one of the model's,
        None for another. Neither counts where the model has no times or no sessions.
        """
        row = self._row(covariate)
        shared = np.zeros((self._drift.size, len(self._design)))
        if self.times is not None and time is not None:
            shared += self._drift[:, None] * self._correlation(self.times - time)
        if self.sessions is not None and session is not None:
            shared += self._session[:, None] * (self.sessions == session)
        means = row @ self._coefficients + np.einsum("gn,gnf->gf", shared, self._solved)
        beyond = row - np.einsum("gpn,gn->gp", self._weighted, shared)
        own = 1.0 + self._drift + self._session - np.einsum("gn,gnm,gm->g", shared, self._inverse, shared)
        own += np.einsum("gp,gpq,gq->g", beyond, self._estimates, beyond)
        extra, shares = np.zeros(1), np.ones(1)
        if self._only_session and session is None:  # its own effect, and that of the only session known
            law = self._between_sessions
            log_s = law.log_grid()[::3]
            extra, shares = 2.0 * np.exp(2.0 * log_s), np.exp(law.log_density(log_s))
            shares /= shares.sum()
        return Prediction(means, own[:, None] * self._scatter, self._weights, extra, shares)
