"""The model of a recorded stream: light and detector as a vector of parameters, and streams drawn at it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.calibration.recording import Clock, Recording
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.instrument.avalanches import Afterpulsing
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.effects import Jitter
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import System
from mars_lidar.instrument.tolerances import TOL
from mars_lidar.light.flux import Flux
from mars_lidar.light.tolerances import TOL as LIGHT

_NARROWEST = 2e-6  # periods: the narrowest pulse that the engines draw
_WIDEST = 0.3  # sigma of a recorded pulse, periods: a wider one is hardly distinguished from background
EXCESS = 0.25  # of an electronics' dead time over the detector's, in the test for one


@dataclass(frozen=True)
class Effect:
    """A property of a detector beside dead time and jitter.

    `names` of its parameters, of which the first is its size and the others are logarithms; `start`: their values in
    the test for it; `least` and `most`: their bounds; `words` for a table; `onoff`: it has no size.
    """

    names: tuple[str, ...]
    start: tuple[float, ...]
    least: tuple[float, ...]
    most: tuple[float, ...]
    words: str
    onoff: bool = False

    def of(self, fields: dict[str, Any], values: dict[str, float]) -> dict[str, Any]:
        """Fields of a `Detector` with the effect, whose parameters have these `values`."""
        name, dead = self.names[0], fields["dead_time_ns"]
        size = values[name]
        if name == "electronics_excess":  # the observed dead time is the electronics'; the detector is ready earlier
            return fields | {"electronics_dead_time_ns": dead, "dead_time_ns": dead / (1.0 + size)}
        if name == "afterpulse_probability":
            delay = float(np.exp(values["log_afterpulse_delay"]))
            carriers = all_carriers(size, delay, dead)
            of = Afterpulsing(probability=carriers, delay_ns=delay) if carriers > 0 else None
            return fields | {"afterpulsing": of}
        if name == "paralyzable":
            return fields | {"mode": "paralyzable"}
        return fields | {name: min(size, dead) if name == "twilight_ns" else size}


def all_carriers(after: float, delay_ns: float, dead_time_ns: float) -> float:
    """Mean carriers of an avalanche, after * exp(t_d / delay), of which `after` outlive the dead time; at most 0.95."""
    return float(min(after * np.exp(dead_time_ns / delay_ns), 0.95))


def effects(dead: float) -> tuple[Effect, ...]:
    """Effects that are tested in the stream of a detector with this dead time, ns."""
    after = ("afterpulse_probability", "log_afterpulse_delay")
    middle, reach = float(np.log(1.6 * dead)), float(np.log(8.0))  # mean delays from a fifth to 13 dead times
    least, most = (0.0, middle - reach), (0.5, middle + reach)
    starts = [(0.03, middle + place * reach) for place in (-0.5, 0.0, 0.5)]
    own = "electronics with a dead time of their own"
    return (
        *(Effect(after, start, least, most, "afterpulses") for start in starts),
        Effect(("twilight_ns",), (min(1.0, 0.2 * dead),), (0.0,), (dead,), "twilight pulses"),
        Effect(("recovery_ns",), (0.03 * dead,), (0.0,), (2.0 * dead,), "slow recovery"),
        Effect(("electronics_excess",), (EXCESS,), (0.0,), (19.0,), own),
        Effect(("paralyzable",), (1.0,), (0.0,), (1.0,), "paralyzable detector", onoff=True),
    )


class Waveform:
    """Light of any shape, as shares of it in equal parts of the period, from recorded ones, which jitter has blurred.

    The noise of the recorded shares is white; what is above it in the power of nearby frequencies is signal, and all
    else is removed (Wiener's filter) if there are enough photons to know it. The light before a jitter of given width
    is the nonnegative one that the jitter blurs to these shares, by the iteration of Richardson (J. Opt. Soc. Am. 62,
    55, 1972) and Lucy (Astron. J. 79, 745, 1974). Light drawn for a stream of fewer periods scatters about that as the
    recorded shares do, and more.
    """

    def __init__(self, light: FloatArray, error: FloatArray, exposure: float, period_ns: float, filtered: bool) -> None:
        """Recorded light (parts,) and its standard errors by `exposure` periods."""
        # error**2 is that of one registration more, (light passes + 1) / passes**2
        passes = (light + np.sqrt(light**2 + 4.0 * error**2)) / (2.0 * error**2)
        self._variance, self._exposure = light / passes / light.sum() ** 2, exposure
        spectrum = np.fft.rfft(light / light.sum())
        power = np.convolve(np.pad(np.abs(spectrum[1:]) ** 2, 4, "symmetric"), np.full(9, 1.0 / 9), "valid")
        signal = np.maximum(1.0 - self._variance.sum() / power, 0.0) * filtered + (not filtered)
        self._signal = np.r_[1.0, signal]
        shares = np.maximum(np.fft.irfft(spectrum * self._signal, light.size), 1e-3 / light.size)
        self._shares = shares / shares.sum()
        self._jitters = TOL.jitter_periods * period_ns * np.linspace(0.0, 1.0, 25) ** 2
        width, half = period_ns / light.size, light.size // 2
        x = width * np.arange(-half - 1, light.size - half + 1)
        integral = np.array([Jitter(sigma_ns=max(sigma, 1e-3 * width)).integral(x) for sigma in self._jitters])
        kernel = np.roll(np.diff(integral, 2), -half, axis=1) / width  # from part to part: positive, symmetric
        blur = np.asarray(np.fft.rfft(kernel).real, np.float64)
        self._before = np.tile(self._shares, (self._jitters.size, 1))
        for _ in range(100):  # which reproduce recorded pulses to 0.1 %
            ratio = self._shares / self._blurred(self._before, blur)
            self._before = self._before * self._blurred(ratio, blur)

    def _blurred(self, shares: FloatArray, blur: FloatArray) -> FloatArray:
        parts = self._shares.size
        return np.asarray(np.maximum(np.fft.irfft(blur * np.fft.rfft(shares), parts), 1e-6 / parts))  # of rounding

    def drawn(self, jitter: FloatArray, cycles: int, seed: int) -> FloatArray:
        """Shares (rows, parts) before jitters (rows,), drawn for a stream of so many periods; of 0, the mean."""
        place = np.interp(jitter, self._jitters, np.arange(self._jitters.size))
        first = np.minimum(place.astype(int), self._jitters.size - 2)
        part = (place - first)[:, None]
        out = (1.0 - part) * self._before[first] + part * self._before[first + 1]
        if cycles:
            scale = self._variance * (self._exposure / cycles) / self._shares  # of gamma laws: none is negative
            shares = np.random.default_rng(seed).gamma(self._shares / scale, size=out.shape) * scale
            out *= self._blurred(shares, self._signal) / self._shares
        return np.asarray(out / out.sum(-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Model:
    """Parameters, in this order: background, (signal, delay) of each return, width, jitter, dead time, effects.

    The light is in photons per period, times in ns. `width` is the standard deviation of the recorded pulse, jitter
    included, and the jitter an angle, in radians, whose sine and cosine times `width` are the standard deviations of
    jitter and pulse. Counts are differentiable in both where one width is 0; in the variances they are not.
    Where the jitter is given (`jitter_given`) or the pulse is no Gaussian of unknown width, it is in ns. With a
    `waveform` there is no return, and the background is all light. With a `pulse` its shape is known, before any
    jitter, and `width` is not used.
    """

    clock: Clock
    returns: int
    pulse: Pulse | None = None
    waveform: Waveform | None = None
    effects: tuple[Effect, ...] = ()
    fields: tuple[tuple[str, Any], ...] = ()  # of the detector, as given
    jitter_given: bool = False

    @property
    def gaussian(self) -> bool:
        """Whether the pulse is a Gaussian of unknown width."""
        return self.pulse is None and self.returns > 0

    @property
    def split(self) -> bool:
        """Whether the jitter is an unknown part of the recorded width."""
        return self.gaussian and not self.jitter_given

    @property
    def paralyzable(self) -> bool:
        """Whether the detector is paralyzable."""
        return "paralyzable" in (*self.names, dict(self.fields).get("mode"))

    @property
    def light(self) -> int:
        """Parameters of the light that a call of the engine varies from stream to stream."""
        return 1 + 2 * self.returns

    @property
    def amounts(self) -> list[int]:
        """Indices of the background and of the signals."""
        return [0, *range(1, self.light, 2)]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        places = [f"_{k + 1}" for k in range(self.returns)] if self.returns > 1 else [""] * self.returns
        light = [f"{name}{place}" for place in places for name in ("signal", "delay_ns")]
        more = [name for effect in self.effects for name in effect.names]
        return ("background", *light, "width", "jitter", "dead_time_ns", *more)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def bounded(self, theta: FloatArray) -> FloatArray:
        """Parameters (..., p) within their bounds."""
        k, period = self.light, self.clock.period_ns
        jitter = TOL.jitter_periods * period
        least = [1e-7, *(0.0, -np.inf) * self.returns, _NARROWEST * period, 0.0, 0.0]
        amounts = LIGHT.photons, *(LIGHT.photons, np.inf) * self.returns
        most = [*amounts, _WIDEST * period, np.pi / 2.0 if self.split else jitter, np.inf]
        for effect in self.effects:
            least += effect.least
            most += effect.most
        out = np.clip(theta, least, most)
        if self.split:
            out[..., k + 1] = np.minimum(out[..., k + 1], np.arcsin(np.minimum(jitter / out[..., k], 1.0)))
        elif self.gaussian:
            out[..., k] = np.maximum(out[..., k], out[..., k + 1])
        return out

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (...) of the pulse and of the jitter, ns, of parameters (..., p) within the bounds."""
        width, jitter = theta[..., self.light], theta[..., self.light + 1]
        if self.split:
            return width * np.cos(jitter), width * np.sin(jitter)
        return np.sqrt(np.maximum(width**2 - jitter**2, 0.0)), jitter

    def scale(self, theta: FloatArray) -> FloatArray:
        """Changes (p,) of the parameters over which the counts are about linear, for the spread of a batch."""
        k, unit = self.light, self.clock.unit_ns
        width = float(np.hypot(theta[k], unit / 12**0.5))
        # mean wait for the next photon at the brightest phase: a pulse's rate is that of its light within 2.5 widths
        wait = 1.0 / (theta[0] / self.clock.period_ns + float((theta[1:k:2] / (2.5 * width)).max(initial=0.0)))
        short = min(width, wait)
        out = np.zeros(self.size)
        out[0] = max(0.3 * theta[0], 0.02 * float(theta[1:k:2].sum()))
        out[1:k:2] = 0.2 * theta[1:k:2] + 0.04 * theta[0]
        out[2:k:2] = 0.6 * width
        out[k] = 0.3 * width
        out[k + 1] = 0.6 * short / (width if self.split else 1.0)
        out[k + 2] = 0.6 * short + unit
        out[k + 3 :] = 0.8
        for effect in self.effects:
            at = self.names.index(effect.names[0])
            out[at] *= max(effect.start[0], theta[at])
        return out

    def prior(self, theta: FloatArray, free: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Prior precision (free, free) and its centre (p,): only the angle has a prior, as wide as its range."""
        angle = self.split & (np.arange(self.size) == self.light + 1)
        return np.diag(angle[free] * (2.0 / np.pi) ** 2), np.where(angle, np.pi / 4.0, theta)

    def system(self, theta: FloatArray, cycles: int, bins: int = 16, jitter: bool = True) -> System:
        """The instrument of parameters (p,), with or without jitter."""
        theta, period = self.bounded(theta), self.clock.period_ns
        values = dict(zip(self.names, theta.tolist(), strict=True))
        sigma, sd = map(float, self.widths(theta))
        fields: dict[str, Any] = dict(self.fields) | {"dead_time_ns": values["dead_time_ns"]}
        for effect in self.effects:
            fields = effect.of(fields, values)
        if jitter and sd > _NARROWEST * period:
            fields["jitter"] = Jitter(sigma_ns=sd)
        # without a return the pulse has no light
        sigma = max(sigma, _NARROWEST * period) if self.returns else _WIDEST * period
        pulse = self.pulse or GaussianPulse(sigma_ns=float(f"{sigma:.9g}"))
        return System(period_ns=period, cycles=cycles, bins=bins, pulse=pulse, detector=Detector(**fields))

    def flux(self, rows: FloatArray, cycles: int = 0, seed: int = 0) -> Flux:
        """Light (1, rows) of parameters (rows, p); of a waveform, with shapes as uncertain as by so many `cycles`."""
        rows = self.bounded(np.atleast_2d(rows))
        if self.waveform is not None:
            return Flux(waveform=(rows[:, :1] * self.waveform.drawn(self.widths(rows)[1], cycles, seed))[None])
        back = rows[None, :, 0]
        if self.returns == 0:
            return Flux(0.0, back)
        signal, delay = (rows[:, first : self.light : 2].T[:, None] for first in (1, 2))
        return Flux(signal, back, delay % self.clock.period_ns)

    def streams(self, rows: FloatArray, cycles: int, seed: int) -> Recording:
        """A stream of `cycles` periods for each row of (rows, p), all with the detector of the first but its jitter.

        The jitter is added here, a normal deviate for each time, so that it may differ from row to row and no table is
        built for each value.
        """
        rows = self.bounded(np.atleast_2d(rows))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a trial value may look like one in another unit
            system = self.system(rows[0], cycles, jitter=False)
        flux = self.flux(rows, cycles, seed)
        task = Task(flux, system, 1, 0, np.arange(len(rows), dtype=np.uint32), seed, threads=1, progress=None)
        most = self.clock.period_ns / max(system.detector.dead_time_ns, 1e-9)  # registrations in a period
        made = ExactEngine().records(task, float(cycles * np.minimum(flux.total, most).sum()))
        sigma = self.widths(rows)[1]
        sigma[sigma <= _NARROWEST * self.clock.period_ns] = 0.0
        times, drawn = np.empty(made.phase.size), (made.cycle, made.phase, made.offsets)
        _core.recorded_times(*drawn, sigma_ns=sigma, seed=seed, grid=self.clock, out=times)
        return Recording(tuple(np.split(times, made.offsets[1:-1])), (float(cycles),) * len(rows), self.clock)
