"""Dim cubes: each pixel's photons together with those of its neighbours, over a window that the likelihood chooses.

Local likelihood on a plane (Tibshirani and Hastie, J. Am. Stat. Assoc. 82, 559, 1987), its window chosen by the
likelihood of photons that were left out: docs/reconstruction.md, section 10.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruct.histogram_record import relative_width
from mars_lidar.reconstruct.histograms import Histograms
from mars_lidar.reconstruct.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruct.method import Estimates, Flags, Method

MOST_RADIUS = 12
_PATCH = 2  # pixels around each, over which left-out photons are summed up
_NEAR = 3.0  # widths of the pulse, within which other windows speak of the same surface
_AROUND = 2  # pixels to each side whose planes are heard on the bias
# of the exposure, on average: above it a pixel's own photons are enough, and planes neglect dead time
_MOST_BLIND = 0.05


@dataclass(frozen=True)
class Neighbourhood(Method):
    """Maximum likelihood of a plane over the window around each pixel, of the radius that predicts it best.

    Parameters
    ----------
    radius
        The largest window reaches so many pixels to each side, in [1, 12].
    false_alarm
        As of `MaximumLikelihood`, of the pooled photons.
    """

    radius: int = 4
    false_alarm: float = 0.01

    name = "neighbourhood"
    modes = ("nonparalyzable",)
    assumes = "little light, surfaces that are flat over some pixels"
    windows = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", checks.integer("neighbourhood", self.radius, low=1, high=MOST_RADIUS))
        checks.real("false_alarm", self.false_alarm, low=1e-12, high=0.5)

    def least_gain(self, system: System) -> float:
        """As of `MaximumLikelihood`, with the tilts that a window tells apart as further places."""
        tilts = float(2 * self.radius + 1) ** 2
        return MaximumLikelihood(false_alarm=max(self.false_alarm / tilts, 1e-12)).least_gain(system)

    def estimate(self, histograms: Histograms) -> Estimates:
        """Estimates of the chosen windows; errors of delays know the spread between windows and planes around."""
        if len(histograms.image) < 2:
            raise ValueError(
                f"neighbourhood={self.radius} needs images, a cube (..., H, W, bins), got leading axes "
                f"{histograms.image}"
            )
        height, width = histograms.image[-2:]
        blind = float(_blind(histograms).mean())
        if blind > _MOST_BLIND:
            raise ValueError(
                f"neighbourhood is for dim cubes: dead times take {100.0 * blind:.3g} % of this exposure, more than "
                f"{100.0 * _MOST_BLIND:g} %; each pixel has photons enough of its own"
            )
        images = histograms.counts.reshape(-1, height * width, histograms.system.bins)
        parts = [
            self._image(replace(histograms, counts=counts, image=(height, width)), height, width) for counts in images
        ]
        return Estimates(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})

    def _image(self, given: Histograms, height: int, width: int) -> dict[str, NDArray[np.generic]]:
        from mars_lidar._base.native import _core

        counts = np.round(given.counts).astype(np.int64)
        first = np.concatenate([[0], counts.sum(-1).cumsum()])
        bins = np.repeat(np.nonzero(counts)[1], counts[counts > 0]).astype(np.int32)
        exposure = given.system.cycles * (1.0 - _blind(given))
        planes, fits = _first_planes(given, counts.reshape(height, width, -1)), []
        for radius in range(1, self.radius + 1):
            found, out = np.empty_like(planes), np.empty((len(counts), 7))
            _core.surface_fits(
                given.recording,
                first,
                bins,
                exposure,
                width=width,
                radius=radius,
                tilted=radius > 1,
                before=planes,
                planes=found,
                out=out,
                threads=given.threads,
                progress=given.progress if radius == self.radius else None,
            )
            planes = found
            fits.append(np.concatenate([found[:, 1:], out], axis=-1))
        every = np.stack(fits)  # (radii, pixels, 10): delay, right, down; S, B, errors of S, B and delay, gain, score
        return self._chosen(given.system, every, height, width, first[1:] == first[:-1])

    def _chosen(
        self, system: System, every: FloatArray, height: int, width: int, empty: NDArray[np.bool_]
    ) -> dict[str, NDArray[np.generic]]:
        """The window of each pixel by the photons left out around it, and what windows of other sizes say of it."""
        from scipy.ndimage import uniform_filter

        side = 2 * _PATCH + 1
        score = np.stack(
            [uniform_filter(one.reshape(height, width), side, mode="mirror").ravel() for one in every[..., 9]]
        )
        score *= side**2
        best = score.argmax(0)
        chosen = np.take_along_axis(every, best[None, :, None], axis=0)[0]
        delay, right, down, signal, background, signal_error, background_error, _, gain, _ = chosen.T
        weight = np.exp(score - score.max(0))
        apart = every[..., 0] - delay
        apart -= np.round(apart)
        near = _NEAR * relative_width(system)
        weight = np.where(np.abs(apart) < near, weight, 0.0)
        weight /= weight.sum(0)
        within = np.where(weight > 0.0, weight * every[..., 7] ** 2, 0.0).sum(0)
        between = (weight * apart**2).sum(0)
        on_image = (height, width)
        around = _around(delay.reshape(on_image), right.reshape(on_image), down.reshape(on_image), near).ravel()
        flags = np.where(gain < self.least_gain(system), Flags.NO_SIGNAL, 0).astype(np.uint8)
        lost = gain <= 0.0
        flags[lost & empty] |= np.uint8(Flags.EMPTY)
        return {
            "signal": signal,
            "background": background,
            "delay": np.where(lost, np.nan, delay),
            "flags": flags,
            "signal_error": signal_error,
            "background_error": background_error,
            "delay_error": np.sqrt(within + between + around),
            "significance": np.sqrt(gain),
            "radius": (best + 1).astype(np.uint8),
        }


def _around(delay: FloatArray, right: FloatArray, down: FloatArray, most: float) -> FloatArray:
    """Mean square (H, W) of what the planes of the pixels around say of this one's delay, less that, in periods.

    NaN where one of them is further off than `most`: an edge lies between, whose bias no window tells.
    """
    height, width = delay.shape
    total, number = np.zeros((height, width)), np.zeros((height, width))
    for dy in range(-_AROUND, _AROUND + 1):
        for dx in range(-_AROUND, _AROUND + 1):
            here = slice(max(-dy, 0), height - max(dy, 0)), slice(max(-dx, 0), width - max(dx, 0))
            there = slice(max(dy, 0), height - max(-dy, 0)), slice(max(dx, 0), width - max(-dx, 0))
            off = delay[there] - right[there] * dx - down[there] * dy - delay[here]
            off -= np.round(off)
            total[here] += np.where(np.abs(off) < most, off**2, np.nan)
            number[here] += 1.0
    return np.asarray(total / number)


def _blind(given: Histograms) -> FloatArray:
    """Share of the exposure that each pixel's dead times take (pixels,)."""
    return np.asarray(given.counts.sum(-1, dtype=np.float64) * given.system.dead_time_periods / given.system.cycles)


