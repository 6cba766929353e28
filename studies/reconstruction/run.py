"""Study "reconstruction": bias and error of depth and signal by every method, beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mars_lidar import Flux, Scene, System, cramer_rao, reconstruct, simulate
from mars_lidar.reconstruction import METHODS, Flags, window_error, window_weights
from studies import Facts, Request
from studies.common.report import Row
from studies.reconstruction.settings import (
    BRIGHT,
    FULL,
    KNOWN,
    OUTLIER_SIGMAS,
    PLAIN,
    QUICK,
    SBR,
    SEED,
    SYNCHRONOUS,
    Picture,
    Settings,
)

_BOUNDS = 17  # delays at which the bound is computed; between them its logarithm is interpolated


def run(request: Request) -> Facts:
    """Sweeps over flux, near the bound, and a picture."""
    from studies.reconstruction.bounds import lines
    from studies.reconstruction.figures import TITLE, flux_figure, maps_figure

    settings = QUICK if request.quick else FULL
    rows = []
    for signal in settings.signals:
        request.tell(f"reconstruction: S = {signal:.3g}")
        rows += sweep(PLAIN, signal, settings.pixels)
        rows += sweep(SYNCHRONOUS, signal, settings.pixels)
    request.tell("reconstruction: near the bound")
    near = lines(2 * settings.pixels)
    request.tell("reconstruction: picture")
    example = picture(settings)
    n = len(settings.signals)  # three fluxes: dim, ordinary, bright
    chosen = {settings.signals[k] for k in ((0, 1, 2) if n < 5 else (n // 4, (5 * n) // 8, n - 2))}
    words = {"matched_filter": "the matched filter", "maximum_likelihood": "maximum likelihood"}
    return {
        "s": settings,
        "findings": [finding for mode, title in TITLE.items() if (finding := _finding(rows, mode, title))],
        "chosen": [row for row in rows if row["signal"] in chosen],
        "near": near,
        "shown": [
            (said, 1e3 * (estimate.depth_m - example.depth_m), float(np.median(estimate.signal / example.signal - 1.0)))
            for said, estimate in ((said, example.estimates[name]) for name, said in words.items())
        ],
        "window": window_lines(settings),
        "rows": rows,
        "figures": {"flux": flux_figure(rows), "maps": maps_figure(example)},
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


def picture(settings: Settings) -> Picture:
    """A room of `BRIGHT` signal photons per period by the matched filter on raw counts and by maximum likelihood."""
    scene = Scene.example("room", size=settings.size)
    flux = scene.flux(PLAIN, signal=BRIGHT, sbr=SBR)
    cube = simulate(flux, PLAIN, seed=SEED)[0]
    estimate = {name: reconstruct(cube, PLAIN, name) for name in ("matched_filter", "maximum_likelihood")}
    return Picture(scene.depth_m, flux.signal, estimate)
