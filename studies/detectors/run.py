"""Study "detectors": what each mode of a detector does to the same flux, simulated and in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, System, count_law, simulate_timestamps
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.effects import AVALANCHE_EFFECTS
from mars_lidar.plot.style import COLOURS, INK, MUTED
from mars_lidar.statistics import mean_histogram
from mars_lidar.statistics.count_pmf import Pmf
from studies import Facts, Request
from studies.common.distance import g_test
from studies.common.draw import legend_below, panels
from studies.common.sample import settings_of

SIGNAL, BACKGROUND, DELAY_NS, DEAD_NS = 1.0, 1.0, 37.0, 45.0
LIGHT = {"signal S": SIGNAL, "background B": BACKGROUND, "delay_ns": DELAY_NS, "dead_time_ns": DEAD_NS}
SEED = 20
REACH = 3.0  # periods of inter-registration times that are drawn


@dataclass(frozen=True)
class Example:
    """A detector, its name in figures and tables, and the figure it belongs to."""

    name: str
    figure: str
    detector: Detector


def example_of(name: str, figure: str, **changes: Any) -> Example:
    """A detector of the common dead time but for `changes`."""
    return Example(name, figure, Detector(**{"dead_time_ns": DEAD_NS, **changes}))


EXAMPLES = (
    example_of("non-paralyzable", ""),
    example_of("paralyzable", "paralyzable", mode="paralyzable"),
    example_of("synchronous, no dead time", "synchronous", dead_time_ns=0.0, mode="synchronous"),
    example_of("synchronous", "synchronous", mode="synchronous"),
    example_of("gated", "gated", mode="gated", gate_start_ns=20.0, gate_width_ns=40.0),
    example_of(
        "moving gate", "gated", mode="gated", gate_start_ns=0.0, gate_width_ns=30.0, gate_step_ns=1.0, gate_cycles=5
    ),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One detector: simulated, and predicted where there is a prediction.

    `histogram` and `intervals` are means per exposure; `counts` (exposures,). `law` (n,) is P(N = n), or None.
    """

    example: Example
    system: System
    counts: NDArray[np.int64]
    histogram: FloatArray
    histogram_error: FloatArray
    intervals: FloatArray
    expected: FloatArray | None
    moments: tuple[float, float] | None
    law: FloatArray | None


_BINS_OF_INTERVALS = 150
_SIMULATED_ONLY = (*AVALANCHE_EFFECTS, "max_events_per_period", "max_events_per_exposure")


def run(request: Request) -> Facts:
    """Every mode; a figure for each."""

    exposures = 400 if request.quick else 40_000
    outcomes = []
    for example in EXAMPLES:
        request.tell(f"detectors: {example.name}")
        outcomes.append(outcome(example, exposures))
    rows = [row(each) for each in outcomes]
    return {
        "settings": settings_of(outcomes[0].system, LIGHT, exposures, SEED),
        "rows": rows,
        "figures": draw_all(outcomes),
    }


def outcome(example: Example, exposures: int) -> Outcome:
    """Simulate one detector, and predict what is known of it."""
    pulse = GaussianPulse(sigma_ns=1.0)
    system = System(period_ns=100.0, cycles=500, bins=200, pulse=pulse, detector=example.detector)
    coupled = example.detector.crosstalk is not None  # the exposures are then the pixels of one square image
    side = round(math.sqrt(exposures))
    flux = Flux(np.full((side, side) if coupled else (1, exposures), SIGNAL), BACKGROUND, DELAY_NS)
    times = simulate_timestamps(flux, system, engine="sequential" if coupled else "exact", seed=SEED)
    counts = times.counts.ravel()
    exposures = counts.size
    each = np.bincount(times.bin, minlength=system.bins) / exposures
    item = np.repeat(np.arange(exposures), counts)
    place, number = np.unique(item * system.bins + times.bin, return_counts=True)
    second = np.bincount(place % system.bins, number.astype(np.float64) ** 2, minlength=system.bins) / exposures
    apart = np.diff(times.times_ns)[item[1:] == item[:-1]] / system.period_ns
    intervals = np.histogram(apart, _BINS_OF_INTERVALS, (0.0, REACH))[0] / exposures
    expected, moments, law = _predicted(system)
    error = np.sqrt(np.maximum(second - each**2, 0.0) / exposures)
    return Outcome(example, system, counts, each, error, intervals, expected, moments, law)


