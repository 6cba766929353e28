"""Study "reconstruction": bias and error of depth and signal by every method, beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import Cube, Detector, Flux, Reconstruction, Scene, System, cramer_rao, reconstruct, simulate
from mars_lidar.plot.colours import COLOURS, INK
from mars_lidar.plot.reconstruction import reconstruction
from mars_lidar.reconstruction import METHODS, Flags, MaximumLikelihood, log_likelihood, window_error, window_weights
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.report import Row
from studies.common.sample import system_of

SEED = 9
SBR = 1.0
OUTLIER_SIGMAS = 4.0  # of the pulse: further off the pulse itself was missed
_DEAD_NS = 75.0
KNOWN = 10.0  # %, of S: a bound above it is not reached by any estimate (section "Near the bound")
WORDS = {"matched_filter": "the matched filter", "maximum_likelihood": "maximum likelihood"}  # of the picture
BRIGHT = 3.0  # mean signal photons per period of the picture
PLAIN = system_of(_DEAD_NS, 1000)
SYNCHRONOUS = PLAIN.replace(detector=Detector(dead_time_ns=0.0, mode="synchronous"))


@dataclass(frozen=True)
class Settings:
    """Levels of signal photons per period, pixels at each, side of the picture's image."""

    signals: tuple[float, ...]
    pixels: int
    size: int


FULL = Settings(tuple(float(s) for s in np.geomspace(0.003, 10.0, 15)), 1000, 48)
QUICK = Settings((0.03, 0.3, 3.0), 100, 24)


_DELAY_NS = 50.0  # both ends of the exposure matter there
_LONG = 20_000  # cycles
_STEP = 2e-3  # of finite differences, in standard errors
FREE = (1.0, 1.76, 3.14, 5.6, 10.0)
CLOCKED = (1.76, 3.14, 5.6)


def lines(pixels: int) -> list[dict[str, Any]]:
    """A line for each brightness: error of S over the bound, and two bounds that know more of a short exposure."""
    return [line(PLAIN, s, pixels) for s in FREE] + [line(SYNCHRONOUS, s, pixels) for s in CLOCKED]


def line(system: System, signal: float, pixels: int) -> dict[str, Any]:
    """Maximum likelihood and bounds of S at one brightness, in units of the Cramer-Rao bound of known armed times."""
    background = signal / SBR
    flux = Flux(np.full(pixels, signal), background, _DELAY_NS)
    bound = cramer_rao(Flux(signal, background, _DELAY_NS), system)
    least = float(bound.signal)
    out: dict[str, Any] = {"detector": system.detector.mode, "S": signal, "bound %": 100.0 * least / signal}
    for cycles in (system.cycles, _LONG):
        longer = system.replace(cycles=cycles)
        cube = simulate(flux, longer, seed=SEED)[0, 0]
        for less, name in ((True, ""), (False, " of the maximum")):
            if not less and cycles != system.cycles:
                continue
            estimate = reconstruct(cube, longer, MaximumLikelihood(less_bias=less))
            error = (estimate.signal - signal)[estimate.flags & Flags.SATURATED == 0] / least
            error *= np.sqrt(cycles / system.cycles)
            out[f"error{name} / bound, {cycles} cycles"] = float(np.sqrt(np.mean(error**2)))
            out[f"bias{name} / bound, {cycles} cycles"] = float(error.mean())
        if cycles == system.cycles:
            out |= _bounds(cube, longer, (signal, background, _DELAY_NS), bound.information, least)
    return out


def _bounds(
    cube: NDArray[Any],
    system: System,
    truth: tuple[float, float, float],
    information: NDArray[np.float64],
    least: float,
) -> dict[str, float]:
    """Bounds from the scores of simulated histograms: the first derivatives, and with the second ones.

    Bhattacharyya, Sankhya 8, 1 (1946): of statistics L'/L and L''/L, an unbiased estimate of S has covariance 1 with
    the first's derivative by S, 0 with all others.
    """
    scale = np.sqrt(np.diag(np.linalg.inv(information)))
    steps = _STEP * np.concatenate([np.zeros((1, 3)), np.diag(scale), -np.diag(scale)])
    points = np.asarray(truth) + steps
    gradient = np.array([log_likelihood(h, Flux(*points.T), system)[1] for h in cube])  # (pixels, 7, 3)
    score = gradient[:, 0] * scale
    second = (gradient[:, 1:4] - gradient[:, 4:]) * scale / (2.0 * _STEP)
    second = 0.5 * (second + second.transpose(0, 2, 1)) + score[:, :, None] * score[:, None, :]
    pairs = np.triu_indices(3)
    both = np.concatenate([score, second[:, pairs[0], pairs[1]]], axis=1)
    entries = {}
    for name, statistics in (("bound, ends hidden", score), ("bound, second order", both)):
        inverse = np.linalg.inv(statistics.T @ statistics / len(statistics))
        entries[name] = float(np.sqrt(inverse[0, 0]) * scale[0] / least)
    return entries


