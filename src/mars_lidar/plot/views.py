"""Maps and rates for the figures, computed from a cube or from the light fitted to it, without matplotlib."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.instrument.system import System
from mars_lidar.io.cube import Cube, as_cube
from mars_lidar.io.layout import MEASURED
from mars_lidar.io.recipe import Recipe
from mars_lidar.light.flux import Flux
from mars_lidar.reconstruction import METHODS, reconstruct
from mars_lidar.reconstruction.map_errors import depth_lag_m
from mars_lidar.statistics import ConvergenceError, mean_histogram, photons_per_bin
from mars_lidar.statistics.histogram import histogram_effects
from mars_lidar.statistics.tolerances import TOL

_READ_BYTES = 64 * 2**20


@checked
def count_maps(
    cube: Cube | ArrayLike, realization: int = 0, *, system: System | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Total counts, and the depth at the fullest bin.

    The depth is that of the bin's centre minus the distance between the pulse's peak and its origin, modulo the
    unambiguous range. Of several equal bins the first is used.

    Parameters
    ----------
    cube
        A cube in memory or on disk, read in bands of rows; or counts as `simulate` returns them.
    realization
        Number of the exposure, from the start of the cube.
    system
        For an array of counts: the system that recorded them.

    Returns
    -------
    tuple
        Counts (H, W), and depth (H, W) in m: NaN without counts.

    Raises
    ------
    TypeError
        Neither a cube nor an array of counts with its system.
    ValueError
        A realization outside the cube.

    See Also
    --------
    depth_error_m, overview

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(signal=1.0, background=0.1, delay_ns=40.0), system, seed=0)
    >>> totals, depth_m = ml.plot.count_maps(counts, system=system)
    >>> totals.shape, abs(float(depth_m[0, 0]) - 6.0) < 0.3
    ((1, 1), True)
    """
    cube = as_cube(cube, system)
    realizations, height, width, bins = cube.shape
    realization = checks.integer("realization", realization, low=0, high=realizations - 1)
    totals = np.empty((height, width), np.int64)
    peaks = np.empty((height, width), np.int64)
    band = max(1, _READ_BYTES // (width * bins * np.dtype(cube.histogram.dtype).itemsize))
    for row in range(0, height, band):
        rows = slice(row, min(row + band, height))
        counts = np.asarray(cube.histogram[realization, rows])
        totals[rows] = counts.sum(-1, dtype=np.int64)
        peaks[rows] = counts.argmax(-1)
    system = cube.system
    delay = (system.time_ns[peaks] - _peak_offset_ns(system)) % system.period_ns
    return totals, np.where(totals > 0, system.depth_m(delay), np.nan)


@checked
def example_pixels(flux: Flux, depth_m: NDArray[np.float64]) -> dict[str, tuple[int, int]]:
    """A bright, a dim and an edge pixel, if present: ``{"bright": (y, x), ...}``.

    Bright and dim are the 98th and the 5th percentile of the signal among pixels with a return; the edge is
    the steepest step in depth. The rim of the image, where recorded images have artefacts, is excluded.

    Parameters
    ----------
    flux
        The light of the image (H, W).
    depth_m
        (H, W) depth, m; NaN without a return.

    Returns
    -------
    dict
        Row and column by name.

    Raises
    ------
    TypeError
        Not a `Flux`, or a depth that is not an array of numbers.
    ValueError
        A depth of another shape than the flux.

    See Also
    --------
    overview

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> scene = ml.Scene.example("room", size=32)
    >>> flux = scene.flux(system, signal=0.5, sbr=2.0)
    >>> sorted(ml.plot.example_pixels(flux, scene.depth_m))
    ['bright', 'dim', 'edge']
    """
    flux = flux.image
    if np.shape(depth_m) != flux.shape:
        raise ValueError(f"depth_m must be {flux.shape} as the flux, got shape {np.shape(depth_m)}")
    inside, order = by_signal(flux)
    if order.size == 0:
        return {"first": (0, 0)}
    flat = {"bright": order[int(0.98 * (order.size - 1))]}
    dim = order[int(0.05 * (order.size - 1))]
    if flux.signal.flat[dim] < flux.signal.flat[flat["bright"]]:
        flat["dim"] = dim
    if min(flux.shape) > 1:
        slope = np.hypot(*np.gradient(depth_m))
        slope[~np.isfinite(slope) | (flux.signal <= 0) | ~inside] = -1.0
        if slope.max() > 0:
            flat["edge"] = np.argmax(slope)
    return with_pixels({}, flat, flux)


def by_signal(flux: Flux) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """(H, W) pixels without the rim of the image, and those with a return among them, flat, sorted by signal."""
    inside = np.zeros(flux.shape, bool)
    rim = [n // 16 for n in flux.shape]
    inside[rim[0] : flux.shape[0] - rim[0], rim[1] : flux.shape[1] - rim[1]] = True
    lit = np.flatnonzero((flux.signal > 0) & inside)
    return inside, lit[np.argsort(flux.signal.ravel()[lit], kind="stable")]


def with_pixels(named: dict[str, tuple[int, int]], flat: dict[str, np.int64], flux: Flux) -> dict[str, tuple[int, int]]:
    """The pixels `named` and those of `flat`, as (y, x)."""
    for name, k in flat.items():
        pixel = (int(k) // flux.shape[1], int(k) % flux.shape[1])
        if pixel not in named.values():
            named[name] = pixel
    return named


def instrument(system: System) -> str:
    """A system as a title: bins, exposure, dead time, and mode and effects of the detector."""
    detector, width = system.detector, system.bin_ns
    bins = f"{system.bins:,} bin{'s' if system.bins > 1 else ''} of "
    bins += f"{width:.4g} ns" if width >= 1.0 else f"{1e3 * width:.4g} ps"
    periods = f"{system.cycles:,} laser period{'s' if system.cycles > 1 else ''} of {system.period_ns:.4g} ns"
    mode = "" if detector.mode == "nonparalyzable" else f", {detector.mode}"
    effects = [name.removesuffix("_ns").removesuffix("_hz").replace("_", " ") for name in detector.effects]
    return f"{bins}; {periods}; dead time {detector.dead_time_ns:.4g} ns{mode}" + "".join(
        f", {effect}" for effect in effects
    )


@checked
def incident_rate(flux: Flux, system: System, y: int, x: int) -> NDArray[np.float64]:
    """Photons per period in each bin that reach a pixel, before gate and dead time.

    Parameters
    ----------
    flux, system
        The light of the image (H, W), photons per period, and the system.
    y, x
        Row and column of the pixel, from 0.

    Returns
    -------
    NDArray
        (bins,) expected photons per period.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        A pixel outside the image.

    See Also
    --------
    pixel_histogram, mars_lidar.statistics.photons_per_bin

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> rate = ml.plot.incident_rate(ml.Flux(1.0, 0.5, 40.0), system, 0, 0)
    >>> round(float(rate.sum()), 6)  # S + B
    1.5
    """
    flux = flux.image
    y, x = (checks.integer(name, k, low=0, high=n - 1) for name, k, n in zip("yx", (y, x), flux.shape, strict=True))
    return photons_per_bin(flux[y, x], system.detected(), bins=system.bins)


def predicted_counts(cube: Cube, y: int, x: int) -> NDArray[np.float64] | None:
    """Expected histogram (bins,) of pixel (y, x), by the exact finite-exposure statistics.

    None if it takes too long for a figure, does not converge, or is unknown (a moving gate, limits on events). The
    engine "poisson" has no dead time: its mean is the detected rate within the gate.
    """
    system, flux = cube.system, cube.flux
    effects = system.detector.effects
    if system.detector.gate_moves or not set(effects) <= set(histogram_effects(system)):
        return None
    if cube.engine == "poisson" and system.detector.mode != "gated":
        return photons_per_bin(flux[y, x], system, bins=system.bins) * system.cycles
    if cube.engine == "poisson":
        system = system.replace(detector=replace(system.detector, dead_time_ns=0.0))
    tolerance = 1e-2 if "electronics_dead_time_ns" in effects else TOL.law_tolerance  # seconds each beyond that
    try:
        return mean_histogram(flux[y, x], system, tolerance=tolerance)
    except ConvergenceError:
        return None


@checked
def depth_error_m(
    cube: Cube | ArrayLike, estimate_m: NDArray[np.float64], *, system: System | None = None, flux: Flux | None = None
) -> NDArray[np.float64]:
    """Estimated minus true depth, modulo the unambiguous range.

    Parameters
    ----------
    cube
        A cube with known or fitted true depth; or counts as `simulate` returns them.
    estimate_m
        (H, W) depth, m; NaN without an estimate.
    system, flux
        For an array of counts: the system that recorded them, and the light, whose delays are the truth.

    Returns
    -------
    NDArray
        (H, W) difference, m; NaN if either is missing.

    Raises
    ------
    TypeError
        Neither a cube nor an array of counts with its system; estimates that are not an array of numbers.
    ValueError
        Estimates of another shape than the image.

    See Also
    --------
    count_maps

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=1.0, background=0.1, delay_ns=40.0)
    >>> counts = ml.simulate(flux, system, seed=0)
    >>> depth_m = ml.reconstruct(counts, system).depth_m[0]
    >>> abs(float(ml.plot.depth_error_m(counts, depth_m, system=system, flux=flux)[0, 0])) < 0.05
    True
    """
    cube = as_cube(cube, system, flux)
    if np.shape(estimate_m) != cube.shape[1:3]:
        raise ValueError(f"estimate_m must be {cube.shape[1:3]} as the cube, got shape {np.shape(estimate_m)}")
    return depth_lag_m(cube.system, np.asarray(estimate_m), cube.depth_m)


def _peak_offset_ns(system: System) -> float:
    """Time from the origin of a delay to the largest value of the pulse, at the width of a bin or finer."""
    low, high = system.pulse.support_ns()
    fine = max(64, min(2**16, int(np.ceil(4 * (high - low) / system.bin_ns))))
    edges = np.linspace(low, high, fine + 1)
    peak = int(np.argmax(np.diff(system.pulse.cumulative(edges))))
    return float(0.5 * (edges[peak] + edges[peak + 1]))


def fitted(cube: Cube, realization: int) -> Cube:
    """One exposure of a measured cube with its maximum-likelihood flux; a simulated cube unchanged.

    The flux is that of detectable photons, so that the system is `System.detected`. Depth is NaN without a return. For
    detectors to which maximum likelihood does not apply, the first applicable method is used.
    """
    if not cube.measured:
        return cube
    system = cube.system
    counts = np.asarray(cube.histogram[realization])
    names = ("maximum_likelihood", *(name for name in METHODS if name != "maximum_likelihood"))
    for name in names:
        with suppress(ValueError):
            METHODS[name].check(system)
            break
    estimate = reconstruct(counts, system, name)
    with_return = estimate.detected & np.isfinite(estimate.signal)
    flux = Flux(
        np.where(with_return, estimate.signal, 0.0),
        np.where(np.isfinite(estimate.background), estimate.background, 0.0),
        np.where(with_return, estimate.delay_ns, 0.0),
    )
    recipe = Recipe(
        system=system.detected(),
        flux=flux,
        engine=MEASURED,
        depth_m=np.where(with_return, estimate.depth_m, np.nan),
        source=cube.recipe.source,
    )
    return Cube.of(counts[None], recipe, version=cube.version)
