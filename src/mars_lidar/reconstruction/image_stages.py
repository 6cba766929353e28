"""Depth from a few photons a pixel, stage by stage: docs/theory_reconstruction.md, section 7.

Sum-product on the two comb trees of each pixel (Bleyer and Gelautz, VISAPP 2008, with sums for maxima), and planes
through the photons about the delays that it gives. All in cells of delay, photons, and sigma of the pulse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.image_network import HIDDEN, OFFSETS, PEAKS, RADII, Floats, Networks, offsets
from mars_lidar.reconstruction.image_pulse import NEAR, Cells
from mars_lidar.reconstruction.photons import Photons

# the prior of a step to the next pixel: Gaussian of so many sigma; shares within 15 cells, and to anywhere
STEP_SIGMA, WIDE, JUMP = 0.5, 0.3, 0.15
VOLUME_BYTES = 96 * 2**20  # of each of three volumes (rows, columns, cells): larger images are done in parts
_OVERLAP = 24  # pixels that parts reach into each other: a message from farther off has weight (1 - JUMP)^24 at most
_SURROUNDINGS = 5  # pixels a side, over which signal is averaged
_BACKGROUND_SIDE = 9  # pixels a side, over which background is averaged
# how often a pixel's background is so many times that around it: hot pixels
_HOT, _HOT_SHARE = np.array([1.0, 4.0, 16.0, 64.0, 256.0, 1024.0]), np.array([0.98, 0.01, 0.004, 0.002, 0.002, 0.002])
_MISSING = 1e-4  # chance of no registration, by the pixels around, below which a pixel counts as missing
_SETTLED = 0.98  # posterior mass of the largest peak, above which there is nothing to choose
_SURVEY = 2**16  # pixels, of which the share of signal is taken at first
_MARGIN = RADII[-1]


@dataclass(frozen=True, eq=False)
class Light:
    """Signal and background of each pixel (H, W), photons of an exposure that is never blind, and where none came.

    They are those of a pixel of mean efficiency; `efficiency` (H, W) is each pixel's own, relative to the mean.
    """

    signal: FloatArray
    background: FloatArray
    missing: NDArray[np.bool_]
    efficiency: FloatArray

    @property
    def ratio(self) -> Floats:
        """Signal to background (pixels,)."""
        ratio = self.signal / np.maximum(self.background, 0.02)
        return np.ascontiguousarray(ratio.ravel(), np.float32)


@dataclass(frozen=True, eq=False)
class Choice:
    """Of each pixel (pixels,): delay, confidence, posterior within 3 cells and its spread there, and within 8 cells."""

    delay: Floats
    confidence: Floats
    mass: Floats
    spread: Floats
    broad: Floats


def parts(height: int, width: int, cells: int) -> Iterator[tuple[slice, slice, slice, slice]]:
    """Rows and columns of each part of an image, and of what is kept of it; they do not depend on the machine."""
    pixels = VOLUME_BYTES // (4 * cells)
    if height * width <= pixels:
        yield slice(0, height), slice(0, width), slice(0, height), slice(0, width)
        return
    side = max(int(pixels**0.5), 24)
    overlap = min(_OVERLAP, side // 4)
    for y0, y1, top, bottom in _cuts(height, side, overlap):
        for x0, x1, left, right in _cuts(width, side, overlap):
            yield slice(y0, y1), slice(x0, x1), slice(top, bottom), slice(left, right)


def _cuts(length: int, side: int, overlap: int) -> Iterator[tuple[int, int, int, int]]:
    """Begin and end of overlapping pieces of about `side`, and of what is kept of each."""
    if length <= side:
        yield 0, length, 0, length
        return
    number = -(-length // (side - 2 * overlap))
    edges = [length * k // number for k in range(number + 1)]
    for low, high in pairwise(edges):
        yield max(0, low - overlap), min(length, high + overlap), low, high


def survey(photons: Photons, cells: Cells) -> float:
    """Share of the photons that is signal, from coincidences between neighbours in up to 65,536 pixels."""
    height, width = photons.height, photons.width
    slots = int(np.clip(cells.count / cells.sigma / 2, 4, 256))
    bins = cells.bins
    rows = max(2, min(height, _SURVEY // width))
    counts = np.zeros(2)
    chosen = np.linspace(0, max(height - 2, 0), num=max(1, min(rows // 2, height // 2)), dtype=np.int64)
    for y in np.unique(chosen):
        begin, end = photons.first[y * width], photons.first[min(y + 2, height) * width]
        pixel = np.repeat(
            np.arange(min(2, height - y) * width),
            np.diff(photons.first[y * width : min(y + 2, height) * width + 1]),
        )
        slot = np.minimum(photons.bin[begin:end].astype(np.int64) * slots // bins, slots - 1)
        flat = np.bincount(pixel * slots + slot, photons.number[begin:end], min(2, height - y) * width * slots)
        v = flat.reshape(-1, width, slots)
        near = v + 0.5 * (np.roll(v, 1, -1) + np.roll(v, -1, -1))
        total = v.sum(-1)
        counts += (v[:, 1:] * near[:, :-1]).sum(), (total[:, 1:] * total[:, :-1]).sum()
        if len(v) > 1:
            counts += (v[1:] * near[:-1]).sum(), (total[1:] * total[:-1]).sum()
    if counts[1] == 0.0:
        return 0.5
    by_chance = 2.0 / slots
    # 0.8 of the pairs of signal from one surface lie in the same slot or, by half, in the next
    return float(np.sqrt(np.clip((counts[0] / counts[1] - by_chance) / (0.8 - by_chance), 1e-3, 0.9)))


def first_light(photons: Photons, cells: Cells, efficiency: FloatArray | None = None) -> Light:
    """Signal and background before any delay is known: one share of signal, background as the pixels have photons."""
    share = survey(photons, cells)
    total = photons.total()
    relative = np.ones(total.shape) if efficiency is None else efficiency
    missing = _missing(total, relative)
    background = _background((1.0 - share) * total, np.where(missing, 0.0, relative))
    mean = total[~missing].sum() / max(relative[~missing].sum(), 1e-9)
    return Light(np.full(total.shape, max(share * mean, 0.02)), background, missing, relative)


def light_at(photons: Photons, cells: Cells, delay: Floats, light: Light, threads: int) -> Light:
    """Signal and background of each pixel, given delays (pixels,)."""
    _, _, exposure, whole, near = centroids(photons, cells, delay, light, 1, threads)
    shape = light.signal.shape
    share = cells.near / cells.count
    total = photons.total()
    whole = np.where(light.missing, 0.0, whole.reshape(shape))
    seen = np.where(light.missing, 0.0, exposure.reshape(shape))
    background = _background(np.maximum(total - near.reshape(shape), 0.0), whole * (1.0 - share))
    inside = near.reshape(shape) - background * share * seen
    around = _mean(inside * (seen > 0), _SURROUNDINGS)
    signal = around / np.maximum(_mean(seen, _SURROUNDINGS), 1e-6) / cells.inside
    return Light(np.maximum(signal, 0.1 * background * share + 0.02), background, light.missing, light.efficiency)


def _mean(values: FloatArray, side: int) -> FloatArray:
    from scipy.ndimage import uniform_filter

    return np.asarray(np.maximum(uniform_filter(values, side, mode="nearest"), -1e30))


def _missing(total: FloatArray, efficiency: FloatArray) -> NDArray[np.bool_]:
    """Pixels (H, W) without a registration where those around have so many that this is no chance, or that see none."""
    if min(total.shape) < 2:
        return np.asarray(efficiency == 0.0)
    present = (total > 0).astype(np.float64)
    around = _mean(np.minimum(total, 4.0 * np.median(total) + 4.0), _SURROUNDINGS)
    around /= np.maximum(_mean(present, _SURROUNDINGS), 1e-3)
    return np.asarray((efficiency == 0.0) | ((total == 0) & (np.exp(-0.5 * around * efficiency) < _MISSING)))


def _background(count: FloatArray, exposure: FloatArray) -> FloatArray:
    """Background (H, W) of a full exposure: that around, or of a hot pixel, where its counts ask for it, its own.

    Posterior mean over the factors `_HOT`, of Poisson counts.
    """
    from scipy.special import gammaln, logsumexp

    usual = 4.0 * np.median(count) + 4.0
    around = _mean(np.minimum(count, usual), _BACKGROUND_SIDE) / np.maximum(_mean(exposure, _BACKGROUND_SIDE), 1e-6)
    around = np.maximum(around, 1e-3 * max(float(around.mean()), 1e-6))
    suspect = count > around * exposure + 4.0 * np.sqrt(around * exposure) + 2.0
    out = around.copy()
    if suspect.any():
        mean = (around * exposure)[suspect][:, None] * _HOT + 1e-9
        n = count[suspect][:, None]
        log_weight = np.log(_HOT_SHARE) + n * np.log(mean) - mean - gammaln(n + 1.0)
        weight = np.exp(log_weight - logsumexp(log_weight, axis=1, keepdims=True))
        # between the factors: a Gamma of the count's own spread about it
        own = n[:, 0] / np.maximum(exposure[suspect], 1e-6)
        out[suspect] = weight[:, 0] * around[suspect] + (1.0 - weight[:, 0]) * own
    return out


def volumes(
    photons: Photons, cells: Cells, light: Light, rows: slice, columns: slice, peaks: int, threads: int
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Posterior, its sums over 17 cells and likelihood (rows, columns, cells) of a part; its peaks and their mass."""
    from mars_lidar._base.native import _core

    shape = rows.stop - rows.start, columns.stop - columns.start, cells.count
    likelihood, one, other = (np.empty(shape, np.float32) for _ in range(3))
    _core.image_likelihood(
        cells.setting,
        height=photons.height,
        width=photons.width,
        first=photons.first,
        bin=photons.bin,
        number=photons.number,
        ratio=light.ratio,
        y0=rows.start,
        x0=columns.start,
        out=likelihood,
        threads=threads,
    )
    tap = np.exp(-0.5 * (np.arange(4) / (STEP_SIGMA * cells.sigma)) ** 2)
    tap /= tap[0] + 2.0 * tap[1:].sum()
    place, mass = (np.empty((shape[0] * shape[1], peaks), np.float32) for _ in range(2))
    _core.image_posterior(
        likelihood,
        one,
        other,
        narrow=tuple(float(x) for x in tap),
        wide=WIDE,
        jump=JUMP,
        place=place,
        mass=mass,
        broad=peaks > 1,
        threads=threads,
    )
    return one, other, likelihood, place, mass


