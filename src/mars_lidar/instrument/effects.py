"""What a real pixel and its electronics do beside dead time and mode: the optional fields of `Detector`.

Every effect is off by default, and off means the bits of the ideal pixel. The order in which they act, and what each
of them is taken to be, is in docs/detectors.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar.instrument.avalanches import Afterpulsing, Crosstalk
from mars_lidar.instrument.jitter import Jitter as Jitter
from mars_lidar.instrument.jitter import SampledJitter as SampledJitter
from mars_lidar.instrument.jitter import jitter_from_dict

LIGHT_EFFECTS = ("detection_efficiency", "dark_count_hz")
"""What changes the flux only, `Flux.detected`: every engine and statistic takes it."""

AVALANCHE_EFFECTS = ("afterpulsing", "twilight_ns", "crosstalk")
"""What avalanches leave behind: further arrivals, in the same pixel or in its neighbours."""

TIMING_EFFECTS = ("jitter", "code_density")
"""What moves records and leaves their number as it is."""

RECORDING_EFFECTS = ("electronics_dead_time_ns", "max_events_per_period", "max_events_per_exposure", *TIMING_EFFECTS)
"""What happens to the registrations of a pixel, in order: which are recorded, and at what time."""

EFFECTS = (*LIGHT_EFFECTS, *AVALANCHE_EFFECTS, *RECORDING_EFFECTS)
"""Names of all effects: fields of `Detector`."""

_MAX_RATE_HZ = 1e12
_MAX_EVENTS = 2**31 - 1
_MAX_CODES = 2**16
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Field:
    """How a field of `Detector` that is an effect is checked, switched off, and read from plain data."""

    off: Any
    checked: Callable[[Any], Any]
    read: Callable[[Any], Any] | None = None  # None: as it is


def _jitter(value: Any) -> Jitter | SampledJitter:
    if not isinstance(value, (Jitter, SampledJitter)):
        raise TypeError(f"jitter must be a Jitter or a SampledJitter, got {value!r}")
    return value


def _instance(name: str, value: Any, of: type) -> Any:
    if not isinstance(value, of):
        raise TypeError(f"{name} must be of type {of.__name__}, got {value!r}")
    return value


def _code_density(value: Any) -> tuple[float, ...]:
    widths = np.asarray(value)
    if widths.dtype.kind not in "fiu" or widths.ndim != 1 or not 2 <= widths.size <= _MAX_CODES:
        raise ValueError(
            f"code_density must be 2 to {_MAX_CODES} relative widths of TDC codes (n,), got shape {widths.shape} "
            f"of {widths.dtype}"
        )
    widths = widths.astype(np.float64)
    bad = ~(np.isfinite(widths) & (widths >= 0.0))
    if bad.any() or not 0.0 < widths.sum() < math.inf:
        got = f"{widths[bad][0]:g}" if bad.any() else f"a sum of {widths.sum():g}"
        raise ValueError(f"code_density must be finite, non-negative and not all 0, got {got}")
    return tuple(widths.tolist())


FIELDS: dict[str, Field] = {
    "detection_efficiency": Field(
        1.0, lambda v: checks.real("detection_efficiency", v, low=0.0, high=1.0, strict_low=True)
    ),
    "dark_count_hz": Field(0.0, lambda v: checks.real("dark_count_hz", v, low=0.0, high=_MAX_RATE_HZ)),
    "afterpulsing": Field(None, lambda v: _instance("afterpulsing", v, Afterpulsing), Afterpulsing.from_dict),
    "twilight_ns": Field(0.0, lambda v: checks.real("twilight_ns", v, low=0.0)),
    "crosstalk": Field(None, lambda v: _instance("crosstalk", v, Crosstalk), Crosstalk.from_dict),
    "electronics_dead_time_ns": Field(0.0, lambda v: checks.real("electronics_dead_time_ns", v, low=0.0)),
    "max_events_per_period": Field(None, lambda v: checks.integer("max_events_per_period", v, low=1, high=_MAX_EVENTS)),
    "max_events_per_exposure": Field(
        None, lambda v: checks.integer("max_events_per_exposure", v, low=1, high=_MAX_EVENTS)
    ),
    "jitter": Field(None, _jitter, jitter_from_dict),
    "code_density": Field(None, _code_density),
}
"""One entry per effect."""


def plain(value: Any) -> Any:
    """A field as JSON and YAML have it."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    return list(value) if isinstance(value, tuple) else value


def code_edges(code_density: tuple[float, ...]) -> FloatArray:
    """Edges (n + 1,) of the codes of `Detector.code_density`, in mean code widths from 0 to n."""
    widths = np.array(code_density)
    edges = np.concatenate([[0.0], np.cumsum(widths)])
    return np.asarray(edges * (widths.size / edges[-1]), dtype=np.float64)
