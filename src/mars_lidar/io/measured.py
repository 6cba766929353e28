"""Cubes from histograms and photon times of other programs in memory; `foreign_cube` reads files."""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, checked_with_masks
from mars_lidar._base.resources import check_memory
from mars_lidar._base.sparse import dense_bytes, dense_counts, is_sparse
from mars_lidar.instrument.system import System
from mars_lidar.io.cube import Cube
from mars_lidar.io.recipe import Recording

_AXES = {1: "t", 2: "(yx)t", 3: "yxt", 4: "nyxt"}  # by the number of dimensions
_WHOLE = 1e-3  # share of a bin by which a start may miss a whole number of bins


@checked_with_masks
def from_histograms(
    counts: ArrayLike,
    system: System,
    *,
    axes: str | None = None,
    image: tuple[int, int] | None = None,
    start_ns: float = 0.0,
    source: str = "",
) -> Cube:
    """A cube of measured histograms, for `mars_lidar.reconstruct`, `io.save` and all other functions of cubes.

    Parameters
    ----------
    counts
        Counts (H, W, T), or in the order `axes`; or a SciPy sparse matrix (pixels, T). Whole numbers >= 0, also as
        floats.
    system
        The system that recorded them; `cycles` is the number of laser periods of each histogram, `bins` the number of
        bins of a whole period. If T is smaller, the histograms are a window of the period: the detector of the cube is
        gated to it, and bins outside are empty.
    axes
        The dimensions in order: n exposures, y rows, x columns, t time; in brackets one dimension of all pixels,
        ordered by rows, ``(yx)``, or by columns, ``(xy)``, as in MATLAB. Default, by the number of dimensions: ``t``,
        ``(yx)t``, ``yxt``, ``nyxt``.
    image
        (H, W) of the pixels in brackets. Default: (1, pixels).
    start_ns
        Time from the laser pulse to the start of the first bin, ns: a whole number of bins.
    source
        Free text: origin of the counts.

    Returns
    -------
    Cube
        In memory; its `recipe` is a `Recording`, and it has no flux.

    Raises
    ------
    ValueError, TypeError
        Shapes that do not fit, values that are not counts, or counts above those that the system can register.

    See Also
    --------
    foreign_cube, from_photon_times, mars_lidar.reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import numpy as np
    >>> ml.io.from_histograms(np.ones((4, 6, 128), int), system).shape
    (1, 4, 6, 128)
    >>> ml.io.from_histograms(np.ones((40, 24), int), system, axes="t(xy)", image=(4, 6), start_ns=25.0).shape
    (1, 4, 6, 128)
    """
    ordered = in_order(counts, axes, image)
    first = _first_bin(start_ns, system)
    recorded = windowed(system, ordered.shape[-1], first)
    kind = recorded.histogram_dtype
    most = min(recorded.max_bin_count, np.iinfo(kind).max)
    _check_counts(ordered, most, recorded)
    if ordered.shape[-1] == system.bins and first == 0:
        whole = np.ascontiguousarray(ordered, kind)
    else:
        shape = (*ordered.shape[:-1], system.bins)
        check_memory(int(np.prod(shape)) * kind.itemsize, "the cube of whole periods", "take a part of the image")
        whole = np.zeros(shape, kind)
        whole[..., (first + np.arange(ordered.shape[-1])) % system.bins] = ordered
    recorded.check_possible(whole)
    largest = whole.sum(-1, dtype=np.uint64).max()
    if largest > recorded.max_registrations:
        raise ValueError(
            f"a pixel holds {largest:,} counts, and the system registers at most {recorded.max_registrations:,.0f}: "
            f"cycles must be the laser periods that each histogram was accumulated over, got {system.cycles:,}"
        )
    realizations, height, width, _ = whole.shape
    recording = Recording(system=recorded, pixels=(height, width), realizations=realizations, source=source)
    return Cube.of(whole, recording, registrations=int(whole.sum(dtype=np.uint64)))