def _predicted(system: System) -> tuple[FloatArray | None, tuple[float, float] | None, FloatArray | None]:
    if system.detector.gate_moves or set(system.detector.effects) & set(_SIMULATED_ONLY):
        return None, None, None
    expected = mean_histogram(Flux(SIGNAL, BACKGROUND, DELAY_NS), system)
    law = count_law(Flux(SIGNAL, BACKGROUND, DELAY_NS), system)
    pmf = np.zeros(int(law.support[-1]) + 1)
    pmf[law.support] = law.pmf
    return expected, (float(law.mean), float(law.variance)), pmf


def row(each: Outcome) -> dict[str, Any]:
    """One line of the table."""
    n = each.counts.size
    mean, variance = float(each.counts.mean()), float(each.counts.var(ddof=1))
    line: dict[str, Any] = {"detector": each.example.name, "simulated mean": mean, "simulated variance": variance}
    if each.moments is None or each.expected is None or each.law is None:
        words = ("predicted mean", "predicted variance", "z mean", "z variance", "worst z of a bin", "p of the law")
        return line | dict.fromkeys(words, "-")
    fourth = float(np.mean((each.counts - mean) ** 4))
    selected = each.histogram_error > 0
    z = (each.histogram[selected] - each.expected[selected]) / each.histogram_error[selected]
    return line | {
        "predicted mean": each.moments[0],
        "predicted variance": each.moments[1],
        "z mean": (mean - each.moments[0]) / math.sqrt(each.moments[1] / n),
        "z variance": (variance - each.moments[1]) / math.sqrt((fourth - variance**2) / n),
        "worst z of a bin": float(np.abs(z).max()),
        "p of the law": g_test(Pmf(0, each.law), Pmf.of_counts(each.counts), n),
    }


def draw_all(outcomes: Sequence[Outcome]) -> dict[str, Figure]:
    """A figure for each group of detectors, the free-running pixel in all of them."""
    groups = dict.fromkeys(each.example.figure for each in outcomes if each.example.figure)
    return {name: _group([each for each in outcomes if each.example.figure in ("", name)]) for name in groups}


def _group(examples: Sequence[Outcome]) -> Figure:
    figure, axes = panels(2.5, 1, 3)
    left_axes, middle, right = axes[0]
    system = examples[0].system
    energy = SIGNAL * system.pulse.bin_energy(DELAY_NS, system.period_ns, system.bins) + BACKGROUND / system.bins
    left_axes.plot(system.time_ns, energy / system.bin_ns, color=INK, lw=0.6, ls=":", label="arrivals")
    for each, colour in zip(examples, [MUTED, *COLOURS], strict=False):
        _histogram(left_axes, each, colour)
        number = np.bincount(each.counts) / each.counts.size
        n = np.flatnonzero(number)
        middle.plot(n, number[n], ".", ms=2.0, color=colour)
        if each.law is not None:
            middle.plot(n, np.pad(each.law, (0, max(0, number.size - each.law.size)))[n], color=colour, lw=0.9)
        edges = np.linspace(0.0, REACH, each.intervals.size + 1)
        right.stairs(np.where(each.intervals > 0, each.intervals, np.nan), edges, color=colour, lw=0.8)
    left_axes.set(xlabel="time in the period, ns", ylabel="registrations per period and ns", yscale="log")
    left_axes.set_title("mean histogram")
    middle.set(xlabel="registrations N in an exposure", ylabel="P(N)")
    middle.set_title("count law")
    right.set(xlabel="periods between registrations", ylabel="intervals per exposure", yscale="log")
    right.set_title("inter-registration times")
    right.set_xlim(0, REACH)
    legend_below(figure, axes.flat, 4)
    return figure


def _histogram(ax: Axes, each: Outcome, colour: str) -> None:
    system = each.system
    scale = 1.0 / (system.cycles * system.bin_ns)
    selected = each.histogram > 0
    ax.plot(system.time_ns[selected][::2], each.histogram[selected][::2] * scale, ".", ms=1.6, color=colour)
    label = each.example.name
    if each.expected is None:
        ax.plot([], [], color=colour, lw=0.9, label=f"{label} (simulated only)")
        return
    inside = each.expected > 1e-9
    gaps = np.where(inside, each.expected * scale, np.nan)
    ax.plot(system.time_ns, gaps, color=colour, lw=0.9, label=label)