def first_delays(photons: Photons, cells: Cells, light: Light, threads: int) -> Floats:
    """Largest peak (pixels,) of each posterior."""
    out = np.empty((photons.height, photons.width), np.float32)
    for rows, columns, keep_rows, keep_columns in parts(photons.height, photons.width, cells.count):
        place = volumes(photons, cells, light, rows, columns, 1, threads)[3]
        image = place.reshape(rows.stop - rows.start, -1)
        out[keep_rows, keep_columns] = image[_within(rows, keep_rows), _within(columns, keep_columns)]
    return out.ravel()


def choice(photons: Photons, cells: Cells, light: Light, nets: Networks | None, threads: int) -> Choice:
    """The delay of each pixel: the largest peak of its posterior, or that which a network chooses."""
    shape = photons.height, photons.width
    out = [np.empty(shape, np.float32) for _ in range(5)]
    for rows, columns, keep_rows, keep_columns in parts(*shape, cells.count):
        posterior, broad, likelihood, place, mass = volumes(photons, cells, light, rows, columns, PEAKS, threads)
        pixels = np.arange(len(place))
        best, confidence = np.zeros(len(place), np.int64), mass[:, 0].copy()
        if nets is not None:
            signal = np.ascontiguousarray(light.signal[rows, columns].ravel(), np.float32)
            open_pixels = np.ascontiguousarray(np.flatnonzero(mass[:, 0] < _SETTLED))
            best[open_pixels], confidence[open_pixels] = _chosen(
                posterior, broad, likelihood, place, mass, signal, open_pixels, nets, threads
            )
        delay = place[pixels, best]
        cell = np.minimum(delay.astype(np.int64), cells.count - 1)
        step = np.arange(-3, 4)
        flat = posterior.reshape(len(place), cells.count)
        near = flat[pixels[:, None], (cell[:, None] + step) % cells.count] + np.float32(1e-9)
        total = near.sum(1)
        mean = (near * step).sum(1) / total
        spread = np.sqrt(np.maximum((near * step**2).sum(1) / total - mean**2, 0.01))
        mass_broad = broad.reshape(len(place), cells.count)[pixels, cell]
        values = ((cell + 0.5 + mean) % cells.count, confidence, total, spread, mass_broad)
        for to, value in zip(out, values, strict=True):
            image = np.asarray(value, np.float32).reshape(rows.stop - rows.start, -1)
            to[keep_rows, keep_columns] = image[_within(rows, keep_rows), _within(columns, keep_columns)]
    return Choice(*(np.ascontiguousarray(each.ravel()) for each in out))


