"""Two surfaces behind each pixel in dim light: peaks of the image's posterior beside ``returns=2``."""

from __future__ import annotations

import numpy as np

from mars_lidar import Flux, Scene, System, reconstruct, simulate
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.reconstruction import MaximumLikelihood
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_pulse import settings_of
from mars_lidar.reconstruction.photons import Photons
from studies.common.report import Row

PHOTONS = 1.0, 2.0, 5.0, 10.0, 20.0  # of each of two returns, a pixel
FALSE = 0.01  # share of the pixels of one surface, to which a second is given
_APART = 5.0  # sigma between two returns at least


def rows(size: int, system: System, seed: int, photons: tuple[float, ...] = PHOTONS) -> list[Row]:
    """For each light the share of the pixels whose surfaces both were found, by either way."""
    room = Scene.example("room", size)
    y, x = np.mgrid[:size, :size]
    pane = 10.0 + 3.0 * x / size + 2.0 * y / size  # ns: a pane of glass in front of the room
    behind = np.asarray(room.flux(system, signal=1.0, sbr=1.0).delay_ns)
    out: list[Row] = []
    for each in photons:
        level = each / system.cycles
        wall = Flux(np.full((size, size), level), level, behind)
        both = Flux.multi(wall, Flux(np.full((size, size), level), 0.0, pane))
        one = Flux(np.full((size, size), 2.0 * level), level, behind)
        line: dict[str, float] = {"photons of each return": each}
        lone, pair = (simulate(flux, system, seed=seed, threads=1)[0] for flux in (one, both))
        for name, seconds in (("pixel alone", _alone), ("posterior's peaks", _peaks)):
            _, score = seconds(lone, system)
            least = float(np.quantile(score, 1.0 - FALSE))
            delays, score = seconds(pair, system)
            near = [
                np.abs(_gap(delays, d[..., None], system)) < _core.IMAGE_OUTLIER_SIGMA * _sigma(system)
                for d in (behind, pane)
            ]
            found = (near[0] & near[1][..., ::-1]).any(-1) & (score > least)
            line[f"{name}, both found %"] = 100.0 * float(found.mean())
        out.append(line)
    return out


def _sigma(system: System) -> float:
    setting = settings_of(system)[-1]
    return setting.sigma / setting.cells * system.period_ns


def _gap(a: FloatArray, b: FloatArray, system: System) -> FloatArray:
    return np.asarray((a - b + 0.5 * system.period_ns) % system.period_ns - 0.5 * system.period_ns)


def _alone(cube: np.ndarray, system: System) -> tuple[FloatArray, FloatArray]:
    """Delays (H, W, 2) of the two returns of each pixel alone, and minus the log of the second's false alarm."""
    found = reconstruct(cube, system, MaximumLikelihood(false_alarm=0.2), returns=2, threads=1).returns
    assert found is not None
    chance = np.sort(np.where(np.isfinite(found.delay_ns), found.false_alarm, 1.0), -1)[..., -1]
    return found.delay_ns, -np.log(np.maximum(chance, 1e-300))


def _peaks(cube: np.ndarray, system: System) -> tuple[FloatArray, FloatArray]:
    """Delays (H, W, 2) of the two largest peaks apart of each pixel's posterior, and the mass of the smaller."""
    height, width, bins = cube.shape
    solver = solver_of(Photons.of(cube.reshape(-1, bins), height, width), 1)
    setting = settings_of(system)[-1]
    solver.begin(setting)
    volumes, cells = solver.volumes(), setting.cells
    place, mass = np.asarray(volumes.place), np.asarray(volumes.mass)
    apart = np.abs((place - place[:, :1] + 0.5 * cells) % cells - 0.5 * cells)
    others = np.where(apart > _APART * setting.sigma, mass, 0.0)
    second = others.argmax(1)
    pixels = np.arange(len(place))
    delays = np.stack([place[:, 0], place[pixels, second]], -1) / cells * system.period_ns
    return delays.reshape(height, width, 2), others[pixels, second].reshape(height, width)
