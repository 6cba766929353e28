"""The report on the closed-form covariance of the histogram."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from mars_lidar.light.flux import Flux
from mars_lidar.plot.style import COLOURS, INK, MUTED, style
from mars_lidar.simulate import simulate
from mars_lidar.statistics import JointLaw, joint_law
from studies import Request
from studies.draw import panels
from studies.joint_covariance import (
    FULL,
    OFTEN,
    PERIOD_NS,
    QUICK,
    TOLERANCE,
    FloatArray,
    Outcome,
    Settings,
    random_systems,
    reference_case,
    second_look,
    system_of,
)
from studies.report import Row, configuration, save_csv, save_figure, save_text, table

_SINGLE = (
    "count, mean",
    "count, variance",
    "window, mean",
    "window, variance",
    "random weights, mean",
    "random weights, variance",
)
_WORST = 10  # systems listed


def run(request: Request) -> list[Path]:
    """Compare, draw and write; returns the paths written."""
    settings = QUICK if request.quick else FULL
    systems = random_systems(settings, request.tell)
    cases = [reference_case(path) for path in sorted(request.data.glob("*.json"))] if request.data else []
    scores = _scores(systems, settings)
    with style():
        figure = _figure(request.out / "joint_covariance.png", scores, 4000 if request.quick else 40_000)
    text = save_text(request.out / "joint_covariance.md", _text(settings, systems, cases, scores, request.quick))
    return [text, figure, save_csv(request.out / "joint_covariance.csv", [_row(o) for o in [*cases, *systems]])]


def _scores(systems: Sequence[Outcome], settings: Settings) -> dict[str, FloatArray]:
    """z of each kind, one number from each system: independent of each other."""
    random = np.random.default_rng(settings.seed + 1)
    found = {name: [o.single[name] for o in systems if name in o.single] for name in _SINGLE}
    for kind, words in (("bins", "variance of a bin at random"), ("lags", "lag-1 covariance at random")):
        drawn = [o.chosen(kind, random) for o in systems]
        found[words] = [z for z in drawn if z is not None]
    return {name: np.array(z) for name, z in found.items()}


def _text(
    settings: Settings, systems: list[Outcome], cases: list[Outcome], scores: dict[str, FloatArray], quick: bool
) -> list[str]:
    numbers = sum(len(o.single) + o.bins.size + o.lags.size for o in systems)
    by_z = sorted(systems, key=lambda o: -o.worst()[0])
    settled = sum(o.law.settled >= 0 for o in systems)
    low, high = settings.cycles
    return [
        "# The covariance of the histogram in closed form, against simulation",
        "_Quick form: a look, not for citing._" if quick else "",
        "`joint_law` knows no simulation, the simulators no statistics. z is simulation less law in standard errors "
        "(of variances: of their logarithm, error from the sample's fourth moment). Derivation: "
        "[joint_law.md](../joint_law.md).",
        "## Configuration",
        f"Command: `python -m studies joint-covariance{' --quick' if quick else ''} --data DIR --out DIR`",
        configuration(
            {
                "random systems": f"{settings.systems}: S 0.01-10, B 0.001-10, t_d 0.02-4 periods (a third within 0.1 "
                f"of a whole period), sigma 0.002-0.03 periods, {low:g}-{high:g} cycles, all log-uniform, delays "
                f"uniform, armed and stationary start by turns, {settings.bins} bins",
                "simulation": f"exact engine, {settings.exposures} exposures a system, seed {settings.seed}",
                "law": f"tolerance {TOLERANCE:g}",
                "left out": f"numbers that differ from their usual value in fewer than {OFTEN} exposures (variance x "
                "exposures)",
            }
        ),
        "## Random systems",
        table([_law_row(name, z) for name, z in scores.items()]),
        "One number from each system, so that the rows of z are independent: KS is the Kolmogorov-Smirnov test "
        "against the "
        "standard normal, chi-square the sum of z squared, as a p-value.",
        f"All {numbers} numbers together, bins and neighbours of one system being dependent: root mean square "
        f"z {_rms(systems):.3f}; the largest |z| is {by_z[0].worst()[0]:.2f}, where {numbers} independent ones would "
        f"reach some {stats.norm.isf(0.5 / numbers):.2f}. {settled} of {len(systems)} exposures forget their "
        "start; the others were run through period by period.",
        "The systems with the largest |z|:",
        table([_worst_row(o, second_look(o, settings)) for o in by_z[:_WORST]]),
        "*again*: z of the same number from four times as many other exposures; what was chance does not come back.",
        *_reference_text(cases),
        "## A look",
        "![closed form and simulation](joint_covariance.png)",
        "S = 2, B = 5, t_d = 0.1, sigma = 0.01 periods, 1000 cycles. Left: variance over mean of each bin, "
        "and that of a multinomial histogram with the exact law of the count. Middle: correlations, closed form "
        "(upper triangle) and simulation (lower): bins within one dead time repel, and more so around the pulse. "
        "Right: quantiles of the z of the random systems.",
    ]


def _reference_text(cases: list[Outcome]) -> list[str]:
    if not cases:
        return ["## Reference cases", "None given (`--data`)."]
    return [
        "## Reference cases",
        "Cases simulated photon by photon by a program that shares nothing with this package (armed start).",
        table([_reference_row(o) for o in cases]),
        "*window*: within 3 sigma of the delay. *N_r term*: the leading term alone, without start and end of the "
        "exposure. rms: root mean square z over the bins (variance) and pairs of neighbours (lag-1 covariance); the "
        "standard error of a bin's variance is that of a Poisson number there, the files hold no fourth moments.",
    ]


def _rms(systems: Sequence[Outcome]) -> float:
    z = np.concatenate([np.concatenate([list(o.single.values()), o.bins, o.lags]) for o in systems])
    return float(np.sqrt(np.mean(z**2)))


def _law_row(name: str, z: FloatArray) -> Row:
    return {
        "of": name,
        "systems": z.size,
        "mean z": f"{z.mean():+.3f}",
        "sd of z": f"{z.std():.3f}",
        "KS p": f"{stats.kstest(z, 'norm').pvalue:.3f}",
        "chi-square p": f"{stats.chi2.sf(float(np.sum(z**2)), z.size):.3f}",
        "largest abs z": f"{np.abs(z).max():.2f}",
    }


def _worst_row(o: Outcome, again: float | None) -> Row:
    z, what = o.worst()
    given = {k: v if isinstance(v, str) else f"{v:.4g}" for k, v in o.settings.items()}
    numbers = len(o.single) + o.bins.size + o.lags.size
    return {
        "system": o.name,
        **given,
        "z": f"{o.scores()[what]:+.2f}" if numbers else "",
        "of": what,
        "among": numbers,
        "p, Bonferroni": f"{min(1.0, 2 * numbers * stats.norm.sf(z)):.2g}",
        "again": "" if again is None else f"{again:+.2f}",
    }


def _reference_row(o: Outcome) -> Row:
    s, v = o.single, o.leading
    return {
        "case": o.name,
        "count variance": f"{v['count']:.5g}",
        "N_r term": f"{v['count leading']:.5g}",
        "simulated": f"{v['count simulated']:.5g}",
        "z": f"{s['count, variance']:+.1f}",
        "window variance": f"{v['window']:.5g}",
        "N_r term ": f"{v['window leading']:.5g}",
        "simulated ": f"{v['window simulated']:.5g}",
        "z ": f"{s['window, variance']:+.1f}",
        "z of means": f"{s['count, mean']:+.1f}, {s['window, mean']:+.1f}",
        "bins, rms": f"{np.sqrt(np.mean(o.bins**2)):.2f}",
        "lag 1, rms": f"{np.sqrt(np.mean(o.lags**2)):.2f}",
    }


def _row(o: Outcome) -> Row:
    given = {k: o.settings.get(k, "") for k in ("S", "B", "t_d", "cycles", "sigma", "start")}
    worst, what = o.worst()
    return {
        "name": o.name,
        **given,
        "count_mean": o.law.count_mean,
        "count_variance": o.law.count_variance,
        **{"z_" + name.replace(", ", "_").replace(" ", "_"): o.single.get(name, "") for name in _SINGLE},
        "bins": o.bins.size,
        "rms_z_bins": float(np.sqrt(np.mean(o.bins**2))) if o.bins.size else "",
        "lags": o.lags.size,
        "rms_z_lags": float(np.sqrt(np.mean(o.lags**2))) if o.lags.size else "",
        "worst_z": worst,
        "worst_of": what,
        "grid_bins": o.law.grid_bins,
        "movement": o.law.movement,
        "sweeps": o.law.sweeps,
        "settled": o.law.settled,
    }


def _figure(path: Path, scores: dict[str, FloatArray], exposures: int) -> Path:
    system = system_of(0.01, 0.1, 1000, 64)
    law = joint_law(2.0, 5.0, system)
    flux = Flux(signal=2.0, background=5.0, delay_ns=0.5 * PERIOD_NS)
    x = simulate(flux, system, realizations=exposures, seed=7).reshape(exposures, -1).astype(float)
    figure, axes = panels(2.5, 1, 3)
    _variances(axes[0, 0], law, x)
    _correlations(figure, axes[0, 1], law.covariance(), np.cov(x, rowvar=False))
    _quantiles(axes[0, 2], scores)
    return save_figure(path, figure)


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
