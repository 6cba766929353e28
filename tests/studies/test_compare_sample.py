"""Errors and scores behind ``python -m studies compare``: those that repeated samples show."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from mars_lidar.statistics.count_pmf import Pmf
from studies.compare.sample import Moments, Sample, law_distance, ratio, shape_distance


def test_standard_errors_are_those_of_repeated_samples():
    random = np.random.default_rng(3)
    law = stats.nbinom(6, 0.3)  # skewed and over-dispersed
    mean, variance = (float(v) for v in law.stats("mv"))
    many = [Moments.of(law.rvs(size=500, random_state=random)) for _ in range(400)]
    truth = {"mean": mean, "variance": variance, "fano": variance / mean}
    for name, true in truth.items():
        z = [(getattr(m, name).value - true) / getattr(m, name).error for m in many]
        assert 0.88 < np.std(z) < 1.12, name  # 0.035 by chance; the variance's own error adds some
    cumulants = np.array([mean, variance, *(_third_and_fourth(law))])
    z = np.array(
        [
            [e.z for e in vars(Moments.of(law.rvs(size=500, random_state=random), cumulants=cumulants)).values()]
            for _ in range(400)
        ]
    )
    assert np.all((z.std(0) > 0.8) & (z.std(0) < 1.15))
    a, b = many[0].variance, many[1].variance
    assert ratio(a, b).value == a.value / b.value
    assert ratio(a, b).z == pytest.approx((a.value - b.value) / math.hypot(a.error, b.error))


def _third_and_fourth(law) -> tuple[float, float]:
    variance, skew, kurtosis = (float(v) for v in law.stats("vsk"))
    return skew * variance**1.5, kurtosis * variance**2


@pytest.mark.full
@pytest.mark.parametrize("photons", [3.0, 0.02], ids=["many", "few"])
def test_scores_of_distances_are_calibrated(photons):
    """Bins that share a common factor, so that their errors are correlated, against the truth and each other."""
    random = np.random.default_rng(11)
    rate = photons * np.linspace(0.2, 1.8, 50)
    values = []
    for _ in range(60):
        drawn = random.poisson(random.gamma(20.0, 1.0 / 20.0, (2, 400, 1)) * rate).astype(np.uint16)
        a, b = (Sample(h, np.ones(50, bool)) for h in drawn)
        p = 20.0 / (20.0 + rate.sum())
        counts = Pmf(0, stats.nbinom(20, p).pmf(np.arange(int(6 * rate.sum()) + 40)))
        shapes = [shape_distance(a, goal, random).z for goal in (rate, b)]
        values.append(shapes + [law_distance(a, goal, random).z for goal in (counts, b)])
    z = np.array(values)
    assert np.all(np.abs(z.mean(0)) < 0.6), z.mean(0)  # 0.13 by chance
    assert np.all((z.std(0) > 0.6) & (z.std(0) < 1.4)), z.std(0)
    assert z.max() < 5.0


def test_a_certain_count_is_certain():
    same = Moments.of(np.full(100, 7), cumulants=np.array([7.0, 0.0, 0.0, 0.0]))
    assert (same.mean.z, same.variance.z) == (0.0, 0.0)
    assert Moments.of(np.full(100, 8), cumulants=np.array([7.0, 0.0, 0.0, 0.0])).mean.wrong
    rare = Moments.of(np.full(100, 7), cumulants=np.array([7.0 + 1e-6, 1e-6, 1e-6, 1e-6]))
    assert not rare.mean.wrong
