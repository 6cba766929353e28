"""Origin of a cube: the recipe that reproduces a simulated cube bit for bit, or the recording of a measured one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked_fields
from mars_lidar._base.display import brief
from mars_lidar.engines.simulation import checked_index
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux, StoredFlux

BLOCK_BYTES = 64 * 2**20  # one call of the simulator: enough work for every core, little beside the output


class _Blocks:
    """Shape and type of a cube, and the parts in which it is simulated, written and read."""

    system: System
    realizations: int

    @property
    def image(self) -> tuple[int, int]:
        """(H, W)."""
        raise NotImplementedError

    @property
    def light_bytes(self) -> int:
        """Size of incident light that stays on disk until its part is simulated."""
        return 0

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(realizations, H, W, bins) of the cube."""
        return (self.realizations, *self.image, self.system.bins)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the counts, a function of the system."""
        return self.system.histogram_dtype

    @property
    def nbytes(self) -> int:
        """Size of the whole cube in memory."""
        return math.prod(self.shape) * self.dtype.itemsize

    def chunks(self, target_bytes: int) -> tuple[int, int, int, int]:
        """Shape of a storage chunk of at most about `target_bytes`: image rows x all columns x all bins.

        Realizations share a chunk only where whole images are small, and columns are split only where a
        single row is larger than the target.
        """
        realizations, height, width, bins = self.shape
        pixel = bins * self.dtype.itemsize
        columns = min(width, max(1, target_bytes // pixel))
        rows = min(height, max(1, target_bytes // (columns * pixel)))
        if self.light_bytes:  # blocks are made of whole chunks, and must hold the waveforms
            rows = min(rows, max(1, BLOCK_BYTES // max(1, self.light_bytes // height)))
        together = min(realizations, max(1, target_bytes // (height * width * pixel)))
        return together, rows, columns, bins

    def blocks(self, chunks: tuple[int, int, int, int]) -> Iterator[tuple[slice, slice]]:
        """Parts (realizations, rows) that cover the cube in C order, each one made of whole chunks.

        A part is several whole images or a band of rows of one image, of at most about `BLOCK_BYTES`.
        """
        realizations, height, width, bins = self.shape
        # waveforms on disk are in memory while a part is simulated
        row_bytes = max(width * bins * self.dtype.itemsize, self.light_bytes // height)
        images = BLOCK_BYTES // (height * row_bytes)
        if images >= 1:
            step = max(chunks[0], images // chunks[0] * chunks[0])
            for first in range(0, realizations, step):
                yield slice(first, min(first + step, realizations)), slice(0, height)
            return
        band = max(chunks[1], BLOCK_BYTES // row_bytes // chunks[1] * chunks[1])
        if self.system.detector.crosstalk is not None:  # no part of an image can be made alone
            band = height
        for k in range(realizations):
            for row in range(0, height, band):
                yield slice(k, k + 1), slice(row, min(row + band, height))


@checked_fields
@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(_Blocks):
    """Recording of a measured cube, whose light is unknown.

    Parameters
    ----------
    system
        Laser, detector and histogram: `cycles` laser periods in each exposure.
    pixels
        Image size (H, W).
    realizations
        Number of exposures.
    source
        Free text: origin of the counts.

    Raises
    ------
    ValueError, TypeError
        A size or a number of realizations below 1, or `system` is not a `System`.

    See Also
    --------
    from_histograms, Recipe

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> ml.io.from_histograms([[0, 3] * 64], system).recipe.pixels
    (1, 1)
    """

    system: System
    pixels: tuple[int, int]
    realizations: int = 1
    source: str = ""

    __repr__ = brief

    first_realization: ClassVar[int] = 0
    engine: ClassVar[str] = "measured"
    settings: ClassVar[dict[str, Any]] = {}
    reflectivity: ClassVar[None] = None

    def __post_init__(self) -> None:
        if not isinstance(self.pixels, tuple) or len(self.pixels) != 2:
            raise TypeError(f"pixels must be (H, W), got {self.pixels!r}")
        for size in self.pixels:
            checks.integer("pixels", size, low=1, high=2**32)
        checks.integer("realizations", self.realizations, low=1, high=2**32)

    @property
    def image(self) -> tuple[int, int]:
        """(H, W)."""
        return self.pixels

    @property
    def depth_m(self) -> NDArray[np.float64]:
        """Unknown: NaN (H, W)."""
        return np.full(self.pixels, np.nan)

    def replace(self, **changes: Any) -> Recording:
        """A copy with some fields changed: `changes`, by their names."""
        changes.pop("first_realization", None)  # its exposures have no numbers
        return dataclasses.replace(self, **changes)


@checked_fields
@dataclass(frozen=True, eq=False, kw_only=True)
class Recipe(_Blocks):
    """All arguments of one call of `mars_lidar.simulate`, and the maps of the scene.

    Parameters
    ----------
    system, flux, engine, seed, realizations, first_realization, pixel_index
        As for `mars_lidar.simulate`; `pixel_index` is (H * W,) or None for the row-major numbering
        of the flux.
    depth_m
        (H, W), m. By default the depth c tau / 2 of the flux's strongest return.
    reflectivity
        (H, W), or None if the flux was not made from a scene.
    source
        Free text: origin of the scene.
    options
        Further arguments of `mars_lidar.simulate` for the engine: table, count, interpolation,
        outside.
    settings
        Settings on which the cube depends besides system, flux and seed, as plain data: `Engine.settings`. A file
        stores them in place of the options.

    Raises
    ------
    ValueError, TypeError
        An argument that `mars_lidar.simulate` would refuse, or maps of another shape than the flux.

    See Also
    --------
    simulate_to, regenerate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> recipe = ml.io.Recipe(system=system, flux=ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), seed=7)
    >>> ml.io.regenerate(recipe).shape
    (1, 1, 2, 128)
    """

    system: System
    flux: Flux
    engine: str = "exact"
    seed: int = 0
    realizations: int = 1
    first_realization: int = 0
    pixel_index: NDArray[np.int64] | None = None
    depth_m: NDArray[np.float64] = None  # type: ignore[assignment]  # filled below, never None afterwards
    reflectivity: NDArray[np.float64] | None = None
    source: str = ""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)

    __repr__ = brief

    def __post_init__(self) -> None:
        object.__setattr__(self, "flux", self.flux.image)
        for name, low, high in (
            ("seed", 0, 2**64 - 1),
            ("realizations", 1, 2**32),
            ("first_realization", 0, 2**32 - 1),
        ):
            number = checks.integer(name, getattr(self, name), low=low, high=high)
            object.__setattr__(self, name, number)
        depth = self.system.depth_m(self.flux.delay_ns) if self.depth_m is None else self.depth_m
        object.__setattr__(self, "depth_m", self._map("depth_m", depth))
        if self.reflectivity is not None:
            object.__setattr__(self, "reflectivity", self._map("reflectivity", self.reflectivity))
        if self.pixel_index is not None:
            index = checked_index(self.pixel_index, self.flux.shape)
            object.__setattr__(self, "pixel_index", index.astype(np.int64))

    def _map(self, name: str, value: ArrayLike) -> NDArray[np.float64]:
        array = np.asarray(checks.numbers(name, checks.unmasked(name, value)), dtype=np.float64)
        if array.shape != self.flux.shape:
            raise ValueError(f"{name} must have the flux's shape {self.flux.shape}, got {array.shape}")
        return array

    @property
    def image(self) -> tuple[int, int]:
        """(H, W)."""
        height, width = self.flux.shape
        return height, width

    @property
    def light_bytes(self) -> int:
        """Size of incident light that stays on disk until its part is simulated."""
        return self.flux.waveform_bytes if isinstance(self.flux, StoredFlux) else 0

    def part(self, realizations: slice, rows: slice) -> dict[str, Any]:
        """Arguments for `mars_lidar.simulate` of this part alone, with the same bits as in the whole.

        Both slices, `realizations` and `rows`, count from the start of this cube and have explicit ends.
        """
        height, width = self.flux.shape
        if self.system.detector.crosstalk is not None and (rows.start, rows.stop) != (0, height):
            raise ValueError(
                f"rows must be all {height} rows with crosstalk, where the pixels of an image depend on each other, "
                f"got {rows.start} to {rows.stop}"
            )
        index = self.pixel_index
        first, last = rows.start * width, rows.stop * width
        return {
            "flux": self.flux[rows],
            "system": self.system,
            "engine": self.engine,
            "realizations": realizations.stop - realizations.start,
            "first_realization": self.first_realization + realizations.start,
            "pixel_index": np.arange(first, last) if index is None else index[first:last],
            "seed": self.seed,
            **self.options,
        }

    def replace(self, **changes: Any) -> Recipe:
        """A copy with some fields changed: `changes`, by their names."""
        return dataclasses.replace(self, **changes)
