"""Rendered transients: light against time at each pixel, as the detector's input.

A transient path tracer renders the response to a delta pulse. `Transient.flux` folds it with the laser period,
convolves it with the pulse of the system, and scales it to photons. Rates (H, W, T) may stay on disk: rows are read as
needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.resample import area_mean, new_size, window
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux, StoredFlux
from mars_lidar.light.tolerances import TOL

# --- Parts of rates that stay on disk ------------------------------------------------------------------------------


class RateArray(Protocol):
    """An array in memory or on disk, such as rates (H, W, T): `shape`, and rows by ``values[first:last]``."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""

    def __getitem__(self, key: Any) -> Any:
        """The selected rows, in memory."""


class Rows:
    """Rates (H, W, T) whose rows are read when they are sliced."""

    def __init__(self, shape: tuple[int, ...], read: Callable[[slice], NDArray[Any]]) -> None:
        self.shape, self._read = shape, read

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return self._read(rows)


def cropped(values: RateArray, rows: slice, columns: slice) -> Rows:
    """Some rows and columns."""
    height, width, bins = values.shape
    inside = range(height)[rows]

    def read(key: slice) -> NDArray[Any]:
        wanted = inside[key]
        return np.asarray(values[min(wanted) : max(wanted) + 1])[:: wanted.step, columns]

    return Rows((len(inside), len(range(width)[columns]), bins), read)


def resized(values: RateArray, size: tuple[int, int]) -> Rows:
    """Mean light over the area of larger or smaller pixels."""
    old, (new, width) = values.shape[0], size

    def read(key: slice) -> NDArray[Any]:
        return area_mean(np.stack([row(k) for k in range(new)[key]]), width, axis=1)

    def row(k: int) -> NDArray[np.float64]:
        """Mean of the old rows that a new one covers, each by its share."""
        first, last = k * old // new, math.ceil((k + 1) * old / new)
        edges = np.clip(np.arange(first, last + 1) * new, k * old, (k + 1) * old)
        share = np.diff(edges) / old
        rows = np.asarray(values[first:last], dtype=np.float64)
        return np.asarray((share[:, None, None] * rows).sum(axis=0))

    return Rows((*size, values.shape[2]), read)


# --- The transient -------------------------------------------------------------------------------------------------