_ALONE = [name for name, method in METHODS.items() if not method.of_images]
_COLOUR = dict(zip(_ALONE, (*COLOURS, INK), strict=True))
TITLE = {"nonparalyzable": "free-running, t_d = 75 ns", "synchronous": "synchronous"}


def flux_figure(rows: Sequence[Row]) -> Figure:
    """RMSE and bias of depth and signal over flux: a column for each detector."""
    quantities = (
        ("depth RMSE mm", "depth bound mm", "depth RMSE (mm)"),
        ("depth bias mm", None, "depth |bias| (mm)"),
        ("signal RMSE %", "signal bound %", "signal RMSE (%)"),
        ("signal bias %", None, "signal |bias| (%)"),
    )
    figure, axes = panels(5.7, 4, 2, sharex=True, sharey="row")
    for column, detector in enumerate(TITLE):
        mine = [row for row in rows if row["detector"] == detector]
        for line, (name, bound, label) in enumerate(quantities):
            ax = axes[line, column]
            for method in dict.fromkeys(row["method"] for row in mine):
                here = [row for row in mine if row["method"] == method]
                x = [row["signal"] for row in here]
                y = np.abs([row[name] for row in here])
                ax.plot(x, y, "o-", ms=2.5, lw=1.0, color=_COLOUR[method], label=method.replace("_", " "))
                if bound and method == "maximum_likelihood":
                    ax.plot(x, [row[bound] for row in here], "--", lw=1.2, color=INK, label="bound", zorder=5)
            ax.set(xscale="log", yscale="log")
            ax.minorticks_off()
            if column == 0:
                ax.set_ylabel(label)
            if line == 0:
                ax.set_title(TITLE[detector], loc="left")
            if line == len(quantities) - 1:
                ax.set_xlabel("signal = background photons per period")
    methods = dict.fromkeys(row["method"] for row in rows)
    legend_below(figure, axes[0], len(methods) + 1, handlelength=1.2, columnspacing=1.0)
    axes[2, 0].set_ylim(1.0, 1e3)
    axes[3, 0].set_ylim(1e-2, 1e3)
    axes[0, 0].set_ylim(1.0, 3e2)
    axes[1, 0].set_ylim(1e-2, 1e2)
    return figure


_BOUNDS = 17  # delays at which the bound is computed; between them its logarithm is interpolated


