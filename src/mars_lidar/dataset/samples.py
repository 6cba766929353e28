"""The samples of a dataset: their numbering, and how arrays are cut into chunks and shards."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mars_lidar.dataset.recipe import DatasetRecipe


def count_samples(recipe: DatasetRecipe, scenes: int) -> int:
    """Scenes x systems x levels."""
    return scenes * len(recipe.systems) * len(recipe.light.levels)


def sample_parts(recipe: DatasetRecipe, sample: int) -> tuple[int, int, float, float]:
    """Scene, system, signal and sbr of a sample; levels vary fastest, then systems."""
    rest, level = divmod(sample, len(recipe.light.levels))
    scene, system = divmod(rest, len(recipe.systems))
    return scene, system, *recipe.light.levels[level]


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


def grid(shape: Sequence[int], steps: Sequence[int]) -> tuple[int, ...]:
    """How many blocks of `steps` there are along each axis."""
    return tuple(math.ceil(n / step) for n, step in zip(shape, steps, strict=True))


def block(place: Sequence[int], steps: Sequence[int], shape: Sequence[int]) -> tuple[slice, ...]:
    """The part of an array that is the block at a place of the grid."""
    every = zip(place, steps, shape, strict=True)
    return tuple(slice(k * step, min((k + 1) * step, n)) for k, step, n in every)
