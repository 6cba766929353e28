"""Figure of the study "joint-covariance"."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import panels
from studies.joint.cases import Case

_QUANTILES = {  # in words: key of the scores
    "count variance": "count, variance",
    "window variance": "window, variance",
    "bin variance": "variance of a bin at random",
    "lag 1": "lag-1 covariance at random",
}


def figure(scores: dict[str, FloatArray], exposures: int) -> Figure:
    """Variances, correlations, and quantiles of the `scores`; one system of so many exposures is simulated."""
    case = Case("shown", 2.0, 5.0, 0.1, sigma=0.01)
    law, x = case.law(64), case.histograms(64, "exact", exposures, 7).astype(np.float64)
    page, axes = panels(2.5, 1, 3)
    left_axes, middle, right = axes[0]

    mean, variance = law.mean, law.variance
    phase = (np.arange(mean.size) + 0.5) / mean.size
    multinomial = 1.0 - mean / law.count_mean * (1.0 - law.count_variance / law.count_mean)
    left_axes.plot(phase, multinomial, color=MUTED, lw=0.9, label="count x multinomial")
    left_axes.plot(phase, variance / mean, color=COLOURS[0], lw=1.1, label="closed form")
    left_axes.plot(phase, x.var(0) / x.mean(0), "o", ms=2.2, mfc="none", mew=0.6, color=COLOURS[1], label="simulation")
    left_axes.set(xlabel="phase (periods)", ylabel="variance / mean of a bin", ylim=(0.0, 1.05))
    left_axes.legend(frameon=False, loc="lower left")

    both = [c / np.sqrt(np.outer(np.diag(c), np.diag(c))) for c in (law.covariance(), np.cov(x, rowvar=False))]
    image = np.triu(both[0], 1) + np.tril(both[1], -1)
    np.fill_diagonal(image, np.nan)
    limit = float(np.nanmax(np.abs(image)))
    mesh = middle.imshow(image, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=(0, 1, 1, 0))
    middle.set(xlabel="phase (periods)", ylabel="phase (periods)", title="correlation of two bins")
    page.colorbar(mesh, ax=middle, fraction=0.046)

    right.plot([-3.3, 3.3], [-3.3, 3.3], color=INK, lw=0.7)
    for (words, key), colour in zip(_QUANTILES.items(), COLOURS, strict=False):
        z = np.sort(scores[key])
        normal = stats.norm.ppf((np.arange(z.size) + 0.5) / z.size)
        right.plot(normal, z, "o", ms=2.0, mew=0, color=colour, label=words)
    right.set(xlabel="normal quantile", ylabel="z, random systems", xlim=(-3.3, 3.3), ylim=(-4, 4))
    right.legend(frameon=False, loc="upper left", handletextpad=0.1, borderaxespad=0.0)
    return page
