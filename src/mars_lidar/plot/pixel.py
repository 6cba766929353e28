"""One pixel's histogram: the whole period, and the return close up; colours are those of `colours.py`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.system import System
from mars_lidar.io.cube import Cube
from mars_lidar.io.layout import MEASURED
from mars_lidar.plot.colours import MUTED, PREDICTION
from mars_lidar.plot.views import incident_rate, predicted_counts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_Array = NDArray[np.float64]
_COARSE = 64  # parts of the period over which background counts are averaged
_LOG_FROM = 8.0  # counts: below this peak a linear axis shows more


def draw_pixel(
    whole: Axes, zoom: Axes, cube: Cube, realization: int, pixel: tuple[int, int], colour: str, name: str
) -> None:
    """Draw counts, the predicted mean histogram, the incident rate scaled to the same total, and the true delays.

    The incident rate has the shape of a histogram without dead time; its difference from the prediction is pile-up.
    """
    y, x = pixel
    system, flux = cube.system, cube.flux
    counts = np.asarray(cube.histogram[realization, y, x]).astype(np.float64)
    rate = incident_rate(flux, system, y, x)
    expected = rate * (counts.sum() / rate.sum()) if rate.sum() > 0 else rate
    predicted = predicted_counts(cube, y, x)
    returns = zip(flux.returns_signal[:, y, x], flux.returns_delay_ns[:, y, x], strict=True)
    delays = [float(tau % system.period_ns) for s, tau in returns if s > 0]
    if delays:
        centre, (low, high) = float(flux.delay_ns[y, x] % system.period_ns), _zoom_ns(system)
    else:
        centre = float(system.time_ns[int((rate if np.ptp(rate) > 0 else counts).argmax())])
        low, high = -0.1 * system.period_ns, 0.1 * system.period_ns

    edges = np.linspace(0.0, system.period_ns, system.bins + 1)
    whole.fill_between(*_steps(edges, counts), color=colour, alpha=0.4, lw=0, label="counts")
    lowest = float(expected[expected > 0].min(initial=1.0))
    _draw_means(whole, system, counts, expected, lowest, colour)
    whole.plot(*_steps(edges, expected), color=MUTED, lw=0.8, label="incident rate, same total")
    if predicted is not None:
        whole.plot(*_steps(edges, predicted), color=PREDICTION, lw=0.9, label="predicted mean")
    label = "fitted delay" if cube.engine == MEASURED else "true delay"
    for k, tau in enumerate(delays):
        whole.axvline(tau, color=MUTED, lw=0.7, ls=(0, (3, 2)), zorder=0, label=label if k == 0 else None)
    whole.set_xlim(0.0, system.period_ns)
    top = max(float(counts.max()), float(expected.max()), 1.0)
    if top > _LOG_FROM:
        whole.set_yscale("log")
        whole.yaxis.set_major_formatter("{x:g}")
        whole.yaxis.set_minor_formatter("")
        whole.set_ylim(max(0.25 * min(lowest, 1.0), 5e-4 * top), 2.0 * top)
    else:
        whole.set_ylim(0.0, 1.15 * top)
        whole.locator_params(axis="y", integer=True, nbins=4)

    # whole bins around the centre, cyclic: a return at the period's edge is seen in one piece
    first, last = np.floor((centre + low) / system.bin_ns), np.ceil((centre + high) / system.bin_ns)
    bins = np.arange(int(first), int(max(last, first + 1)))
    edges = np.append(bins, bins[-1] + 1) * system.bin_ns - centre
    near, incident = counts[bins % system.bins], expected[bins % system.bins]
    zoom.fill_between(*_steps(edges, near), color=colour, alpha=0.4, lw=0)
    zoom.plot(*_steps(edges, near), color=colour, lw=0.6)
    zoom.plot(*_steps(edges, incident), color=MUTED, lw=0.9)
    if predicted is not None:
        zoom.plot(*_steps(edges, predicted[bins % system.bins]), color=PREDICTION, lw=0.9)
    for tau in delays:
        offset = (tau - centre + 0.5 * system.period_ns) % system.period_ns - 0.5 * system.period_ns
        zoom.axvline(offset, color=MUTED, lw=0.7, ls=(0, (3, 2)), zorder=0)
    zoom.set_xlim(edges[0], edges[-1])
    zoom.set_ylim(0.0, 1.1 * max(float(near.max()), float(incident.max()), 1.0))
    zoom.locator_params(axis="y", integer=True, nbins=4)
    whole.set_title(
        f"{name} pixel (y {y}, x {x}): S = {flux.signal[y, x]:.3g}, B = {flux.background[y, x]:.3g}, "
        f"{int(counts.sum()):,} registrations".lstrip(),
        color=colour,
    )


def quiet_corner(rate: NDArray[np.float64]) -> str:
    """The corner in which a legend covers least of a histogram of this rate."""
    early, middle, late = (float(part.max(initial=0.0)) for part in np.array_split(rate, 3))
    places = {"upper right": late, "upper left": early, "upper center": middle}
    return min(places, key=lambda name: places[name])


def _draw_means(ax: Axes, system: System, counts: _Array, expected: _Array, lowest: float, colour: str) -> None:
    """Means over many bins; beside the returns, for there the bins themselves are the better picture."""
    group = system.bins // _COARSE
    if group > 1:
        starts = np.arange(0, system.bins, group)
        means = np.add.reduceat(counts, starts) / np.diff(starts, append=system.bins)
        means[np.maximum.reduceat(expected, starts) > 3.0 * lowest] = np.nan
        edges = np.append(starts, system.bins) * system.bin_ns
        ax.plot(*_steps(edges, means), color=colour, lw=1.0, label=f"counts, mean of {group} bins")


def _steps(edges: _Array, values: _Array) -> tuple[_Array, _Array]:
    """Outline of a histogram as a line; drawn this way 20 times faster than by `Axes.stairs`."""
    return np.repeat(edges, 2)[1:-1], np.repeat(values, 2)


def _zoom_ns(system: System) -> tuple[float, float]:
    """Interval around the delay with all but 1e-3 of the pulse, and some of what is beside it."""
    low, high = system.pulse.support_ns()
    t = np.linspace(low, high, 4097)
    inside = np.interp((5e-4, 1 - 5e-4), system.pulse.cumulative(t), t)
    margin = max(0.3 * float(inside[1] - inside[0]), 6 * system.bin_ns)
    half = 0.5 * system.period_ns
    return max(float(inside[0]) - margin, -half), min(float(inside[1]) + margin, half)