@checked
def from_photon_times(
    cells: Any,
    system: System,
    *,
    unit_ns: float = 1.0,
    start_ns: float = 0.0,
    window_ns: tuple[float, float] | None = None,
    source: str = "",
) -> Cube:
    """A cube from the photon times of each pixel, as in cell arrays of MATLAB.

    Parameters
    ----------
    cells
        (H, W) of arrays of times since the laser pulse, or one array for one pixel. Absolute times over many laser
        periods are folded.
    system
        The system that recorded them, see `from_histograms`.
    unit_ns
        Unit of the times, ns. If all times are whole numbers, they are clock units and are moved to the middle of the
        unit.
    start_ns
        Time from the laser pulse to time 0, ns, such as the start of a gate from which times are counted.
    window_ns
        (start, stop): use only photons in this interval after the laser pulse, whole numbers of bins; the cube is a
        window. For recordings with a gate whose times count from the pulse, or to exclude an internal reflection.
    source
        Free text: origin of the times.

    Raises
    ------
    ValueError, TypeError
        Times that are not numbers >= 0, shapes that do not fit, or no photon in the window.

    See Also
    --------
    from_histograms, foreign_cube

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> import numpy as np
    >>> times_ns = np.array([20.1, 120.2, 220.3])
    >>> ml.io.from_photon_times(times_ns, system).registrations
    3
    """
    unit = checks.real("unit_ns", unit_ns, low=0.0, strict_low=True)
    start = checks.real("start_ns", start_ns)
    image = _cells(cells)
    times = [np.asarray(checks.numbers("cells", cell), np.float64).ravel() for cell in image.ravel()]
    raw = np.concatenate([np.empty(0), *times])
    bad = ~(np.isfinite(raw) & (raw >= 0))
    if bad.any():
        raise ValueError(f"cells must hold finite times >= 0, got {raw[int(np.argmax(bad))]}")
    middle = 0.5 if raw.size and bool((raw == np.floor(raw)).all()) else 0.0
    since_ns = (raw + middle) * unit + start
    if start != 0.0 and raw.size and since_ns.max() >= system.period_ns:
        warnings.warn(
            f"start_ns={start:g} is added to the times, which then reach {since_ns.max():.6g} ns and are folded into "
            f"the period of {system.period_ns:g} ns: right for a gate that crosses its end; for times that count from "
            "the laser pulse leave out start_ns (--start-ns) and give window_ns, (start, stop) (--window-ns)",
            stacklevel=3,  # of the caller, through what checks the arguments
        )
    if window_ns is not None:
        return _in_window(since_ns, [cell.size for cell in times], image.shape, system, window_ns, source)
    phase = np.mod(since_ns / system.period_ns, 1.0)
    place = np.minimum((phase * system.bins).astype(np.int64), system.bins - 1)
    check_memory(
        8 * image.size * system.bins, "the histograms of the photons", "take fewer bins or a part of the image"
    )
    pixel = np.repeat(np.arange(image.size), [cell.size for cell in times])
    flat = np.bincount(pixel * system.bins + place, minlength=image.size * system.bins)
    return from_histograms(flat.reshape(*image.shape, system.bins), system, source=source)


def _in_window(
    since_ns: NDArray[np.float64],
    photons: list[int],
    image: tuple[int, ...],
    system: System,
    window_ns: tuple[float, float],
    source: str,
) -> Cube:
    """Photons (all pixels, `photons` of each) between two times since the pulse, folded into the period."""
    if not isinstance(window_ns, tuple | list) or len(window_ns) != 2:
        raise TypeError(f"window_ns must be (start, stop), ns, got {window_ns!r}")
    start, stop = (checks.real("window_ns", edge, low=0.0) for edge in window_ns)
    edges = [edge / system.bin_ns for edge in (start, stop)]
    first, bins = round(edges[0]), round(edges[1]) - round(edges[0])
    if any(abs(edge - round(edge)) > _WHOLE for edge in edges) or not 1 <= bins <= system.bins:
        raise ValueError(
            f"window_ns must be two times a whole number of bins of {system.bin_ns:.6g} ns apart from the laser pulse, "
            f"at most a period of {system.period_ns:g} ns from each other, got {start:g} to {stop:g}"
        )
    phase_ns = np.mod(since_ns - start, system.period_ns)
    place = np.floor(phase_ns / system.bin_ns).astype(np.int64)
    inside = (place >= 0) & (place < bins)
    if not inside.any():
        raise ValueError(f"window_ns must hold photons, got {start:g} to {stop:g}, in which there are none")
    check_memory(8 * math.prod(image) * bins, "the histograms of the photons", "take a narrower window")
    pixel = np.repeat(np.arange(math.prod(image)), photons)[inside]
    flat = np.bincount(pixel * bins + place[inside], minlength=math.prod(image) * bins)
    begin = (first % system.bins) * system.bin_ns
    return from_histograms(flat.reshape(*image, bins), system, start_ns=begin, source=source)


