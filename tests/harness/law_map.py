"""Random systems of the declared domain, the laws of each, and what must agree between them.

Extra weight lies near locks (dead times just below k periods, and k halves) and at the extremes. Laws that must agree:
pmf and cumulants, mean histogram and mean, the joint law and both, constant light and its closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import mars_lidar as ml

PERIOD_NS = 100.0
SMALL = 1e-3  # by which laws may disagree, in standard deviations or relative
TINY = 1e-12  # probability that is nothing

Values = dict[str, float]


@dataclass(frozen=True)
class Drawn:
    """One system of the map, times in periods; `electronics` is a dead time too, or 0."""

    seed: int
    signal: float
    background: float
    dead: float
    cycles: int
    bins: int
    sigma: float
    sampled: bool
    start: str
    mode: str
    electronics: float
    delay: float

    def system(self) -> ml.System:
        """The system of the package."""
        pulse: Any = ml.GaussianPulse(sigma_ns=self.sigma * PERIOD_NS)
        if self.sampled:
            random = np.random.default_rng(self.seed)
            values = random.exponential(size=random.integers(2, 60)) ** 2
            pulse = ml.SampledPulse(values, bin_ns=min(6.0 * self.sigma, 0.99) * PERIOD_NS / values.size)
        gate = {"gate_start_ns": 20.0, "gate_width_ns": 55.0} if self.mode == "gated" else {}
        detector = ml.Detector(
            dead_time_ns=self.dead * PERIOD_NS,
            mode=self.mode,  # type: ignore[arg-type]
            electronics_dead_time_ns=self.electronics * PERIOD_NS,
            **gate,
        )
        return ml.System(
            period_ns=PERIOD_NS,
            cycles=self.cycles,
            bins=self.bins,
            pulse=pulse,
            detector=detector,
            start=self.start,  # type: ignore[arg-type]
        )


def draw(seed: int) -> Drawn:
    """System number `seed` of the map."""
    random = np.random.default_rng([77, seed])

    def power(low: float, high: float) -> float:
        return float(10.0 ** random.uniform(low, high))

    def flux() -> float:
        kind = random.random()
        return 0.0 if kind < 0.08 else 1000.0 if kind < 0.11 else power(-6, 3) if kind < 0.6 else power(-2, 1.5)

    kind = random.random()
    near = power(-5, -0.7)
    if kind < 0.05:
        dead = 0.0
    elif kind < 0.40:  # just below a lock
        dead = float(random.choice([1, 1, 1, 2, 2, 3, 5, 10, 100, 0.5, 1.5, 2.5, 1 / 3])) - near
    elif kind < 0.45:
        dead = float(random.choice([1, 2, 3, 7, 50, 1000, 1_000_000]))
    elif kind < 0.75:
        dead = float(random.uniform(0, 3))
    else:
        dead = power(-4, 6)
    mode = str(random.choice(["nonparalyzable"] * 7 + ["paralyzable", "synchronous", "gated"]))
    dead = max(dead, 0.0)
    electronics = 0.0
    if mode in ("nonparalyzable", "gated") and random.random() < 0.1:
        electronics = dead * random.uniform(1.0, 3.0) + random.uniform(0.0, 1.0)
    cycles = random.choice([1, 2, 1000, 10**8]) if random.random() < 0.25 else power(0, 8)
    return Drawn(
        seed,
        flux(),
        flux(),
        dead,
        int(cycles),
        round(2 ** random.uniform(1, 20 if random.random() < 0.3 else 11)),
        power(-4, 0),
        bool(random.random() < 0.2),
        str(random.choice(["armed", "stationary"])),
        mode,
        min(electronics, 1e6),
        float(random.random()),
    )


def laws(drawn: Drawn) -> dict[str, Callable[[Values], Values]]:
    """Each law of a system: from the figures so far to more of them."""
    system = drawn.system()
    flux = ml.Flux(drawn.signal, drawn.background, drawn.delay * PERIOD_NS)
    held: dict[str, Any] = {}

    def count(_: Values) -> Values:
        law = held["law"] = ml.count_law(flux, system, threads=1)
        return {"mean": float(law.mean), "variance": float(law.variance)}

    def pmf(_: Values) -> Values:
        law = held["law"]
        first, p = float(law.support[0]) - float(law.mean), law.pmf
        offset = first + np.arange(p.size)
        return {
            "pmf sum": float(p.sum()),
            "pmf mean": float(p @ offset) + float(law.mean),
            "pmf variance": float(p @ offset**2),
            "pmf least": float(p.min()),
            "pmf size": float(p.size),
        }

    def shape(method: str) -> Callable[[Values], Values]:
        def of(_: Values) -> Values:
            pdf = ml.registration_pdf(flux, system, method=method, threads=1)  # type: ignore[arg-type]
            held[method] = pdf
            return {f"{method} sum": float(pdf.sum()), f"{method} least": float(pdf.min())}

        return of

    def histogram(_: Values) -> Values:
        mean = ml.statistics.mean_histogram(flux, system, threads=1)
        return {"histogram total": float(mean.sum()), "histogram least": float(mean.min())}

    def joint(_: Values) -> Values:
        law = held["joint"] = ml.joint_law(flux, system)
        return {"joint mean": law.count_mean}

    def window(_: Values) -> Values:
        return {"joint variance": held["joint"].count_variance}

    results = {
        "count_law": count,
        "pmf": pmf,
        "exposure": shape("exposure"),
        "stationary": shape("stationary"),
        "mean_histogram": histogram,
    }
    if drawn.mode == "nonparalyzable" and drawn.electronics == 0.0:
        results |= {"joint_law": joint, "window": window}
    return results


def disagreements(drawn: Drawn, values: Values) -> list[str]:
    """What does not agree, in words."""
    results = []

    def compare(a: str, expected: float, scale: float, allowed: float = SMALL) -> None:
        if a in values and not abs(values[a] - expected) <= allowed * scale + TINY:
            results.append(f"{a} {values[a]:.9g} for {expected:.9g}")

    for name in values:
        if not math.isfinite(values[name]):
            results.append(f"{name} {values[name]}")
        if name.endswith("sum"):
            compare(name, 1.0, 1.0, 1e-4)
        if name.endswith("least") and values[name] < 0.0:
            results.append(f"{name} {values[name]:.3g}")
    if "mean" in values:
        mean, variance = values["mean"], values["variance"]
        spread = max(math.sqrt(max(variance, 0.0)), 1e-6 * mean, 1e-300)
        scale = min(spread, max(mean, 1e-300))
        loose = 5.0 if drawn.electronics else 1.0
        compare("pmf mean", mean, scale, loose * SMALL)
        compare("pmf variance", variance, max(variance, 1e-6), loose * SMALL)
        compare("histogram total", mean, scale, loose * SMALL)
        compare("joint mean", mean, scale, 5 * SMALL)
        compare("joint variance", variance, max(variance, 1e-5 * mean), 5 * SMALL)
        plain = drawn.mode == "nonparalyzable" and not drawn.electronics
        if plain and drawn.signal == 0.0:
            rate, x, t = drawn.background, drawn.background * drawn.dead, float(drawn.cycles)
            if drawn.start == "stationary":
                compare("mean", rate * t / (1.0 + x), scale)
            elif t > 20.0 * (drawn.dead + 1.0) * (1.0 + 1.0 / max(x, 1e-9)) * (1.0 + x):
                compare("mean", rate * t / (1 + x) + x**2 / (2 * (1 + x) ** 2), scale)
                known = rate * t / (1 + x) ** 3 + x**2 * (18 + 4 * x + x**2) / (12 * (1 + x) ** 4)
                compare("variance", known, max(known, 1e-9))
        if plain and drawn.start == "armed" and drawn.dead >= drawn.cycles:
            compare("mean", -math.expm1(-(drawn.signal + drawn.background) * drawn.cycles), scale)
    return results
