"""Reference cases of another program beside the closed form of the histogram's covariance.

They are JSON files that hold, beside what study `reference` reads, ``bins``, ``reals``, ``hist_mean``, ``hist_var``,
``hist_cov_lag1`` (each (bins,)), ``win_mean`` and ``win_var``, of the window of +-3 sigma around the delay.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import JointLaw
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.joint import Pixel
from studies.joint.cases import OFTEN, Case
from studies.joint.covariance import Outcome, named


def leading(law: JointLaw, weights: FloatArray) -> float:
    """Variance of a window by the term that grows with the exposure alone, without start and end."""
    assert isinstance(law._pixel, Pixel)
    assert law._pixel.law is not None
    return law._pixel.law.leading(np.repeat(weights, law.grid_bins // weights.size))


def reference_case(path: Path) -> Outcome:
    """A case simulated by another program, from its JSON file."""
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    size, bins = int(data["reals"]), int(data["bins"])
    case = Case(path.stem, data["S"], data["B"], data["dead"], data["tau"], data["sigma"], data["cycles"])
    law = case.law(bins)
    edges = (case.delay + 3.0 * case.sigma * np.array([-1.0, 1.0])) % 1.0
    fine = next(n for n in (400, 800, 1000, 2000, 4000, 8000) if np.abs(edges * n - np.round(edges * n)).max() < 1e-6)
    first, last = np.round(edges * fine).astype(int)
    window = ((np.arange(fine) - first) % fine < (last - first) % fine).astype(float)
    wide = case.law(fine)
    mean, variance = (float(v) for v in wide.window(window))
    kurtosis = _excess(data["count"])
    often = law.variance * size >= OFTEN
    pairs = often & np.roll(often, -1)
    # Bins are binomial-like: kurtosis that of a Poisson number, an upper bound below it
    fourth = np.sqrt((2.0 + 1.0 / law.variance[often]) / size)
    v, lag = law.variance, law.lag(1)
    off = (np.array(data["hist_cov_lag1"]) - lag) / np.sqrt((v * np.roll(v, -1) + lag**2) / size)
    return Outcome(
        case,
        law,
        single={
            "count, mean": (data["count_mean"] - law.count_mean) / float(np.sqrt(law.count_variance / size)),
            "count, variance": float(np.log(data["count_var"] / law.count_variance) / np.sqrt(kurtosis / size)),
            "window, mean": (data["win_mean"] - mean) / float(np.sqrt(variance / size)),
            "window, variance": float(np.log(data["win_var"] / variance) / np.sqrt((2.0 + 1.0 / variance) / size)),
        },
        bins=named("variance of bin", often, np.log(np.array(data["hist_var"])[often] / v[often]) / fourth),
        lags=named("covariance at", pairs, off[pairs]),
        leading={
            "count": law.count_variance,
            "count simulated": float(data["count_var"]),
            "count leading": leading(law, np.ones(bins)),
            "window": variance,
            "window simulated": float(data["win_var"]),
            "window leading": leading(wide, window),
        },
    )


def _excess(count: dict[str, int]) -> float:
    """Fourth central moment over the squared variance, less one, of a table of counts."""
    n, times = np.array([int(k) for k in count]), np.array(list(count.values()), float)
    p = times / times.sum()
    deviation = n - p @ n
    return float(p @ deviation**4 / (p @ deviation**2) ** 2 - 1.0)
