"""Hit and miss against fits that are printed with their data: estimates, errors, sizes found with a stated probability
and their bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from sealscope.evaluation.pod import detection_by_size, fit_hit_miss, proven_size

# doses, subjects at each, subjects that responded. SAS/STAT User's Guide, PROBIT procedure, example "Dosage Levels"
SAS_DOSE = ([1.0, 2, 3, 4, 5, 6, 7], [10, 12, 10, 10, 12, 10, 10], [1, 2, 4, 5, 8, 8, 10])
# Venables and Ripley, Modern Applied Statistics with S (4th ed., 2002), section 7.2 (Collett 1991): dose [ug], moths of
# the tobacco budworm dead of 20 in 3 days
BUDWORM_DOSE = [1.0, 2, 4, 8, 16, 32]
BUDWORM_MALES = (BUDWORM_DOSE, [20] * 6, [1, 4, 9, 13, 18, 20])
BUDWORM_FEMALES = (BUDWORM_DOSE, [20] * 6, [0, 2, 6, 10, 12, 16])
# Bliss, Ann. Appl. Biol. 22 (1935) 134-167: beetles dead after 5 h; log10 of the dose of CS2 [mg/l]
BEETLES = (
    [1.6907, 1.7242, 1.7552, 1.7842, 1.8113, 1.8369, 1.8610, 1.8839],
    [59, 60, 62, 56, 63, 59, 62, 60],
    [6, 13, 18, 28, 52, 53, 61, 60],
)


def trials(size, tested, result) -> tuple[np.ndarray, np.ndarray]:
    """Counts as single trials."""
    hits = [one for n, k in zip(tested, result, strict=True) for one in [1] * k + [0] * (n - k)]
    return np.repeat(np.asarray(size, dtype=float), tested), np.array(hits)


def test_the_fiducial_limits_of_a_printed_logit_analysis():
    """A dose that a share p responds to is the size found with probability p, and the fiducial limits lie where the
    Wald band of the detection reaches p. Logistic model over log10(dose), as printed with the data: estimates
    -3.22464 (0.88606) and 5.97018 (1.44917), log-likelihood -37.110652, and log10(dose) with its 95 % limits."""
    fit = fit_hit_miss(*trials(*SAS_DOSE))
    ten = math.log(10)
    assert (fit.intercept, fit.slope * ten) == pytest.approx((-3.22464, 5.97018), abs=5e-6)
    assert np.sqrt(np.diag(fit.covariance)) * (1, ten) == pytest.approx((0.88606, 1.44917), abs=5e-6)
    assert fit.log_likelihood == pytest.approx(-37.110652, abs=5e-6)
    for p, printed in (
        (0.01, (-0.97441, -0.22955, 0.04234)),
        (0.02, (-0.75158, -0.11175, 0.12404)),
        (0.03, (-0.62018, -0.04212, 0.17265)),
    ):
        limits = [brentq(lambda at, end=end, p=p: fit.detection_band(10**at)[end] - p, -4, 2) for end in (1, 0)]
        assert [limits[0], math.log10(fit.size_at(p)), limits[1]] == pytest.approx(printed, abs=6e-6)


def test_the_budworms():
    """Each sex's own line over log2(dose), as printed from one fit with both: females -2.9935 (0.5527), 0.9060
    (0.1671); males 0.1750 and 0.3529 more; residual deviance of both 4.9937 with 8 degrees of freedom."""
    female, male = (fit_hit_miss(*trials(*sex)) for sex in (BUDWORM_FEMALES, BUDWORM_MALES))
    two = math.log(2)
    assert (female.intercept, female.slope * two) == pytest.approx((-2.9935, 0.9060), abs=5e-5)
    assert np.sqrt(np.diag(female.covariance)) * (1, two) == pytest.approx((0.5527, 0.1671), abs=5e-5)
    assert (male.intercept - female.intercept, (male.slope - female.slope) * two) == pytest.approx(
        (0.1750, 0.3529), abs=5e-5
    )
    assert sum(deviance(one) for one in (female, male)) == pytest.approx(4.9937, abs=5e-5)


def deviance(fit) -> float:
    """Twice what the fit's log-likelihood lacks to that of the observed shares."""
    share = fit.hits / fit.tested
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.nan_to_num(share * np.log(share)) + np.nan_to_num((1 - share) * np.log(1 - share))
    return 2.0 * (float(np.sum(fit.tested * each)) - fit.log_likelihood)


def test_the_beetles():
    """Logistic estimates -60.717 (5.181) and 34.270 (2.912), deviance 11.23 (Dobson and Barnett, An Introduction to
    Generalized Linear Models, 3rd ed. 2008, section 7.3)."""
    dose, dead = trials(*BEETLES)
    fit = fit_hit_miss(np.exp(dose), dead)
    assert (fit.intercept, fit.slope) == pytest.approx((-60.717, 34.270), abs=5e-4)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx((5.181, 2.912), abs=5e-4)
    assert deviance(fit) == pytest.approx(11.23, abs=5e-3)
    assert math.log(fit.a50) == pytest.approx(60.717 / 34.270, abs=1e-4)


def test_twenty_nine_of_twenty_nine():
    """The rule of the inspection standards: 29 finds of 29, 45 of 46 or 59 of 61 show 90 % with 95 % confidence, and
    one trial less does not (Rummel, Mater. Eval. 40 (1982) 922-932)."""
    for result, tested in ((29, 29), (45, 46), (59, 61)):
        assert proven_size(detection_by_size(*trials([1.0], [tested], [result]))) == 1.0
        assert proven_size(detection_by_size(*trials([1.0], [tested - 1], [result - 1]))) == math.inf
