"""Study "detectors": what each mode and each effect of a detector does to the same light, simulated and predicted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import (
    Afterpulsing,
    CountLaw,
    Crosstalk,
    Detector,
    Flux,
    GaussianPulse,
    Jitter,
    System,
    count_law,
    simulate,
    simulate_timestamps,
)
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.effects import AVALANCHE_EFFECTS
from mars_lidar.plot.colours import COLOURS, INK, MUTED
from mars_lidar.statistics import constant_light_rate, mean_histogram, photons_per_bin
from mars_lidar.statistics.pmf import Pmf
from studies import Facts, Request
from studies.common.distance import g_test
from studies.common.draw import legend_below, panels
from studies.common.report import Row

DEAD_NS = 45.0
_REACH, _BINS_OF_INTERVALS = 3.0, 150  # periods between registrations that are drawn
_SIMULATED_ONLY = {*AVALANCHE_EFFECTS, "max_events_per_period", "max_events_per_exposure"}

Settings = Mapping[str, int]  # exposures of each part
FULL: Settings = {"modes": 40_000, "effects": 10_000, "fog": 4_000, "rate": 4_000}
QUICK: Settings = {"modes": 400, "effects": 400, "fog": 200, "rate": 40}


@dataclass(frozen=True, eq=False)
class Light:
    """The light of one pixel, the instrument without its detector, the seed."""

    pixel: Flux
    system: System
    seed: int

    def on(self, shape: tuple[int, int]) -> Flux:
        """Equal pixels (H, W)."""
        pixel = self.pixel
        if pixel.waveform is None:
            return Flux(np.full(shape, float(pixel.signal)), pixel.background, pixel.delay_ns)
        return Flux(
            waveform=np.broadcast_to(pixel.waveform, (*shape, pixel.waveform.size)), background=pixel.background
        )


RETURN = Light(
    Flux(1.0, 1.0, 37.0),
    System(
        period_ns=100.0,
        cycles=500,
        bins=200,
        pulse=GaussianPulse(sigma_ns=1.0),
        detector=Detector(dead_time_ns=DEAD_NS),
    ),
    seed=20,
)
_FOG_SYSTEM = RETURN.system.replace(
    cycles=1000, bins=400, pulse=GaussianPulse(sigma_ns=0.3), detector=Detector(dead_time_ns=30.0)
)
# a pane of glass at 40 ns and a wall at 73 ns; a visibility of 49 m
FOG = Light(
    Flux.multi(Flux(0.15, 0.05, 40.0), Flux(3.0, 0.0, 73.0)).in_fog(
        _FOG_SYSTEM, parts=_FOG_SYSTEM.bins, extinction_per_m=0.08, backscatter=1.2, nearest_m=0.6
    ),
    _FOG_SYSTEM,
    seed=6,
)
REGIONS = {"fog": (0.0, 37.0), "glass": (37.0, 43.0), "wall": (70.0, 76.0)}  # ns


@dataclass(frozen=True)
class Example:
    """A detector, its name in figures and tables, and the figure it belongs to; of none in all."""

    name: str
    figure: str
    detector: Detector


def example_of(name: str, figure: str, **changes: Any) -> Example:
    """A detector of the common dead time but for `changes`."""
    return Example(name, figure, Detector(**{"dead_time_ns": DEAD_NS, **changes}))


_GATE: dict[str, Any] = {"mode": "gated", "gate_start_ns": 0.0, "gate_width_ns": 30.0}
MODES = (
    example_of("non-paralyzable", ""),
    example_of("paralyzable", "paralyzable", mode="paralyzable"),
    example_of("synchronous, no dead time", "synchronous", dead_time_ns=0.0, mode="synchronous"),
    example_of("synchronous", "synchronous", mode="synchronous"),
    example_of("gated", "gated", mode="gated", gate_start_ns=20.0, gate_width_ns=40.0),
    example_of("moving gate", "gated", **_GATE, gate_step_ns=1.0, gate_cycles=5),
)
CODES = tuple(1.0 + 0.25 * np.sin(2.0 * np.pi * k / 8.0) for k in range(8))
_TAILED = Jitter(sigma_ns=0.5, tail_ns=6.0, tail_fraction=0.4)
EFFECTS = (
    example_of("free running", ""),
    example_of("efficiency 0.3", "light", detection_efficiency=0.3),
    example_of("dark counts 5 MHz", "light", dark_count_hz=5e6),
    *(
        example_of(f"p {p:g}, {delay:g} ns", "afterpulsing", afterpulsing=Afterpulsing(probability=p, delay_ns=delay))
        for p, delay in ((0.1, 30.0), (0.4, 30.0), (0.4, 200.0))
    ),
    *(example_of(f"alpha {alpha:g} ns", "twilight", twilight_ns=alpha) for alpha in (3.0, 15.0)),
    *(example_of(f"p {p:g}", "crosstalk", crosstalk=Crosstalk(probability=p)) for p in (0.1, 0.5)),
    *(example_of(f"t_e {dead:g} ns", "electronics", electronics_dead_time_ns=dead) for dead in (60.0, 130.0)),
    example_of("Gaussian, 2 ns", "jitter", jitter=Jitter(sigma_ns=2.0)),
    example_of("Gaussian and tail of 6 ns, 40 %", "jitter", jitter=_TAILED),
    example_of("codes of 0.75 to 1.25 bins", "converter", code_density=CODES),
    example_of("1 event a period", "limits", max_events_per_period=1),
    example_of("400 events an exposure", "limits", max_events_per_exposure=400),
)
IN_FOG = tuple(
    example_of(name, "fog", dead_time_ns=30.0, mode=name.replace("-", ""))
    for name in ("non-paralyzable", "paralyzable", "synchronous")
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One detector: simulated, and predicted where there is a prediction.

    `histogram` and `intervals` are means per exposure; `counts` (exposures,).
    """

    example: Example
    system: System
    counts: NDArray[np.int64]
    histogram: FloatArray
    histogram_error: FloatArray
    intervals: FloatArray
    expected: FloatArray | None
    law: CountLaw | None


