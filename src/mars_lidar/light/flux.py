"""Photon flux at the pixels: expected photons per laser period (`Flux`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, checked_with_masks, constructed_by_name
from mars_lidar._base.display import as_html
from mars_lidar._base.imports import late
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import ArrayLike, FloatArray, IndexArray, NDArray
from mars_lidar.instrument.system import System
from mars_lidar.light.tolerances import TOL

# --- Maps of photons -----------------------------------------------------------------------------------------------


def light_map(name: str, value: ArrayLike, *, photons: bool = True) -> FloatArray:
    """Numbers of at most two axes as float64: photons per period, or any finite number or NaN."""
    if isinstance(value, np.ma.MaskedArray):  # a masked delay is no return; masked light is refused, not taken as it is
        value = np.where(np.ma.getmaskarray(value), np.nan, value.data)
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
    array = array.astype(np.float64)
    if array.ndim > 2:
        raise ValueError(f"{name} must be a scalar, (N,) or (H, W), got shape {array.shape}")
    if array.size == 0:
        raise ValueError(f"{name} must have at least one pixel, got shape {array.shape}")
    if photons:
        check_photons(name, array)
    elif np.isinf(array).any():
        raise ValueError(f"{name} must be finite (or NaN where there is no return), got inf")
    return array


def check_photons(name: str, array: FloatArray) -> None:
    """Raise ValueError, naming the first one, for invalid numbers of photons per period."""
    if not (array.min() >= 0 and array.max() <= TOL.photons):  # NaN is neither
        bad = ~((array >= 0) & (array <= TOL.photons))
        where = tuple(int(k) for k in np.argwhere(bad)[0])
        place = f" at index {where}" if where else ""
        raise ValueError(f"{name} must lie in [0, {TOL.photons:g}] photons per period, got {array[where]}{place}")


def common_shape(names: Sequence[str], shapes: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """The common shape to which all broadcast."""
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        given = ", ".join(f"{n} {s}" for n, s in zip(names, shapes, strict=True))
        raise ValueError(f"shapes must broadcast to one, got {given}") from None


def broadcast(names: Sequence[str], maps: Sequence[FloatArray]) -> list[FloatArray]:
    """Maps of one shape."""
    shape = common_shape(names, [m.shape for m in maps])
    return [m if m.shape == shape else np.broadcast_to(m, shape) for m in maps]


def waveform_maps(waveform: ArrayLike, background: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Waveforms (..., T) and background (...)."""
    wave = np.asarray(checks.unmasked("waveform", waveform))
    if wave.dtype.kind not in "fiub":
        raise TypeError(f"waveform must be real numbers, got dtype {wave.dtype}")
    if wave.ndim not in (1, 2, 3) or wave.size == 0:
        raise ValueError(f"waveform must be (T,), (N, T) or (H, W, T), got shape {wave.shape}")
    wave = wave.astype(np.float64)
    check_photons("waveform", wave)
    check_photons("waveform summed over a period", wave.sum(-1))
    back = light_map("background", background)
    shape = common_shape(("waveform", "background"), [wave.shape[:-1], back.shape])
    return np.broadcast_to(wave, (*shape, wave.shape[-1])), np.broadcast_to(back, shape)


def frozen(array: FloatArray) -> FloatArray:
    """A contiguous read-only copy."""
    copy = np.array(array, dtype=np.float64, order="C")
    copy.flags.writeable = False
    return copy


# --- The flux ------------------------------------------------------------------------------------------------------


