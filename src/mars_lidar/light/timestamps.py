"""Registration times of an image, packed pixel after pixel."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.display import as_html
from mars_lidar._base.imports import late
from mars_lidar._base.native import _core
from mars_lidar._base.resources import thread_count
from mars_lidar.instrument.system import System


@dataclass(frozen=True, eq=False)
class Timestamps:
    """Registrations of every pixel, pixel after pixel (row-major).

    Attributes
    ----------
    times_ns
        (n,) absolute times since the start of the exposure, ns, sorted within a pixel; of a recording
        clock the middle of each unit.
    cycle
        (n,) int32, laser period of each registration, from 0.
    bin
        (n,) int32, histogram bin of its phase.
    offsets
        (H * W + 1,) int64; pixel k owns ``[offsets[k], offsets[k + 1])``.
    shape
        (H, W).
    bins
        Bins of the histogram.
    period_ns, cycles
        Laser period, ns, and laser periods of the exposure.
    dtype
        Type of their histogram, uint16 or uint32.
    info
        Origin, as far as known: ``system`` (as `System.to_dict` returns it), ``engine``, ``seed``, ``realization``,
        ``source``, ``unit_ns`` (resolution of the recording clock).

    See Also
    --------
    simulate_timestamps, simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> times = ml.simulate_timestamps(ml.Flux(0.5, 0.5, 40.0), system, seed=0)
    >>> bool((times.histogram() == ml.simulate(ml.Flux(0.5, 0.5, 40.0), system, seed=0)[0]).all())
    True
    """

    times_ns: NDArray[np.float64]
    cycle: NDArray[np.int32]
    bin: NDArray[np.int32]
    offsets: NDArray[np.int64]
    shape: tuple[int, int]
    bins: int
    dtype: np.dtype[Any]
    period_ns: float = math.nan
    cycles: int = 0
    info: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ValueError or TypeError, with the name of the attribute, for what no detector registers."""
        for name, kind in (("times_ns", "f"), ("cycle", "iu"), ("bin", "iu"), ("offsets", "iu")):
            array = checks.unmasked(name, getattr(self, name))
            if not isinstance(array, np.ndarray) or array.ndim != 1 or array.dtype.kind not in kind:
                given = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                numbers = "real numbers" if kind == "f" else "integers"
                raise TypeError(f"{name} must be a NumPy array (n,) of {numbers}, got {given}")
        height, width = self.shape
        offsets, number = self.offsets, self.times_ns.size
        if offsets.size != height * width + 1 or offsets[0] != 0 or (np.diff(offsets) < 0).any():
            raise ValueError(
                f"offsets must be {height * width + 1} numbers that rise from 0, for {height} x {width} pixels"
            )
        for name in ("times_ns", "cycle", "bin"):
            if getattr(self, name).size != offsets[-1]:
                raise ValueError(
                    f"{name} must have {offsets[-1]} registrations as offsets tell, got {getattr(self, name).size}"
                )
        checks.integer("bins", self.bins, low=1, high=2**32)
        cycles = checks.integer("cycles", self.cycles, low=0, high=2**31) or 2**31
        for name, most in (("cycle", cycles), ("bin", self.bins)):
            array = getattr(self, name)
            if number and (array.min() < 0 or array.max() >= most):
                raise ValueError(f"{name} must lie in [0, {most}), got {array.min()} to {array.max()}")
        if number and not (self.times_ns.min() >= 0 and self.times_ns.max() < math.inf):  # false of NaN
            raise ValueError("times_ns must be finite and >= 0")
        falls = self.times_ns[1:] < self.times_ns[:-1]
        falls[offsets[(offsets > 0) & (offsets < number)] - 1] = False
        if falls.any():
            raise ValueError(f"times_ns must be sorted within a pixel, got {falls.sum()} before the one before them")

    @property
    def system(self) -> System | None:
        """Laser, detector and histogram, or None if unknown (a measured stream)."""
        stored = self.info.get("system")
        return None if stored is None else System.from_dict(stored)

    def _repr_html_(self) -> str:
        return as_html(self, {"photons": np.diff(self.offsets).reshape(self.shape)})

    @checked
    def save(self, path: str | Path, *, overwrite: bool = False, clock_ps: float | None = None) -> None:
        """Write to a ``.npz`` (exact), ``.ptu`` or ``.h5`` / ``.hdf5`` (Photon-HDF5); see docs/formats.md.

        Parameters
        ----------
        path, overwrite
            The file, and whether to replace an existing one.
        clock_ps
            For a ``.ptu``: smallest unit of its times; None: the finest that its records allow. Programs that make an
            image of the file use one bin per unit.

        Raises
        ------
        ValueError
            Another suffix, or a stream that the format cannot contain.
        OSError
            `path` exists and `overwrite` is false, or cannot be written.
        """
        late("io.streams.formats:save")(path, self, overwrite=overwrite, clock_ps=clock_ps)

    @classmethod
    @checked
    def load(
        cls,
        path: str | Path,
        *,
        period_ns: float | None = None,
        bins: int | None = None,
        unit_ns: float | None = None,
        variable: str | None = None,
    ) -> Timestamps:
        """Read a file of `save`, or a photon stream of another program: PTU (T2, T3), Photon-HDF5, .mat, .npz.

        Parameters
        ----------
        path
            ``.npz``, ``.ptu``, ``.h5``, ``.hdf5`` or ``.mat``. In PTU and Photon-HDF5 of other programs a pixel
            is a detector (channel), and the image is (1, detectors); in ``.mat`` and ``.npz`` an array of absolute
            times is one pixel, and a cell array (.mat) an image.
        period_ns
            Laser period, for files of other programs that do not contain it (T2) or contain a rounded one.
        bins
            Histogram bins, for files of other programs; None: one per unit of their fine clock.
        unit_ns, variable
            For ``.mat`` and ``.npz`` of other programs: unit of the times in ns, and the variable that contains them.

        Raises
        ------
        ValueError
            A file of another kind, damaged or incomplete: the message names it.
        """
        load = late("io.streams.formats:load")
        loaded: Timestamps = load(path, period_ns=period_ns, bins=bins, unit_ns=unit_ns, variable=variable)
        return loaded

    def pixel(self, y: int, x: int) -> Timestamps:
        """The registrations of the pixel in row `y` and column `x`, as views."""
        k = self._place(y, x)
        part = slice(self.offsets[k], self.offsets[k + 1])
        offsets = np.array([0, self.offsets[k + 1] - self.offsets[k]], np.int64)
        return dataclasses.replace(
            self,
            times_ns=self.times_ns[part],
            cycle=self.cycle[part],
            bin=self.bin[part],
            offsets=offsets,
            shape=(1, 1),
        )

    def _place(self, y: int, x: int) -> int:
        """Number of a pixel, row-major; IndexError outside of the image."""
        h, w = self.shape
        y, x = checks.integer("y", y, low=-(2**31), high=2**31), checks.integer("x", x, low=-(2**31), high=2**31)
        if not (-h <= y < h and -w <= x < w):
            raise IndexError(f"pixel ({y}, {x}) is outside of an image of {h} x {w}")
        return (y % h) * w + x % w

    def __len__(self) -> int:
        """Number of registrations."""
        return int(self.offsets[-1])

    @property
    def counts(self) -> NDArray[np.int64]:
        """Registrations of each pixel (H, W)."""
        return np.diff(self.offsets).reshape(self.shape)

    def histogram(self) -> NDArray[Any]:
        """(H, W, bins): equals the cube of the same engine and seed exactly."""
        pixels = self.shape[0] * self.shape[1]
        out = np.empty((pixels, self.bins), self.dtype)
        for k in range(pixels):
            out[k] = np.bincount(self.bin[self.offsets[k] : self.offsets[k + 1]], minlength=self.bins)
        return out.reshape(*self.shape, self.bins)

    def __repr__(self) -> str:
        h, w = self.shape
        return f"Timestamps({len(self)} registrations, {h} x {w} pixels)"


