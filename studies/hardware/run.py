"""Study "hardware", T6 of the MaRS paper: calibrated streams, their tests of fit, compared with the paper.

Streams of known light, of detectors with effects, and a measured one: calibrated, and their counts compared.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from matplotlib.figure import Figure

from mars_lidar import Afterpulsing, Calibration, Detector, Flux, Jitter, Timestamps, calibrate, simulate_timestamps
from mars_lidar.calibration.realizations import Realizations
from mars_lidar.plot.colours import COLOURS, MUTED
from mars_lidar.plot.stream import calibration
from studies import Facts, Request, Tell
from studies.common.draw import panels
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, system_of

DEAD_NS, DELAY_NS = 85.0, 40.0
EXAMPLE_UNIT_NS = 0.064  # of the times in the measured stream
PIXELS = {"bright": (0.8, 0.1), "dark": (0.25, 0.1)}  # the paper's S and B are not known


@dataclass(frozen=True)
class Settings:
    """Configuration: cycles and realizations of each part."""

    cycles: int = 9975  # of a realization, as in the paper
    realizations: int = 1000  # of the bright and the dark pixel; the paper has 10,000
    swept_photons: int = 60_000
    fault_photons: int = 100_000
    example_cycles: int = 100
    signals: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
    delays: tuple[float, ...] = (0.2, 60.0, 133.0)
    faults: int = 100  # the first so many of `FAULTS`
    seed: int = 2026


FULL = Settings()
QUICK = Settings(
    cycles=300, realizations=100, swept_photons=6000, fault_photons=8000, signals=(0.3,), delays=(), faults=2
)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A detector, what of it is given, and the suspect that should be named."""

    name: str
    detector: Detector | None = None
    given: Mapping[str, Any] | None = None
    suspect: str | None = None
    background: float = 0.1
    fits: bool = True


def _detector(**effects: Any) -> Detector:
    return Detector(dead_time_ns=DEAD_NS, **effects)


FAULTS = (
    Fault(name="none (control)"),
    Fault(name="dead time given 5 ns too short", given={"dead_time_ns": 80.0}, fits=False),
    Fault(name="dead time given 0.5 ns too short", given={"dead_time_ns": 84.5}, fits=False),
    Fault(name="jitter 0.2 ns", detector=_detector(jitter=Jitter(sigma_ns=0.2))),
    Fault(
        name="afterpulses 5 % of mean delay 100 ns",
        detector=_detector(afterpulsing=Afterpulsing(probability=0.05, delay_ns=100.0)),
        suspect="afterpulses",
    ),
    Fault(name="twilight 0.5 ns", detector=_detector(twilight_ns=0.5), suspect="twilight pulses"),
    Fault(name="slow recovery of 2 ns", detector=_detector(recovery_ns=2.0), suspect="slow recovery"),
    Fault(
        name="paralyzable detector, B = 1",
        detector=_detector(mode="paralyzable"),
        background=1.0,
        suspect="paralyzable detector",
    ),
    Fault(
        name="electronics dead for 102 ns, B = 1",
        detector=_detector(electronics_dead_time_ns=1.2 * DEAD_NS),
        background=1.0,
        suspect="electronics with a dead time of their own",
    ),
)


@dataclass(frozen=True, eq=False)
class Case:
    """A stream, what made it (S, B, delay in ns), its calibration, and its counts beside the model's."""

    name: str
    truth: tuple[float, float, float]
    result: Calibration
    counts: Realizations | None = None
    fault: Fault | None = None

    @property
    def scores(self) -> tuple[float, ...]:
        """(calibrated - true) / stated error of S, B and delay."""
        out = []
        for name, true in zip(("signal", "background", "delay_ns"), self.truth, strict=True):
            estimate = self.result.estimates.get(name)
            known = estimate is not None and estimate.error > 0.0
            out.append((estimate.value - true) / estimate.error if known and estimate is not None else float("nan"))
        return tuple(out)

    @property
    def suspects(self) -> list[str]:
        """Names of the suspects."""
        return [suspect.name for suspect in self.result.suspects]

    @property
    def right(self) -> bool:
        """Whether the verdict and the named suspect are what the fault should give."""
        if self.fault is None or self.fault.suspect is None:
            return self.result.fits == (self.fault is None or self.fault.fits)
        return self.fault.suspect in self.suspects


