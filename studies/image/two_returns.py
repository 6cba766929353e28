"""Two surfaces behind each pixel in dim light: ``returns=2`` of each pixel alone, and of the image."""

from __future__ import annotations

import numpy as np

from mars_lidar import Flux, Scene, System, reconstruct, simulate
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction.histogram_record import relative_width
from studies.common.report import Row

PHOTONS = 1.0, 2.0, 5.0, 10.0, 20.0  # of each of two returns, a pixel
_METHODS = "maximum_likelihood", "image"


def rows(size: int, system: System, seed: int, photons: tuple[float, ...] = PHOTONS) -> list[Row]:
    """Shares of the pixels with both surfaces where there are two, and with a second return where there is one."""
    x, half = np.arange(size), size // 2
    pane = 10.0 + (3.0 * x + 2.0 * x[:, None]) / size  # ns: a pane of glass in front of the room
    wall = np.asarray(Scene.example("room", size).flux(system, signal=1.0, sbr=1.0).delay_ns)
    out: list[Row] = []
    for each in photons:
        level = np.full((size, size), each / system.cycles)
        of_wall = Flux(level, level, wall)
        scenes = {
            "whole": Flux.multi(of_wall, Flux(level, 0.0, pane)),
            "half": Flux.multi(of_wall, Flux(np.where(x < half, level, 0.0), 0.0, pane)),
            "none": Flux(2.0 * level, level, wall),
        }
        cubes = {name: simulate(flux, system, seed=seed, threads=1)[0] for name, flux in scenes.items()}
        for method in _METHODS:
            delays = {name: _delays(cube, system, method) for name, cube in cubes.items()}
            both = {name: _both(delays[name], wall, pane, system) for name in ("whole", "half")}
            two = {name: np.asarray(np.isfinite(delays[name]).all(-1)) for name in ("half", "none")}
            line = {"photons of each return": each, "method": method, "both, whole pane %": both["whole"]}
            line |= {"both, half a pane %": both["half"][:, :half], "two beside it %": two["half"][:, half:]}
            line |= {"two without a pane %": two["none"]}
            out.append({k: 100.0 * float(v.mean()) if isinstance(v, np.ndarray) else v for k, v in line.items()})
    return out


def _delays(cube: np.ndarray, system: System, method: str) -> FloatArray:
    """Of both returns (H, W, 2), ns."""
    returns = reconstruct(cube, system, method, returns=2, threads=1).returns
    assert returns is not None
    return returns.delay_ns


def _both(delays: FloatArray, wall: FloatArray, pane: FloatArray, system: System) -> np.ndarray:
    """Whether the returns (H, W, 2) of a pixel are within 3 sigma of pane and wall, or of wall and pane."""
    period, most = system.period_ns, _core.IMAGE_OUTLIER_SIGMA * relative_width(system) * system.period_ns
    near = [np.abs((delays - each[..., None] + 0.5 * period) % period - 0.5 * period) < most for each in (wall, pane)]
    return np.asarray((near[0] & near[1][..., ::-1]).any(-1))
