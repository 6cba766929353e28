"""How near any estimate from a histogram can come to the Cramer-Rao bound where few passes are left at the pulse."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, System, cramer_rao, reconstruct, simulate
from mars_lidar.reconstruction import Flags, MaximumLikelihood, log_likelihood
from studies.reconstruction.settings import PLAIN, SBR, SEED, SYNCHRONOUS

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
