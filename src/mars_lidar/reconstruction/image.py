"""Depth and signal of an image from a few photons a pixel: docs/theory_reconstruction.md, section 7.

The posterior of each pixel is computed on the two comb trees of the image; then planes are fitted to the photons around
it. In the trained method two small networks choose among the peaks of the posterior and weight the planes. The steps
are in native/image/solver.h.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.engines.simulation import simulate
from mars_lidar.instrument.pulse import SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction.histogram_record import relative_width
from mars_lidar.reconstruction.histograms import Histograms
from mars_lidar.reconstruction.image_network import card, networks, trained_for
from mars_lidar.reconstruction.image_pulse import centroid_error, settings_of
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruction.method import Estimates, Flags, Method
from mars_lidar.reconstruction.photons import Photons
from mars_lidar.reconstruction.returns import MOST_RETURNS, RETURN_COLUMNS

VOLUME_BYTES = 96 * 2**20  # of each of three volumes (rows, columns, cells): larger images are computed in parts
BLOCK_PIXELS = 2**17  # of the second network at a time
NORMAL_HALF_WIDTH = NormalDist().inv_cdf(0.95)  # standard errors to either side that hold 90 %
_SELF_BLIND = 1.0  # signal photons per period, above which few pixels are armed in the later part of a pulse
_BRIGHT_BYTES = 64 * 2**20  # of the counts of such pixels at a time
_PLANE, _PLANES = 32, 4  # pixels a side of a simulated plane, and their number
_SLOPES = 0.06, 0.03  # widths of the pulse from row to row and from column to column
_PLACES = 16  # parts of the period, in one of which a plane's delay begins
_NO_SURFACE = np.uint8(Flags.EMPTY | Flags.FILLED)
_REJECTED = np.uint8(Flags.EMPTY | Flags.NO_SIGNAL | Flags.SATURATED | Flags.UNCONVERGED)


@dataclass(frozen=True, eq=False)
class Image(Method):
    """Depth and signal of every pixel from its photons and those of its neighbours, by networks where they apply.

    Intervals contain the delay with probability 0.9; none is given if the probability of an outlier exceeds 0.1.

    Parameters
    ----------
    efficiency
        (H, W) relative detection efficiency of each pixel, 0 for dead pixels; None: equal. Signal and background are
        those of a pixel with the mean efficiency of the pixels that are not dead.
    returns
        Largest number of returns in a pixel, 1 to 8, each estimated from the photons outside the pulses of the others.
        A return is given if its interval is. `signal` and `delay_ns` are then those of the strongest.

    Raises
    ------
    TypeError
        `returns` is not a number.
    ValueError
        An invalid efficiency; ``check``: a detector to which this method does not apply.

    See Also
    --------
    UntrainedImage, MaximumLikelihood, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> scene = ml.Scene.example("room", size=32)
    >>> counts = ml.simulate(scene.flux(system, signal=0.002, sbr=1.0), system, seed=0)  # 2 photons a pixel
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.Image())
    >>> bool(((abs(maps.depth_m[0] - scene.depth_m) < 0.5).mean()) > 0.85)
    True
    """

    efficiency: FloatArray | None = None
    returns: int = 1

    name = "image"
    modes = ("nonparalyzable", "synchronous", "gated")
    windows = False
    of_images = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "returns", checks.integer("returns", self.returns, low=1, high=MOST_RETURNS))
        if self.efficiency is None:
            return
        given = np.array(self.efficiency, np.float64)
        if given.ndim != 2 or not np.isfinite(given).all() or (given < 0.0).any() or not given.any():
            raise ValueError(
                f"efficiency must be an image (H, W) of numbers of 0 or more, not all 0, got shape {given.shape}"
            )
        object.__setattr__(self, "efficiency", given / given[given > 0.0].mean())

    def estimate(self, histograms: Histograms) -> Estimates:
        """Estimates of each image of the counts (..., H, W, bins) in `histograms`."""
        if len(histograms.image) < 2:
            raise ValueError(
                f"method {self.name!r} needs images, a cube (..., H, W, bins), got leading axes {histograms.image}"
            )
        height, width = histograms.image[-2:]
        cubes = histograms.counts.reshape(-1, height * width, histograms.system.bins)
        estimates = []
        for k, counts in enumerate(cubes):
            estimates.append(self.of_photons(Photons.of(counts, height, width), histograms.system, histograms.threads))
            if histograms.progress is not None:
                histograms.progress(k + 1, len(cubes))
        return Estimates.joined(estimates)

    def of_photons(self, photons: Photons, system: System, threads: int) -> Estimates:
        """Estimates of one image from its `photons` (times by pixel), recorded by `system`, on `threads` threads."""
        image = photons.height, photons.width
        if self.efficiency is not None and self.efficiency.shape != image:
            raise ValueError(f"efficiency must be of the image's {image} pixels, got shape {self.efficiency.shape}")
        if self.returns == 1:
            return self._surface(photons, photons.number, system, threads)
        setting = settings_of(system)[-1]
        surfaces: list[Estimates] = []
        for k in 2 * tuple(range(self.returns)):  # twice: the first surface needs the others
            others = surfaces[:k] + surfaces[k + 1 :]
            counted, share = _outside(photons, others, setting)
            surface = self._surface(photons, counted, system, threads)
            surfaces[k : k + 1] = [replace(surface, background=surface.background / share)]
        return _several(surfaces)

    def _surface(
        self, photons: Photons, counted: NDArray[np.float32], system: System, threads: int, *, checked: bool = True
    ) -> Estimates:
        """One surface, from the photons that are `counted` (entries,).

        `checked`: for a measured pulse the networks are used only if their intervals hold on a simulated plane.
        """
        pixels = photons.height * photons.width
        settings = settings_of(system)
        solver = solver_of(photons, threads, self.efficiency, counted)
        maps, flags = np.empty((_core.IMAGE_SIZES["maps"], pixels)), np.empty(pixels, np.uint8)
        trained = self._networks(system)
        solver.solve(settings, trained, maps=maps, flags=flags)
        if trained is not None and checked and not _hold_for(system, maps):
            solver.solve(settings, None, maps=maps, flags=flags)
        delay, half_width, deviation, outlier, signal, signal_error, background, number = maps
        of_bins, largest = centroid_error(system)
        deviation, half_width = np.hypot(deviation, of_bins), np.hypot(half_width, largest)
        estimates = Estimates(
            signal=signal,
            background=background,
            delay=delay,
            flags=flags,
            signal_error=signal_error,
            delay_error=deviation,
            half_width=half_width,
            outlier=outlier,
        )
        if self.returns == 1:
            width = settings[-1].sigma / settings[-1].cells
            self_blind = signal > _SELF_BLIND
            bright = np.flatnonzero((number > _core.IMAGE_BRIGHT) | self_blind)
            signal_error[self_blind] = np.nan  # unless the refit of the pixel below gives it
            _refit_bright(estimates, bright, width, photons, system, self.efficiency, threads)
        return estimates

    def _networks(self, system: System) -> _core.ImageNetworks | None:
        return networks() if trained_for(system.pulse) else None


@dataclass(frozen=True, eq=False)
class UntrainedImage(Image):
    """As `Image`, without networks: the largest peak of the posterior, and the largest consistent window.

    Parameters
    ----------
    efficiency, returns
        As for `Image`.

    Raises
    ------
    TypeError
        `returns` is not a number.
    ValueError
        An invalid efficiency; ``check``: a detector to which this method does not apply.

    See Also
    --------
    Image, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> scene = ml.Scene.example("room", size=32)
    >>> counts = ml.simulate(scene.flux(system, signal=0.005, sbr=1.0), system, seed=0)  # 5 photons a pixel
    >>> maps = ml.reconstruct(counts, system, ml.reconstruction.UntrainedImage())
    >>> bool(((abs(maps.depth_m[0] - scene.depth_m) < 0.5).mean()) > 0.85)
    True
    """

    name = "image_untrained"

    def _networks(self, system: System) -> _core.ImageNetworks | None:
        return None


def _hold_for(system: System, maps: FloatArray) -> bool:
    """Whether the networks' intervals hold for this pulse, in light like that of an image's `maps`."""
    if not isinstance(system.pulse, SampledPulse):
        return True
    delay, _, _, _, signal, _, background, _ = maps
    low, high = card()["holds_for"]["signal"]
    if not low <= signal.mean() * system.cycles <= high:  # none are used
        return True
    middle = np.angle(np.exp(2j * np.pi * delay[np.isfinite(delay)]).sum()) / (2.0 * np.pi)
    octaves = np.log2(np.maximum([signal.mean(), background.mean()], 1e-12)).round()
    return _plane_holds(system, float(octaves[0]), float(octaves[1]), int(np.round(middle * _PLACES)) % _PLACES)


@lru_cache(maxsize=64)
def _plane_holds(system: System, signal_octave: float, background_octave: float, place: int) -> bool:
    """Whether 90 % of the networks' intervals hold in simulated planes, the easiest of surfaces, at such a delay."""
    across = np.arange(_PLANE)
    step = relative_width(system) * system.period_ns
    delay = system.period_ns * place / _PLACES + step * (_SLOPES[0] * across[:, None] + _SLOPES[1] * across)
    flux = Flux(np.full(delay.shape, 2.0**signal_octave), 2.0**background_octave, delay)
    held = []
    for seed in range(_PLANES):
        counts = simulate(flux, system, seed=seed)[0]
        photons = Photons.of(counts.reshape(-1, system.bins), _PLANE, _PLANE)
        estimates = Image()._surface(photons, photons.number, system, 1, checked=False)
        assert estimates.half_width is not None
        stated = np.isfinite(estimates.half_width)
        off = (estimates.delay - delay.ravel() / system.period_ns + 0.5) % 1.0 - 0.5
        held.append((np.abs(off) <= estimates.half_width)[stated])
    every = np.concatenate(held)
    return bool(every.size == 0 or every.mean() >= 0.9)