def _within(whole: slice, part: slice) -> slice:
    return slice(part.start - whole.start, part.stop - whole.start)


def _chosen(
    posterior: Floats,
    broad: Floats,
    likelihood: Floats,
    place: Floats,
    mass: Floats,
    signal: Floats,
    pixel: NDArray[np.int64],
    nets: Networks,
    threads: int,
) -> tuple[NDArray[np.int32], Floats]:
    from mars_lidar._base.native import _core

    down, right = offsets()
    chosen, confidence = np.empty(len(pixel), np.int32), np.empty(len(pixel), np.float32)
    _core.image_choose(
        posterior,
        broad,
        likelihood,
        place=place,
        mass=mass,
        signal=signal,
        pixel=pixel,
        down=down,
        right=right,
        weights=nets.choose,
        hidden=HIDDEN,
        chosen=chosen,
        confidence=confidence,
        threads=threads,
    )
    return chosen, confidence


def candidate_features(
    posterior: Floats,
    broad: Floats,
    likelihood: Floats,
    place: Floats,
    mass: Floats,
    signal: Floats,
    pixel: NDArray[np.int64],
    threads: int,
) -> Floats:
    """(pixels, peaks, features) what the first network reads of the candidates of these pixels."""
    from mars_lidar._base.native import _core

    down, right = offsets()
    out = np.empty((len(pixel), place.shape[1], 3 * len(OFFSETS) + 3), np.float32)
    _core.image_features(
        posterior,
        broad,
        likelihood,
        place=place,
        mass=mass,
        signal=signal,
        pixel=np.ascontiguousarray(pixel, np.int64),
        down=down,
        right=right,
        out=out,
        threads=threads,
    )
    return out