class Transient:
    """Light in each time bin at each pixel.

    Parameters
    ----------
    values
        (H, W, T), >= 0, in any linear unit (radiance per bin): an array, a memory map, or any object with
        `shape` that returns rows when sliced. It is read in bands of rows, never as a whole.
    bin_ns
        Width of a time bin, ns of travel time (for a bin of d metres of optical path, d / c).
    start_ns
        Travel time at the start of bin 0, ns.
    source
        Free text: its origin.
    totals
        (H, W), sums over all bins, if known; otherwise the values are read once to compute them.

    Raises
    ------
    ValueError, TypeError
        Values of another shape, negative or not numbers; a width that is not positive.

    See Also
    --------
    read_transient, mars_lidar.Flux.from_transient

    Examples
    --------
    >>> import numpy as np
    >>> from mars_lidar import io
    >>> io.Transient(np.ones((4, 6, 50)), bin_ns=0.1, start_ns=3.0).values.shape
    (4, 6, 50)
    """

    @checked
    def __init__(
        self,
        values: RateArray | ArrayLike,
        bin_ns: float,
        *,
        start_ns: float = 0.0,
        source: str = "",
        totals: ArrayLike | None = None,
    ) -> None:
        self.bin_ns = checks.real("bin_ns", bin_ns, low=0.0, strict_low=True)
        self.start_ns = checks.real("start_ns", start_ns)
        rates: Any = values if hasattr(values, "shape") else np.asarray(checks.numbers("values", values))
        checks.unmasked("values", values)
        if len(rates.shape) != 3 or 0 in rates.shape:
            raise ValueError(f"values must be (H, W, T) with at least one bin, got shape {tuple(rates.shape)}")
        self.values: RateArray = rates
        self.source = source
        if totals is not None:
            self.totals = np.asarray(totals, dtype=np.float64)
            if self.totals.shape != self.shape:
                raise ValueError(f"totals must have shape {self.shape}, got {self.totals.shape}")

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        height, width, _ = self.values.shape
        return height, width

    def __repr__(self) -> str:
        h, w, bins = self.values.shape
        return f"Transient({h} x {w} pixels, {bins} bins of {self.bin_ns:.6g} ns from {self.start_ns:.6g} ns)"

    def __getitem__(self, key: Any) -> Transient:
        """A crop: ``transient[rows, columns]`` with slices; nothing is read."""
        rows, columns = window("transient", key, self.shape)
        return self._with(cropped(self.values, rows, columns))

    @checked
    def resize(self, size: int | tuple[int, int]) -> Transient:
        """At another `size`, (H, W) or the longer side: mean light over the area of the new pixels; nothing is read."""
        return self._with(resized(self.values, new_size(size, self.shape)))

    def _with(self, values: RateArray) -> Transient:
        return Transient(values, self.bin_ns, start_ns=self.start_ns, source=self.source)

    @cached_property
    def totals(self) -> FloatArray:
        """Light of each pixel (H, W): the sum over all bins. Reads the whole transient once, band by band."""
        return np.concatenate([self.rows(some).sum(-1) for some in self.bands()])

    def bands(self, band_bytes: int = TOL.band_bytes) -> Iterator[slice]:
        """Bands of at least one row and about `band_bytes` as float64, which cover the image."""
        height, width, bins = self.values.shape
        step = max(1, band_bytes // (8 * width * bins))
        for first in range(0, height, step):
            yield slice(first, min(first + step, height))

    @checked
    def flux(
        self,
        system: System,
        *,
        signal: float | None = None,
        photons_per_unit: float | None = None,
        sbr: float = math.inf,
        dark_count_hz: float = 0.0,
        pulse: bool = True,
        parts: int | None = None,
        rows: slice = slice(None),
    ) -> Flux:
        """The photon flux at each pixel, as a waveform.

        With L the light of a pixel, summed over all bins, and V the pixels with any light::

            S = signal * L / mean_V(L)      or      S = photons_per_unit * L
            B = mean_V(S) / sbr  +  dark_count_hz * t_r / detection_efficiency

        Time is folded with the laser period: light after the end of a period arrives in the next one.

        Parameters
        ----------
        system
            The system with the laser period and the pulse.
        signal
            Mean detectable signal photons per laser period over the pixels with light, > 0.
        photons_per_unit
            Instead of `signal`: detectable photons per laser period for one unit of light, > 0.
        sbr
            Mean signal over ambient photons, uniform over the image; inf: no ambient light.
        dark_count_hz
            Dark counts of a pixel, counts/s, in addition to those of the detector (`Detector.dark_count_hz`); not
            reduced by the detection efficiency.
        pulse
            Convolve with the system's pulse (for the response to a delta pulse). False: the transient already contains
            the pulse and the detector's response.
        parts
            Parts of the waveform in a period. Default: as fine as the transient and the histogram. A transient
            with a whole number of bins per period is used unchanged.
        rows
            Rows of the image, of step 1; levels always refer to the whole image.

        Raises
        ------
        ValueError, TypeError
            An invalid argument; light that is negative or not finite; no light in any pixel.
        """
        if (signal is None) == (photons_per_unit is None):
            raise ValueError("the level is one of signal and photons_per_unit, got neither or both")
        for name, value in (("signal", signal), ("photons_per_unit", photons_per_unit)):
            if value is not None:
                checks.real(name, value, low=0.0, strict_low=True)
        checks.real("sbr", sbr, low=0.0, strict_low=True, infinite=True)
        checks.real("dark_count_hz", dark_count_hz, low=0.0)
        first, last, stride = rows.indices(self.shape[0])
        if stride != 1 or first >= last:
            raise ValueError(f"rows must select a run of at least one of {self.shape[0]}, got {rows!r}")
        fitting = parts_of(self, system)
        number = checks.integer("parts", fitting if parts is None else parts, low=1, high=TOL.parts)
        lit = self.totals[self.totals > 0]
        if lit.size == 0:
            raise ValueError(f"{self._named}values must have light in some pixel, got none")
        mean = float(lit.mean())
        scale = signal / mean if signal is not None else float(photons_per_unit or 0.0)
        dark = dark_count_hz * 1e-9 * system.period_ns / system.detector.detection_efficiency
        background = (scale * mean / sbr if sbr != math.inf else 0.0) + dark
        size = 8 * (last - first) * self.shape[1] * number
        check_memory(4 * size, "the waveforms of these rows", "take fewer rows at a time")  # Flux keeps a copy
        waveform = np.empty((last - first, self.shape[1], number))
        step = max(1, TOL.work_bytes // (8 * self.shape[1] * max(number, self.values.shape[2])))
        for begin in range(first, last, step):
            here = slice(begin, min(begin + step, last))
            light = self._on_period(self.rows(here), system.period_ns, number)
            if pulse:
                light = through_pulse(light, system)
            waveform[here.start - first : here.stop - first] = scale * light
        info = {
            "transient": self.source,
            "bin_ns": self.bin_ns,
            "start_ns": self.start_ns,
            "mean_signal": scale * mean,
            "mean_background": background,
            "sbr": None if sbr == math.inf else sbr,
            "dark_count_hz": dark_count_hz,
            "pulse_convolved": pulse,
        }
        return Flux(waveform=waveform, background=background, info=info)

    @checked
    def stored_flux(self, system: System, **level: Any) -> StoredFlux:
        """The flux of `flux`, for a transient larger than memory: rows are read on use.

        `mars_lidar.io.simulate_to` reads it band by band. `system`, the arguments of `level` (all but `rows`) and the
        errors are those of `flux`; the transient is read once at this call, for its `totals`.
        """

        def make(rows: slice) -> Flux:
            return self.flux(system, **level, rows=rows)

        first = make(slice(0, 1))
        assert first.waveform is not None
        lit = self.totals[self.totals > 0]
        scale = first.info["mean_signal"] / float(lit.mean())
        background = np.full(self.shape, first.info["mean_background"])
        return StoredFlux(scale * self.totals, background, first.waveform.shape[-1], make, first.info)

    @property
    def _named(self) -> str:
        """Begins errors of values, which are read long after their file was opened."""
        return f"{self.source}: " if self.source else ""

    def rows(self, rows: slice) -> FloatArray:
        """Light of some `rows` (rows, W, T), checked."""
        values = np.asarray(self.values[rows])
        if values.dtype.kind not in "fiu":
            error = ValueError if self.source else TypeError  # of a file, or of an argument
            raise error(f"{self._named}values must be real numbers, got dtype {values.dtype}")
        light = values.astype(np.float64)
        wrong = ~((light >= 0.0) & (light < np.inf))
        if wrong.any():
            y, x, k = (int(n) for n in np.argwhere(wrong)[0])
            place = (y + rows.start, x, k)
            raise ValueError(
                f"{self._named}values must be finite and >= 0, got {light[y, x, k]} at (y, x, bin) {place}"
            )
        return light

    def _on_period(self, light: FloatArray, period_ns: float, number: int) -> FloatArray:
        """Light in `number` equal parts of the period, energy kept; constant inside each bin of the source."""
        bins = light.shape[-1]
        before = np.concatenate([np.zeros((*light.shape[:2], 1)), light.cumsum(-1)], axis=-1)
        edges = np.arange(number + 1) * (period_ns / number)
        out = np.zeros((*light.shape[:2], number))
        end_ns = self.start_ns + bins * self.bin_ns
        for n in range(math.floor(self.start_ns / period_ns), math.floor(end_ns / period_ns) + 1):
            place = (edges + n * period_ns - self.start_ns) / self.bin_ns
            whole = np.round(place)  # edges that meet must meet exactly, or light leaks into a neighbour
            place = np.clip(np.where(np.abs(place - whole) < 1e-9 * bins, whole, place), 0.0, bins)
            below = np.minimum(place.astype(np.int64), bins - 1)
            at = before[..., below] + (place - below) * light[..., below]
            out += np.diff(at, axis=-1)
        return np.maximum(out, 0.0)


def parts_of(transient: Transient, system: System) -> int:
    """Number of parts of a waveform as fine as the transient and the histogram; ValueError for unreasonable bins."""
    parts = system.period_ns / transient.bin_ns * (1 - 1e-12)
    periods = (transient.values.shape[2] * transient.bin_ns + abs(transient.start_ns)) / system.period_ns
    if parts > TOL.parts or periods > TOL.periods:
        raise ValueError(
            f"{transient.source or 'the transient'}: bin_ns of {transient.bin_ns:g} from {transient.start_ns:g} ns on "
            f"makes {max(parts, 1.0):.3g} parts of a laser period and {periods:.3g} periods; at most {TOL.parts} and "
            f"{TOL.periods} can be: is it in ns?"
        )
    return max(system.bins, math.ceil(parts))


def through_pulse(light: FloatArray, system: System) -> FloatArray:
    """Light in equal parts of the period (..., T), constant in each, convolved with the system's pulse."""
    number = light.shape[-1]
    total = light.sum(-1, keepdims=True)
    spread = np.fft.irfft(np.fft.rfft(light) * _spectrum(system.pulse, system.period_ns, number), n=number)
    spread = np.maximum(spread, 0.0)  # the transform's rounding
    spread *= np.divide(total, spread.sum(-1, keepdims=True), out=np.zeros_like(total), where=total > 0)
    return spread


@lru_cache(maxsize=4)
def _spectrum(pulse: Pulse, period_ns: float, number: int) -> NDArray[np.complex128]:
    """Transform of the pulse's energy in each part, for light that is spread evenly over part 0."""
    part_ns = period_ns / number
    energy = np.zeros(number)
    for k in range(TOL.delays):
        energy += pulse.bin_energy((k + 0.5) / TOL.delays * part_ns, period_ns, number)
    return np.fft.rfft(energy / TOL.delays)