def stream_of(light: Flux, cycles: int, seed: int, detector: Detector | None = None) -> Timestamps:
    """A recording of one pixel in that light, without what it knows of light and detector."""
    system = system_of(DEAD_NS, cycles).replace(detector=detector or Detector(dead_time_ns=DEAD_NS))
    made = simulate_timestamps(light, system, seed=seed)
    return replace(made, info={"source": "simulated"})


def _cycles(photons: int, signal: float, background: float) -> int:
    return int(photons * (1.0 / (1.0 - np.exp(-signal - background)) + DEAD_NS / PERIOD_NS))


def pixels_of(settings: Settings, tell: Tell) -> list[Case]:
    """The paper's bright and dark pixel: one continuous stream each, nothing given."""
    cases = []
    for number, (name, (signal, background)) in enumerate(PIXELS.items()):
        tell(f"hardware: {name} pixel, {settings.realizations:,} realizations of {settings.cycles:,} cycles")
        light = Flux(signal, background, DELAY_NS)
        times = stream_of(light, settings.cycles * settings.realizations, settings.seed + number)
        result = calibrate(times)
        drawn = max(200, 2 * settings.realizations)
        counts = result.realizations(settings.cycles, simulated=drawn)
        cases.append(Case(name, (signal, background, DELAY_NS), result, counts))
    return cases


def sweeps(settings: Settings, tell: Tell) -> list[Case]:
    """Dynamic range and distance, nothing given."""
    tell("hardware: sweeps")
    wanted = [(f"S = {signal:g}", signal, DELAY_NS) for signal in settings.signals]
    wanted += [(f"delay {delay:g} ns", 0.8, delay) for delay in settings.delays]
    cases = []
    for number, (name, signal, delay) in enumerate(wanted):
        cycles = _cycles(settings.swept_photons, signal, 0.1)
        times = stream_of(Flux(signal, 0.1, delay), cycles, settings.seed + 20 + number)
        cases.append(Case(name, (signal, 0.1, delay), calibrate(times)))
    return cases


def faults_of(settings: Settings, tell: Tell) -> list[Case]:
    """Each of `FAULTS`: the suspect should be named."""
    cases = []
    for number, fault in enumerate(FAULTS[: settings.faults]):
        tell(f"hardware: {fault.name}")
        signal = PIXELS["bright"][0]
        cycles = _cycles(settings.fault_photons, signal, fault.background)
        light = Flux(signal, fault.background, DELAY_NS)
        times = stream_of(light, cycles, settings.seed + 200 + number, fault.detector)
        result = calibrate(times, fault.given)
        cases.append(Case(fault.name, (signal, fault.background, DELAY_NS), result, fault=fault))
    return cases


def example(path: Path, settings: Settings, tell: Tell) -> list[Case]:
    """The measured stream in each of several ways."""
    tell(f"hardware: {path.name}")
    times = Timestamps.load(path, unit_ns=EXAMPLE_UNIT_NS)
    ways: list[tuple[str, dict[str, Any]]] = [("free shape", {"pulse": "free"}), ("Gaussian pulse", {})]
    with h5py.File(path) as file:
        if "DT_electronics" in file and "DT_detector" in file:
            electronics, detector = (
                float(np.asarray(file[name])[0, 0]) * EXAMPLE_UNIT_NS for name in ("DT_electronics", "DT_detector")
            )
            known = {"dead_time_ns": detector, "electronics_dead_time_ns": electronics}
            ways.insert(1, ("free shape, both dead times given", {"pulse": "free", "given": known}))
    cases = []
    for name, way in ways:
        result = calibrate(times, **way)
        counts = result.realizations(settings.example_cycles)
        cases.append(Case(name, (float("nan"),) * 3, result, counts))
    return cases


