"""Reference cases of another program beside the closed form of the histogram's covariance.

They are JSON files that hold, beside what study `reference` reads, ``bins``, ``reals``, ``hist_mean``, ``hist_var``,
``hist_cov_lag1`` (each (bins,)), ``win_mean`` and ``win_var``, of the window of +-3 sigma around the delay.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import JointLaw, joint_law
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.joint_pixel import Pixel
from studies.joint.covariance import OFTEN, PERIOD_NS, TOLERANCE, Outcome, system_of


def leading(law: JointLaw, weights: FloatArray) -> float:
    """Variance of a window by the term that grows with the exposure alone, without start and end."""
    assert isinstance(law._pixel, Pixel)
    assert law._pixel.law is not None
    return law._pixel.law.leading(np.repeat(weights, law.grid_bins // weights.size))


def reference_case(path: Path) -> Outcome:
    """A case simulated by another program, from its JSON file."""
    case: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    signal, background, delay = float(case["S"]), float(case["B"]), case["tau"] * PERIOD_NS
    size, bins = int(case["reals"]), int(case["bins"])
    system = system_of(case["sigma"], case["dead"], case["cycles"], bins)
    law = joint_law(signal, background, system, delay_ns=delay, tolerance=TOLERANCE)
    edges = (case["tau"] + 3.0 * case["sigma"] * np.array([-1.0, 1.0])) % 1.0
    fine = next(n for n in (400, 800, 1000, 2000, 4000, 8000) if np.abs(edges * n - np.round(edges * n)).max() < 1e-6)
    first, last = np.round(edges * fine).astype(int)
    window = ((np.arange(fine) - first) % fine < (last - first) % fine).astype(float)
    wide = joint_law(signal, background, system.replace(bins=fine), delay_ns=delay, tolerance=TOLERANCE)
    mean, variance = (float(v) for v in wide.window(window))
    kurtosis = _excess(case["count"])
    often = law.variance * size >= OFTEN
    pairs = often & np.roll(often, -1)
    # Bins are binomial-like: kurtosis that of a Poisson number, an upper bound below it
    fourth = np.sqrt((2.0 + 1.0 / law.variance[often]) / size)
    v, lag = law.variance, law.lag(1)
    return Outcome(
        name=path.stem,
        settings={"S": signal, "B": background, "t_d": case["dead"], "cycles": float(case["cycles"])},
        law=law,
        single={
            "count, mean": (case["count_mean"] - law.count_mean) / float(np.sqrt(law.count_variance / size)),
            "count, variance": float(np.log(case["count_var"] / law.count_variance) / np.sqrt(kurtosis / size)),
            "window, mean": (case["win_mean"] - mean) / float(np.sqrt(variance / size)),
            "window, variance": float(np.log(case["win_var"] / variance) / np.sqrt((2.0 + 1.0 / variance) / size)),
        },
        bins=np.asarray(np.log(np.array(case["hist_var"])[often] / v[often]) / fourth),
        bin_index=np.flatnonzero(often),
        lags=np.asarray(
            ((np.array(case["hist_cov_lag1"]) - lag) / np.sqrt((v * np.roll(v, -1) + lag**2) / size))[pairs]
        ),
        lag_index=np.flatnonzero(pairs),
        leading={
            "count": law.count_variance,
            "count simulated": float(case["count_var"]),
            "count leading": leading(law, np.ones(bins)),
            "window": variance,
            "window simulated": float(case["win_var"]),
            "window leading": leading(wide, window),
        },
    )


def _excess(count: dict[str, int]) -> float:
    """Fourth central moment over the squared variance, less one, of a table of counts."""
    n, times = np.array([int(k) for k in count]), np.array(list(count.values()), float)
    p = times / times.sum()
    deviation = n - p @ n
    return float(p @ deviation**4 / (p @ deviation**2) ** 2 - 1.0)
