"""Streams of known light and a measured one: simulated, calibrated and validated."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import (
    Detector,
    Flux,
    GaussianPulse,
    System,
    Timestamps,
    Validation,
    calibrate,
    simulate_timestamps,
    validate,
)
from mars_lidar.calibrate import calibration_bound
from studies import Tell
from studies.common.report import picked

PERIOD_NS, DEAD_NS, SIGMA_NS, DELAY_NS, BINS = 1e3 / 7.5, 85.0, 0.5, 40.0, 1024
AT_FLOOR = 1.15  # times the floor that matched pixels may have
EXAMPLE_UNIT_NS = 0.064  # of the times in the measured stream


@dataclass(frozen=True)
class Settings:
    """Configuration: cycles and realizations of each part."""

    cycles: int = 9975  # of a realization, as in the paper
    realizations: int = 10_000  # of the bright and the dark pixel, as in the paper
    swept_cycles: int = 1000
    swept_realizations: int = 1000
    fault_cycles: int = 2000
    fault_realizations: int = 1000
    replicates: int = 60
    replicate_cycles: int = 20_000
    example_cycles: int = 100
    fluxes: tuple[float, ...] = (0.05, 0.5, 5.0)
    signals: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
    delays: tuple[float, ...] = (0.2, 20.0, 60.0, 100.0, 133.0)
    alarms: int = 125  # streams of `replicate_cycles` for each way of calibrating
    alarm_cycles: int = 100
    sensed: int = 8  # streams of each weak mismatch
    mismatched: int = 100  # the first so many of `mismatches.MISMATCHES`
    seed: int = 2026


FULL = Settings()
QUICK = Settings(
    cycles=500,
    realizations=300,
    swept_cycles=200,
    swept_realizations=200,
    fault_cycles=500,
    fault_realizations=200,
    replicates=8,
    replicate_cycles=4000,
    fluxes=(0.5,),
    signals=(0.1, 3.0),
    delays=(0.2,),
    alarms=2,
    sensed=1,
    mismatched=4,
)

PIXELS = {"bright": (0.8, 0.1), "dark": (0.25, 0.1)}  # the paper's S and B are not known


@dataclass(frozen=True, eq=False)
class Case:
    """A stream, what made it (S, B, delay in ns), and how its validation ended."""

    name: str
    truth: tuple[float, float, float]
    found: Validation

    @property
    def ratio(self) -> float:
        """Total variation of the count law over its floor."""
        return self.found.total_variation / self.found.total_variation_floor[0]

    @property
    def verdict(self) -> str:
        """In words."""
        return "fits" if self.found.consistent else "does not fit"

    @property
    def failed(self) -> list[str]:
        """Tests that failed."""
        return [check.name for check in self.found.failed] + ["short intervals"] * self.found.too_short

    @property
    def findings(self) -> list[str]:
        """What the recovery says; nothing where it was predicted by simulation of the detector, effects and all."""
        return self.found.recovery.findings() if self.found.prediction.recovery is None else []

    @property
    def scores(self) -> tuple[float, float, float]:
        """(calibrated - true) / standard error of S, B and delay, of a single return."""
        light = self.found.calibration
        errors = light.errors
        got = (light.signal, light.background, light.delay_ns)
        names = ("signal", "background", "delay_ns")
        return tuple(  # type: ignore[return-value]
            (value - true) / errors.get(name, np.nan) for value, true, name in zip(got, self.truth, names, strict=True)
        )


def system_of(cycles: int, detector: Detector | None = None) -> System:
    """The paper's laser and detector, started ready as a recording is."""
    return System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=BINS,
        pulse=GaussianPulse(sigma_ns=SIGMA_NS),
        detector=Detector(dead_time_ns=DEAD_NS) if detector is None else detector,
    )


def recorded(times: Timestamps) -> Timestamps:
    """The stream as a laboratory has it: without what it knows of light and detector."""
    return replace(times, info={"source": "simulated"})


def stream_of(
    light: Flux, cycles: int, seed: int, detector: Detector | None = None, engine: str = "exact"
) -> Timestamps:
    """A recording of one pixel in that light."""
    return recorded(simulate_timestamps(light, system_of(cycles, detector), seed=seed, engine=engine))


def matched(settings: Settings, tell: Tell) -> list[Case]:
    """The bright and the dark pixel: one continuous stream each, with pulse and dead time known."""
    cases = []
    for number, (name, (signal, background)) in enumerate(PIXELS.items()):
        tell(f"hardware: {name} pixel, {settings.realizations:,} realizations of {settings.cycles:,} cycles")
        light = Flux(signal, background, DELAY_NS)
        times = stream_of(light, settings.cycles * settings.realizations, settings.seed + number)
        known = system_of(settings.cycles)
        found = validate(times, calibrate(times, known), cycles=settings.cycles)
        cases.append(Case(name, (signal, background, DELAY_NS), found))
    return cases