def run(settings: Settings, request: Request) -> Facts:
    """Sweeps over flux, near the bound, and a picture."""
    rows = []
    for signal in settings.signals:
        request.tell(f"reconstruction: S = {signal:.3g}")
        rows += sweep(PLAIN, signal, settings.pixels)
        rows += sweep(SYNCHRONOUS, signal, settings.pixels)
    request.tell("reconstruction: near the bound")
    near = lines(2 * settings.pixels)
    request.tell("reconstruction: picture")
    cube, estimates = picture(settings.size)
    n = len(settings.signals)  # three fluxes: dim, ordinary, bright
    chosen = {settings.signals[k] for k in ((0, 1, 2) if n < 5 else (n // 4, (5 * n) // 8, n - 2))}
    return {
        "findings": [finding for mode, title in TITLE.items() if (finding := _finding(rows, mode, title))],
        "chosen": [row for row in rows if row["signal"] in chosen],
        "near": near,
        "shown": [
            (words, 1e3 * (each.depth_m - cube.depth_m), float(np.median(each.signal / cube.flux.signal - 1.0)))
            for words, each in ((words, estimates[name]) for name, words in WORDS.items())
        ],
        "window": window_lines(settings),
        "rows": rows,
        "figures": {"flux": flux_figure(rows), "maps": maps_figure(cube, estimates)},
    }


def _finding(rows: Sequence[Row], detector: str, title: str) -> dict[str, Any] | None:
    """How near maximum likelihood comes to the bound where the bound can be reached."""
    mine = [r for r in rows if r["detector"] == detector and r["method"] == "maximum_likelihood"]
    clean = [r for r in mine if r["outliers %"] == 0.0 and r["saturated %"] == 0.0]
    last = max((r["signal"] for r in clean if r["signal bound %"] < KNOWN), default=0.0)
    sure = [r for r in clean if r["signal"] <= last]
    if not sure:
        return None
    return {
        "title": title.capitalize(),
        "low": sure[0]["signal"],
        "high": sure[-1]["signal"],
        "depth": [r["depth RMSE mm"] / r["depth bound mm"] for r in sure],
        "signal": [r["signal RMSE %"] / r["signal bound %"] for r in sure],
        "raw": [r for r in rows if r["detector"] == detector and r["method"] == "matched_filter"][-1],
    }


def sweep(system: System, signal: float, pixels: int) -> list[dict[str, Any]]:
    """A line for each method that suits the detector: errors over `pixels` exposures, delays all over the period."""
    background = signal / SBR
    period = system.period_ns
    delay = np.random.default_rng(SEED).uniform(0.0, period, pixels)
    cube = simulate(Flux(np.full(pixels, signal), background, delay), system, seed=SEED)[0, 0]
    places = np.linspace(0.0, period, _BOUNDS)
    bound = cramer_rao(Flux(signal, background, places), system)
    least = {}
    for name in ("depth_m", "signal"):  # of these delays: a synchronous pixel sees late ones less well
        at = np.exp(np.interp(delay, places, np.log(getattr(bound, name))))
        least[name] = float(np.sqrt(np.mean(at**2)))
    lines = []
    for name, method in METHODS.items():
        if method.of_images or system.detector.mode not in method.modes:
            continue
        estimate = reconstruct(cube, system, method)
        lag = (estimate.delay_ns - delay + 0.5 * period) % period - 0.5 * period
        near = np.abs(lag) < OUTLIER_SIGMAS * system.pulse.sigma_ns  # type: ignore[attr-defined]
        off = np.asarray(system.depth_m(lag))[near]
        bounded = estimate.flags & Flags.SATURATED == 0
        error = (estimate.signal - signal)[bounded]
        lines.append(
            {
                "detector": system.detector.mode,
                "method": name,
                "signal": signal,
                "outliers %": 100.0 * float(1.0 - near.mean()),
                "depth bias mm": 1e3 * float(off.mean()) if near.any() else float("nan"),
                "depth RMSE mm": 1e3 * float(np.sqrt(np.mean(off**2))) if near.any() else float("nan"),
                "depth bound mm": 1e3 * least["depth_m"],
                "saturated %": 100.0 * float(1.0 - bounded.mean()),
                "signal bias %": 100.0 * float(error.mean()) / signal if error.size else float("nan"),
                "signal RMSE %": 100.0 * float(np.sqrt(np.mean(error**2))) / signal if error.size else float("nan"),
                "signal bound %": 100.0 * least["signal"] / signal,
            }
        )
    return lines


def window_lines(settings: Settings) -> list[dict[str, Any]]:
    """The raw window estimate of the signal, predicted by the joint law of the bins: no simulation."""
    delay = 0.37 * PLAIN.period_ns
    weights = window_weights(PLAIN, delay)
    lines = []
    for signal in settings.signals[:: max(1, len(settings.signals) // 5)]:
        mean, deviation = window_error(weights, Flux(signal, signal / SBR, delay), PLAIN)
        bound = float(cramer_rao(Flux(signal, signal / SBR, delay), PLAIN).signal)
        lines.append(
            {
                "S": signal,
                "bias %": 100.0 * float(mean / signal - 1.0),
                "standard deviation %": 100.0 * float(deviation) / signal,
                "bound %": 100.0 * bound / signal,
            }
        )
    return lines


def picture(size: int) -> tuple[Cube, dict[str, Reconstruction]]:
    """A room of `BRIGHT` signal photons per period by the matched filter on raw counts and by maximum likelihood."""
    flux = Scene.example("room", size=size).flux(PLAIN, signal=BRIGHT, sbr=SBR)
    cube = Cube(simulate(flux, PLAIN, seed=SEED), PLAIN, flux)
    return cube, {name: reconstruct(cube, method=name) for name in WORDS}


def maps_figure(cube: Cube, estimates: dict[str, Reconstruction]) -> Figure:
    """True maps, and those of the methods."""
    figure = reconstruction(cube, estimates)
    for ax in figure.axes:
        for image in ax.images:
            image.set_interpolation("nearest")  # a file a third as large
    return figure
