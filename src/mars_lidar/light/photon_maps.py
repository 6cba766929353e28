"""Maps of photons as a `Flux` takes them: read, checked, brought to one shape, and frozen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray

MAX_DELAY_NS = 1e9  # a second: beyond, float64 does not tell the phase in a laser period to 1e-6 ns
MAX_PHOTONS = 1e6  # per period; the samplers are tested to 1e3


def light_map(name: str, value: ArrayLike, *, photons: bool = True) -> FloatArray:
    """A scalar or (H, W) as float64 of two axes: photons per period, or any finite number or NaN."""
    if isinstance(value, np.ma.MaskedArray):  # a masked delay is no return; masked light is refused, not taken as it is
        value = np.where(np.ma.getmaskarray(value), np.nan, value.data)
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
    array = array.astype(np.float64)
    if array.ndim > 2:
        raise ValueError(f"{name} must be a scalar or (H, W), got shape {array.shape}")
    if array.size == 0:
        raise ValueError(f"{name} must have at least one pixel, got shape {array.shape}")
    if photons:
        check_photons(name, array)
    elif np.isinf(array).any():
        raise ValueError(f"{name} must be finite (or NaN where there is no return), got inf")
    return np.atleast_2d(array)


def check_photons(name: str, array: FloatArray) -> None:
    """Raise ValueError, naming the first one, for numbers that are no photons per period."""
    if not (array.min() >= 0 and array.max() <= MAX_PHOTONS):  # NaN is neither
        bad = ~((array >= 0) & (array <= MAX_PHOTONS))
        where = tuple(int(k) for k in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} must lie in [0, {MAX_PHOTONS:g}] photons per period, got {array[where]} at index {where}"
        )


def common_shape(names: Sequence[str], shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """The shape that all broadcast to."""
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        told = ", ".join(f"{n} {s}" for n, s in zip(names, shapes, strict=True))
        raise ValueError(f"shapes must broadcast to one (H, W), got {told}") from None


def broadcast(names: Sequence[str], maps: Sequence[FloatArray]) -> list[FloatArray]:
    """Maps of one shape."""
    shape = common_shape(names, [m.shape for m in maps])
    return [m if m.shape == shape else np.broadcast_to(m, shape) for m in maps]


def waveform_maps(waveform: ArrayLike, background: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Waveforms (H, W, T) and background (H, W)."""
    wave = np.asarray(checks.unmasked("waveform", waveform))
    if wave.dtype.kind not in "fiub":
        raise TypeError(f"waveform must be real numbers, got dtype {wave.dtype}")
    if wave.ndim not in (1, 2, 3) or wave.size == 0:
        raise ValueError(f"waveform must be (T,), (W, T) or (H, W, T), got shape {wave.shape}")
    wave = wave.astype(np.float64)
    check_photons("waveform", wave)
    wave = wave.reshape((1,) * (3 - wave.ndim) + wave.shape)
    check_photons("waveform summed over a period", wave.sum(-1))
    back = light_map("background", background)
    shape = common_shape(("waveform", "background"), [wave.shape[:2], back.shape])
    return np.broadcast_to(wave, (*shape, wave.shape[-1])), np.broadcast_to(back, shape)


def frozen(array: FloatArray) -> FloatArray:
    """A contiguous copy that nobody writes to."""
    copy = np.ascontiguousarray(array, dtype=np.float64)
    if copy is array or copy.base is not None:
        copy = copy.copy()
    copy.flags.writeable = False
    return copy