def pixels_figure(cases: Sequence[Case]) -> Figure:
    """Law of the count of the matched pixels."""
    figure, axes = panels(2.4, 1, len(cases))
    for ax, case in zip(axes[0], cases, strict=True):
        drawn = case.counts
        assert drawn is not None
        measured, law = drawn.measured, drawn.predicted
        edges = measured.first - 0.5 + np.arange(measured.p.size + 1)
        ax.stairs(measured.p, edges, color=COLOURS[0], fill=True, alpha=0.45, label="recorded")
        ax.plot(law.first + np.arange(law.p.size), law.p, color=COLOURS[1], lw=1.0, label="model")
        ax.set(xlabel="registrations of a realization", ylabel="probability")
        words = f"{case.name}: TV {drawn.total_variation:.3g}, floor {drawn.total_variation_floor[0]:.3g}"
        ax.set_title(words, loc="left")
        ax.legend(frameon=False)
    return figure


def range_figure(cases: Sequence[Case]) -> Figure:
    """Calibrated over true signal and background, with three stated errors, over the signal."""
    chosen = [case for case in cases if case.name.startswith("S =") and "signal" in case.result.estimates]
    figure, axes = panels(2.4, 1, 2)
    for ax, name, which in zip(axes[0], ("signal", "background"), (0, 1), strict=True):
        true = np.array([case.truth[which] for case in chosen])
        value = np.array([case.result.estimates[name].value for case in chosen])
        error = np.array([case.result.estimates[name].error for case in chosen])
        ax.axhline(1.0, color=MUTED, lw=0.6)
        ax.errorbar([case.truth[0] for case in chosen], value / true, 3 * error / true, fmt=".", ms=4, color=COLOURS[0])
        ax.set(xscale="log", xlabel="signal S (photons per period)", ylabel=f"calibrated / true {name}")
    return figure


PAPER = {"bright": 0.0651, "dark": 0.0601}  # T6 of arXiv 2512.04924: total variation of the count law


def run(settings: Settings, request: Request) -> Facts:
    """All streams: the paper's pixels, sweeps, detectors with effects, and a measured one if there is one."""
    began = time.process_time()
    pixels = pixels_of(settings, request.tell)
    swept = sweeps(settings, request.tell)
    faults = faults_of(settings, request.tell)
    measured = [] if request.stream is None else example(request.stream, settings, request.tell)
    drawn = {"pixels": pixels_figure(pixels), "range": range_figure(swept)}
    if measured:
        drawn["measured"] = calibration(measured[0].result, measured[0].name)
    scores = [value for case in (*pixels, *swept) for value in case.scores if not np.isnan(value)]
    return {
        "pixels": pixels,
        "swept": swept,
        "scores": scores,
        "square": float(np.mean(np.square(scores))),
        "faults": faults,
        "measured": measured,
        "stream": None if request.stream is None else request.stream.name,
        "figures": drawn,
        "spent": time.process_time() - began,
        "rows": [_csv_row(case) for case in (*pixels, *swept, *faults, *measured)],
    }


def _csv_row(case: Case) -> Row:
    result = case.result
    row: dict[str, object] = {
        "stream": case.name,
        "true_signal": case.truth[0],
        "true_background": case.truth[1],
        "true_delay_ns": case.truth[2],
        "registrations": result.look.registrations,
        "p": result.p_value,
        "fits": result.fits,
        "suspects": "; ".join(case.suspects),
    }
    for name in ("signal", "background", "delay_ns", "dead_time_ns", "jitter_ns"):
        estimate = result.estimates.get(name)
        row[name] = float("nan") if estimate is None else estimate.value
        row[f"{name}_error"] = float("nan") if estimate is None else estimate.error
    counts = case.counts
    row["count_tv"] = float("nan") if counts is None else counts.total_variation
    row["count_tv_floor"] = float("nan") if counts is None else counts.total_variation_floor[0]
    return row