def solver_of(
    photons: Photons, threads: int, efficiency: FloatArray | None = None, counted: NDArray[np.float32] | None = None
) -> _core.ImageSolver:
    """The native solver of one image; `counted`: photons of each entry that are not attributed to another surface."""
    return _core.ImageSolver(
        height=photons.height,
        width=photons.width,
        first=photons.first,
        bin=photons.bin,
        number=photons.number,
        counted=photons.number if counted is None else counted,
        efficiency=np.empty(0) if efficiency is None else efficiency.ravel(),
        volume_bytes=VOLUME_BYTES,
        block_pixels=BLOCK_PIXELS,
        threads=threads,
    )


def _outside(
    photons: Photons, surfaces: list[Estimates], setting: _core.ImageSetting
) -> tuple[NDArray[np.float32], FloatArray]:
    """Photons (entries,) outside the pulses of `surfaces`, and the share (pixels,) of the period outside them."""
    first, last = (end / setting.cells for end in setting.pulse)
    counted, share = photons.number.copy(), np.ones(photons.height * photons.width)
    for each in surfaces:
        there = each.flags & _NO_SURFACE == 0
        since = (photons.bin + 0.5) / setting.bins - each.delay[photons.pixel] - first
        counted[there[photons.pixel] & (since % 1.0 < last - first)] = 0.0
        share -= there * (last - first)
    return counted, np.maximum(share, 1.0 / setting.cells)


