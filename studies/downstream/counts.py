"""How far the counts of each arm are from those of the gold standard on the test scenes: what a network meets there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Scene
from studies.downstream.data import Config, Simulators

QUARTERS = ("dimmest", "second", "third", "brightest")
_STREAMS = (5, 6, 7)  # of the arms and of two exposures by the gold standard; others than those of the networks' data


def count_bias(config: Config, scenes: Sequence[Scene], simulators: Simulators) -> dict[str, dict[str, list[float]]]:
    """By ratio and arm: mean count over that of the gold standard, less 1, in quarters of the pixels by reflectivity.

    Key ``"scatter"`` stands for the gold standard's own standard deviation of a pixel's count, over its mean: what a
    bias is to be measured by.
    """
    reflectivity = np.stack([scene.reflectivity for scene in scenes]).ravel()
    quarters = np.array_split(np.argsort(reflectivity, kind="stable"), len(QUARTERS))

    def totals(arm: str, sbr: float, stream: int) -> NDArray[np.float64]:
        cubes = simulators.cubes(arm, scenes, sbr, (config.seed << 8) + stream)
        return np.asarray(cubes.sum(axis=-1, dtype=np.float64)).ravel()

    def by_quarter(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([values[pixels].mean() for pixels in quarters])

    found: dict[str, dict[str, list[float]]] = {}
    for sbr in config.sbr:
        first, second = (totals(config.gold, sbr, stream) for stream in _STREAMS[1:])
        gold = 0.5 * by_quarter(first + second)
        rows = {arm: by_quarter(totals(arm, sbr, _STREAMS[0])) / gold - 1.0 for arm in config.arms}
        rows["scatter"] = np.sqrt(0.5 * by_quarter((first - second) ** 2)) / gold
        found[f"{sbr:g}"] = {name: row.tolist() for name, row in rows.items()}
    return found
