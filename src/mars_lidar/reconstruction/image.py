"""Depth and signal of an image from a few photons a pixel: docs/theory_reconstruction.md, section 7.

Each pixel's posterior on the two comb trees of the image, then planes through the photons about it; trained, two small
networks choose among the posterior's peaks and weigh the planes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction import image_stages as stages
from mars_lidar.reconstruction.histograms import Histograms
from mars_lidar.reconstruction.image_network import OUTLIER_SIGMA, RADII, REACH, Floats, Networks, networks, weigh
from mars_lidar.reconstruction.image_pulse import CELLS_PER_SIGMA, Cells, cell_count, cells_of
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruction.method import Estimates, Flags, Method
from mars_lidar.reconstruction.photons import Photons

LEVEL = 0.9  # of the intervals
FILLED_ABOVE = 0.5  # probability of an outlier, from which on a pixel takes the delay of those around it
_MOST_CELLS = 4096  # a period, of the sum-product: narrower pulses are first blurred to it
_KAPPA = 1.2  # standard errors to either side, in which windows of all sizes must agree
_SCALE = (
    1.05  # of a Laplace distribution, in the error of `_untrained`: 90 % of the errors in the scenes of studies/image
)
_BLOCK_PIXELS = 2**17  # of the second network at a time
_OWN = 20.0  # signal photons of a pixel, from which on it is a window of its own
_ALONE = 200.0  # and from which on nothing around it tells more than its own likelihood
_ALONE_BYTES = 64 * 2**20  # of their counts at a time
_NOT_ALONE = np.uint8(Flags.EMPTY | Flags.NO_SIGNAL | Flags.SATURATED | Flags.UNCONVERGED)
_NORMAL = 1.645  # standard errors to either side that hold 90 % of a normal distribution


@dataclass(frozen=True, eq=False)
class Image(Method):
    """Depth and signal of every pixel from its photons and those of the image around it, trained where that holds.

    Intervals hold the delay with probability `LEVEL`; none is given where an outlier is likelier than the rest.

    Parameters
    ----------
    efficiency
        (H, W) of each pixel, as a share of that of the others, 0 for pixels that see nothing; None: all alike. Signal
        and background are those of a pixel of the map's mean.

    Raises
    ------
    ValueError
        An efficiency that is no such map; ``check``: a detector that this method does not hold for.

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

    name = "image"
    modes = ("nonparalyzable", "synchronous", "gated")
    assumes = "surfaces that continue from pixel to pixel"
    windows = False
    of_images = True

    def __post_init__(self) -> None:
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
        found = []
        for k, counts in enumerate(cubes):
            found.append(self.of_photons(Photons.of(counts, height, width), histograms.system, histograms.threads))
            if histograms.progress is not None:
                histograms.progress(k + 1, len(cubes))
        return Estimates.joined(found)

    def of_photons(self, photons: Photons, system: System, threads: int) -> Estimates:
        """Estimates of one image from its `photons` (times by pixel), recorded by `system`, on so many `threads`."""
        image = photons.height, photons.width
        if self.efficiency is not None and self.efficiency.shape != image:
            raise ValueError(f"efficiency must be of the image's {image} pixels, got shape {self.efficiency.shape}")
        return _estimate(photons, system, self.efficiency, self._networks(), threads)

    def _networks(self) -> Networks | None:
        return networks()


