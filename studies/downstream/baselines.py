"""Study "downstream-baselines": what no network needs, on the cubes of study "downstream".

A network's result stands beside these or not at all. Depth: methods of `mars_lidar.reconstruct` and the Cramer-Rao
bound. Reflectivity: a polynomial of two numbers of a pixel, fitted to each simulator's training cubes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Scene, cramer_rao, reconstruct
from mars_lidar._base.types import FloatArray
from studies import Request
from studies.common.report import write
from studies.downstream.data import CONFIGS, SYSTEM, Config, Simulators, crop
from studies.downstream.metrics import psnr, rmse

ARMS = {"poisson": "Poisson", "renewal": "renewal", "mars": "MaRS", "exact": "exact"}
METHODS = ("peak", "matched_filter", "generalised_coates", "maximum_likelihood")
SBR = (0.6, 1.0)
WINDOW, DEGREE = 24, 4  # bins about the fullest smoothed one; of the polynomial
_TRAINING, _OWN, _GOLD = 0, 2, 3  # streams, as in study "downstream"


def run(request: Request) -> list[Path]:
    """Write downstream_baselines.md and its CSV."""
    config = CONFIGS["tiny" if request.quick else "small"]
    training, test = ([crop(first + k, config) for k in range(n)] for first, n in (config.train, config.test))
    simulators = Simulators(config)
    rows: list[dict[str, Any]] = []
    for sbr in SBR:
        request.tell(f"downstream-baselines: gold-standard cubes, SBR {sbr:g}")
        gold = simulators.cubes(config.gold, test, sbr, (config.seed << 8) + _GOLD)
        rows += [{"sbr": sbr, **row} for row in _depths(gold, test, sbr, config)]
        for arm, words in ARMS.items():
            request.tell(f"downstream-baselines: polynomial on {words} cubes")
            cubes = simulators.cubes(arm, training, sbr, (config.seed << 8) + _TRAINING)
            own = simulators.cubes(arm, test, sbr, (config.seed << 8) + _OWN)
            law = np.linalg.lstsq(_terms(cubes), _shares(training).ravel(), rcond=None)[0]
            found = {name: _psnr(_terms(each) @ law, test) for name, each in (("own", own), ("gold", gold))}
            rows.append({"sbr": sbr, "target": "reflectivity", "what": f"polynomial, {words}", "unit": "dB", **found})
    settings = {
        "scenes": f"{config.train[1]} to fit, {config.test[1]} to test, as in study downstream, configuration small",
        "gold standard": config.gold,
        "polynomial": f"degree {DEGREE} in log(1 + total) and log(1 + counts of {WINDOW} bins about the fullest)",
    }
    return write(
        request, "downstream_baselines", __name__, "baselines", {"settings": settings, "rows": rows}, rows=rows
    )


def _depths(gold: NDArray[Any], test: list[Scene], sbr: float, config: Config) -> list[dict[str, Any]]:
    """RMSE of depth, m, of each method on gold-standard cubes, over the pixels with a return; and the bound's."""
    true = np.stack([scene.depth_m for scene in test])
    out = []
    for method in METHODS:
        depth = reconstruct(gold, SYSTEM, method).depth_m
        away = np.where(np.isfinite(depth), depth, 0.5 * SYSTEM.unambiguous_range_m)
        out.append({"target": "depth", "what": method.replace("_", " "), "unit": "m", "gold": rmse(away, true)})
    bounds = []
    for scene in test:
        signal = config.photons * float(scene.reflectivity[scene.valid].mean())
        flux = scene.flux(SYSTEM, signal=signal, sbr=sbr)
        lit = flux.signal > 0
        bound = cramer_rao(flux.signal[lit], flux.background[lit], SYSTEM, delay_ns=flux.delay_ns[lit])
        bounds.append(bound.depth_m)
    least = float(np.sqrt(np.mean(np.concatenate(bounds) ** 2)))
    return [*out, {"target": "depth", "what": "Cramer-Rao bound", "unit": "m", "gold": least}]


def _shares(scenes: list[Scene]) -> FloatArray:
    return np.stack([np.where(scene.valid, scene.reflectivity, 0.0) for scene in scenes])


def _psnr(found: FloatArray, scenes: list[Scene]) -> float:
    true = _shares(scenes)
    return float(np.mean([psnr(a, b, 1.0) for a, b in zip(found.reshape(true.shape), true, strict=True)]))


def _terms(cubes: NDArray[Any]) -> FloatArray:
    """Monomials (pixels, terms) of the two numbers of every pixel."""
    flat = cubes.reshape(-1, cubes.shape[-1])
    total, near = np.empty(len(flat)), np.empty(len(flat))
    for first in range(0, len(flat), 4096):
        counts = flat[first : first + 4096].astype(np.float64)
        sums = np.cumsum(np.concatenate([counts, counts[:, : WINDOW - 1]], axis=-1), axis=-1)
        windows = sums[:, WINDOW - 1 :] - np.concatenate([np.zeros((len(counts), 1)), sums[:, :-WINDOW]], axis=-1)
        total[first : first + 4096], near[first : first + 4096] = counts.sum(-1), windows.max(-1)
    a, b = np.log1p(total), np.log1p(near)
    return np.stack([a**i * b**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=-1)
