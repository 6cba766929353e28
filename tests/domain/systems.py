"""Random systems over the whole declared domain: a pixel, its light and its instrument, a function of seed and number.

Times are in laser periods; the period is 100 ns throughout, because nothing but ratios matters.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Afterpulsing, Detector, Flux, GaussianPulse, Jitter, Pulse, SampledPulse, System

PERIOD_NS = 100.0
MOVING = "moving gate"


@dataclass(frozen=True, eq=False)
class Case:
    """One pixel of the domain: `signal` photons per period of each return at `delay` periods, or a waveform.

    `rare`: intervals (periods, may pass 1) of the period whose few photons are counted by themselves.
    """

    name: str
    family: str
    system: System
    signal: tuple[float, ...]
    delay: tuple[float, ...]
    background: float
    waveform: NDArray[np.float64] | None = None
    wave: str = ""
    rare: tuple[tuple[float, float], ...] = ()

    @property
    def photons(self) -> float:
        """Photons per period that would register in an armed pixel, all effects on the light included."""
        light = sum(self.signal) if self.waveform is None else float(self.waveform.sum())
        detector = self.system.detector
        dark = detector.dark_count_hz * PERIOD_NS * 1e-9
        return (light + self.background) * detector.detection_efficiency + dark

    @property
    def number(self) -> int:
        """Its number in the sweep; 0 for one made by hand."""
        last = self.name.rpartition("/")[2]
        return int(last) if last.isdigit() else 0

    @property
    def strongest(self) -> float:
        """Signal photons per period, summed over the returns or the waveform."""
        return float(sum(self.signal) if self.waveform is None else self.waveform.sum())

    @property
    def mode(self) -> str:
        """Mode of the detector; a moving gate is a mode of its own here."""
        return MOVING if self.system.detector.gate_moves else self.system.detector.mode

    def since_gate(self, time: NDArray[np.float64], early: float = 0.0) -> NDArray[np.float64]:
        """Time since the gate of its period opened, modulo the period, of times (periods) that may be `early`."""
        detector = self.system.detector
        period = np.floor(time)
        moves = np.floor(period / (detector.gate_cycles or 1)) if detector.gate_moves else 0.0
        start = ((detector.gate_start_ns or 0.0) + moves * (detector.gate_step_ns or 0.0)) / PERIOD_NS
        return np.asarray((time - period - start + early) % 1.0)

    @property
    def gate_width(self) -> float:
        """Time for which the gate is open in a period, in periods."""
        return (self.system.detector.gate_width_ns or 0.0) / PERIOD_NS

    def registrations(self) -> float:
        """Registrations of an exposure, roughly."""
        n, rate, dead = self.system.cycles, self.photons, self.system.dead_time_periods
        if self.mode == "synchronous":
            return min(n * rate, n / max(1.0, dead))
        return n * rate / (1.0 + rate * dead) + min(1.0, n * rate)

    def flux(self, pixels: int = 1) -> Flux:
        """A row of `pixels` equal pixels."""
        row = np.ones((1, pixels))
        if self.waveform is not None:
            alike = np.broadcast_to(self.waveform, (1, pixels, self.waveform.size))
            return Flux(waveform=alike, background=self.background)
        backgrounds = [self.background, *[0.0] * (len(self.signal) - 1)]
        parts = zip(self.signal, backgrounds, self.delay, strict=True)
        returns = [Flux(s * row, b, d * PERIOD_NS) for s, b, d in parts]
        return Flux.multi(*returns) if len(returns) > 1 else returns[0]

    def facts(self) -> dict[str, Any]:
        """One row of the data: what the maps are drawn over."""
        system = self.system
        pulse = system.pulse
        return {
            "case": self.name,
            "family": self.family,
            "mode": self.mode,
            "start": system.start,
            "S": self.strongest,
            "B": self.background,
            "delay": self.delay[0],
            "dead": system.dead_time_periods,
            "cycles": system.cycles,
            "bins": system.bins,
            "sigma": pulse.sigma_ns / PERIOD_NS if isinstance(pulse, GaussianPulse) else 0.0,
            "light": self.wave or (f"{len(self.signal)} returns" if len(self.signal) > 1 else "return"),
            "effects": " ".join(system.detector.effects),
        }


FluxRange = (1e-6, 1e3)
FAMILIES = ("any", "electronics", "locked", "dim", "waveform", "mode", "effects", "tails", "long", "ends")
_SHARES = (0.15, 0.11, 0.16, 0.11, 0.14, 0.12, 0.11, 0.03, 0.03, 0.04)
Start = Literal["armed", "stationary"]


def draw(seed: int, number: int, family: str | None = None) -> Case:
    """System `number` of the sweep `seed`."""
    random = np.random.default_rng([seed, number])
    chosen = family or str(random.choice(FAMILIES, p=_SHARES))
    return _Draw(random, chosen).case(f"{seed}/{number}")


LONG = ("gaussian", "bright", "locked", "reflection", "samples", "spike", "returns", "waveform")


def draw_long(seed: int, number: int) -> Case:
    """System `number` of the study of long exposures: kinds for which `feedback` had errors in earlier versions."""
    return _Draw(np.random.default_rng([seed, number]), LONG[number % len(LONG)]).long(f"{seed}/{number}")


class _Draw:
    """One system, from its own random numbers."""

    def __init__(self, random: np.random.Generator, family: str) -> None:
        self.random, self.family = random, family

    def log(self, low: float, high: float) -> float:
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def chance(self, share: float) -> bool:
        return bool(self.random.random() < share)

    def case(self, name: str) -> Case:
        signal, background = self._light()
        mode = self._mode()
        dead = self._dead(mode)
        pulse, rare = self._pulse()
        if isinstance(pulse, SampledPulse) and mode == "nonparalyzable" and self.chance(0.4):
            low, high = pulse.support_ns()  # armed again within the record, some periods later
            dead = int(self.random.integers(0, 4)) + float(self.random.uniform(1e-3, 1.0)) * (high - low) / PERIOD_NS
        cycles = self._cycles(signal + background)
        wide = self.chance(0.04 if self.family == "locked" else 0.12)
        bins = round(self.log(2, 2**20)) if wide else 2 ** int(self.random.integers(1, 13))
        if self.family == "electronics" and self.chance(0.5):
            bins = round(self.log(2, 5000))
        if self.family == "ends":
            bins = int(self.random.choice([1, 2, 2, 2**20]))
        if self.family == "tails":
            bins = 2 ** int(np.ceil(np.log2(6.0 / self._width(pulse))))
        waves = self.family == "waveform" or (self.family == "electronics" and self.chance(0.15))
        wave, kind = self._waveform(signal) if waves else (None, "")
        signals, delays = self._returns(signal)
        start: Start = "stationary" if self.chance(0.33) and mode != MOVING and self.family != "tails" else "armed"
        detector = self._detector(mode, dead, bins)
        system = System(
            period_ns=PERIOD_NS, cycles=cycles, bins=min(bins, 2**20), pulse=pulse, detector=detector, start=start
        )
        looked = tuple((delays[0] + a, delays[0] + b) for a, b in rare) if wave is None and len(signals) == 1 else ()
        return Case(name, self.family, system, signals, delays, background, wave, kind, looked)

    def _light(self) -> tuple[float, float]:
        if self.family == "locked":
            return self.log(3.0, 300.0), self.log(0.03, 15.0)
        if self.family == "ends":
            either = [0.0, 1e-6, 1.0, 1e3]
            return float(self.random.choice(either)), float(self.random.choice(either))
        if self.family == "tails":
            return self.log(1e-3, 20.0), 0.0 if self.chance(0.5) else self.log(1e-6, 1e-3)
        if self.family == "dim":
            return self.log(1e-6, 0.3), self.log(1e-6, 0.3) * (not self.chance(0.2))
        low, high = FluxRange if self.chance(0.5) else (1e-2, 30.0)
        signal, background = self.log(low, high), self.log(low, high)
        return signal * (not self.chance(0.1)), background * (not self.chance(0.1))

    def _mode(self) -> str:
        others = {"electronics": 0.15} | dict.fromkeys(("waveform", "effects", "dim", "ends"), 0.35)
        if self.family == "mode" or (self.family in others and self.chance(others[self.family])):
            return str(self.random.choice(["paralyzable", "synchronous", "gated", MOVING]))
        return "nonparalyzable"

    def _dead(self, mode: str) -> float:
        whole = int(self.random.integers(1, 7))
        if self.family == "locked":
            kind = self.random.random()
            if kind < 0.55:
                return float(self.random.uniform(0.7, 0.999))
            if kind < 0.8:
                return whole - self.log(1e-4, 0.1)
            return float(self.random.uniform(0.02, 3.0))
        if self.family == "ends":
            return float(self.random.choice([0.0, 1e-6, 0.5, 1.0, 1e4 if mode == "paralyzable" else 1e6]))
        kind = self.random.random()
        if kind < 0.08:
            return 0.0
        if kind < 0.45:
            return self.log(1e-3, 1.0)
        if kind < 0.60:
            return float(self.random.uniform(0.0, 8.0))
        if kind < 0.70:
            return float(whole)
        if kind < 0.82:
            return whole - self.log(1e-5, 0.1)
        if kind < 0.88:
            return whole + self.log(1e-5, 0.1)
        return self.log(5.0, 1e6 if mode != "paralyzable" else 1e4)

    def _cycles(self, photons: float) -> int:
        if self.family == "ends":
            return int(self.random.choice([1, 2, 1000, 10**8]))
        if self.family == "long":
            return int(self.log(1e5, 1e8))
        if self.family == "tails":
            return int(min(1e8, 3e6 / photons))
        if self.family == "dim":
            return int(np.clip(self.log(1.0, 1e5) / photons, 1, 1e8))
        if self.family == "locked":
            return int(self.log(100, 1e6))
        return int(self.log(1, 1e8 if self.chance(0.25) else 3e4))

    def _pulse(self) -> tuple[Pulse, list[tuple[float, float]]]:
        """The pulse, and intervals round its delay that hold few photons."""
        kind = self.random.random()
        if self.family == "ends":
            return GaussianPulse(sigma_ns=float(self.random.choice([1e-6, 1e-4, 1.0])) * PERIOD_NS), []
        if self.family == "tails" and kind < 0.7:
            sigma = self.log(1e-3, 0.02)
            edges = (4.5, 5.0, 5.5, 6.0, 8.0)
            both = [(a * sigma, b * sigma) for a, b in pairwise(edges)]
            return GaussianPulse(sigma_ns=sigma * PERIOD_NS), both + [(-b, -a) for a, b in both]
        if kind < 0.7 and self.family != "tails":
            low, high = (1e-4, 0.03) if self.family == "locked" else (1e-4, 1.0)
            return GaussianPulse(sigma_ns=self.log(low, high) * PERIOD_NS), []
        samples, length = round(self.log(10, 5000)), float(self.random.uniform(0.02, 0.9))
        t = np.arange(samples) / samples
        shape = self.random.random()
        if shape < 0.25 and self.family != "tails":  # a peak and its reflection
            width, later = self.log(0.01, 0.05), float(self.random.uniform(0.3, 0.7))
            peaks = [(1.0, 0.15), (float(self.random.uniform(0.05, 0.8)), 0.15 + later)]
            values = sum(height * np.exp(-0.5 * ((t - at) / width) ** 2) for height, at in peaks)
            return SampledPulse(values, length * PERIOD_NS / samples, "first"), []
        if shape < 0.4 and self.family != "tails":  # a spike in a long pulse
            values = np.full(samples, 1.0)
            values[int(self.random.integers(samples))] += samples * self.log(0.01, 0.5)
            return SampledPulse(values, length * PERIOD_NS / samples, "first"), []
        if kind < 0.9:  # a pre-pulse of a millionth, a dark gap, the pulse with a tail
            values = np.where(t > 0.4, np.exp(-(t - 0.4) * self.random.uniform(8, 40)), 0.0)
            early = t < 0.15
            values[early] = 10 ** self.random.uniform(-6.5, -5) * values.sum() / early.sum()
            width = length / samples
            rare = [(0.0, float(early.sum()) * width)]
        else:  # lobes at random, some of nothing
            values, rare = self.random.exponential(size=samples) ** 3 * (self.random.random(samples) < 0.6), []
            values[int(self.random.integers(samples))] += 1.0
        return SampledPulse(values, length * PERIOD_NS / samples, "first"), rare

    def _width(self, pulse: Pulse) -> float:
        """The pulse's feature width, periods."""
        if isinstance(pulse, GaussianPulse):
            return pulse.sigma_ns / PERIOD_NS
        low, high = pulse.support_ns()
        return (high - low) / PERIOD_NS / 20.0

    def _returns(self, signal: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        first = float(self.random.choice([self.random.random(), self.random.random(), 0.0, 0.999]))
        if self.family in ("any", "electronics", "mode", "effects") and self.chance(0.25):
            number = int(self.random.choice([2, 3, 16]))
            share = self.random.dirichlet(np.full(number, 0.7))
            near = self.random.random(number) * self.random.choice([0.05, 1.0])
            return tuple((share * signal).tolist()), tuple(((first + near) % 1.0).tolist())
        return (signal,), (0.5 if self.family == "tails" else first,)

    def _waveform(self, signal: float) -> tuple[NDArray[np.float64], str]:
        parts = round(self.log(1, 65_536))
        kind = str(self.random.choice(["flat", "smooth", "spikes", "steps", "rough"]))
        t = (np.arange(parts) + 0.5) / parts
        if kind == "flat":
            values = np.ones(parts)
        elif kind == "smooth":
            values = 1.0 + 0.9 * np.cos(2 * np.pi * (t - self.random.random()))
        elif kind == "spikes":
            values = np.full(parts, 0.0 if self.chance(0.5) else 0.1 / parts)
            where = self.random.integers(0, parts, int(self.random.integers(1, 5)))
            values[where] += self.random.exponential(size=where.size)
        elif kind == "steps":
            levels = self.random.exponential(size=6) * (self.random.random(6) < 0.7)
            values = levels[(t * 6).astype(int)]
        else:
            values = self.random.exponential(size=parts) ** 3
        total = values.sum()
        return (values * (signal / total) if total > 0.0 else np.zeros(parts)), kind

    def _detector(self, mode: str, dead: float, bins: int) -> Detector:
        fields: dict[str, Any] = {"dead_time_ns": dead * PERIOD_NS}
        if mode in ("gated", MOVING):
            width = self.log(1e-4, 1.0)
            start = self.random.random() * PERIOD_NS
            fields |= {"mode": "gated", "gate_start_ns": start, "gate_width_ns": width * PERIOD_NS}
            if mode == MOVING:
                fields |= {
                    "gate_step_ns": float(self.random.choice([0.01, 0.1, 0.37, -0.05])) * PERIOD_NS,
                    "gate_cycles": int(self.random.choice([1, 3, 50])),
                }
        elif mode != "nonparalyzable":
            fields["mode"] = mode
        if self.family == "effects":
            fields |= self._effects(mode, dead, bins)
        if self.family == "electronics":
            fields["electronics_dead_time_ns"] = (dead + self.log(1e-2, 3.0)) * PERIOD_NS
            beside = {"detection_efficiency": self.log(0.1, 1.0), "jitter": self._jitter()}
            if bins % 4 == 0:
                beside["code_density"] = tuple(self.random.uniform(0.5, 1.5, 4).tolist())
            fields |= {name: value for name, value in beside.items() if self.chance(0.2)}
        return Detector(**fields)

    def _jitter(self) -> Jitter:
        sigma = self.log(1e-4, 0.05) * PERIOD_NS
        if self.chance(0.5):
            return Jitter(sigma_ns=sigma)
        return Jitter(sigma_ns=sigma, tail_ns=self.log(1e-3, 0.04) * PERIOD_NS, tail_fraction=0.1)

    def _effects(self, mode: str, dead: float, bins: int) -> dict[str, Any]:
        possible: dict[str, Any] = {
            "detection_efficiency": self.log(0.01, 1.0),
            "dark_count_hz": self.log(10.0, 1e6),
            "jitter": self._jitter(),
            "electronics_dead_time_ns": dead * PERIOD_NS + self.log(1e-2, 3.0) * PERIOD_NS,
            "max_events_per_period": int(self.random.integers(1, 4)),
            "max_events_per_exposure": int(self.log(1, 1e4)),
            "afterpulsing": Afterpulsing(probability=self.log(1e-3, 0.3), delay_ns=self.log(0.05, 10.0) * PERIOD_NS),
        }
        if bins % 4 == 0:
            possible["code_density"] = tuple(self.random.uniform(0.5, 1.5, 4).tolist())
        if mode == "nonparalyzable" and dead > 0.0:
            possible["recovery_ns"] = self.log(0.01, 1.0) * PERIOD_NS
            possible["twilight_ns"] = float(self.random.uniform(0.01, 0.2)) * min(dead, 1.0) * PERIOD_NS
        names = self.random.choice(sorted(possible), size=int(self.random.integers(1, 4)), replace=False)
        return {str(name): possible[str(name)] for name in names}

    def long(self, name: str) -> Case:
        """A free-running pixel without effects that is exposed for long."""
        random = self.random
        signal, background = self.log(0.05, 10.0), self.log(0.01, 10.0)
        dead = int(random.integers(0, 4)) + float(random.uniform(0.02, 1.0))
        pulse: Pulse = GaussianPulse(sigma_ns=self.log(1e-3, 0.02) * PERIOD_NS)
        wave = None
        if self.family == "bright":
            signal, background = self.log(10.0, 100.0), self.log(0.005, 1.0)
        elif self.family == "locked":
            signal, background = self.log(3.0, 100.0), self.log(0.03, 12.0)
            dead = float(random.uniform(0.7, 0.999)) if self.chance(0.7) else dead
        if self.family in ("reflection", "samples", "spike"):
            signal, length = self.log(0.3, 60.0), self.log(0.02, 0.6)
            pulse = self._long_pulse(length)
            if self.chance(0.6):  # armed again within the record, some periods later
                dead = int(random.integers(0, 4)) + max(length * float(random.uniform(0.05, 1.0)), 0.01)
        elif self.chance(0.25):  # next to whole periods
            dead = max(1, int(random.integers(1, 4))) + float(random.choice([-1.0, 1.0])) * self.log(1e-5, 0.05)
        delay = float(random.random())
        signals: tuple[float, ...] = (signal,)
        delays: tuple[float, ...] = (delay,)
        if self.family == "returns":
            signals = tuple((signal * random.dirichlet(np.ones(2))).tolist())
            delays = (delay, (delay + float(random.uniform(0.0, 0.3))) % 1.0)
        if self.family == "waveform":
            t = (np.arange(1024) + 0.5) / 1024
            shape = 0.2 + 5.0 * np.exp(-0.5 * (((t - delay + 0.5) % 1.0 - 0.5) / self.log(0.003, 0.05)) ** 2)
            wave = shape * (signal / shape.sum())
        system = System(
            period_ns=PERIOD_NS,
            cycles=int(self.log(3e4, 1e8)),
            bins=int(random.choice([64, 100, 256, 1024])),
            pulse=pulse,
            detector=Detector(dead_time_ns=dead * PERIOD_NS),
            start="stationary" if self.chance(0.33) else "armed",
        )
        return Case(name, self.family, system, signals, delays, background, wave, self.family)

    def _long_pulse(self, length: float) -> SampledPulse:
        """A measured pulse `length` periods long."""
        samples = round(self.log(10, 5000))
        t = (np.arange(samples) + 0.5) / samples
        if self.family == "reflection":
            width, share, later = self.random.uniform((0.01, 0.05, 0.3), (0.06, 0.8, 0.75))
            values = np.exp(-0.5 * ((t - 0.15) / width) ** 2) + share * np.exp(-0.5 * ((t - 0.15 - later) / width) ** 2)
        elif self.family == "spike":
            values = np.ones(samples)
            values[int(self.random.integers(samples))] += samples * self.log(0.01, 0.5)
        else:
            values = self.random.uniform(size=samples) ** 5
        return SampledPulse(values, length * PERIOD_NS / samples, "first")
