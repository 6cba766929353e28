"""The figure of a reconstruction: the truth above, and a row of depth, its error, and reflectivity for each method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar.io.cube import Cube
from mars_lidar.plot.colours import DEPTH_MAP, SHARE_MAP
from mars_lidar.plot.figures import _draw_map, _limits, _metres, pixel_histogram
from mars_lidar.plot.style import DPI, style
from mars_lidar.plot.views import depth_error_m
from mars_lidar.reconstruction import Reconstruction, Returns

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAP_INCHES = 2.35


def reconstruction(cube: Cube, results: Mapping[str, Reconstruction]) -> Figure:
    """Depth, its error, and reflectivity by each method, of the first exposure; errors only if the truth is known.

    For a single pixel its histogram, with the true light, or the fitted light of a measured one.

    Parameters
    ----------
    cube
        The cube, whose maps are the truth if it has a scene.
    results
        Reconstructions (realizations, H, W) by name of the method.
    """
    depth = cube.depth_m
    if depth.shape == (1, 1):
        return pixel_histogram(cube, 0, 0)
    known = bool(np.isfinite(depth).any())
    what = "signal" if cube.reflectivity is None else "reflectivity"
    reflectivity = cube.reflectivity
    truth = depth if cube.measured else cube.flux.signal if reflectivity is None else reflectivity
    unit = "reflectivity" if what == "reflectivity" else "photons per period"
    pick = {name: _maps(each, what) for name, each in results.items()}
    first = next(iter(pick.values()))
    depth_limits = _limits(depth if known else first["depth"])
    share_limits = _limits(truth) if known else _limits(first["share"])
    errors = {name: depth_error_m(cube, each["depth"]) for name, each in pick.items()}
    scale = max((float(np.nanpercentile(np.abs(e), 90)) for e in errors.values() if np.isfinite(e).any()), default=1.0)
    height, width = depth.shape
    several = {name: each.returns for name, each in results.items() if each.returns is not None}
    rows, columns = len(results) + known + len(several), 2 + known
    image = _MAP_INCHES * height / width
    with style():
        from matplotlib.figure import Figure

        size = columns * (_MAP_INCHES + 0.85) + 0.2, rows * (image + 0.32) + 0.1
        figure = Figure(figsize=size, dpi=DPI, layout="constrained")
        axes: Any = figure.subplots(rows, columns, squeeze=False)
        if known:
            _draw_map(axes[0, 0], depth, "depth (m)", DEPTH_MAP, depth_limits, "Truth: depth")
            axes[0, 1].set_axis_off()
            _draw_map(axes[0, 2], truth, unit, SHARE_MAP, share_limits, f"Truth: {what}")
        for row, (name, returns) in zip(axes[int(known) + len(results) :], several.items(), strict=True):
            _draw_returns(row, name, returns)
        for row, (name, each) in zip(axes[int(known) : int(known) + len(results)], pick.items(), strict=True):
            title = name.replace("_", " ")
            _draw_map(row[0], each["depth"], "depth (m)", DEPTH_MAP, depth_limits, title)
            if known:
                error = errors[name]
                note = ""
                if np.isfinite(error).any():
                    rmse = _metres(float(np.sqrt(np.nanmean(error**2))))
                    note = f"error: RMSE {rmse}, median {_metres(float(np.nanmedian(np.abs(error))))}"
                _draw_map(row[1], 1e3 * error, "depth error (mm)", "RdBu_r", (-1e3 * scale, 1e3 * scale), note)
            own = known and _needs_own_scale(each["share"], truth)
            limits = _limits(each["share"]) if own else share_limits
            _draw_map(row[-1], each["share"], unit, SHARE_MAP, limits, f"{what}, a scale of its own" if own else what)
    return figure


def _draw_returns(row: Any, name: str, returns: Returns) -> None:
    """Of a method that looked for several: how many, and the nearest and the farthest of those pixels."""
    count, depth = returns.count[0].astype(np.int64), returns.depth_m[0]
    most = depth.shape[-1]
    where = np.where(count > 1, 1.0, np.nan)
    farthest = np.take_along_axis(depth, np.maximum(count, 1)[..., None] - 1, axis=-1)[..., 0]
    _draw_map(row[0], count.astype(np.float64), "returns", DEPTH_MAP, (0.0, most), f"{name.replace('_', ' ')}: returns")
    row[0].images[0].colorbar.set_ticks(range(most + 1))
    limits = _limits(np.stack([where * depth[..., 0], where * farthest])) if (count > 1).any() else (0.0, 1.0)
    _draw_map(row[-1], where * farthest, "depth (m)", DEPTH_MAP, limits, "farthest of several")
    if len(row) > 2:
        _draw_map(row[1], where * depth[..., 0], "depth (m)", DEPTH_MAP, limits, "nearest of several")


def _needs_own_scale(share: Any, truth: Any) -> bool:
    """Whether a map would be black or white on the scale of the truth, as of methods that know no dead time."""
    lit = (share > 0) & (truth > 0)
    return bool(lit.any()) and not 0.5 <= float(np.median(share[lit] / truth[lit])) <= 2.0


def _maps(result: Reconstruction, what: str) -> dict[str, Any]:
    detected = result.detected[0]
    return {
        "depth": np.where(detected, result.depth_m[0], np.nan),
        "share": np.where(detected, getattr(result, what)[0], 0.0),
    }