def run(settings: Settings, request: Request) -> Facts:
    """Modes, effects, fog; a figure for each group of detectors."""
    rows: dict[str, list[dict[str, Any]]] = {}
    figures: dict[str, Figure] = {}
    for part, light, examples in (("modes", RETURN, MODES), ("effects", RETURN, EFFECTS), ("fog", FOG, IN_FOG)):
        request.tell(f"detectors: {part}")
        outcomes = [outcome(example, light, settings[part]) for example in examples]
        rows[part] = [row(each) for each in outcomes]
        for name in dict.fromkeys(example.figure for example in examples if example.figure):
            figures[name] = _group(light, [each for each in outcomes if each.example.figure in ("", name)])
    arrivals = FOG.system.cycles * photons_per_bin(FOG.pixel, FOG.system, bins=FOG.system.bins)
    for line, each in zip(rows["fog"], outcomes, strict=True):
        for name, (low, high) in REGIONS.items():
            inside = (FOG.system.time_ns >= low) & (FOG.system.time_ns < high)
            line[name] = float(each.histogram[inside].sum() / arrivals[inside].sum())
    rates = constant_light(settings["rate"])
    tables = {"fog": rows["fog"], "rate": rates}
    every = [*rows["modes"], *rows["effects"]]
    return {"parts": rows, "rows": every, "rates": rates, "tables": tables, "figures": figures}


def outcome(example: Example, light: Light, exposures: int) -> Outcome:
    """Simulate one detector, and predict what is known of it."""
    system = light.system.replace(detector=example.detector)
    coupled = example.detector.crosstalk is not None  # the exposures are then the pixels of one square image
    side = round(math.sqrt(exposures))
    flux = light.on((side, side) if coupled else (1, exposures))
    times = simulate_timestamps(flux, system, engine="sequential" if coupled else "exact", seed=light.seed)
    counts = times.counts.ravel()
    exposures = counts.size
    each = np.bincount(times.bin, minlength=system.bins) / exposures
    item = np.repeat(np.arange(exposures), counts)
    place, number = np.unique(item * system.bins + times.bin, return_counts=True)
    second = np.bincount(place % system.bins, number.astype(np.float64) ** 2, minlength=system.bins) / exposures
    apart = np.diff(times.times_ns)[item[1:] == item[:-1]] / system.period_ns
    intervals = np.histogram(apart, _BINS_OF_INTERVALS, (0.0, _REACH))[0] / exposures
    error = np.sqrt(np.maximum(second - each**2, 0.0) / exposures)
    if system.detector.gate_moves or set(system.detector.effects) & _SIMULATED_ONLY:
        return Outcome(example, system, counts, each, error, intervals, None, None)
    expected, law = mean_histogram(light.pixel, system), count_law(light.pixel, system)
    return Outcome(example, system, counts, each, error, intervals, expected, law)


