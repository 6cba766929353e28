"""One system of the sweep: a pixel, its light and its instrument.

Times are in laser periods; the period is 100 ns throughout, because nothing but ratios matters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, GaussianPulse, System

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
        """How long the gate is open in a period."""
        return (self.system.detector.gate_width_ns or 0.0) / PERIOD_NS

    def registrations(self) -> float:
        """Registrations of an exposure, roughly."""
        n, rate, dead = self.system.cycles, self.photons, self.system.dead_time_periods
        if self.mode == "synchronous":
            return min(n * rate, n / max(1.0, dead))
        return n * rate / (1.0 + rate * dead) + min(1.0, n * rate)

    def flux(self, pixels: int = 1) -> Flux:
        """`pixels` alike pixels in a row."""
        row = np.ones((1, pixels))
        if self.waveform is not None:
            alike = np.broadcast_to(self.waveform, (1, pixels, self.waveform.size))
            return Flux(waveform=alike, background=self.background)
        parts = [Flux(s * row, 0.0, d * PERIOD_NS) for s, d in zip(self.signal, self.delay, strict=True)]
        if len(parts) == 1:
            return Flux(self.signal[0] * row, self.background, self.delay[0] * PERIOD_NS)
        return Flux.multi(*parts, Flux(0.0 * row, self.background, 0.0))

    @property
    def predictable(self) -> bool:
        """Whether the predictions are compared: for one return, or a waveform."""
        return self.waveform is not None or len(self.signal) == 1

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