def _several(surfaces: list[Estimates]) -> Estimates:
    """Of each pixel the surfaces that have an interval, nearest first; and the maps of the strongest of them."""
    every = {each.name: [getattr(surface, each.name) for surface in surfaces] for each in fields(Estimates)}
    maps = {name: np.stack(values, -1) for name, values in every.items() if values[0] is not None}
    maps["false_alarm"] = maps["outlier"]
    stated = np.isfinite(maps["half_width"])
    returns = np.stack([np.where(stated, maps[name], np.nan) for name in RETURN_COLUMNS], -1)
    order = np.argsort(returns[..., 0], -1)  # NaN last
    strongest = np.where(stated, maps["signal"], -1.0).argmax(-1)[:, None]
    chosen = {name: np.take_along_axis(values, strongest, -1)[:, 0] for name, values in maps.items()}
    del chosen["false_alarm"]
    return Estimates(**chosen, returns=np.take_along_axis(returns, order[..., None], 1))


def _refit_bright(
    estimates: Estimates,
    pixels: NDArray[np.int64],
    width: float,
    photons: Photons,
    system: System,
    efficiency: FloatArray | None,
    threads: int,
) -> None:
    """Maximum likelihood of bright pixels, each alone, where its delay is within 3 widths of the image's."""
    step = max(1, _BRIGHT_BYTES // (4 * system.bins))
    for begin in range(0, len(pixels), step):
        part = pixels[begin : begin + step]
        counts = np.zeros((len(part), system.bins), np.uint32)
        for row, p in zip(counts, part, strict=True):
            entries = slice(photons.first[p], photons.first[p + 1])
            row[photons.bin[entries]] = photons.number[entries]
        own = MaximumLikelihood().estimate(Histograms(counts, system, threads))
        off = (own.delay - estimates.delay[part] + 0.5) % 1.0 - 0.5
        same = (np.abs(off) < 3.0 * width) & (own.flags & _REJECTED == 0)
        to = part[same]
        share = 1.0 if efficiency is None else efficiency.ravel()[to]
        for name in ("delay", "delay_error"):
            getattr(estimates, name)[to] = getattr(own, name)[same]
        for name in ("signal", "background", "signal_error"):
            getattr(estimates, name)[to] = getattr(own, name)[same] / share
        if estimates.half_width is not None and own.delay_error is not None:
            estimates.half_width[to] = NORMAL_HALF_WIDTH * own.delay_error[same]
        estimates.flags[to] = own.flags[same]
