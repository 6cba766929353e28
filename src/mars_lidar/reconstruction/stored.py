"""Reconstruction of a stored cube in parts: its counts need not fit in memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import FloatArray, Progress
from mars_lidar.reconstruction.histograms import checked
from mars_lidar.reconstruction.image import Image
from mars_lidar.reconstruction.maximum_likelihood import warn_of_bias
from mars_lidar.reconstruction.method import Estimates, Method, warn_of_effects
from mars_lidar.reconstruction.photons import Photons
from mars_lidar.reconstruction.reconstruction import (
    Reconstruction,
    assembled,
    find_method,
    flag_impossible,
    with_returns,
)

if TYPE_CHECKING:
    from mars_lidar.io import Cube

_CHUNK_BYTES = 4 * 2**20  # of counts read at a time


@dataclass(frozen=True, eq=False)
class Timed:
    """A reconstruction (realizations, H, W), and the seconds of its estimates, without those of reading the file."""

    result: Reconstruction
    seconds: float


def reconstruct_stored(
    cube: Cube,
    methods: Sequence[str | Method] = ("maximum_likelihood",),
    *,
    level: float | None = None,
    attenuation: str | None = None,
    returns: int = 1,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> dict[str, Timed]:
    """Reconstruct a cube of `mars_lidar.io.load` with several methods, reading each part of its counts once.

    Parameters
    ----------
    cube
        The cube. Without `level`, the level with which the signal was computed from the reflectivity of its scene.
    methods
        Names, or methods with different names.
    level, attenuation, returns, threads, progress
        As for `mars_lidar.reconstruct`; attenuation None: that of the flux, if recorded.

    Returns
    -------
    dict
        Results by name of the method.
    """
    progress = callback_of(progress, "reconstructing")
    system, recipe = cube.system, cube.recipe
    used = [with_returns(find_method(method), returns) for method in methods]
    for method in used:
        method.check(system)
    warn_of_effects(system)
    if attenuation is None:
        attenuation = "none" if cube.measured else str(cube.flux.info.get("attenuation", "none"))
    scale = true_level(cube, attenuation) if level is None else checks.real("level", level, low=0.0, strict_low=True)
    team = thread_count(threads)
    shape = cube.shape[:3]
    buffers: dict[str, dict[str, np.ndarray]] = {method.name: {} for method in used}
    seconds = dict.fromkeys(buffers, 0.0)
    total, done = len(used) * shape[0] * shape[1] * shape[2], 0
    blocks = recipe.blocks(recipe.chunks(_CHUNK_BYTES))

    def use(
        method: Method, estimate: Callable[[], Estimates], registrations: FloatArray, images: slice, rows: slice
    ) -> None:
        """Hold the estimates of some rows of some images, with `registrations` (pixels,)."""
        nonlocal done
        began = time.perf_counter()
        estimates = estimate()
        seconds[method.name] += time.perf_counter() - began
        flag_impossible(estimates, registrations, system)
        for field in fields(estimates):
            values = getattr(estimates, field.name)
            if values is None:
                continue
            whole = buffers[method.name].setdefault(field.name, np.empty((*shape, *values.shape[1:]), values.dtype))
            part = whole[images, rows]
            part[...] = values.reshape(part.shape)
        done += len(estimates.signal)
        if progress is not None:
            progress(done, total)

    of_images = [method for method in used if isinstance(method, Image)]
    gathered: dict[int, list[Photons]] = {}  # by image: of a whole one only photons are in memory
    for images, rows in blocks:
        counts, block = checked(np.asarray(cube.histogram[images, rows]), system, team)
        registrations = counts.counts.sum(-1, dtype=np.float64)
        for method in used:
            if not isinstance(method, Image):
                use(method, partial(method.estimate, counts), registrations, images, rows)
        if not of_images:
            continue
        for k, part in zip(range(images.start, images.stop), counts.counts.reshape(*block, -1), strict=True):
            gathered.setdefault(k, []).append(Photons.of(part.reshape(-1, system.bins), *block[1:]))
            if sum(each.height for each in gathered[k]) < shape[1]:
                continue
            photons = Photons.joined(gathered.pop(k))
            for method in of_images:
                estimate = partial(method.of_photons, photons, system, team)
                use(method, estimate, photons.total().ravel(), slice(k, k + 1), slice(0, shape[1]))
    results = {}
    for method in used:
        estimates = Estimates(
            **{name: values.reshape(-1, *values.shape[3:]) for name, values in buffers[method.name].items()}
        )
        warn_of_bias(method, system, estimates)
        results[method.name] = Timed(
            assembled(method.name, system, estimates, shape, scale, attenuation), seconds[method.name]
        )
    return results


def true_level(cube: Cube, attenuation: str) -> float | None:
    """Detectable signal of a surface of reflectivity 1 in the scene of a cube; None without a scene."""
    if cube.reflectivity is None:
        return None
    light = cube.reflectivity * (cube.depth_m**-2.0 if attenuation == "inverse_square" else 1.0)
    signal = cube.flux.signal * cube.system.detector.detection_efficiency
    lit = (signal > 0) & np.isfinite(light) & (light > 0)
    return float(signal[lit].sum() / light[lit].sum()) if lit.any() else None