@dataclass(frozen=True, eq=False)
class UntrainedImage(Image):
    """As `Image`, with nothing trained: the largest peak of the posterior, and the largest window that agrees.

    Parameters
    ----------
    efficiency
        As of `Image`.

    Raises
    ------
    ValueError
        An efficiency that is no such map; ``check``: a detector that this method does not hold for.

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

    def _networks(self) -> Networks | None:
        return None


@dataclass(frozen=True, eq=False)
class _Result:
    """In cells and photons, each (pixels,); `scale` of a Laplace distribution, cells; `doubt`: chance of an outlier.

    `half`: half the width of the interval, cells, NaN where none is stated.
    """

    delay: FloatArray
    scale: FloatArray
    doubt: FloatArray
    half: FloatArray
    signal: FloatArray
    signal_scale: FloatArray  # of its logarithm


def _estimate(
    photons: Photons, system: System, efficiency: FloatArray | None, nets: Networks | None, threads: int
) -> Estimates:
    blurs = _blurs(system)
    cells = cells_of(system, blurs[0])
    light = stages.first_light(photons, cells, efficiency)
    delay = stages.first_delays(photons, cells, light, threads)
    light = stages.light_at(photons, cells, delay, light, threads)
    here = ~light.missing
    if nets is not None and not (
        here.any()
        and nets.holds_for(
            signal=float(light.signal[here].mean()),
            background=float(light.background[here].mean()),
            cells=cell_count(system),
            side=min(photons.height, photons.width),
        )
    ):
        nets = None
    chosen = stages.choice(photons, cells, light, nets, threads)
    for blur in blurs[1:]:  # the same surfaces, seen with half the blur each time
        delay = _by_planes(photons, cells, chosen.delay, light, threads)
        finer = cells_of(system, blur)
        scale = np.float32(finer.count / cells.count)
        chosen = stages.Choice((delay * scale) % finer.count, *_others(chosen))
        cells = finer
    light = stages.light_at(photons, cells, chosen.delay, light, threads)
    seen = stages.photometry(photons, cells, chosen.delay, light, threads)
    result = _untrained(seen, chosen, cells, threads) if nets is None else None
    if nets is not None:
        result = _trained(seen, chosen, light, cells, nets, threads)
    assert result is not None
    estimates = _estimates(result, light, photons, system, cells)
    bright = np.flatnonzero(seen.number.ravel() > _ALONE)
    _alone(estimates, bright, light.efficiency.ravel()[bright], photons, system, cells, threads)
    return estimates


def _alone(
    estimates: Estimates,
    pixels: NDArray[np.int64],
    efficiency: FloatArray,
    photons: Photons,
    system: System,
    cells: Cells,
    threads: int,
) -> None:
    """Maximum likelihood of the brightest pixels, each alone, where it finds the same surface."""
    step = max(1, _ALONE_BYTES // (4 * system.bins))
    for begin in range(0, len(pixels), step):
        part = pixels[begin : begin + step]
        counts = np.zeros((len(part), system.bins), np.uint32)
        for row, p in zip(counts, part, strict=True):
            entries = slice(photons.first[p], photons.first[p + 1])
            row[photons.bin[entries]] = photons.number[entries]
        own = MaximumLikelihood().estimate(Histograms(counts, system, threads))
        off = (own.delay - estimates.delay[part] + 0.5) % 1.0 - 0.5
        same = (np.abs(off) * cells.count < 3.0 * cells.sigma) & (own.flags & _NOT_ALONE == 0)
        to, share = part[same], efficiency[begin : begin + step][same]
        for name in ("delay", "delay_error"):
            getattr(estimates, name)[to] = getattr(own, name)[same]
        for name in ("signal", "background", "signal_error"):
            getattr(estimates, name)[to] = getattr(own, name)[same] / share
        if estimates.half_width is not None and own.delay_error is not None:
            estimates.half_width[to] = _NORMAL * own.delay_error[same]
        estimates.flags[to] = own.flags[same]


def _blurs(system: System) -> list[float]:
    """Standard deviations of the blur, in periods, from that which the cells of the sum-product hold down to none."""
    if cell_count(system) <= _MOST_CELLS:
        return [0.0]
    blur, out = CELLS_PER_SIGMA / (_MOST_CELLS - 16), []
    while cell_count(system, 0.5 * blur) < cell_count(system):
        out.append(blur)
        blur *= 0.5
    return [*out, 0.0]


def _others(chosen: stages.Choice) -> tuple[Floats, ...]:
    return chosen.confidence, chosen.mass, chosen.spread, chosen.broad


def _by_planes(photons: Photons, cells: Cells, delay: Floats, light: stages.Light, threads: int) -> Floats:
    """Delays (pixels,) of the largest windows that agree with all smaller ones."""
    seen = stages.photometry(photons, cells, delay, light, threads)
    offset = np.concatenate([_agreeing(seen, cells, rows, threads)[0].ravel() for rows in _blocks(seen)])
    return np.asarray((delay + offset * cells.sigma) % cells.count, np.float32)


def _blocks(seen: stages.Photometry) -> list[slice]:
    height, width = seen.delay.shape
    step = max(1, _BLOCK_PIXELS // width)
    return [slice(y, min(height, y + step)) for y in range(0, height, step)]


def _agreeing(
    seen: stages.Photometry, cells: Cells, rows: slice, threads: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Offset and standard error in sigma, signal and its photons, of the largest window that agrees with all smaller.

    Intersection of confidence intervals (Katkovnik, IEEE Trans. Signal Process. 47, 2567, 1999).
    """
    plane = stages.planes(seen, cells, rows.start, rows.stop, threads)
    number = seen.number[rows]
    own = number > _OWN
    offset = np.concatenate([(seen.offset[rows] / cells.sigma)[..., None], plane[..., 0]], -1)
    alone = np.where(own, 1.0 / np.sqrt(np.maximum(number, 1e-3)), 9.0)
    error = np.maximum(np.concatenate([alone[..., None], np.maximum(plane[..., 1], 0.03)], -1), 1e-3)
    signal = np.concatenate([(number / np.maximum(seen.exposure[rows], 1e-3))[..., None], plane[..., 5]], -1)
    light = np.concatenate([number[..., None], plane[..., 4]], -1)
    low, high = np.full(number.shape, -np.inf), np.full(number.shape, np.inf)
    best, agrees = np.where(own, 0, 1), np.ones(number.shape, bool)
    for k in range(len(RADII) + 1):
        low = np.maximum(low, offset[..., k] - _KAPPA * error[..., k])
        high = np.minimum(high, offset[..., k] + _KAPPA * error[..., k])
        agrees &= low <= high
        best = np.where(agrees & (k > 0), k, best)
    pick = [np.take_along_axis(x, best[..., None], -1)[..., 0] for x in (offset, error, signal, light)]
    return pick[0], pick[1], pick[2], pick[3]