def centroids(photons: Photons, cells: Cells, delay: Floats, light: Light, steps: int, threads: int) -> FloatArray:
    """(5, pixels): signal photons about a delay, their centroid less it, exposures of pulse and background, window."""
    from mars_lidar._base.native import _core

    out = np.empty((photons.height * photons.width, 5), np.float32)
    _core.image_centroids(
        cells.setting,
        height=photons.height,
        width=photons.width,
        first=photons.first,
        bin=photons.bin,
        number=photons.number,
        ratio=light.ratio,
        delay=np.ascontiguousarray(delay, np.float32),
        steps=steps,
        out=out,
        threads=threads,
    )
    columns = np.ascontiguousarray(out.T, np.float64)
    columns[2:4] *= light.efficiency.ravel()
    return columns


@dataclass(frozen=True, eq=False)
class Photometry:
    """What planes are laid through, of each pixel (H, W): delay, signal photons, their centroid less it, exposure."""

    delay: Floats
    number: Floats
    offset: Floats
    exposure: Floats


def photometry(photons: Photons, cells: Cells, delay: Floats, light: Light, threads: int) -> Photometry:
    """The photons about delays (pixels,); three steps, so that many photons of one pixel find their own centroid."""
    number, offset, exposure, _, _ = centroids(photons, cells, delay, light, 3, threads)
    shape = light.signal.shape
    exposure = np.where(light.missing.ravel(), 0.0, exposure)
    as_image = [np.ascontiguousarray(x.reshape(shape), np.float32) for x in (delay, number, offset, exposure)]
    return Photometry(*as_image)


