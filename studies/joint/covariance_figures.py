"""Figure of the study "joint-covariance"."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from mars_lidar import Flux, JointLaw, joint_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS, INK, MUTED
from studies.common.draw import panels
from studies.joint.covariance import PERIOD_NS, system_of


def figure(scores: dict[str, FloatArray], exposures: int) -> Figure:
    """Variances, correlations, and quantiles of the `scores`; one system of so many exposures is simulated."""
    system = system_of(0.01, 0.1, 1000, 64)
    law = joint_law(2.0, 5.0, system)
    flux = Flux(signal=2.0, background=5.0, delay_ns=0.5 * PERIOD_NS)
    x = simulate(flux, system, realizations=exposures, seed=7).reshape(exposures, -1).astype(float)
    page, axes = panels(2.5, 1, 3)
    _variances(axes[0, 0], law, x)
    _correlations(page, axes[0, 1], law.covariance(), np.cov(x, rowvar=False))
    _quantiles(axes[0, 2], scores)
    return page


def _variances(ax: Any, law: JointLaw, x: FloatArray) -> None:
    mean, variance = law.mean, law.variance
    phase = (np.arange(mean.size) + 0.5) / mean.size
    multinomial = 1.0 - mean / law.count_mean * (1.0 - law.count_variance / law.count_mean)
    ax.plot(phase, multinomial, color=MUTED, lw=0.9, label="count x multinomial")
    ax.plot(phase, variance / mean, color=COLOURS[0], lw=1.1, label="closed form")
    ax.plot(phase, x.var(0) / x.mean(0), "o", ms=2.2, mfc="none", mew=0.6, color=COLOURS[1], label="simulation")
    ax.set(xlabel="phase (periods)", ylabel="variance / mean of a bin", ylim=(0.0, 1.05))
    ax.legend(frameon=False, loc="lower left")


def _correlations(figure: Any, ax: Any, law: FloatArray, sample: FloatArray) -> None:
    both = [c / np.sqrt(np.outer(np.diag(c), np.diag(c))) for c in (law, sample)]
    image = np.triu(both[0], 1) + np.tril(both[1], -1)
    np.fill_diagonal(image, np.nan)
    limit = float(np.nanmax(np.abs(image)))
    shown = ax.imshow(image, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=(0, 1, 1, 0))
    ax.set(xlabel="phase (periods)", ylabel="phase (periods)", title="correlation of two bins")
    figure.colorbar(shown, ax=ax, fraction=0.046)


def _quantiles(ax: Any, scores: dict[str, FloatArray]) -> None:
    named = {
        "count variance": "count, variance",
        "window variance": "window, variance",
        "bin variance": "variance of a bin at random",
        "lag 1": "lag-1 covariance at random",
    }
    ax.plot([-3.3, 3.3], [-3.3, 3.3], color=INK, lw=0.7)
    for (words, key), colour in zip(named.items(), COLOURS, strict=False):
        z = np.sort(scores[key])
        ax.plot(stats.norm.ppf((np.arange(z.size) + 0.5) / z.size), z, "o", ms=2.0, mew=0, color=colour, label=words)
    ax.set(xlabel="normal quantile", ylabel="z, random systems", xlim=(-3.3, 3.3), ylim=(-4, 4))
    ax.legend(frameon=False, loc="upper left", handletextpad=0.1, borderaxespad=0.0)