def _untrained(seen: stages.Photometry, chosen: stages.Choice, cells: Cells, threads: int) -> _Result:
    rows = [[x.ravel() for x in _agreeing(seen, cells, rows, threads)] for rows in _blocks(seen)]
    offset, error, signal, light = (np.concatenate(each) for each in zip(*rows, strict=True))
    doubt = np.clip(1.0 - chosen.broad.astype(np.float64), 0.0, 1.0)
    # the window's error knows nothing of what is rough within it; half the posterior's spread does
    scale = _SCALE * np.hypot(error * cells.sigma, 0.5 * chosen.spread.astype(np.float64))
    return _Result(
        delay=seen.delay.ravel().astype(np.float64) + offset * cells.sigma,
        scale=scale,
        doubt=doubt,
        half=half_width(scale, doubt),
        signal=np.maximum(signal.astype(np.float64), 0.02),
        signal_scale=np.sqrt(0.5 / np.maximum(light, 0.5)),
    )


def _trained(
    seen: stages.Photometry,
    chosen: stages.Choice,
    light: stages.Light,
    cells: Cells,
    nets: Networks,
    threads: int,
) -> _Result:
    parts = []
    height = seen.delay.shape[0]
    for rows in _blocks(seen):
        wide = slice(max(0, rows.start - REACH), min(height, rows.stop + REACH))
        plane = stages.planes(seen, cells, wide.start, wide.stop, threads)
        features, delays, log_signal = stages.plane_features(plane, chosen, light, seen, cells, wide)
        kept = slice(rows.start - wide.start, rows.stop - wide.start)
        outputs = weigh(features, nets.weigh, threads)[:, kept]
        parts.append([x.ravel() for x in combined(outputs, delays[:, kept], log_signal[:, kept])])
    offset, log_scale, logit, log_half, signal, signal_scale = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    doubt = 1.0 / (1.0 + np.exp(-logit))
    half = float(nets.card["interval_factor"]) * np.exp(log_half)
    half[(half > OUTLIER_SIGMA) | (doubt > 1.0 - LEVEL)] = np.nan
    return _Result(
        delay=seen.delay.ravel().astype(np.float64) + offset * cells.sigma,
        scale=np.exp(log_scale) * cells.sigma,
        doubt=doubt,
        half=half * cells.sigma,
        signal=np.exp(signal),
        signal_scale=np.exp(signal_scale),
    )