@constructed_by_name
@dataclass(frozen=True, eq=False, init=False)
class Flux:
    """The light: expected photons per laser period at one pixel, a row of pixels or an image.

    Argument of `simulate` and of every prediction, such as ``count_law(flux, system)``. The arrival rate at a pixel is
    periodic, ``lambda(t) = S s(t - tau) + B / t_r`` with the pulse s of the `System`, or any non-negative waveform.
    Photons are detectable photons; with a `Detector.detection_efficiency` below 1 they are the photons on the pixel, of
    which it detects that share.

    Parameters
    ----------
    signal
        Signal photons per period S. Scalars are one pixel, (N,) a row of pixels, (H, W) an image; all arguments
        broadcast. (R, H, W) is an image with R returns in each pixel, 1 to 16, whose delays are then also (R, H, W);
        `Flux.multi` combines the returns of several fluxes.
    background
        Background photons per period B, uniform in time.
    delay_ns
        Delay tau of the return, ns, between -1e9 and 1e9 (one second); it wraps into the laser period. NaN, for "no
        return", is allowed where the signal is 0.
    waveform
        Instead of `signal` and `delay_ns`: photons per period in each of T equal parts of the period
        (..., T), as they reach the detector (the pulse of the system is *not* applied), constant inside
        each part. T may differ from the number of histogram bins.

    Attributes
    ----------
    shape
        () for one pixel, (N,) or (H, W). Results of predictions begin with these axes; `simulate` treats every flux as
        an image, of 1 x 1 or 1 x N pixels (`image`).
    signal, background, delay_ns
        (...) of that shape, read-only. With several returns `signal` is their sum and `delay_ns` that of the strongest;
        with a waveform `signal` is its sum and `delay_ns` is NaN.
    returns_signal, returns_delay_ns
        (K, ...), one row per return (K = 0 with a waveform).
    waveform
        (..., T) or None.
    info
        Origin of this flux, such as the levels that scene radiometry achieved.

    Raises
    ------
    TypeError
        Light that is not an array of real numbers.
    ValueError
        Negative or infinite photons, delays that are not finite where there is signal, shapes that do not broadcast,
        more than 16 returns, or a waveform together with signal or delay.

    See Also
    --------
    Scene, simulate, count_law, System

    Examples
    --------
    >>> import mars_lidar as ml
    >>> flux = ml.Flux(signal=[[0.5, 2.0]], background=1.0, delay_ns=[[20.0, 60.0]])
    >>> flux.shape
    (1, 2)
    >>> flux[0, 1]
    Flux(one pixel, 1 return, signal 2, background 1 photons per period)
    """

    signal: FloatArray
    background: FloatArray
    delay_ns: FloatArray
    returns_signal: FloatArray
    returns_delay_ns: FloatArray
    waveform: FloatArray | None
    info: dict[str, Any]

    @checked_with_masks
    def __init__(
        self,
        signal: ArrayLike | None = None,
        background: ArrayLike = 0.0,
        delay_ns: ArrayLike | None = None,
        *,
        waveform: ArrayLike | None = None,
        info: dict[str, Any] | None = None,
    ) -> None:
        if waveform is not None:
            if signal is not None or delay_ns is not None:
                raise ValueError("waveform replaces signal and delay_ns: give it alone, or with background")
            wave, back = waveform_maps(waveform, background)
            none = np.empty((0, *back.shape))
            vars(self).update(vars(made(none, none, back, wave, info)))
            return
        if signal is None:
            raise ValueError("signal must be given (photons per period), or a waveform instead of it")
        if np.ndim(signal) == 3:
            returns = _each_return(signal, delay_ns)
            both = Flux.multi(*(Flux(s, background if k == 0 else 0.0, tau) for k, (s, tau) in enumerate(returns)))
            vars(self).update(vars(both), info=dict(info or {}))
            return
        maps = [light_map("signal", signal), light_map("background", background)]
        maps.append(light_map("delay_ns", 0.0 if delay_ns is None else delay_ns, photons=False))
        s, b, tau = broadcast(("signal", "background", "delay_ns"), maps)
        if delay_ns is None and (s > 0).any():
            raise ValueError("delay_ns must be given where signal > 0")
        vars(self).update(vars(made(s[None], tau[None], b, None, info)))

    @classmethod
    def multi(cls, *fluxes: Flux, info: dict[str, Any] | None = None) -> Flux:
        """The sum of several fluxes: all their returns, and the sum of their backgrounds.

        For example, a pane of glass in front of a wall. Waveforms of equal length are added; a waveform cannot be
        combined with returns, because their pulse belongs to the `System`.
        """
        if not fluxes or not all(isinstance(f, Flux) for f in fluxes):
            raise TypeError(f"multi takes one or more Flux objects, got {fluxes!r}")
        waves = [f.waveform for f in fluxes if f.waveform is not None]
        if waves and len(waves) != len(fluxes):
            raise ValueError("multi cannot mix waveforms with returns; write the returns into the waveform")
        shape = common_shape(tuple(f"fluxes[{k}]" for k in range(len(fluxes))), [f.shape for f in fluxes])
        back = np.sum([np.broadcast_to(f.background, shape) for f in fluxes], axis=0)
        if waves:
            lengths = {w.shape[-1] for w in waves}
            if len(lengths) > 1:
                raise ValueError(f"waveforms must have equal lengths to add up, got {sorted(lengths)}")
            wave = np.sum([np.broadcast_to(w, (*shape, w.shape[-1])) for w in waves], axis=0)
            return made(np.empty((0, *shape)), np.empty((0, *shape)), back, wave, info)
        s = np.concatenate([np.broadcast_to(f.returns_signal, (len(f.returns_signal), *shape)) for f in fluxes])
        tau = np.concatenate([np.broadcast_to(f.returns_delay_ns, (len(f.returns_delay_ns), *shape)) for f in fluxes])
        return made(s, tau, back, None, info)

    @classmethod
    def from_transient(
        cls, values: ArrayLike, system: System, *, bin_ns: float, start_ns: float = 0.0, **level: Any
    ) -> Flux:
        """The flux of a rendered transient: light `values` (H, W, T) in bins of `bin_ns` from the time `start_ns`.

        `level` takes the arguments of `mars_lidar.io.Transient.flux`: ``signal`` or ``photons_per_unit``, and
        ``sbr``, ``dark_count_hz``, ``pulse``, ``parts``. Files are read by `mars_lidar.io.read_transient`.
        """
        rendered = late("light.transient:Transient")(values, bin_ns, start_ns=start_ns)
        flux: Flux = rendered.flux(system, **level)
        return flux

    @checked
    def detected(self, system: System) -> Flux:
        """The flux of avalanches: photons times `Detector.detection_efficiency`, plus `Detector.dark_count_hz`.

        Poisson photons, each detected with the same probability, are Poisson photons of the thinned rate, and dark
        counts are background: registrations under this flux have exactly the law of those of a pixel without these two
        effects (`System.detected`) under the returned flux. Returns this flux if both effects are off.
        """
        share, dark = system.detector.detection_efficiency, system.detector.dark_count_hz * (system.period_ns * 1e-9)
        if share == 1.0 and dark == 0.0:
            return self
        return self._scaled(share, dark)

    def delay_periods(self, period_ns: float) -> FloatArray:
        """Delays of the returns (K, pixels) in periods of `period_ns`, in [0, 1); 0 without a return."""
        pixels = self.background.size
        delay = np.ascontiguousarray(self.returns_delay_ns.reshape(-1, pixels)) / period_ns
        return np.nan_to_num(delay - np.floor(delay), nan=0.0)

    @checked
    def with_dark_counts(self, rate_hz: ArrayLike, system: System) -> Flux:
        """This flux with dark counts at `rate_hz`, counts/s: a number, or a map such as that of `dark_count_map`.

        Dark counts are background, uniform in time, that the detection efficiency of the system does not reduce (they
        are divided by it here, because `detected` multiplies by it); a gated pixel has them within its gate only.
        """
        rate = light_map("rate_hz", rate_hz, photons=False)
        if not (rate >= 0.0).all():
            raise ValueError(f"rate_hz must be counts/s >= 0, got {rate.min():g}")
        common_shape(("flux", "rate_hz"), [self.shape, rate.shape])
        if np.broadcast_shapes(self.shape, rate.shape) != self.shape:
            raise ValueError(f"rate_hz must be a scalar or {self.shape}, got {rate.shape}")
        return self._scaled(1.0, rate * (system.period_ns * 1e-9) / system.detector.detection_efficiency)

    def _scaled(self, share: float, more: float | FloatArray) -> Flux:
        """Signal and background times `share`, and more background."""
        background = self.background * share + more
        check_photons("background with dark counts", background)
        wave = None if self.waveform is None else self.waveform * share
        return made(self.returns_signal * share, self.returns_delay_ns, background, wave, self.info)

    @checked
    def in_fog(
        self,
        system: System,
        *,
        extinction_per_m: float,
        backscatter: float,
        nearest_m: float = 1.0,
        parts: int | None = None,
    ) -> Flux:
        """These returns through homogeneous fog, as a waveform: attenuated, with the backscatter of the fog.

        With alpha the extinction and z = c tau / 2, by the lidar equation for single scattering (U. Wandinger,
        "Introduction to lidar", in C. Weitkamp, ed., Lidar, Springer 2005), through the pulse of the system::

            S_k -> S_k exp(-2 alpha z_k)
            fog:   backscatter * g(z),   g(z) ~ exp(-2 alpha z) / z^2   from z_0 to the pixel's farthest return

        g integrates to 1 from z_0 to infinity; a pixel without a return receives all of it.

        Parameters
        ----------
        extinction_per_m
            Extinction coefficient alpha, 1/m; 3.91 / (visibility in m), by Koschmieder's law.
        backscatter
            Photons per period backscattered by fog without a target.
        nearest_m
            Depth z_0 from which on laser and field of view overlap, m, > 0.
        parts
            Parts of the waveform; default 4 for each bin of the histogram.
        """
        in_fog = late("light.fog:in_fog")
        flux: Flux = in_fog(self, system, extinction_per_m, backscatter, nearest_m, parts)
        return flux

    @property
    def shape(self) -> tuple[int, ...]:
        """() of one pixel, (N,) or (H, W)."""
        return self.background.shape

    @property
    def image(self) -> Flux:
        """The same light as an image (H, W): one pixel is 1 x 1, a row of N pixels 1 x N."""
        if len(self.shape) == 2:
            return self
        shape = (1, *self.shape) if self.shape else (1, 1)
        signal, delay = (a.reshape(len(a), *shape) for a in (self.returns_signal, self.returns_delay_ns))
        wave = None if self.waveform is None else self.waveform.reshape(*shape, -1)
        return made(signal, delay, self.background.reshape(shape), wave, self.info)

    @property
    def total(self) -> FloatArray:
        """Photons per period Lambda = S + B."""
        return self.signal + self.background

    def __getitem__(self, key: Any) -> Flux:
        """Some of the pixels: ``flux[y, x]`` is one pixel, ``flux[y]`` a row, ``flux[10:20]`` and ``flux[10:20, :5]``
        are parts of the image.
        """
        keys = key if isinstance(key, tuple) else (key,)
        if len(keys) > len(self.shape):
            axes = ("is one pixel", "has one axis (pixels)", "has two axes (rows, columns)")[len(self.shape)]
            raise IndexError(f"flux {axes}, got {len(keys)} indices")
        for k, n in zip(keys, self.shape, strict=False):
            if isinstance(k, (int, np.integer)) and not -n <= k < n:
                raise IndexError(f"index {k} is out of range for an axis of {n} pixels")
            if isinstance(k, bool) or not isinstance(k, (int, np.integer, slice)):
                raise IndexError(f"flux takes integers and slices, got {k!r}")
        returns, wave = (slice(None), *keys), None if self.waveform is None else self.waveform[keys]
        part = made(
            self.returns_signal[returns],
            self.returns_delay_ns[returns],
            np.asarray(self.background[keys]),
            wave,
            self.info,
        )
        if 0 in part.shape:
            raise IndexError(f"flux{list(keys)} selects no pixel of {self.shape}")
        return part

    def pixels(self, numbers: IndexArray) -> Flux:
        """Some pixels (N,) by their `numbers` in row-major order."""
        number, every = len(self.returns_signal), self.background.size
        signal, delay = (a.reshape(number, every)[:, numbers] for a in (self.returns_signal, self.returns_delay_ns))
        wave = None if self.waveform is None else self.waveform.reshape(every, -1)[numbers]
        return made(signal, delay, self.background.reshape(-1)[numbers], wave, self.info)

    def _repr_html_(self) -> str:
        return as_html(self, {"signal (photons per period)": self.signal, "background": self.background})

    def __repr__(self) -> str:
        pixels = " x ".join(map(str, self.shape)) + " pixels" if self.shape else "one pixel"
        what = f"waveform of {self.waveform.shape[-1]}" if self.waveform is not None else ""
        what = what or (f"{len(self.returns_signal)} returns" if len(self.returns_signal) > 1 else "1 return")
        mean = "mean " if self.shape else ""
        return (
            f"Flux({pixels}, {what}, {mean}signal {self.signal.mean():.4g}, "
            f"{mean}background {self.background.mean():.4g} photons per period)"
        )


