"""A flux whose waveforms stay on disk: rows of them are made when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import FloatArray
from mars_lidar.light.flux import Flux, check_photons
from mars_lidar.light.tolerances import TOL


class StoredFlux(Flux):
    """A `Flux` of waveforms too large for memory; ``flux[rows]`` is an ordinary `Flux`.

    `mars_lidar.io.simulate_to` takes it band by band; `mars_lidar.simulate` makes it whole first. `waveform` has a
    `shape` and gives rows when it is indexed.

    Parameters
    ----------
    signal, background
        (H, W) photons per period.
    parts
        T, parts of the period.
    rows
        Makes the flux of some rows, a slice with explicit ends and step 1.
    info
        As for `Flux`.
    """

    def __init__(
        self,
        signal: ArrayLike,
        background: ArrayLike,
        parts: int,
        rows: Callable[[slice], Flux],
        info: dict[str, Any] | None = None,
    ) -> None:
        maps = Flux(signal, background, 0.0).image
        height, width = maps.shape
        none = np.empty((0, height, width))
        for name, value in {
            "signal": maps.signal,
            "background": maps.background,
            "delay_ns": np.full(maps.shape, np.nan),
            "returns_signal": none,
            "returns_delay_ns": none,
            "waveform": Waveforms((height, width, parts), rows),
            "info": dict(info or {}),
            "_make": rows,
        }.items():
            object.__setattr__(self, name, value)

    _make: Callable[[slice], Flux]

    @property
    def waveform_bytes(self) -> int:
        """Size of all waveforms in memory."""
        assert self.waveform is not None
        return self.waveform.nbytes

    def __getitem__(self, key: Any) -> Flux:
        """Part of the image, in memory."""
        keys = key if isinstance(key, tuple) else (key,)
        rows = keys[0]
        height = self.shape[0]
        if isinstance(rows, (int, np.integer)) and -height <= rows < height:
            row = int(rows) % height
            return self._make(slice(row, row + 1))[(0, *keys[1:])]
        if not isinstance(rows, slice) or len(keys) > 2:
            return super().__getitem__(key)  # which says what is wrong
        wanted = range(height)[rows]
        if not wanted:
            raise IndexError(f"flux{list(keys)} selects no pixel of {self.shape}")
        part = self._make(slice(min(wanted), max(wanted) + 1))
        return part[(slice(None, None, wanted.step), *keys[1:])]

    def _scaled(self, share: float, more: float | FloatArray) -> Flux:
        background = self.background * share + more
        check_photons("background with dark counts", background)
        every = np.broadcast_to(more, self.shape)

        def rows(wanted: slice) -> Flux:
            return self._make(wanted)._scaled(share, every[wanted])

        assert self.waveform is not None
        return StoredFlux(self.signal * share, background, self.waveform.shape[2], rows, self.info)


class Waveforms:
    """(H, W, T) photons per period and part, made by rows when indexed."""

    dtype = np.dtype(np.float64)
    ndim = 3

    def __init__(self, shape: tuple[int, int, int], rows: Callable[[slice], Flux]) -> None:
        self.shape = shape
        self._make = rows

    @property
    def nbytes(self) -> int:
        """Size of the whole in memory."""
        return 8 * self.shape[0] * self.shape[1] * self.shape[2]

    def __getitem__(self, key: Any) -> FloatArray:
        keys = key if isinstance(key, tuple) else (key,)
        single = isinstance(keys[0], (int, np.integer))
        wanted = range(self.shape[0])[slice(keys[0], keys[0] + 1 or None) if single else keys[0]]
        if not wanted:
            raise IndexError(f"rows {keys[0]!r} select none of {self.shape[0]}")
        waveform = self._make(slice(min(wanted), max(wanted) + 1)).waveform
        assert waveform is not None
        local = waveform[:: wanted.step][0] if single else waveform[:: wanted.step]
        return np.asarray(local[keys[1:] if single else (slice(None), *keys[1:])])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        check_memory(2 * self.nbytes, "the waveforms", "take rows: flux[rows]")
        return np.asarray(self[0 : self.shape[0]], dtype=dtype)

    def bands(self) -> Iterator[slice]:
        """Rows that are made together; together the image."""
        step = max(1, TOL.band_bytes * self.shape[0] // max(self.nbytes, 1))
        for first in range(0, self.shape[0], step):
            yield slice(first, min(first + step, self.shape[0]))
