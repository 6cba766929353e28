"""Cases to draw: fluxes and systems, by hand, measured and at random."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from mars_lidar import Detector, Flux, GaussianPulse, Pulse, SampledPulse, System
from tests.domain import systems

PERIOD_NS = 100.0
WAVE = np.concatenate([np.full(40, 0.02), np.zeros(30), np.linspace(0.0, 0.08, 30)])  # 2 photons
GATE = {"mode": "gated", "gate_start_ns": 83.0, "gate_width_ns": 40.0}
_SHARED = Path(__file__).parents[3] / "shared"
_PIXELS = 4  # all alike: the same law from neighbouring streams


@dataclass(frozen=True, eq=False)
class Case:
    """Independent exposures of one pixel: `flux` holds a few pixels that are all alike."""

    name: str
    flux: Flux
    system: System
    items: int  # exposures, a multiple of the number of pixels


def make_system(
    dead_ns: float,
    cycles: int = 1000,
    bins: int = 64,
    *,
    sigma_ns: float = 1.0,
    period_ns: float = PERIOD_NS,
    start: str = "armed",
    pulse: Pulse | None = None,
    **detector: Any,
) -> System:
    """A system by its numbers; `detector` are further fields of the detector."""
    return System(
        period_ns=period_ns,
        cycles=cycles,
        bins=bins,
        pulse=pulse or GaussianPulse(sigma_ns=sigma_ns),
        detector=Detector(dead_time_ns=dead_ns, **detector),
        start=start,  # type: ignore[arg-type]  # checked there
    )


def system_of(dead: float, cycles: int = 1000, bins: int = 64, *, sigma: float = 0.00375, **more: Any) -> System:
    """The same by its dead time and pulse in periods of 100 ns."""
    return make_system(dead * PERIOD_NS, cycles, bins, sigma_ns=sigma * PERIOD_NS, **more)


def shared(path: str) -> Path:
    """A file of the project's shared material; the test is skipped where it is absent."""
    file = _SHARED / path
    if not file.exists():
        pytest.skip(f"shared/{path} is not here (it does not ship with the package)")
    return file


def flux_of(signal: ArrayLike, background: float, delay: ArrayLike = 0.5, period_ns: float = PERIOD_NS) -> Flux:
    """Alike pixels; several returns where `signal` and `delay` (periods) are rows."""
    returns = zip(np.atleast_1d(signal), np.atleast_1d(delay), strict=True)
    each = [np.full((1, _PIXELS), x) for pair in returns for x in (pair[0], pair[1] * period_ns)]
    parts = [Flux(s, 0.0, tau) for s, tau in zip(each[::2], each[1::2], strict=True)]
    return (
        Flux.multi(*parts, Flux(np.zeros((1, _PIXELS)), background, 0.0))
        if len(parts) > 1
        else Flux(each[0], background, each[1])
    )


def waveform_flux(waveform: ArrayLike, background: float = 0.0) -> Flux:
    """Alike pixels with a waveform (T,)."""
    return Flux(
        waveform=np.broadcast_to(np.asarray(waveform, float), (1, _PIXELS, np.size(waveform))), background=background
    )


def case(
    signal: Any,
    background: float,
    start: str = "armed",
    *,
    items: int | None = None,
    pulse: Pulse | None = None,
    cycles: int = 60,
    bins: int = 64,
    delay: Any = 0.37,
    **detector: Any,
) -> Case:
    """A case by the fields of its detector; the waveform `WAVE` in the place of a signal is taken for one."""
    fields = {"dead_time_ns": 0.0} | detector
    system = make_system(fields.pop("dead_time_ns"), cycles, bins, sigma_ns=2.0, pulse=pulse, start=start, **fields)
    flux = waveform_flux(WAVE, background) if signal is WAVE else flux_of(signal, background, delay)
    light = "waveform" if signal is WAVE else f"S {signal}"
    effects = [f"{k} {v}" if isinstance(v, int | float | str) else k for k, v in sorted(detector.items())]
    name = f"{light}, B {background}, {start}, {', '.join(effects)}"
    return Case(name, flux, system, items or (4000 if start == "armed" else 1600))


def two_lobes() -> np.ndarray:
    """A pulse of two lobes with a gap of exactly nothing between them."""
    t = np.arange(120)
    first, second = np.exp(-0.5 * ((t - 20) / 4.0) ** 2), 0.3 * np.exp(-0.5 * ((t - 80) / 9.0) ** 2)
    return np.where(t < 45, first, 0.0) + np.where(t > 55, second, 0.0)


def measured_pulse(name: str, span_ns: float, origin: str = "peak") -> SampledPulse:
    """A measured impulse response (../shared/data/irf), stretched to `span_ns`."""
    values = np.maximum(np.load(shared(f"data/irf/{name}.npy")).astype(float).ravel(), 0.0)
    return SampledPulse(values, span_ns / values.size, origin)


def random_cases(
    number: int, seed: int, photons: float = 6e6, least: int = 2000, most: int = 12_000, family: str | None = None
) -> list[Case]:
    """Free-running systems of `tests.domain`, or those of its family "mode", over what the engines must cover.

    `photons` bounds the arrivals to draw for each, `least` and `most` the exposures. With 2000 exposures on
    either side a mean that is off by 0.24 of its standard deviation, or a variance that is off by 34 %, is
    found with a probability of 0.99 at the level of the harness; with 12,000, 0.10 and 14 %.
    """
    drawn = filter(_covered, (systems.draw(seed, k, family) for k in itertools.count()))
    if family is None:
        drawn = (case for case in drawn if case.mode == "nonparalyzable")
    return [_bounded(case, photons, least, most) for case in itertools.islice(drawn, number)]


def _covered(case: systems.Case) -> bool:
    """Without effects, with registrations, and no more than a test can draw."""
    system = case.system
    plain = not system.detector.effects and len(case.signal) < 16
    return plain and 1e-2 < case.photons < 60.0 and system.dead_time_periods < 11.0 and system.bins <= 4096


def _bounded(drawn: systems.Case, photons: float, least: int, most: int) -> Case:
    """As many exposures of as many cycles as `photons` allow."""
    system, dead, rate = drawn.system, drawn.system.dead_time_periods, drawn.photons
    start = system.start
    warm_up = 320 * (dead + 1) if start == "stationary" and dead > 0 else 0.0  # of the sequential engine
    if rate * warm_up * least > photons:
        start, warm_up = "armed", 0.0
    cycles = int(np.clip(photons / (least * rate) - warm_up, 1, min(2000, system.cycles)))
    most = min(most, max(least, 3_000_000 // system.bins))
    items = int(np.clip(photons / (rate * (cycles + warm_up)), least, most)) // _PIXELS * _PIXELS
    light = f"S {drawn.strongest:.3g}, B {drawn.background:.3g}, {drawn.facts()['light']}"
    name = f"{drawn.number} ({drawn.family}): {light}, t_d {dead:.4g}, {cycles} cycles, {start}"
    return Case(name, drawn.flux(_PIXELS), system.replace(cycles=cycles, start=start), items)