def in_order(counts: Any, axes: str | None, image: tuple[int, int] | None) -> NDArray[Any]:
    """`counts` as (exposures, H, W, T)."""
    if is_sparse(counts):
        check_memory(dense_bytes(counts), "the counts of the sparse matrix", "take a part of it")
        counts = dense_counts("counts", counts)
    if isinstance(counts, np.ma.MaskedArray):
        raise TypeError("counts must not be a masked array: fill it, or leave those pixels out")
    array = np.asarray(counts)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"counts must be an array of numbers, got {array.dtype}")
    if axes is None and array.ndim not in _AXES:
        raise ValueError(f"counts must be (t,), (pixels, t), (y, x, t) or (n, y, x, t), got shape {array.shape}")
    order = _AXES[array.ndim] if axes is None else axes
    names = re.findall(r"\((?:yx|xy)\)|[nyxt]", order)
    letters = "".join(names).translate({40: None, 41: None})
    if "".join(names) != order or len(set(letters)) != len(letters) or "t" not in letters:
        raise ValueError(f"axes must be made of n, y, x, t and (yx) or (xy), each once and t among them, got {axes!r}")
    if array.ndim != len(names) or array.size == 0:
        raise ValueError(f"counts must have the axes {order} and not be empty, got shape {array.shape}")
    shape = list(array.shape)
    flat = next((k for k, name in enumerate(names) if name.startswith("(")), None)
    if flat is None:
        if image is not None:
            raise ValueError(f"image belongs to axes with pixels in brackets, (yx) or (xy), got axes {order}")
    else:
        height, width = (1, shape[flat]) if image is None else image
        if height * width != shape[flat]:
            raise ValueError(f"image must have {shape[flat]} pixels, got {height} x {width}")
        shape[flat : flat + 1] = [height, width] if names[flat] == "(yx)" else [width, height]
    array = array.reshape(shape)
    array = array.transpose([letters.index(name) for name in "nyxt" if name in letters])
    for place, name in enumerate("nyx"):
        if name not in letters:
            array = np.expand_dims(array, place)
    return array


def windowed(system: System, bins: int, first: int) -> System:
    """The system of histograms of `bins` bins from bin `first` on, gated to them unless they cover the period."""
    if bins > system.bins:
        raise ValueError(f"the system has {system.bins} bins in a period, and the histograms have {bins}")
    if bins == system.bins or system.detector.mode == "gated":
        return system
    if system.detector.mode != "nonparalyzable":
        raise ValueError(
            f"histograms of {bins} of {system.bins} bins are a window, which mode {system.detector.mode!r} has not: "
            "the detector must be nonparalyzable or gated"
        )
    start, width = first * system.bin_ns, bins * system.bin_ns
    gated = dataclasses.replace(system.detector, mode="gated", gate_start_ns=start, gate_width_ns=width)
    return system.replace(detector=gated)


def _first_bin(start_ns: float, system: System) -> int:
    start = checks.real("start_ns", start_ns)
    bins = start / system.bin_ns
    if abs(bins - round(bins)) > _WHOLE:
        below, above = np.floor(bins) * system.bin_ns, np.ceil(bins) * system.bin_ns
        raise ValueError(
            f"start_ns must be a whole number of bins of {system.bin_ns:.6g} ns, got {start:g}; "
            f"{below:.6g} or {above:.6g} would be one, and depths move with it"
        )
    return round(bins) % system.bins


def _check_counts(counts: NDArray[Any], most: float, system: System) -> None:
    for image in counts:  # one exposure at a time: what is compared is a copy
        if image.dtype.kind == "f" and not (np.isfinite(image) & (image == np.floor(image))).all():
            raise ValueError("counts must be whole numbers; means of several exposures are for mars_lidar.reconstruct")
        if image.min() < 0:
            raise ValueError(f"counts must be at least 0, got {image.min():g}")
        if image.max() > most:
            raise ValueError(
                f"a bin holds {image.max():g} counts, and the system registers at most {most:g} there: cycles must be "
                f"the laser periods that each histogram was accumulated over, got {system.cycles:,}"
            )


def _cells(cells: Any) -> NDArray[Any]:
    """(H, W) of arrays of times."""
    checks.unmasked("cells", cells)
    if isinstance(cells, np.ndarray):
        array = cells
    elif not isinstance(cells, list | tuple):
        raise TypeError(f"cells must be (H, W) of arrays of times, got {type(cells).__name__}")
    elif all(isinstance(cell, Real) for cell in cells):
        array = np.asarray(cells, np.float64)
    elif len({len(row) for row in cells}) > 1:
        raise ValueError("cells must be rows of equally many pixels, each an array of times")
    else:
        array = np.empty((len(cells), len(cells[0])), object)
        for place in np.ndindex(array.shape):
            array[place] = np.asarray(cells[place[0]][place[1]])
    if array.dtype != object:
        if array.ndim != 1:
            raise ValueError(f"cells must be (H, W) of arrays of times, or one array of times, got {array.shape}")
        single = np.empty((1, 1), object)
        single[0, 0] = array
        return single
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"cells must be (H, W) of arrays of times, got shape {array.shape}")
    return array
