"""Cases to draw: fluxes and systems, by hand, measured and at random."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from mars_lidar import Detector, Flux, GaussianPulse, Pulse, SampledPulse, System

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


def system_of(
    dead: float,
    cycles: int = 1000,
    bins: int = 64,
    *,
    sigma: float = 0.00375,
    start: str = "armed",
    pulse: Pulse | None = None,
) -> System:
    """A free-running system; times in periods of 100 ns."""
    return System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=bins,
        pulse=pulse or GaussianPulse(sigma_ns=sigma * PERIOD_NS),
        detector=Detector(dead_time_ns=dead * PERIOD_NS),
        start=start,  # type: ignore[arg-type]  # checked there
    )


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
        waveform=np.broadcast_to(np.asarray(waveform, float), (1, _PIXELS, np.size(waveform))),
        background=background,
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
    system = System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=bins,
        pulse=pulse or GaussianPulse(sigma_ns=2.0),
        start=start,
        detector=Detector(**detector),
    )
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


def random_cases(number: int, seed: int, photons: float = 6e6, least: int = 2000, most: int = 12_000) -> list[Case]:
    """Systems all over the range that the engines must cover.

    `photons` bounds the arrivals to draw for each, `least` and `most` the exposures. With 2000 exposures on
    either side a mean that is off by 0.24 of its standard deviation, or a variance that is off by 34 %, is
    found with a probability of 0.99 at the level of the harness; with 12,000, 0.10 and 14 %.
    """
    random = np.random.default_rng(seed)
    return [_random_case(random, k, photons, least, most) for k in range(number)]


def _random_case(random: np.random.Generator, k: int, photons: float, least: int, most: int) -> Case:
    period = float(random.choice([16.0, 100.0, 1e3 / 7.5]))
    signal, background = np.exp(random.uniform(np.log(1e-3), np.log(30.0), 2))
    signal, background = signal * (k % 8 != 3), background * (k % 8 != 6)
    kinds = ("none", "fraction", "fraction", "whole", "just below", "just above", "many", "tiny")
    kind = kinds[(k + k // 8) % 8]
    whole = int(random.integers(1, 11))
    dead = {
        "none": 0.0,
        "fraction": random.uniform(0.05, 0.98),
        "whole": float(whole),
        "just below": whole - 10 ** random.uniform(-4, -1.5),
        "just above": whole + 10 ** random.uniform(-4, -1.5),
        "many": random.uniform(1.0, 10.0),
        "tiny": 10 ** random.uniform(-3, -1),
    }[kind]
    stationary = bool(random.random() < 0.4)
    shape = ("narrow", "gaussian", "wide", "lobes", "returns", "waveform", "measured-sized", "first")[
        k % 8 ^ (k // 8 % 8)
    ]
    delay = float(random.choice([random.uniform(0, 1), 0.0, 0.001, 0.999]))
    pulse: Pulse = GaussianPulse(sigma_ns=period * 10 ** random.uniform(-2.7, -1.3))
    flux = flux_of(signal, background, delay, period)
    if shape == "narrow":
        pulse = GaussianPulse(sigma_ns=period * 10 ** random.uniform(-5, -3))
    elif shape == "wide":
        pulse = GaussianPulse(sigma_ns=0.3 * period)
    elif shape in ("lobes", "measured-sized", "first"):
        length = random.uniform(0.02, 1.0) if shape != "measured-sized" else 0.1
        origin = {"lobes": "centroid", "measured-sized": "peak", "first": "first"}[shape]
        pulse = SampledPulse(two_lobes(), length * period / 120, origin)
    elif shape == "returns":
        share = random.dirichlet([1.0, 1.0, 1.0])
        flux = flux_of(signal * share, background, [delay, (delay + 0.02) % 1, random.uniform(0, 1)], period)
    elif shape == "waveform":
        wave = random.exponential(size=int(random.integers(1, 300))) ** 3
        wave[random.random(wave.size) < 0.3] = 0.0
        flux = waveform_flux(signal * wave / max(wave.sum(), 1e-9), background)
    total = signal + background
    warm_up = 320 * (dead + 1) if stationary and dead > 0 else 0.0  # of the sequential engine
    if total * warm_up * least > photons:
        stationary, warm_up = False, 0.0
    longest = max(1.0, photons / (least * max(total, 1e-3)) - warm_up)
    cycles = int(np.clip(np.exp(random.uniform(0.0, np.log(2000.0))), 1, min(2000.0, longest)))
    bins = int(random.choice([1, 7, 64, 200, 1024]))
    most = min(most, max(least, 3_000_000 // bins))
    system = System(
        period_ns=period,
        cycles=cycles,
        bins=bins,
        pulse=pulse,
        detector=Detector(dead_time_ns=dead * period),
        start="stationary" if stationary else "armed",
    )
    items = int(np.clip(photons / (max(total, 1e-3) * (cycles + warm_up)), least, most)) // _PIXELS * _PIXELS
    name = f"{k}: S {signal:.3g}, B {background:.3g}, t_d {dead:.4g} ({kind}), {shape}, {cycles} cycles"
    return Case(f"{name}, {system.start}", flux, system, items)