def planes(seen: Photometry, cells: Cells, first: int, last: int, threads: int) -> Floats:
    """Planes (rows, W, windows, 7) of the rows [first, last): `image_planes` in native/image/kernel.cpp names them."""
    from mars_lidar._base.native import _core

    height, width = seen.delay.shape
    images = np.zeros((4, last - first + 2 * _MARGIN, width + 2 * _MARGIN + 16), np.float32)
    low, high = max(0, first - _MARGIN), min(height, last + _MARGIN)
    to = slice(low - first + _MARGIN, high - first + _MARGIN), slice(_MARGIN, _MARGIN + width)
    for image, values in zip(images, (seen.number, seen.offset, seen.delay, seen.exposure), strict=True):
        image[to] = values[low:high]
    out = np.empty(((last - first) * width, len(RADII) * 7), np.float32)
    radii = np.array(RADII, np.int32)
    _core.image_planes(
        images, margin=_MARGIN, cells=cells.count, sigma=cells.sigma, radii=radii, out=out, threads=threads
    )
    return out.reshape(last - first, width, len(RADII), 7)


def plane_features(
    plane: Floats, chosen: Choice, light: Light, seen: Photometry, cells: Cells, rows: slice
) -> tuple[Floats, Floats, Floats]:
    """What the second network reads (channels, rows, W), and mixes: delays in sigma, log signal (choices, rows, W)."""
    shape = plane.shape[:2]

    def part(values: Floats) -> Floats:
        return np.asarray(values.reshape(light.signal.shape)[rows], np.float32)

    delay = np.clip(plane[..., 0], -4.0, 4.0)
    own = part(np.asarray(light.signal, np.float32))
    background = part(np.asarray(light.background, np.float32))
    number = part(seen.number)
    efficiency = part(np.asarray(light.efficiency, np.float32))
    log_signal = np.log(np.concatenate([own[..., None], np.maximum(plane[..., 5], 0.02)], -1))
    features = np.concatenate(
        [
            delay,
            0.5 * np.log(np.clip(plane[..., 1], 0.01, 10.0)),
            np.log(np.clip(plane[..., 2], 0.02, 20.0)),
            plane[..., 3],
            log_signal - log_signal[..., 2:3],
            np.stack(
                [
                    log_signal[..., 0],
                    np.log(part(chosen.spread) / cells.sigma),
                    0.5 * np.log(part(chosen.mass) + 1e-3),
                    0.5 * np.log(np.maximum(part(chosen.confidence), 0.0) + 1e-3),
                    np.log(np.maximum(background, 0.02) * (5.0 * cells.sigma / cells.count)),
                    np.clip(number - np.maximum(plane[..., 1, 5], 0.02) * efficiency, -10.0, 10.0),
                    0.5 * np.log(np.clip(1.0 - part(chosen.broad), 1e-3, 1.0)),
                    # of a Gaussian 0: how much finer than its width a pulse tells the delay
                    np.full(shape, 2.0 * np.log(cells.near / (2.0 * NEAR * cells.sigma)), np.float32),
                ],
                -1,
            ),
        ],
        -1,
    )
    delays = np.concatenate([np.zeros((*shape, 1), np.float32), delay], -1)
    alone = np.log(np.maximum(number / np.maximum(part(seen.exposure), 0.05), 0.02))
    log_signal = np.concatenate([log_signal, alone[..., None]], -1)

    def planar(values: Floats) -> Floats:
        return np.ascontiguousarray(values.transpose(2, 0, 1), np.float32)

    return planar(features), planar(delays), planar(log_signal)
