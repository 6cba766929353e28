"""Study "returns": false returns, the resolution of two returns, and the coverage of their errors."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, System, reconstruct, simulate
from mars_lidar.plot.colours import COLOURS, INK
from mars_lidar.reconstruction import MaximumLikelihood, returns_bound
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.report import Row

SEED = 20
MOST = 3  # returns that are looked for
FALSE_ALARM = 0.01
RARE = 0.001
DELAY_NS = 37.013
COVERS = {"68 %": 1.0, "95 %": 1.96}
SYSTEM = System(
    period_ns=100.0, cycles=4000, bins=500, pulse=GaussianPulse(sigma_ns=0.5), detector=Detector(dead_time_ns=75.3)
)
SIGMA_NS = 0.5
SEPARATIONS = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0)  # sigma


def with_dead(dead_ns: float, *, cycles: int = 4000, bins: int = 500, start: str = "armed", **detector: Any) -> System:
    """`SYSTEM` with another detector."""
    return SYSTEM.replace(cycles=cycles, bins=bins, start=start, detector=Detector(dead_time_ns=dead_ns, **detector))


_GATE: dict[str, Any] = {"mode": "gated", "gate_start_ns": 80.03, "gate_width_ns": 40.0}
# of one return: system, S, S / B
ALONE = (
    (with_dead(0.0), 0.01, 1.0),
    (with_dead(0.0, cycles=20_000), 0.01, 0.1),
    (with_dead(0.0), 1.0, 1.0),
    (with_dead(0.0, cycles=1000), 5.0, 10.0),
    (with_dead(0.1), 1.0, 1.0),
    (with_dead(2.5), 3.0, 1.0),
    (with_dead(20.0), 1.0, 0.05),
    (with_dead(30.0), 0.05, 0.3),
    (with_dead(75.3), 0.005, 50.0),
    (with_dead(75.3), 0.02, 10.0),
    (with_dead(75.3), 0.1, 100.0),
    (with_dead(75.3), 1.0, 0.2),
    (with_dead(75.3), 2.0, 0.1),
    (with_dead(75.3), 3.0, 3.0),
    (with_dead(75.3, cycles=1000), 5.0, 1.0),
    (with_dead(75.3, cycles=20_000), 5.0, 1.0),
    (with_dead(75.3, cycles=20_000, bins=250), 3.0, 1.0),
    (with_dead(75.3, cycles=20_000, bins=100), 3.0, 1.0),
    (with_dead(75.3, start="stationary"), 1.0, 1.0),
    (with_dead(100.0), 5.0, 10.0),
    (with_dead(130.7), 2.0, 1.0),
    (with_dead(253.3, cycles=10_000), 2.0, 4.0),
    (with_dead(253.3, cycles=1000), 5.0, 1.0),
    (with_dead(75.0, mode="synchronous"), 2.0, 1.0),
    (with_dead(75.0, cycles=1000, mode="synchronous"), 5.0, 1.0),
    (with_dead(45.0, **_GATE), 1.0, 1.0),
)
# of two returns: dead time, S of the nearer, S of the farther, B
PAIRS = (
    (0.0, 0.1, 0.1, 0.5),
    (0.0, 1.0, 0.3, 1.0),
    (75.3, 0.5, 0.5, 0.5),
    (75.3, 0.1, 0.05, 0.5),
    (75.3, 0.03, 0.03, 0.02),
    (75.3, 2.0, 0.5, 0.5),
    (75.3, 3.0, 2.0, 0.3),
    (130.7, 0.5, 0.5, 2.0),
    (253.3, 0.5, 1.0, 0.5),
)


@dataclass(frozen=True)
class Settings:
    """Pixels of a case, pixels at the rare level, cycles of the curves of resolution, and every how many-th case."""

    pixels: int
    rare: int
    cycles: tuple[int, ...]
    every: int = 1


FULL = Settings(1000, 10_000, (400, 4000, 40_000))
QUICK = Settings(100, 200, (4000,), every=6)


def run(settings: Settings, request: Request) -> Facts:
    """False alarms, pairs of returns, and curves of resolution."""
    request.tell("returns: false alarms")
    alarms = list(false_alarms(settings))
    rows = []
    for dead, first, second, background in PAIRS[:: settings.every]:
        request.tell(f"returns: dead time {dead:g} ns, S = {first:g} and {second:g}")
        for apart in SEPARATIONS:
            rows.append(pair(with_dead(dead), (first, second), background, apart, settings.pixels))
    curves = []
    for cycles in settings.cycles:
        request.tell(f"returns: resolution, {cycles} cycles")
        for apart in np.geomspace(0.3, 6.0, 12):
            system = with_dead(75.3, cycles=cycles)
            curves.append({"cycles": cycles} | pair(system, (0.5, 0.5), 0.5, float(apart), settings.pixels // 2))
    return {
        "alarms": alarms,
        "worst": max(alarms, key=lambda row: row["extra %"]),
        "pairs": [row for row in rows if row["separation"] in (1.0, 1.5, 2.0, 5.0, 20.0)],
        "held": held(rows),
        "limits": [limit(curves, cycles) for cycles in settings.cycles],
        "times": timings(settings),
        "rows": rows,
        "figures": {"": _figure(curves, rows)},
    }


def false_alarms(settings: Settings) -> Iterator[Row]:
    """Pixels of one return, and of two, in which another was detected."""
    for system, signal, sbr in ALONE[:: settings.every]:
        yield alarm(system, (signal,), signal / sbr, settings.pixels, FALSE_ALARM)
    for dead, first, second, background in PAIRS[:: settings.every]:
        yield alarm(with_dead(dead), (first, second), background, settings.pixels, FALSE_ALARM)
    yield alarm(with_dead(75.3), (1.0,), 1.0, settings.rare, RARE)
    yield alarm(with_dead(75.3), (0.1,), 0.01, settings.rare, RARE)


def histograms(
    system: System, signals: Sequence[float], background: float, delays: Iterable[Any], pixels: int
) -> NDArray[Any]:
    """One exposure of each of `pixels` (pixels, bins) with one or two returns: `signals` at `delays`, ns."""
    each = zip(signals, (background, 0.0), delays, strict=False)
    parts = [Flux(np.full(pixels, s), b, delay) for s, b, delay in each]
    return np.asarray(simulate(Flux.multi(*parts), system, seed=SEED)[0, 0])


def alarm(system: System, signals: tuple[float, ...], background: float, pixels: int, level: float) -> Row:
    """A line: of the pixels in which all returns were detected, how many show one more."""
    random = np.random.default_rng(SEED)
    gated = system.detector.mode == "gated"
    delay = 90.0 + 15.0 * random.random(pixels) if gated else 100.0 * random.random(pixels)
    cube = histograms(system, signals, background, [delay + 20.0 * k for k in range(len(signals))], pixels)
    estimate = reconstruct(cube, system, MaximumLikelihood(false_alarm=level), returns=MOST)
    assert estimate.returns is not None
    detected = estimate.returns.count >= len(signals)
    more = int((estimate.returns.count > len(signals)).sum())
    return {
        "mode": system.detector.mode,
        "start": system.start,
        "dead time ns": system.detector.dead_time_ns,
        "cycles": system.cycles,
        "bin ns": system.bin_ns,
        "S": " + ".join(f"{s:g}" for s in signals),
        "B": background,
        "pixels": int(detected.sum()),
        "level %": 100.0 * level,
        "extra %": 100.0 * more / max(int(detected.sum()), 1),
        "+-": 100.0 * np.sqrt(max(more, 1)) / max(int(detected.sum()), 1),
    }


def pair(system: System, signals: tuple[float, float], background: float, apart: float, pixels: int) -> dict[str, Any]:
    """A line: how often two returns so many sigma apart are both detected, and how well their errors hold then."""
    delay = DELAY_NS + SIGMA_NS * np.array([0.0, apart])
    cube = histograms(system, signals, background, delay, pixels)
    returns = reconstruct(cube, system, returns=MOST).returns
    assert returns is not None
    both = returns.count == 2
    bound = returns_bound(
        Flux.multi(*(Flux(s, 0.5 * background, tau) for s, tau in zip(signals, delay, strict=True))), system
    )
    off = {
        "depth": ((returns.delay_ns[both, :2] - delay), returns.delay_error_ns[both, :2], bound.delay_ns),
        "S": ((returns.signal[both, :2] - np.array(signals)), returns.signal_error[both, :2], bound.signal),
    }
    line: dict[str, Any] = {
        "dead time ns": system.detector.dead_time_ns,
        "S": " + ".join(f"{s:g}" for s in signals),
        "B": background,
        "separation": apart,
        "both detected %": 100.0 * float(both.mean()),
    }
    for what, (error, stated, least) in off.items():
        for words, times in COVERS.items():
            # the lesser share, %, of two returns whose interval holds the truth
            inside = np.abs(error) <= times * stated
            line[f"{what} in {words}"] = 100.0 * float(inside.mean(0).min()) if both.any() else np.nan
        scatters = {"error": error.std(0), "stated": np.nanmedian(stated, 0)} if both.sum() > 1 else {}
        for name in ("error", "stated"):
            line[f"{what} {name} / bound"] = float(np.max(scatters.get(name, np.nan) / least))
    return line


def held(rows: list[dict[str, Any]]) -> list[Row]:
    """The worst coverage of all pairs by how surely they are detected."""
    lines: list[Row] = []
    for low, high in ((99.0, 101.0), (90.0, 99.0), (50.0, 90.0), (5.0, 50.0)):
        mine = [row for row in rows if low <= row["both detected %"] < high]
        if not mine:
            continue
        words = f"{low:g} % and more" if high > 100 else f"{low:g} to {high:g} %"
        line: dict[str, Any] = {"both detected": words, "cases": len(mine)}
        for what in ("depth", "S"):
            for share in COVERS:
                line[f"{what} in {share}, least"] = min(row[f"{what} in {share}"] for row in mine)
                line[f"{what} in {share}, median"] = float(np.median([row[f"{what} in {share}"] for row in mine]))
        lines.append(line)
    return lines


def limit(curves: list[dict[str, Any]], cycles: int) -> Row:
    """The separation, in sigma, at which half and nine tenths of the pairs are detected as two."""
    mine = [row for row in curves if row["cycles"] == cycles]
    share = np.maximum.accumulate([row["both detected %"] for row in mine])
    apart = np.array([row["separation"] for row in mine])
    return {
        "cycles": cycles,
        "photons of each": 0.5 * cycles,
        "half detected, sigma": float(np.interp(50.0, share, apart)),
        "90 % detected, sigma": float(np.interp(90.0, share, apart)),
    }


def timings(settings: Settings) -> list[Row]:
    """Processor seconds of 1000 pixels of one and of two returns."""
    lines: list[Row] = []
    for signals in ((1.0,), (0.5, 0.5)):
        cube = histograms(SYSTEM, signals, 0.5, (37.0, 42.0)[: len(signals)], settings.pixels)
        line: dict[str, Any] = {"returns there": len(signals)}
        for most in (1, MOST):
            began = time.process_time()
            reconstruct(cube, SYSTEM, returns=most)
            line[f"returns={most}, s for 1000 pixels"] = 1000.0 * (time.process_time() - began) / settings.pixels
        lines.append(line)
    return lines


def _figure(curves: Sequence[Row], rows: Sequence[Row]) -> Figure:
    """How often two returns are both detected, over their separation; and how often their intervals hold the truth."""
    figure, axes = panels(2.9, 1, 2)
    left_axes, right = axes[0]
    for colour, cycles in zip(COLOURS, dict.fromkeys(row["cycles"] for row in curves), strict=False):
        mine = [row for row in curves if row["cycles"] == cycles]
        label = f"{0.5 * cycles:g} photons each"
        left_axes.plot(*_line(mine, "both detected %"), "o-", ms=2.5, lw=1.0, color=colour, label=label)
    left_axes.set(xscale="log", xlabel="separation (sigma of the pulse)", ylabel="both detected (%)")
    left_axes.legend(frameon=False, loc="lower right")
    for what, colour in (("depth", COLOURS[0]), ("S", COLOURS[1])):
        for words, marker in (("95 %", "o"), ("68 %", "s")):
            sure = [row for row in rows if row["both detected %"] >= 90.0]
            label = f"{what}, intervals of {words}"
            right.plot(*_line(sure, f"{what} in {words}"), marker, ms=3, mfc="none", color=colour, label=label)
    for share in (95.0, 68.27):
        right.axhline(share, color=INK, lw=0.7, ls="--")
    right.set(xscale="log", xlabel="separation (sigma of the pulse)", ylabel="intervals that hold the truth (%)")
    for ax in (left_axes, right):
        ax.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
        ax.minorticks_off()
    left_axes.set_xlim(0.28, 6.5)
    legend_below(figure, [right], 4, handlelength=1.2, columnspacing=1.0)
    return figure


def _line(rows: Sequence[Row], name: str) -> tuple[list[float], list[float]]:
    return [row["separation"] for row in rows], [row[name] for row in rows]
