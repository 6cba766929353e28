"""Eight kinds of streams and cubes of which earlier code was wrong, calibrated by this one.

``python -m tests.calibration.eight_points`` prints a Markdown table. The column *before* is what a referee measured by
the code of 23 November 2026, which stated errors by an exact likelihood without jitter; *now* is what this code gives.
``--stream FILE.mat`` adds the measured recording of docs/results/hardware.md, ``--points 1 4`` chooses some.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import mars_lidar as ml
from mars_lidar.calibration import Calibration, calibrate_cube
from mars_lidar.reconstruction import Flags
from tests.calibration.photon_by_photon import Truth, as_timestamps, photon_by_photon
from tests.calibration.sweep import ORDINARY, PULLED, outside, pulls, with_effect

UNIT_NS = 0.064  # of the times in the measured recording

BEFORE = {
    1: "delay 28 to 82 stated errors off in 9 of 10 streams, errors of 0.10 to 0.15 ps",
    2: "delay 9, 33 and 67 stated errors late",
    3: "dead time 1 to 2 ns too small with errors of 10 to 50 ps in 8 of 14 streams",
    4: "afterpulses and twilight of 0.5 and 2 ns not named; flicker called afterpulses",
    5: "dead times of 76.4 ± 4.7 and 80.7 ns for one file, and p = 0 with exit code 0; a given 33.024 ns printed as 80",
    6: "ten pieces scatter 8.8 times the stated error",
    7: "called slow recovery in 4 of 5 streams; a recovery of 2 ns called a jitter of 0.72 ns",
    8: "S = 0.483 ± 0.006 and 0.218 ± 0.004 for 0.6, no pixel flagged",
}


def calibrated(truth: Truth, photons: int, seed: int, **given: float) -> Calibration:
    """A stream of the independent simulator, calibrated."""
    t, cycles = photon_by_photon(truth, photons, seed)
    return ml.calibrate(as_timestamps(t, truth, cycles), given or None, seed=seed)


def worst(results: list[Calibration], truth: Truth, name: str) -> str:
    """The largest deviation of a parameter, its errors, and what else the results say."""
    z = np.abs([pulls(result, truth)[PULLED.index(name)] for result in results])
    errors = [result.estimates[name].error for result in results if name in result.estimates]
    missed = sum(name in outside(result, truth) for result in results)
    words = [f"at most {np.nanmax(z):.1f} stated errors off" if np.isfinite(z).any() else "no standard error"]
    words += [f"errors {np.nanmin(errors):.2g} to {np.nanmax(errors):.2g} ns"] if np.isfinite(errors).any() else []
    alone = int(np.isnan(z).sum())
    words += [f"{alone} of {len(results)} with an interval alone"] if alone else []
    return ", ".join([*words, f"{missed} of {len(results)} outside the 95 % interval"])


def short_pulse() -> str:
    """A pulse of 20 ps beside a jitter of 80 ps, nothing given."""
    truth = Truth(signal=0.3, background=0.5, delay=10.0, sigma=0.02, dead=25.0, period=32.768, jitter=0.08, unit=0.064)
    return "delay " + worst([calibrated(truth, 40_000, seed) for seed in range(10)], truth, "delay_ns")


def unknown_jitter() -> str:
    """A dead time that is given and a jitter that is not."""
    out = []
    for signal in (0.3, 1.0, 3.0):
        truth = replace(ORDINARY, signal=signal, dead=30.0, jitter=0.08, sigma=0.1)
        z = pulls(calibrated(truth, 20_000, 2, dead_time_ns=30.0), truth)[PULLED.index("delay_ns")]
        out.append(f"{z:+.1f}")
    return f"delay {', '.join(out)} stated errors off (S = 0.3, 1, 3)"


def dim_background() -> str:
    """A dead time of five periods in dim background."""
    light = Truth(signal=0.455, background=0.026, delay=5.0, sigma=0.1, dead=90.542, period=18.304)
    truth = replace(light, jitter=0.355, unit=0.064)
    return "dead time " + worst([calibrated(truth, 8_495, seed) for seed in range(14)], truth, "dead_time_ns")


def effects() -> str:
    """Afterpulses with and without a laser, twilight pulses, and flicker."""
    out = []
    for words, truth, photons in (
        ("afterpulses of 3 %", with_effect(ORDINARY, "afterpulses"), 100_000),
        ("twilight of 0.5 ns", with_effect(ORDINARY, "twilight"), 100_000),
        ("twilight of 2 ns", replace(ORDINARY, twilight=2.0), 100_000),
        ("flicker of 36 %", replace(ORDINARY, flicker=0.36, flicker_periods=1300), 20_000),
    ):
        result = calibrated(truth, photons, 5)
        out.append(f"{words}: {', '.join(suspect.name for suspect in result.suspects) or 'nothing'}")
    dark = replace(with_effect(ORDINARY, "afterpulses"), signal=1e-9, background=0.5)
    results = [ml.calibrate(photon_by_photon(dark, 40_000, seed)[0], unit_ns=UNIT_NS) for seed in range(5, 11)]
    named = sum([suspect.name for suspect in result.suspects] == ["afterpulses"] for result in results)
    out.append(f"afterpulses of 3 % without a laser: named in {named} of 6")
    return "; ".join(out)


def public_sample(path: Path) -> str:
    """The measured recording in three ways: printed values, values of the system, verdicts."""
    times = ml.Timestamps.load(path, unit_ns=UNIT_NS)
    free, gaussian = ml.calibrate(times, pulse="free"), ml.calibrate(times)
    given = ml.calibrate(times, {"dead_time_ns": 33.024, "electronics_dead_time_ns": 80.0}, pulse="free")
    dead = [result.estimates["dead_time_ns"] if result.estimates else "none" for result in (free, given)]
    written = free.system.detector.dead_time_ns if free.system else np.nan
    return (
        f"free shape {dead[0]} ns, p = {free.p_value:.2g}, system {written:.4g} ns; both dead times given: {dead[1]}, "
        f"p = {given.p_value:.2g}; Gaussian pulse p = {gaussian.p_value:.2g}: rejected"
    )


def pieces(path: Path) -> str:
    """Light of ten pieces of the measured recording, and dead times."""
    whole = ml.Timestamps.load(path, unit_ns=UNIT_NS)
    edges = np.linspace(0, len(whole), 11).astype(int)
    given = {"dead_time_ns": 33.024, "electronics_dead_time_ns": 80.0}
    light, held = [], 0
    for first, last in pairwise(edges):
        t = whole.times_ns[first:last] - np.floor(whole.times_ns[first] / whole.period_ns) * whole.period_ns
        truth = Truth(signal=1.0, background=1.0, delay=0.0, sigma=1.0, dead=1.0, period=whole.period_ns, unit=UNIT_NS)
        part = as_timestamps(t, truth, int(t[-1] / whole.period_ns) + 1)
        light.append(ml.calibrate(part, given, pulse="free").estimates["light"])
        dead = ml.calibrate(part, pulse="free").estimates["dead_time_ns"]
        held += dead.low <= given["electronics_dead_time_ns"] <= dead.high
    values, errors = (np.array([getattr(each, name) for each in light]) for name in ("value", "error"))
    ratio = np.nanstd(values, ddof=1) / np.sqrt(np.nanmean(errors**2))
    return (
        f"light of ten pieces scatters {ratio:.2f} times its stated error ({np.isnan(errors).sum()} have none); 95 % "
        f"intervals of the dead time hold the electronics' 80 ns in {held} of 10"
    )


def wide_jitter() -> str:
    """A Gaussian jitter of a third of the dead time; a recovery beside a jitter."""
    truth = Truth(signal=0.4, background=0.4, delay=30.0, sigma=0.3, dead=12.0, period=100.0, jitter=4.0, unit=0.064)
    results = [calibrated(truth, 40_000, seed) for seed in range(5)]
    suspects = sum(bool(result.suspects) for result in results)
    other = replace(with_effect(ORDINARY, "recovery"), jitter=0.72)
    stated = [
        f"p = {result.p_value:.2g}, {', '.join(suspect.name for suspect in result.suspects) or 'nothing'}, "
        f"{result.estimates.get('recovery_ns', 'none')} ns"
        for result in (calibrated(other, 100_000, seed) for seed in (5, 6, 7))
    ]
    p_values = [result.p_value for result in results]
    return (
        f"suspects in {suspects} of 5, p = {min(p_values):.2g} to {max(p_values):.2g}; dead time "
        f"{worst(results, truth, 'dead_time_ns')}; recovery of 2 ns beside a jitter of 0.72 ns: {'; '.join(stated)}"
    )


def histograms() -> str:
    """Pixels reconstructed with a wrong dead time and a wrong pulse, and what calibrates them."""

    def system(dead: float, sigma: float) -> ml.System:
        pulse, detector = ml.GaussianPulse(sigma_ns=sigma), ml.Detector(dead_time_ns=dead)
        return ml.System(period_ns=100.0, cycles=8000, bins=500, pulse=pulse, detector=detector)

    delay = np.random.default_rng(2).uniform(0.0, 100.0, (10, 10))
    counts = ml.simulate(ml.Flux(np.full((10, 10), 0.6), 0.4, delay), system(50.0, 0.3), seed=2)[0]
    out = []
    for words, wrong in (("dead time 5 ns for 50", system(5.0, 0.3)), ("pulse 0.03 ns for 0.3", system(50.0, 0.03))):
        estimate = ml.reconstruct(counts, wrong, threads=1)
        share = float((estimate.flags & Flags.MISFIT > 0).mean())
        stated = calibrate_cube(counts, wrong).estimates
        out.append(
            f"{words}: {share:.0%} flagged, advice: {estimate.advice}; calibrate_cube: {stated['dead_time_ns']} ns, "
            f"{stated['pulse_sigma_ns']} ns"
        )
    return "; ".join(out)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=sorted(BEFORE))
    parser.add_argument("--stream", type=Path, help="the measured recording, points 5 and 6")
    asked = parser.parse_args()
    now = {1: short_pulse, 2: unknown_jitter, 3: dim_background, 4: effects, 7: wide_jitter, 8: histograms}
    if asked.stream is not None:
        now |= {5: lambda: public_sample(asked.stream), 6: lambda: pieces(asked.stream)}
    print("| | before | now | CPU s |\n|---|---|---|---|")
    for point in sorted(set(asked.points) & set(now)):
        began = time.process_time()
        words = now[point]()
        print(f"| {point} | {BEFORE[point]} | {words} | {time.process_time() - began:.0f} |", flush=True)


if __name__ == "__main__":
    main()