def combined(
    outputs: Floats, delays: Floats, log_signal: Floats
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of `outputs` (delays + signals + 5, H, W), where delays and signals are weighed: six images.

    Offset, log of its Laplace scale and of half its interval in sigma, logit of an outlier between them, log of the
    signal and of its scale.
    """
    k, m = len(delays), len(log_signal)
    o = outputs.astype(np.float64)
    weight, share, rest = _softmax(o[:k]), _softmax(o[k : k + m]), o[k + m :]
    offset = (weight * delays).sum(0) + 0.3 * np.clip(rest[3], -3.0, 3.0)
    signal = np.log((share * np.exp(log_signal)).sum(0))
    return (
        offset,
        np.clip(rest[0], -4.0, 3.0) - 1.5,
        rest[1] - 2.0,
        np.clip(rest[4], -4.0, 3.0) - 0.7,
        signal,
        np.clip(rest[2], -4.0, 3.0) - 1.0,
    )


def _softmax(x: FloatArray) -> FloatArray:
    e = np.exp(x - x.max(0))
    return np.asarray(e / e.sum(0))


def half_width(scale: FloatArray, doubt: FloatArray) -> FloatArray:
    """Half width of the interval that holds the delay with probability `LEVEL`; NaN where outliers are more than that.

    Laplace of this scale with probability 1 - doubt, anywhere else otherwise.
    """
    room = 1.0 - LEVEL - doubt
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(room > 0.05 * (1.0 - LEVEL), scale * np.log((1.0 - doubt) / room), np.nan)


def _estimates(result: _Result, light: stages.Light, photons: Photons, system: System, cells: Cells) -> Estimates:
    shape = light.signal.shape
    empty = photons.first[-1] == 0
    delay = (result.delay / cells.count) % 1.0
    fill = (result.doubt > FILLED_ABOVE) | light.missing.ravel()
    half = np.where(fill, np.nan, result.half / cells.count)
    delay = filled(delay.reshape(shape), fill.reshape(shape)).ravel()
    flags = np.where(fill, Flags.FILLED, 0).astype(np.uint8)
    flags[np.diff(photons.first) == 0] |= np.uint8(Flags.EMPTY) if empty else np.uint8(0)
    signal = result.signal / system.cycles
    deviation = np.where(np.isfinite(half), np.sqrt(2.0) * result.scale / cells.count, np.nan)
    return Estimates(
        signal=np.where(empty, 0.0, signal),
        background=np.where(empty, 0.0, light.background.ravel() / system.cycles),
        delay=np.where(empty, np.nan, delay),
        flags=flags,
        signal_error=np.sqrt(2.0) * result.signal_scale * signal,
        delay_error=deviation,
        half_width=half,
        outlier=np.where(light.missing.ravel(), 1.0, result.doubt),
    )


def filled(delay: FloatArray, fill: NDArray[np.bool_]) -> FloatArray:
    """Delays (H, W), in periods, with those to `fill` as the median of the others within two pixels, borders first."""
    if fill.all():
        return delay
    # unwrapped about the mean direction of all
    middle = np.angle(np.exp(2j * np.pi * delay[~fill]).mean()) / (2.0 * np.pi)
    d = np.where(fill, np.nan, (delay - middle + 0.5) % 1.0)
    width = d.shape[1]
    left = np.flatnonzero(fill.ravel())
    while left.size:
        padded = np.pad(d, 2, constant_values=np.nan)
        y, x = np.divmod(left, width)
        around = np.stack([padded[y + j, x + i] for j in range(5) for i in range(5)])
        number = np.isfinite(around).sum(0)
        enough = number >= min(5, int(number.max()))
        d.ravel()[left[enough]] = np.nanmedian(around[:, enough], axis=0)
        left = left[~enough]
    return np.asarray((d + middle - 0.5) % 1.0)
