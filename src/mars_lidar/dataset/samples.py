"""The samples of a dataset: their numbering, their flux, and how arrays are cut into chunks and shards."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

from mars_lidar.dataset.light import Light
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.flux import Flux
from mars_lidar.scene import Scene
from mars_lidar.system import System


def count_samples(recipe: DatasetRecipe, scenes: int) -> int:
    """Scenes x systems x levels."""
    return scenes * len(recipe.systems) * len(recipe.light.levels)


def sample_parts(recipe: DatasetRecipe, sample: int) -> tuple[int, int, float, float]:
    """Scene, system, signal and sbr of a sample; levels vary fastest, then systems."""
    rest, level = divmod(sample, len(recipe.light.levels))
    scene, system = divmod(rest, len(recipe.systems))
    return scene, system, *recipe.light.levels[level]


def flux_of(
    scene: Scene, system: System, light: Light, signal: float, sbr: float, dark: float | None = None
) -> Flux:
    """The flux of a sample. Pixels without return or beyond the range are told once, not for every sample."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return scene.flux(
            system,
            signal=signal,
            sbr=sbr,
            attenuation=light.attenuation,  # type: ignore[arg-type]  # checked by the recipe
            ambient=light.ambient,  # type: ignore[arg-type]
            dark_counts_per_s=light.dark_counts_per_s if dark is None else dark,
        )


def fitting(shape: Sequence[int], unit: Sequence[int], itemsize: int, most_bytes: float) -> tuple[int, ...]:
    """The largest block of whole `unit` of an array of `shape` below `most_bytes`, filled from the last axis.

    An axis is begun only where those behind it are whole, so that a block is one piece of the array in C order; it is
    cut into equal parts.
    """
    block = list(unit)
    for axis in reversed(range(len(shape))):
        units = math.ceil(shape[axis] / unit[axis])
        room = max(1, int(most_bytes // (math.prod(block) * itemsize)))
        parts = math.ceil(units / min(units, room))
        block[axis] = unit[axis] * math.ceil(units / parts)
        if parts > 1:
            break
    return tuple(block)