class DrawnTimestamps(Timestamps):
    """Timestamps that an engine drew: 8 bytes each; times and bins are computed and cached on first use.

    Made by `of`, without the checks of `Timestamps`, because the numbers are not user input.
    """

    phase: NDArray[np.float32]  # (n,) part of the laser period, in [0, 1]

    @classmethod
    def of(cls, **parts: Any) -> DrawnTimestamps:
        """Of laser periods and phases (n,), and the attributes of `Timestamps`."""
        new = object.__new__(cls)
        vars(new).update(parts)
        return new

    @cached_property
    def times_ns(self) -> NDArray[np.float64]:
        """(n,) absolute times since the start of the exposure, ns, sorted within a pixel."""
        return record_times(self.cycle, self.phase, self.period_ns)

    @cached_property
    def bin(self) -> NDArray[np.int32]:
        """(n,) histogram bin of the phase."""
        return record_bins(self.phase, self.bins)

    def pixel(self, y: int, x: int) -> Timestamps:
        """The registrations of one pixel, as views; their times and bins are views of the image's, if computed."""
        if "phase" not in vars(self):  # changed by dataclasses.replace
            return super().pixel(y, x)
        k = self._place(y, x)
        part = slice(self.offsets[k], self.offsets[k + 1])
        offsets = np.array([0, self.offsets[k + 1] - self.offsets[k]], np.int64)
        arrays = {name: vars(self)[name][part] for name in ("cycle", "phase", "times_ns", "bin") if name in vars(self)}
        return self.of(**(vars(self) | arrays | {"offsets": offsets, "shape": (1, 1)}))


def record_times(cycle: NDArray[np.int32], phase: NDArray[np.float32], period_ns: float) -> NDArray[np.float64]:
    """``(cycle + phase) * period_ns`` (n,); phases that were rounded to 1 lie below it."""
    out = np.empty(cycle.size)
    _core.record_times(cycle, phase, period_ns, out, thread_count(None))
    return out


def record_bins(phase: NDArray[np.float32], bins: int) -> NDArray[np.int32]:
    """Histogram bins (n,) of phases."""
    out = np.empty(phase.size, np.int32)
    _core.record_bins(phase, bins, out, thread_count(None))
    return out
