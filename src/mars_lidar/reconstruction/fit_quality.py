"""Goodness of fit of reconstructed pixels: does each histogram agree with the law of its own estimate?

Given the registrations before, those of a bin are the light there times the passes for which the pixel was armed:
what a histogram has beyond that, h_j - l_j D_j, is a martingale (Andersen, Borgan, Gill, Keiding, Statistical models
based on counting processes, 1993), uncorrelated from bin to bin, of variance E h_j. So a chi-square of bins pooled to
cells needs no covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histograms import Histograms

FALSE_ALARM = 1e-3  # of `Flags.MISFIT`, a pixel
_CELLS = 64  # of a pixel, at most
_EXPECTED = 8.0  # registrations of a cell, at least, for the law of chi-square
_LEAST_CELLS = 6  # of which three are taken up by the estimates
_SUB = 32  # delays of the template within a bin
_DEAD = (1.2, 1.0 / 1.2)  # dead times, and ...
_WIDER = 1.1  # ... pulse whose direction is tested
_BLOCK = 2**18  # bins at a time


def holds_for(system: System) -> bool:
    """Whether armed passes follow from a histogram: free-running, not gated, and long beside its dead time."""
    return system.detector.mode == "nonparalyzable" and system.cycles > 4.0 * max(1.0, system.dead_time_periods)


def blinding(system: System, dead_time_periods: float) -> tuple[float, NDArray[np.complex128]]:
    """Whole periods that a registration blinds, and the transform of the shares (bins,) that the rest blinds."""
    bins = system.bins
    whole, rest = divmod(dead_time_periods * bins, bins)

    def below(x: FloatArray) -> FloatArray:
        """Mean of max(x - u, 0) over u in [0, 1], where registrations are spread over their bin."""
        return np.asarray(np.where(x <= 0.0, 0.0, np.where(x < 1.0, 0.5 * x * x, x - 0.5)))

    d = np.arange(2 * bins, dtype=np.float64)
    share = below(d + 1.0) - below(d) - below(d + 1.0 - rest) + below(d - rest)
    return whole, np.fft.rfft(share[:bins] + share[bins:])


class Template:
    """Shares of a return's photons in each bin, for delays on a grid of sub-bins, and their derivatives."""

    def __init__(self, system: System) -> None:
        self.bins, period = system.bins, system.period_ns
        edges = np.arange(self.bins + 1) / self.bins
        at = (edges[None, :] - (np.arange(_SUB + 2) / _SUB / self.bins)[:, None]) * period
        self.share = np.diff(system.pulse.wrapped_cumulative(at, period), axis=1)
        wide = np.diff(system.pulse.wrapped_cumulative(at / _WIDER, period / _WIDER), axis=1)
        self.wider = (wide - self.share)[: _SUB + 1]
        self.later = (self.share[1:] - self.share[:-1]) * _SUB  # for a delay of one bin more
        self.share = self.share[: _SUB + 1]

    def at(self, delay: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Shares, and changes by a bin of delay and by a tenth of width (pixels, bins), at delays in periods."""
        place = (delay % 1.0) * self.bins
        whole = np.floor(place).astype(np.int64)
        fine = (place - whole) * _SUB
        low = np.minimum(fine.astype(np.int64), _SUB - 1)
        weight = (fine - low)[:, None]
        column = (np.arange(self.bins)[None, :] - whole[:, None]) % self.bins

        def taken(table: FloatArray) -> FloatArray:
            a = np.take_along_axis(table[low], column, axis=1)
            return np.asarray(a + weight * (np.take_along_axis(table[low + 1], column, axis=1) - a))

        return taken(self.share), np.take_along_axis(self.later[low], column, axis=1), taken(self.wider)


@dataclass(frozen=True, eq=False)
class Quality:
    """Of each pixel (pixels,): four tests and their p-value together; NaN where too few photons tell.

    `chi2` of pooled cells with `freedom` degrees; `longer`, `shorter` and `wider` in standard deviations: positive
    where a longer or a shorter dead time, a wider pulse would fit better.
    """

    chi2: FloatArray
    freedom: NDArray[np.int64]
    longer: FloatArray
    shorter: FloatArray
    wider: FloatArray
    p_value: FloatArray


def fit_quality(histograms: Histograms, signal: FloatArray, background: FloatArray, delay: FloatArray) -> Quality:
    """The fit of each pixel to its estimate; delays in periods, NaN without a return."""
    from scipy.stats import chi2 as law
    from scipy.stats import norm

    system, pixels = histograms.system, len(histograms.counts)
    square, longer, shorter, wider = (np.full(pixels, np.nan) for _ in range(4))
    cells = np.zeros(pixels, np.int64)
    template = Template(system)
    dead = system.dead_time_periods
    whole, kernel = blinding(system, dead)
    others = [blinding(system, x * dead) for x in _DEAD] if dead > 0.0 else []
    step = max(1, _BLOCK // system.bins)
    for start in range(0, pixels, step):
        part = slice(start, start + step)
        counts = histograms.counts[part].astype(np.float64)
        sums, spectrum = counts.sum(1, keepdims=True), np.fft.rfft(counts)
        lit = np.where(np.isnan(delay[part]), 0.0, signal[part])[:, None]
        share, later, wide = template.at(np.nan_to_num(delay[part]))
        passes = np.maximum(system.cycles - whole * sums - np.fft.irfft(spectrum * kernel, system.bins), 0.0)
        rate = lit * share + background[part][:, None] / system.bins
        expected = rate * passes
        h, e, number = _pooled(counts, expected)
        used = e > 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            value = np.where(used, (h - e) ** 2 / e, np.where(h > 0.0, np.inf, 0.0)).sum(1)
        enough = number >= _LEAST_CELLS
        cells[part] = used.sum(1)
        square[part] = np.where(enough, value, np.nan)
        test = _Scores(counts, expected, (share * passes, passes, later * passes))
        for score, (more, other) in zip((longer, shorter), others, strict=False):
            blinded = (more - whole) * sums + np.fft.irfft(spectrum * (other - kernel), system.bins)
            change = -rate * np.minimum(blinded, passes)
            score[part] = np.where(enough, test(change), np.nan)
        wider[part] = np.where(enough & (lit[:, 0] > 0.0), test(wide * passes), np.nan)
    freedom = cells - 3
    scores = [2.0 * norm.sf(np.abs(wider)), norm.sf(longer), norm.sf(shorter)]
    each = np.stack([law.sf(square, np.maximum(freedom, 1)), *scores])
    tests = np.maximum((~np.isnan(each)).sum(0), 1)
    least = np.where(np.isnan(square), np.nan, np.nanmin(np.where(np.isnan(each), 1.0, each), axis=0))
    return Quality(square, freedom, longer, shorter, wider, np.asarray(np.minimum(1.0, tests * least)))


def _pooled(counts: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Counts and their expectation (pixels, cells) in cells of about equal expectation, and the cells of each pixel."""
    total = expected.sum(1)
    number = np.minimum(_CELLS, np.floor(total / _EXPECTED)).astype(np.int64)
    below = np.cumsum(expected, axis=1) - 0.5 * expected
    cell = np.minimum((below / np.maximum(total, 1e-300)[:, None] * number[:, None]).astype(np.int64), _CELLS - 1)
    cell += _CELLS * np.arange(len(counts))[:, None]
    rows = len(counts)
    h, e = np.zeros((2, rows, _CELLS))
    h += np.bincount(cell.ravel(), counts.ravel(), rows * _CELLS).reshape(rows, _CELLS)
    e += np.bincount(cell.ravel(), expected.ravel(), rows * _CELLS).reshape(rows, _CELLS)
    return h, e, number


class _Scores:
    """Rao's score of a change of the expectation of counts (pixels, bins), what the fit would take up left out."""

    def __init__(self, counts: FloatArray, expected: FloatArray, tangent: tuple[FloatArray, ...]) -> None:
        self.weight = 1.0 / np.maximum(expected, 1e-9)
        self.tangent = [each * self.weight for each in tangent]
        normal = np.array([[np.einsum("ij,ij->i", a, b) for b in tangent] for a in self.tangent])
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("iik->ki", normal), 1e-300))
        self.scale = np.where(np.isfinite(scale) & (scale < 1e100), scale, 0.0)
        self.normal = normal.transpose(2, 0, 1) * self.scale[:, :, None] * self.scale[:, None, :] + 1e-9 * np.eye(3)
        residual = counts - expected
        self.residual = residual * self.weight
        self.taken = np.stack([np.einsum("ij,ij->i", each, residual) for each in self.tangent], axis=1)

    def __call__(self, change: FloatArray) -> FloatArray:
        """Standard deviations (pixels,)."""
        own = np.stack([np.einsum("ij,ij->i", each, change) for each in self.tangent], axis=1)
        along = self.scale * np.linalg.solve(self.normal, (self.scale * own)[:, :, None])[:, :, 0]
        variance = np.einsum("ij,ij,ij->i", change, change, self.weight) - (along * own).sum(1)
        score = np.einsum("ij,ij->i", change, self.residual) - (along * self.taken).sum(1)
        return np.asarray(score / np.sqrt(np.maximum(variance, 1e-300)))