def _each_return(signal: Any, delay_ns: Any) -> Iterator[tuple[Any, Any]]:
    """Signal and delay (H, W) of each return of arrays (R, H, W)."""
    if not 1 <= len(signal) <= TOL.returns:
        raise ValueError(f"signal must be (R, H, W) of 1 to {TOL.returns} returns, got shape {np.shape(signal)}")
    if delay_ns is None or np.ndim(delay_ns) != 3 or len(delay_ns) != len(signal):
        given = "None" if delay_ns is None else f"shape {np.shape(delay_ns)}"
        raise ValueError(f"delay_ns must be (R, H, W) as signal of shape {np.shape(signal)} is, got {given}")
    return zip(signal, delay_ns, strict=True)


def made(
    signal: FloatArray,
    delay_ns: FloatArray,
    background: FloatArray,
    waveform: FloatArray | None,
    info: dict[str, Any] | None = None,
) -> Flux:
    """A flux of checked parts: returns (K, ...), background (...), and waveforms (..., T) or None."""
    lost = np.isnan(delay_ns)
    if lost.any() and (lost := lost & (signal > 0)).any():
        where = tuple(int(k) for k in np.argwhere(lost)[0][1:])
        raise ValueError(f"delay_ns must be finite where signal > 0, got NaN{f' at pixel {where}' if where else ''}")
    if (far := np.abs(delay_ns) > TOL.delay_ns).any():
        raise ValueError(
            f"delay_ns must be within {TOL.delay_ns:g} ns either way, got {delay_ns[far][0]:g}; give it modulo the "
            "laser period"
        )
    if waveform is not None:
        total, nearest = waveform.sum(-1), np.full(background.shape, np.nan)
    elif len(signal) == 1:
        total, nearest = signal[0], delay_ns[0]
    else:
        total = signal.sum(0)
        nearest = np.take_along_axis(delay_ns, signal.argmax(0)[None], axis=0)[0]
    flux, maps = Flux.__new__(Flux), {"signal": total, "background": background, "delay_ns": nearest}
    maps |= {"returns_signal": signal, "returns_delay_ns": delay_ns}
    vars(flux).update({name: frozen(array) for name, array in maps.items()})
    vars(flux).update(waveform=None if waveform is None else frozen(waveform), info=dict(info or {}))
    return flux


# --- Waveforms that stay on disk -------------------------------------------------------------------------------------


class StoredFlux(Flux):
    """A `Flux` of waveforms too large for memory; ``flux[rows]`` is an ordinary `Flux`.

    `mars_lidar.io.simulate_to` reads it band by band; `mars_lidar.simulate` reads it as a whole. `waveform` has a
    `shape` and returns rows when indexed.

    Parameters
    ----------
    signal, background
        (H, W) photons per period.
    parts
        T, parts of the period.
    rows
        Function that makes the flux of some rows, a slice with explicit ends and step 1.
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
        vars(self).update(signal=maps.signal, background=maps.background, delay_ns=np.full(maps.shape, np.nan))
        vars(self).update(returns_signal=none, returns_delay_ns=none, info=dict(info or {}))
        vars(self).update(waveform=Waveforms((height, width, parts), rows), _make=rows)

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
    """(H, W, T) photons per period and part, computed by rows when indexed."""

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
        """Bands of rows that are computed together and cover the image."""
        step = max(1, TOL.band_bytes * self.shape[0] // max(self.nbytes, 1))
        for first in range(0, self.shape[0], step):
            yield slice(first, min(first + step, self.shape[0]))
