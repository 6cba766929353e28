"""Study "joint-covariance": the histogram's covariance in closed form against simulation.

The systems are random, and those of reference cases (`reference`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from mars_lidar import JointLaw
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.statistics import ConvergenceError
from mars_lidar.statistics.joint import Pixel
from studies import Facts, Request, Tell
from studies.common.draw import panels
from studies.common.report import Row, picked
from studies.joint.table import OFTEN, TOLERANCE, Case, random_cases

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


_SINGLE = tuple(f"{of}, {what}" for of in ("count", "window", "random weights") for what in ("mean", "variance"))
_RANDOM = {"bins": "variance of a bin at random", "lags": "lag-1 covariance at random"}
_WORST = 10  # systems listed


@dataclass(frozen=True)
class Settings:
    """How many random systems of how many exposures each."""

    systems: int
    exposures: int
    bins: int = 64
    cycles: tuple[float, float] = (1e3, 2e4)
    seed: int = 20264


FULL = Settings(systems=200, exposures=4000)
QUICK = Settings(systems=12, exposures=1000, cycles=(300.0, 1000.0))


@dataclass(frozen=True, eq=False)
class Outcome:
    """One system: its law, and simulation less law in standard errors, by name.

    `single` holds one number each; `bins` and `lags` (few or none) the z of the variances of bins and of the
    covariances of neighbours, of all that vary often enough. `leading`: of a reference case, variances and their terms
    that grow with the exposure alone.
    """

    case: Case
    law: JointLaw
    single: dict[str, float]
    bins: dict[str, float]
    lags: dict[str, float]
    leading: dict[str, float] = field(default_factory=dict)

    @property
    def scores(self) -> dict[str, float]:
        """Every z by name."""
        return self.single | self.bins | self.lags

    def worst(self) -> tuple[float, str]:
        """The largest |z| of all, and what it belongs to."""
        return max(((abs(z), name) for name, z in self.scores.items()), default=(0.0, "nothing varies"))


def random_systems(settings: Settings, tell: Tell) -> list[Outcome]:
    """Random systems, a third of them with dead times near whole periods, against the exact engine.

    Those that the closed form refuses are left out: their start-up transients outlast the exposure, and take too long.
    """
    results = []
    cases = random_cases(settings.systems, settings.seed, settings.cycles, ("armed", "stationary"))
    for k, case in enumerate(cases):
        try:
            results.append(compare(case, settings))
        except ConvergenceError:
            tell(f"joint-covariance: {case.name} refused")
        if k % 20 == 19:
            tell(f"joint-covariance: {k + 1} of {settings.systems} systems")
    return results


def second_look(o: Outcome, settings: Settings) -> float | None:
    """The worst z of a system again, from other and four times as many exposures: chance does not come back."""
    more = replace(settings, exposures=4 * settings.exposures, seed=settings.seed + 1_000_000)
    return compare(o.case, more, weights=settings.seed).scores.get(o.worst()[1])


def compare(case: Case, settings: Settings, weights: int | None = None) -> Outcome:
    """A random system; `weights` is the seed of the random weights, by default that of the settings."""
    k = int(case.name[1:])
    random = np.random.default_rng([settings.seed if weights is None else weights, k])
    law = case.law(settings.bins)
    x = case.histograms(settings.bins, "exact", settings.exposures, settings.seed + k).astype(np.float64)
    inside = case.window(settings.bins).astype(np.float64)
    windows = {"count": np.ones(settings.bins), "window": inside, "random weights": random.normal(size=settings.bins)}
    single = {}
    for name, w in windows.items():
        mean, variance = law.window(w)
        if name == "random weights" or variance * len(x) >= OFTEN:
            value = x @ w
            single[f"{name}, mean"] = float((value.mean() - mean) / np.sqrt(variance / len(x)))
            single[f"{name}, variance"] = float(variance_scores(value[:, None], np.array([variance]))[0])
    often = law.variance * len(x) >= OFTEN
    pairs = often & np.roll(often, -1)
    deviation = x - law.mean
    product = deviation * np.roll(deviation, -1, axis=1)
    error = product[:, pairs].std(0) / np.sqrt(len(x))
    return Outcome(
        case,
        law,
        single,
        named("variance of bin", often, variance_scores(x[:, often], law.variance[often])),
        named("covariance at", pairs, (product[:, pairs].mean(0) - law.lag(1)[pairs]) / error),
    )


def named(what: str, chosen: NDArray[np.bool_], z: FloatArray) -> dict[str, float]:
    """The z of the `chosen` (bins,) by their numbers."""
    return {f"{what} {j}": float(value) for j, value in zip(np.flatnonzero(chosen), z, strict=True)}


def variance_scores(x: FloatArray, variance: FloatArray) -> FloatArray:
    """z (k,) of the sample variances of x (n, k) against known ones, by logarithm; error from the fourth moment."""
    square = (x - x.mean(0)) ** 2
    second = square.mean(0)
    spread = np.sqrt(((square**2).mean(0) / second**2 - 1.0) / len(x))
    return np.asarray(np.log(second * len(x) / (len(x) - 1) / variance) / spread)


def run(settings: Settings, request: Request) -> Facts:
    """Random systems and the reference cases, compared with the closed form."""
    systems = random_systems(settings, request.tell)
    cases = [reference_case(path) for path in request.cases()]
    scores = _scores(systems, settings)
    every = [z for o in systems for z in o.scores.values()]
    by_z = sorted(systems, key=lambda o: -o.worst()[0])
    return {
        "often": OFTEN,
        "tolerance": TOLERANCE,
        "laws": [
            (name, z, stats.kstest(z, "norm").pvalue, stats.chi2.sf(float(np.sum(z**2)), z.size))
            for name, z in scores.items()
        ],
        "numbers": len(every),
        "rms": _rms(every),
        "rms_of": lambda z: _rms(list(z.values())),
        "largest": by_z[0].worst()[0],
        "expected": stats.norm.isf(0.5 / len(every)),
        "settled": sum(o.law.settled >= 0 for o in systems),
        "systems": len(systems),
        "worst": [_worst_row(o, second_look(o, settings)) for o in by_z[:_WORST]],
        "cases": cases,
        "rows": [_row(o) for o in [*cases, *systems]],
        "figures": {"": figure(scores, 4000 if request.quick else 40_000)},
    }


def _scores(systems: Sequence[Outcome], settings: Settings) -> dict[str, FloatArray]:
    """z of each kind, one number from each system: independent of each other, unlike those of one system."""
    random = np.random.default_rng(settings.seed + 1)
    results = {name: [o.single[name] for o in systems if name in o.single] for name in _SINGLE}
    for kind, words in _RANDOM.items():
        results[words] = [float(random.choice(list(z.values()))) for o in systems if (z := getattr(o, kind))]
    return {name: np.array(z) for name, z in results.items()}


def _rms(z: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(z))))


def _settings(case: Case) -> dict[str, float | str]:
    return picked(case, "S=signal B=background t_d=dead cycles sigma start")


def _worst_row(o: Outcome, again: float | None) -> Row:
    z, what = o.worst()
    given = {k: v if isinstance(v, str) else f"{v:.4g}" for k, v in _settings(o.case).items()}
    return {
        "system": o.case.name,
        **given,
        "z": f"{o.scores[what]:+.2f}" if o.scores else "",
        "of": what,
        "among": len(o.scores),
        "p, Bonferroni": f"{min(1.0, 2 * len(o.scores) * stats.norm.sf(z)):.2g}",
        "again": "" if again is None else f"{again:+.2f}",
    }


def _row(o: Outcome) -> Row:
    worst, what = o.worst()
    return {
        "name": o.case.name,
        **_settings(o.case),
        **picked(o.law, "count_mean count_variance"),
        **{"z_" + name.replace(", ", "_").replace(" ", "_"): o.single.get(name, "") for name in _SINGLE},
        "bins": len(o.bins),
        "rms_z_bins": _rms(list(o.bins.values())) if o.bins else "",
        "lags": len(o.lags),
        "rms_z_lags": _rms(list(o.lags.values())) if o.lags else "",
        "worst_z": worst,
        "worst_of": what,
        **picked(o.law, "grid_bins movement sweeps settled"),
    }


# --- Reference cases of another program -------------------------------------------------------------------------------

# JSON files that hold, beside what study `reference` reads, `bins`, `reals`, `hist_mean`, `hist_var`, `hist_cov_lag1`
# (each (bins,)), and `win_mean` and `win_var` of the window of +-3 sigma around the delay.


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