def row(each: Outcome) -> dict[str, Any]:
    """One line of the table."""
    n, mean, variance = each.counts.size, float(each.counts.mean()), float(each.counts.var(ddof=1))
    line: dict[str, Any] = {"effect": each.example.figure or "none", "detector": each.example.name}
    line |= {"simulated mean": mean, "simulated variance": variance}
    if each.expected is None or each.law is None:
        words = ("predicted mean", "predicted variance", "z mean", "z variance", "worst z of a bin", "p of the law")
        return line | dict.fromkeys(words, "-")
    fourth = float(np.mean((each.counts - mean) ** 4))
    selected = each.histogram_error > 0
    z = (each.histogram[selected] - each.expected[selected]) / each.histogram_error[selected]
    known = float(each.law.mean), float(each.law.variance)
    return line | {
        "predicted mean": known[0],
        "predicted variance": known[1],
        "z mean": (mean - known[0]) / math.sqrt(known[1] / n),
        "z variance": (variance - known[1]) / math.sqrt((fourth - variance**2) / n),
        "worst z of a bin": float(np.abs(z).max()),
        "p of the law": g_test(Pmf(int(each.law.support[0]), each.law.pmf), Pmf.of_counts(each.counts), n),
    }


def constant_light(exposures: int) -> list[Row]:
    """Rate under constant light of the preset module: one line for each rate of photons."""
    detector = Detector.preset("excelitas-spcm-aqrh")
    pulse = GaussianPulse(sigma_ns=1.0)
    system = System(period_ns=100.0, cycles=2000, bins=2, pulse=pulse, detector=detector, start="stationary")
    lines: list[Row] = []
    for rate in (1e5, 1e6, 1e7, 3e7, 1e8):
        flux = Flux(np.zeros((1, exposures)), rate * 1e-9 * system.period_ns, 0.0)
        measured = simulate(flux, system, seed=RETURN.seed).sum(-1).ravel() / (system.exposure_ns * 1e-9)
        error = float(measured.std(ddof=1)) / measured.size**0.5
        expected = constant_light_rate(rate, detector)
        lines.append(
            {
                "photons per s": rate,
                "simulated per s": float(measured.mean()),
                "predicted per s": expected,
                "z": (float(measured.mean()) - expected) / error,
                "dead time only per s": 1.0 / (1.0 / rate + detector.dead_time_ns * 1e-9),
            }
        )
    return lines


def _group(light: Light, outcomes: Sequence[Outcome]) -> Figure:
    figure, axes = panels(2.5, 1, 3)
    shape, counts, intervals = axes[0]
    system = light.system
    arrivals = photons_per_bin(light.pixel, system, bins=system.bins)
    shape.plot(system.time_ns, arrivals / system.bin_ns, color=INK, lw=0.6, ls=":", label="arrivals")
    scale = 1.0 / (system.cycles * system.bin_ns)
    for each, colour in zip(outcomes, [MUTED, *COLOURS], strict=False):
        some = each.histogram > 0
        shape.plot(system.time_ns[some][::2], each.histogram[some][::2] * scale, ".", ms=1.6, color=colour)
        number = np.bincount(each.counts) / each.counts.size
        n = np.flatnonzero(number)
        counts.plot(n, number[n], ".", ms=2.0, color=colour)
        if each.expected is None or each.law is None:
            shape.plot([], [], color=colour, lw=0.9, label=f"{each.example.name} (simulated only)")
        else:
            gaps = np.where(each.expected > 1e-9, each.expected * scale, np.nan)
            shape.plot(system.time_ns, gaps, color=colour, lw=0.9, label=each.example.name)
            drawn = np.isin(each.law.support, n)
            counts.plot(each.law.support[drawn], each.law.pmf[drawn], color=colour, lw=0.9)
        edges = np.linspace(0.0, _REACH, each.intervals.size + 1)
        intervals.stairs(np.where(each.intervals > 0, each.intervals, np.nan), edges, color=colour, lw=0.8)
    shape.set(xlabel="time in the period, ns", ylabel="registrations per period and ns", yscale="log")
    shape.set_title("mean histogram")
    counts.set(xlabel="registrations N in an exposure", ylabel="P(N)")
    counts.set_title("count law")
    intervals.set(xlabel="periods between registrations", ylabel="intervals per exposure", yscale="log")
    intervals.set_title("inter-registration times")
    intervals.set_xlim(0, _REACH)
    legend_below(figure, axes.flat, 4)
    return figure