def sweeps(settings: Settings, tell: Tell) -> list[Case]:
    """Distance, dynamic range, and several returns: width of the pulse fitted, dead time known."""
    seed = settings.seed + 100
    cases = []
    tell("hardware: sweeps")
    for k, delay in enumerate(settings.delays):
        name = f"distance, delay {delay:g} ns"
        cases.append(_swept(settings, name, (0.8, 0.1, delay), Flux(0.8, 0.1, delay), seed + k))
    for k, signal in enumerate(settings.signals):
        name, light = f"dynamic range, S = {signal:g}", Flux(signal, 0.1, DELAY_NS)
        cases.append(_swept(settings, name, (signal, 0.1, DELAY_NS), light, seed + 20 + k))
    two = Flux.multi(Flux(0.5, 0.1, 30.0), Flux(0.3, 0.0, 34.0))
    truth = (0.8, 0.1, 30.0)
    cases.append(_swept(settings, "two returns, 4 ns apart", truth, two, seed + 40, returns=2))
    three = Flux.multi(two, Flux(0.1, 0.0, 90.0))
    cases.append(_swept(settings, "three returns", (0.9, 0.1, 30.0), three, seed + 41, returns=3))
    return cases


def _swept(
    settings: Settings, name: str, truth: tuple[float, float, float], light: Flux, seed: int, returns: int = 1
) -> Case:
    times = stream_of(light, settings.swept_cycles * settings.swept_realizations, seed)
    found = calibrate(times, dead_time_ns=DEAD_NS, returns=returns)
    return Case(name, truth, validate(times, found, cycles=settings.swept_cycles))


def joined(parts: list[Timestamps]) -> Timestamps:
    """Recordings of one pixel, one after the other, as a single one."""
    begins = np.cumsum([0, *(part.cycles for part in parts)])
    cycle = np.concatenate([part.cycle + begin for part, begin in zip(parts, begins, strict=False)])
    times_ns = np.concatenate(
        [part.times_ns + begin * part.period_ns for part, begin in zip(parts, begins, strict=False)]
    )
    bins = np.concatenate([part.bin for part in parts])
    offsets = np.array([0, times_ns.size], np.int64)
    return replace(
        parts[0], times_ns=times_ns, cycle=cycle.astype(np.int32), bin=bins, offsets=offsets, cycles=int(begins[-1])
    )


def spreads(settings: Settings, tell: Tell) -> list[dict[str, Any]]:
    """Calibrations of many short streams of the same light: estimates over the truth and the Cramer-Rao bound.

    Each (3,): background, signal, delay. ``bias`` in standard errors of the mean of the replicates, ``scatter`` the
    standard deviation of the estimates and ``stated`` the mean stated standard error, both over the bound; ``rapp``
    the scatter of Rapp's total over that of the likelihood's.
    """
    rows = []
    known = system_of(settings.replicate_cycles)
    for number, (signal, background) in enumerate(itertools.product(settings.fluxes, repeat=2)):
        tell(f"hardware: calibrations of S = {signal:g}, B = {background:g}")
        flux = Flux(np.full((1, settings.replicates), signal), background, DELAY_NS)
        times = simulate_timestamps(flux, known, seed=settings.seed + 300 + number)
        truth = np.array([background, signal, DELAY_NS])
        bound = np.array(list(calibration_bound(signal, background, known, delay_ns=DELAY_NS).errors.values()))
        found = [calibrate(times.pixel(0, k), known) for k in range(settings.replicates)]
        got = np.array([[one.background, one.signal, one.delay_ns] for one in found])
        stated = np.array([list(one.errors.values()) for one in found])
        scatter = got.std(0, ddof=1)
        totals, rapp = np.array([one.total for one in found]), np.array([one.rapp.total for one in found])
        rows.append(
            {
                "signal": signal,
                "background": background,
                "registrations": len(times) / len(found),
                "bias": (got.mean(0) - truth) / (scatter / np.sqrt(len(found))),
                "scatter": scatter / bound,
                "stated": stated.mean(0) / bound,
                "rapp": float(rapp.std() / totals.std()) if np.isfinite(rapp).all() else float("inf"),
            }
        )
    return rows


def example(path: Path, settings: Settings, tell: Tell) -> dict[str, Any]:
    """The stream of a TCSPC instrument, light of any shape, two dead times (``told`` by the file), few photons.

    ``cases`` are the ways in which it is calibrated, each validated.
    """
    import h5py

    tell(f"hardware: {path.name}")
    times = Timestamps.load(path, unit_ns=EXAMPLE_UNIT_NS)
    with h5py.File(path) as file:
        told = {
            name: float(np.asarray(file[name])[0, 0]) * EXAMPLE_UNIT_NS
            for name in ("DT_electronics", "DT_detector")
            if name in file
        }
    electronics, detector = told.get("DT_electronics"), told.get("DT_detector")
    ways: list[tuple[str, dict[str, Any]]] = [("free shape, dead time by the smallest interval", {"pulse": "free"})]
    if electronics is not None and detector is not None:
        ways += [
            (f"free shape, t_e = {electronics:g} ns", {"pulse": "free", "dead_time_ns": electronics}),
            (
                f"free shape, t_e, hold-off t_e + t_d = {electronics + detector:g} ns",
                {"pulse": "free", "dead_time_ns": electronics, "hold_off_ns": electronics + detector},
            ),
            (f"free shape, t_d = {detector:g} ns alone", {"pulse": "free", "dead_time_ns": detector}),
            ("Gaussian pulse, t_e", {"pulse": "gaussian", "dead_time_ns": electronics}),
        ]
    cases = [(name, validate(times, calibrate(times, **way), cycles=settings.example_cycles)) for name, way in ways]
    return {**picked(times, "cycles period_ns"), "registrations": len(times), "told": told, "cases": cases}