def _first_planes(given: Histograms, counts: NDArray[np.int64]) -> FloatArray:
    """Planes (pixels, 4) that lie flat, by maximum likelihood of the 3 x 3 pixels around each."""
    from scipy.ndimage import convolve1d

    def around(values: NDArray[np.int64]) -> NDArray[np.int64]:
        rows = convolve1d(values, np.ones(3, np.int64), axis=0, mode="constant")
        return np.asarray(convolve1d(rows, np.ones(3, np.int64), axis=1, mode="constant"))

    pooled = around(counts).reshape(-1, counts.shape[-1]).astype(np.uint32)
    pixels = around(np.ones(counts.shape[:2], np.int64)).ravel()
    planes = np.zeros((len(pooled), 4))
    for number in np.unique(pixels):
        here = pixels == number
        system = given.system.replace(cycles=int(number) * given.system.cycles)
        found = MaximumLikelihood(less_bias=False).estimate(Histograms(pooled[here], system, given.threads))
        light = found.signal + found.background
        share = np.where(light > 0.0, found.signal / np.where(light > 0.0, light, 1.0), 0.5)
        planes[here, 0] = np.clip(np.nan_to_num(share, nan=0.5), 0.05, 0.95)
        planes[here, 1] = np.nan_to_num(found.delay)
    return planes
