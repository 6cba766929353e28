"""Arguments of the exposure statistics, checked: photons and delays as arrays that broadcast."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.types import FloatArray

MAX_PHOTONS = 1e6


def reals(name: str, value: ArrayLike) -> FloatArray:
    """Real numbers as doubles, not none of them."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
    if array.size == 0:
        raise ValueError(f"{name} must not be empty, got shape {array.shape}")
    return array.astype(np.float64)


def photons(name: str, value: ArrayLike) -> FloatArray:
    """Photons per period, in range."""
    array = reals(name, value)
    bad = ~((array >= 0) & (array <= MAX_PHOTONS))
    if bad.any():
        raise ValueError(f"{name} must lie in [0, {MAX_PHOTONS:g}] photons per period, got {array[bad].flat[0]}")
    return array


def broadcast(names: tuple[str, ...], *arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Arrays of one shape; `names` are for the error."""
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError:
        told = ", ".join(f"{n} {a.shape}" for n, a in zip(names, arrays, strict=False))
        raise ValueError(f"shapes must broadcast, got {told}") from None


def with_delays(
    signal: FloatArray, background: FloatArray, delay_ns: ArrayLike | None, period_ns: float
) -> list[NDArray[Any]]:
    """Signal, background and delays, ns, of one shape; delays of None are half the period, NaN is for no return."""
    given = reals("delay_ns", 0.5 * period_ns if delay_ns is None else delay_ns)
    signal, background, delay = broadcast(("signal", "background", "delay_ns"), signal, background, given)
    bad = ~np.isfinite(delay) & ~(np.isnan(delay) & (signal == 0))
    if bad.any():
        raise ValueError(f"delay_ns must be finite (NaN for no return where signal is 0), got {delay[bad].flat[0]}")
    return [signal, background, delay]


def flat(array: NDArray[Any]) -> FloatArray:
    """(cells,) doubles, contiguous."""
    return np.ascontiguousarray(array.reshape(-1), dtype=np.float64)
