"""The figures: an overview of a cube, one pixel, one map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.instrument.system import System
from mars_lidar.io.cube import Cube, as_cube
from mars_lidar.io.layout import MEASURED
from mars_lidar.light.flux import Flux
from mars_lidar.plot.colours import COLOURS, COUNTS_MAP, DEPTH_MAP, HALO, MISSING, SHARE_MAP
from mars_lidar.plot.pixel import draw_pixel, quiet_corner
from mars_lidar.plot.style import DPI, style
from mars_lidar.plot.views import count_maps, depth_error_m, example_pixels, fitted, incident_rate, instrument

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Pixels = dict[str, tuple[int, int]]
_GAP_INCHES, _BAR_INCHES = 0.3, 0.86  # below a map, for the title of the next, and beside it, for its colour bar
_LANDSCAPE = 0.62  # height over width, below which the maps stand in a row
_WIDEST_INCHES, _NARROW_INCHES = 2.45, 1.7  # of a map; a narrower one has a short title


@checked
def overview(
    cube: Cube | ArrayLike,
    system: System | None = None,
    flux: Flux | None = None,
    *,
    realization: int = 0,
    pixels: Sequence[tuple[int, int]] | None = None,
    title: str | None = None,
) -> Figure:
    """Depth, reflectivity, total counts, peak-bin depth, and the histograms of a few pixels.

    For a measured cube the maximum-likelihood estimate replaces the true light.

    Parameters
    ----------
    cube
        A cube in memory or on disk, of which one realization is read in bands of rows; or counts as `simulate`
        returns them.
    system, flux
        For an array of counts: the system that recorded them, and the light, if known.
    realization
        Number of the realization, from the start of the cube.
    pixels
        (y, x) of the pixels whose histograms are drawn, 1 to 6; default `example_pixels`.
    title
        Title; by default a line about the system.

    Returns
    -------
    matplotlib.figure.Figure
        ``figure.savefig(path)`` writes it.

    Raises
    ------
    TypeError
        Neither a cube nor an array of counts with its system; pixels that are not pairs.
    ValueError
        `realization` or a pixel outside the cube; other than 1 to 6 pixels.

    See Also
    --------
    pixel_histogram, map_image

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Scene.example("room", size=12).flux(system, signal=0.5, sbr=2.0)
    >>> figure = ml.plot.overview(ml.simulate(flux, system, seed=0), system, flux)
    >>> len(figure.axes) > 6
    True
    """
    cube, realization, chosen = _checked(as_cube(cube, system, flux), realization, pixels)
    totals, peaks_m = count_maps(cube, realization)
    with style():
        from matplotlib.figure import Figure

        width, height = 13.0, max(6.0, 1.75 * len(chosen) + 0.75)
        aspect = cube.shape[1] / cube.shape[2]
        across = aspect < _LANDSCAPE
        if across:  # the maps in a row above the histograms
            each = width / 4 - _BAR_INCHES
            image = each * aspect
            height += image + _GAP_INCHES - 0.5
            rows, columns, first = 1, 4, width
        else:  # two rows of two beside them, as high as the figure, and no wider than they need
            image = min(0.5 * (height - 0.62 - _GAP_INCHES - 0.12), _WIDEST_INCHES * aspect)
            each = image / aspect
            rows, columns, first = 2, 2, 2.0 * (each + _BAR_INCHES)
        figure = Figure(figsize=(width, height), dpi=DPI)
        below, above = 0.46 / height, 1.0 - 0.62 / height
        right = (first - _BAR_INCHES) / width + 0.012
        bottom = above - (rows * image + (rows - 1) * _GAP_INCHES) / height
        maps = figure.add_gridspec(
            rows,
            columns,
            left=0.012,
            right=min(right, 1.0 - _BAR_INCHES / width),
            bottom=bottom,
            top=above,
            wspace=_BAR_INCHES / each,
            hspace=_GAP_INCHES / image,
        )
        _draw_maps(maps.subplots(), cube, totals, peaks_m, chosen, each < _NARROW_INCHES)
        if across:
            _draw_pixels(figure, (0.055, 0.99, below, bottom - 0.5 / height), cube, realization, chosen)
        else:
            _draw_pixels(figure, ((first + 0.8) / width, 0.99, below, above), cube, realization, chosen)
        headline = _headline(cube, realization) if title is None else title
        figure.text(0.012, 1.0 - 0.2 / height, headline, fontsize=9.0, va="center")
    return figure


@checked
def pixel_histogram(
    cube: Cube | ArrayLike,
    y: int,
    x: int,
    *,
    system: System | None = None,
    flux: Flux | None = None,
    realization: int = 0,
) -> Figure:
    """Histogram of one pixel over the period and around its return, beside the incident rate's shape.

    Parameters
    ----------
    cube
        A cube, or counts as `simulate` returns them.
    y, x
        Row and column of the pixel, from 0.
    system, flux
        For an array of counts: the system that recorded them, and the light, if known.
    realization
        Number of the exposure, from the start of the cube.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    TypeError
        Neither a cube nor an array of counts with its system.
    ValueError
        A pixel or a realization outside the cube.

    See Also
    --------
    overview, incident_rate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> flux = ml.Flux(signal=1.0, background=0.5, delay_ns=40.0)
    >>> counts = ml.simulate(flux, system, seed=0)
    >>> figure = ml.plot.pixel_histogram(counts, 0, 0, system=system, flux=flux)
    >>> [float(size) for size in figure.get_size_inches()]
    [7.0, 2.5]
    """
    cube = as_cube(cube, system, flux)
    y = checks.integer("y", y, low=0, high=cube.shape[1] - 1)
    x = checks.integer("x", x, low=0, high=cube.shape[2] - 1)
    cube, realization, chosen = _checked(cube, realization, [(y, x)])
    with style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.0, 2.5), dpi=DPI)
        _draw_pixels(figure, (0.085, 0.985, 0.17, 0.9), cube, realization, chosen)
    return figure


@checked
def map_image(values: NDArray[Any], label: str, *, cmap: str = DEPTH_MAP) -> Figure:
    """A map with a colour bar; NaN is grey.

    Parameters
    ----------
    values
        (H, W) numbers.
    label
        Name of the quantity and its unit, for the colour bar.
    cmap
        Name of a colour map of matplotlib.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    TypeError
        Values that are not an array of numbers.
    ValueError
        Values that are not a map (H, W), or an unknown colour map.

    See Also
    --------
    overview

    Examples
    --------
    >>> import numpy as np
    >>> import mars_lidar as ml
    >>> figure = ml.plot.map_image(np.eye(4), "depth (m)")
    >>> figure.axes[0].images[0].get_array().shape
    (4, 4)
    """
    values = np.asarray(values)
    if values.ndim != 2 or values.size == 0:
        raise ValueError(f"values must be a map (H, W), got shape {values.shape}")
    with style():
        from matplotlib import colormaps

        if cmap not in colormaps:
            raise ValueError(f"cmap must be the name of a colour map of matplotlib, got {cmap!r}")
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.4, 3.6), dpi=DPI)
        ax = figure.add_axes((0.02, 0.04, 0.78, 0.92))
        _draw_map(ax, values, label, cmap, _limits(values))
    return figure


def _draw_maps(
    axes: Any, cube: Cube, totals: NDArray[np.int64], peaks_m: NDArray[np.float64], pixels: _Pixels, short: bool
) -> None:
    depth, axes = cube.depth_m, np.asarray(axes).ravel()
    known, fit = bool(np.isfinite(depth).any()), ", fitted" if cube.engine == MEASURED else ""
    limits = _limits(depth if known else peaks_m)
    if known:
        _draw_map(axes[0], depth, "depth (m)", DEPTH_MAP, limits, f"Depth{fit}")
    else:  # a waveform has no depth: its background stands here
        _draw_map(axes[0], cube.flux.background, "photons per period", DEPTH_MAP, None, "Background")
    if cube.reflectivity is not None:
        _draw_map(axes[1], cube.reflectivity, "reflectivity", SHARE_MAP, None, "Reflectivity")
    else:
        signal = cube.flux.signal
        _draw_map(axes[1], signal, "photons per period", SHARE_MAP, _limits(signal) if fit else None, f"Signal{fit}")
    _draw_map(axes[2], totals, "registrations", COUNTS_MAP, _limits(totals), "Total counts")
    note = "Peak-bin depth"
    error = np.abs(depth_error_m(cube, peaks_m))
    if np.isfinite(error).any():
        median = _metres(float(np.nanmedian(error)))
        note = f"Peak bin, off {median}" if short else f"{note} (median {'distance' if fit else 'error'} {median})"
    _draw_map(axes[3], peaks_m, "depth (m)", DEPTH_MAP, limits, note)
    for ax in axes:
        for (y, x), colour in zip(pixels.values(), COLOURS, strict=False):
            ax.plot(x, y, "o", ms=6, mfc="none", mec=HALO, mew=2.2)
            ax.plot(x, y, "o", ms=6, mfc="none", mec=colour, mew=1.1)


def _draw_map(
    ax: Axes, values: NDArray[Any], label: str, cmap: str, limits: tuple[float, float] | None, title: str = ""
) -> None:
    import matplotlib as mpl

    low, high = limits or (None, None)
    colours = mpl.colormaps[cmap].with_extremes(bad=MISSING)
    image = ax.imshow(values, cmap=colours, vmin=low, vmax=high, aspect="equal")
    finite = values[np.isfinite(values)]
    above = bool(limits and finite.size and finite.max() > limits[1] * (1 + 1e-9))
    below = bool(limits and finite.size and finite.min() < limits[0] * (1 - 1e-9))
    extend = "both" if above and below else "max" if above else "min" if below else "neither"
    strip = ax.inset_axes((1.025, 0.0, 0.035, 1.0))  # as high as the image, whatever its aspect
    bar = ax.figure.colorbar(image, cax=strip, extend=extend, extendfrac=0.025)
    bar.set_label(label, labelpad=2.0)
    bar.outline.set_linewidth(0.5)
    ax.set_title(title)
    ax.spines[:].set_visible(True)  # an image has a frame
    ax.set_xticks([])
    ax.set_yticks([])


def _draw_pixels(
    figure: Figure, box: tuple[float, float, float, float], cube: Cube, realization: int, pixels: _Pixels
) -> None:
    grid = figure.add_gridspec(
        len(pixels),
        2,
        **dict(zip(("left", "right", "bottom", "top"), box, strict=True)),
        wspace=0.14,
        hspace=0.42,
        width_ratios=(2.4, 1.0),
    )
    axes = grid.subplots(squeeze=False)
    for row, ((name, pixel), colour) in enumerate(zip(pixels.items(), COLOURS, strict=False)):
        draw_pixel(axes[row, 0], axes[row, 1], cube, realization, pixel, colour, name)
    for ax in axes[:, 0]:
        ax.set_ylabel("counts per bin")
        ax.yaxis.set_label_coords(-0.45 / (ax.get_position().width * figure.get_figwidth()), 0.5)
    axes[-1, 0].set_xlabel("time in the laser period (ns)")
    axes[-1, 1].set_xlabel("around the return (ns)")
    spacing = {"handlelength": 1.6, "borderaxespad": 0.1, "labelspacing": 0.25}
    y, x = next(iter(pixels.values()))
    place = quiet_corner(incident_rate(cube.flux, cube.system, y, x))
    axes[0, 0].legend(loc=place, **spacing)


def _headline(cube: Cube, realization: int) -> str:
    system, flux = cube.system, cube.flux
    _, height, width, _ = cube.shape
    which = f", realization {cube.recipe.first_realization + realization}" if cube.shape[0] > 1 else ""
    made = "measured" if cube.engine == MEASURED else f"{cube.engine} engine{which}".strip()
    made = made if cube.engine else f"simulated{which}"
    return (
        f"{height} × {width} pixels, {instrument(system)}; mean S = {flux.signal.mean():.3g}, "
        f"B = {flux.background.mean():.3g} photons per period; {made}"
    )


def _checked(cube: Cube, realization: int, pixels: Sequence[tuple[int, int]] | None) -> tuple[Cube, int, _Pixels]:
    """The cube, or the light fitted to a measured one; which exposure of it, and the pixels to draw by name."""
    count, height, width, _ = cube.shape
    realization = checks.integer("realization", realization, low=0, high=count - 1)
    if cube.measured:
        cube, realization = fitted(cube, realization), 0
    if pixels is None:
        return cube, realization, example_pixels(cube.flux, cube.depth_m)
    if not 1 <= len(pixels) <= len(COLOURS):
        raise ValueError(f"pixels must be 1 to {len(COLOURS)} pairs (y, x), got {len(pixels)}")
    for pixel in pixels:
        if not isinstance(pixel, tuple | list | np.ndarray) or len(pixel) != 2:
            raise TypeError(f"pixels must be pairs (y, x), got {pixel!r}")
        for name, place, size in zip("yx", pixel, (height, width), strict=True):
            checks.integer(f"{name} of pixels", place, low=0, high=size - 1)
    names = [""] if len(pixels) == 1 else [f"{k}." for k in range(1, len(pixels) + 1)]
    return cube, realization, {name: (int(y), int(x)) for name, (y, x) in zip(names, pixels, strict=True)}


def _limits(values: NDArray[Any]) -> tuple[float, float] | None:
    """The range that all but 1 % of the pixels share, so that a few outliers do not flatten the picture."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return None
    low, high = np.percentile(finite, (0.5, 99.5))
    return (float(low), float(high)) if high > low else None


def _metres(value: float) -> str:
    if value < 0.01:
        return f"{1e3 * value:.2g} mm"
    return f"{1e2 * value:.2g} cm" if value < 1.0 else f"{value:.3g} m"
