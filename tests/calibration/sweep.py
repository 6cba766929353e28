"""Pulls of `calibrate` over random streams of the independent simulator: ``python -m tests.calibration.sweep 0 40``.

A stream a number: light, jitter, clock, period, dead time and photons are drawn from the seed of that number, or are
those of `ORDINARY` with ``--ordinary``; with ``--effect NAME``, or ``NAME+NAME``, the detector has these effects too;
with ``--background LOW HIGH`` the background is drawn from that range instead, evenly in its logarithm.
Prints a line a stream, and the spread of the pulls; with ``--keep FILE`` results are appended to that file, a JSON
object a line, and streams that it has are not calibrated again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import mars_lidar as ml
from tests.calibration.photon_by_photon import Truth, as_timestamps, photon_by_photon

ORDINARY = Truth(signal=0.4, background=0.15, delay=30.0, sigma=0.3, dead=50.0, period=100.0, jitter=0.1, unit=0.064)
EFFECTS = {
    "afterpulses": {"afterpulses": 0.03, "afterpulse_delay": 100.0},
    "twilight": {"twilight": 0.5},
    "recovery": {"recovery": 2.0},
    "paralyzable": {"paralyzable": True},
    "electronics": {"electronics": 1.2},  # times the dead time
    "drift": {"drift": 0.05},
}
NAMES = {
    "afterpulses": "afterpulses",
    "twilight": "twilight pulses",
    "recovery": "slow recovery",
    "paralyzable": "paralyzable detector",
    "electronics": "electronics with a dead time of their own",
    "drift": "drift of the light, relative",
}
PULLED = ("background", "signal", "delay_ns", "width_ns", "dead_time_ns")


def random_truth(number: int) -> tuple[Truth, int]:
    """A pixel and the photons of its recording."""
    random = np.random.default_rng(7000 + number)

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    period = between(15.0, 400.0)
    unit = float(random.choice([0.004, 0.016, 0.064, 0.25, 0.0]))
    locked = bool(random.random() < 0.6)
    if unit and random.random() < 0.5:
        period = round(period / unit) * unit
    dead = between(15.0, 150.0)
    signal, background = between(0.03, 3.0), between(0.02, 3.0)
    sigma = min(between(0.02, 1.0), period / 30)
    kind = random.random()
    jitter = 0.0
    if kind > 0.85:
        jitter = float(random.uniform(0.05, 0.33)) * dead
    elif kind > 0.3:
        jitter = between(0.02, 0.5)
    photons = int(between(5e3, 1.2e5))
    truth = Truth(
        signal=signal,
        background=background,
        delay=float(random.uniform(0.0, period)),
        sigma=sigma,
        dead=dead,
        period=period,
        jitter=min(jitter, period / 20),
        unit=unit,
        locked=locked,
    )
    return truth, photons


def with_effect(truth: Truth, effect: str | None) -> Truth:
    """The pixel with one of `EFFECTS`, or two with a plus between them."""
    more: dict[str, Any] = {}
    for name in (effect or "").split("+"):
        more |= EFFECTS.get(name, {})
    if "electronics" in more:
        more["electronics"] = more["electronics"] * truth.dead
    return replace(truth, **more)


def true_values(truth: Truth) -> tuple[float, ...]:
    """Those of `PULLED`."""
    return truth.background, truth.signal, truth.delay, truth.width, truth.dead


def pulls(result: ml.Calibration, truth: Truth) -> np.ndarray:
    """(estimate - truth) / stated error of `PULLED`, NaN where there is none."""
    out = []
    for name, true in zip(PULLED, true_values(truth), strict=True):
        estimate = result.estimates.get(name)
        if estimate is None or not estimate.error > 0.0:
            out.append(np.nan)
            continue
        off = estimate.value - true
        if name == "delay_ns":
            off = (off + truth.period / 2) % truth.period - truth.period / 2
        out.append(off / estimate.error)
    return np.array(out)


def outside(result: ml.Calibration, truth: Truth, low: str = "low", high: str = "high") -> list[str]:
    """Names of `PULLED` whose true values lie outside of the 95 % intervals."""
    out = []
    for name, true in zip(PULLED, true_values(truth), strict=True):
        estimate = result.estimates.get(name)
        if estimate is not None:
            wraps = (0.0, truth.period, -truth.period) if name == "delay_ns" else (0.0,)
            if not any(getattr(estimate, low) <= true + wrap <= getattr(estimate, high) for wrap in wraps):
                out.append(name)
    return out


def silent(result: ml.Calibration, truth: Truth) -> list[str]:
    """Those more than 4.5 stated errors off (an interval alone: outside of it), and outside of the ranges as well."""
    far = {name for name, z in zip(PULLED, pulls(result, truth), strict=True) if not abs(z) <= 4.5}
    stated = {name for name in far if name in result.estimates and np.isfinite(result.estimates[name].low)}
    return [name for name in outside(result, truth, "least", "most") if name in stated]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--effect", help=f"{', '.join(EFFECTS)}; or two, with a plus between them")
    parser.add_argument("--ordinary", action="store_true")
    parser.add_argument("--photons", type=int)
    parser.add_argument("--background", type=float, nargs=2)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--kept", action="store_true", help="only the streams of FILE, as the tables of the docs")
    asked = parser.parse_args()
    lines = asked.keep.read_text().splitlines() if asked.keep is not None and asked.keep.exists() else []
    stored = [json.loads(line) for line in lines]
    wanted = (asked.effect, asked.photons, asked.ordinary, asked.background)
    of = [(row["effect"], row["asked"], row["ordinary"], row.get("range")) for row in stored]
    done = {row["number"]: row for row, own in zip(stored, of, strict=True) if own == wanted}
    rows = []
    for number in range(asked.first, asked.last):
        if asked.kept and number not in done:
            continue
        row = done.get(number) or calibrated(number, *wanted)
        rows.append(row)
        if number not in done and asked.keep is not None:
            with asked.keep.open("a") as file:
                file.write(json.dumps(row) + "\n")
        if not asked.kept:
            print(f"{number} {row['photons']:,} photons {row['seconds']:.1f} s p={row['p']:.2g}", end=" ")
            print(np.round(np.array(row["pulls"], float), 1), row["suspects"], flush=True)
    print(table(rows, [NAMES[name] for name in asked.effect.split("+")] if asked.effect else []))
    if asked.kept and not asked.effect:
        print("\n" + by_photons(rows) + "\n\n" + named(stored))


def table(rows: list[dict[str, Any]], effects: list[str]) -> str:
    """Markdown: what the pulls of these streams were, and a line about verdicts and times."""
    pulled = np.array([row["pulls"] for row in rows], float)
    missed = [name for row in rows for name in row["outside"]]
    lines = [
        ("standard deviation of (estimate - truth) / error", [f"{v:.2f}" for v in np.nanstd(pulled, axis=0)]),
        ("root mean square", [f"{v:.2f}" for v in np.sqrt(np.nanmean(pulled**2, axis=0))]),
        ("largest", [f"{v:.1f}" for v in np.nanmax(np.abs(pulled), axis=0)]),
        ("beyond 4.5", [str(v) for v in (np.abs(pulled) > 4.5).sum(0)]),
        ("truth outside of the 95 % interval", [f"{missed.count(name) / len(rows):.1%}" for name in PULLED]),
        ("without an estimate", [str(v) for v in np.isnan(pulled).sum(0)]),
    ]
    named = [sum(name in row["suspects"] for row in rows) for name in effects]
    others = sum(not {*row["suspects"]} <= {*effects} for row in rows)
    seconds = [row["seconds"] for row in rows]
    return "\n".join(
        [
            "| | B | S | delay | width | dead time |",
            "|---|---|---|---|---|---|",
            *(f"| {words} | {' | '.join(values)} |" for words, values in lines),
            "",
            f"{len(rows)} streams: p below 1 % in {sum(row['p'] < 0.01 for row in rows)}, "
            + "".join(f"{name} named in {number}, " for name, number in zip(effects, named, strict=True))
            + f"other suspects in {others}; {np.mean(seconds):.1f} s of a processor each, largest {max(seconds):.1f}.",
        ]
    )


def by_photons(rows: list[dict[str, Any]]) -> str:
    """Markdown: standard deviations of the pulls of streams of so many photons, and the largest."""
    lines = ["| photons | streams | B | S | delay | width | dead time | largest |", "|---|---|---|---|---|---|---|---|"]
    for low, high in pairwise((0, 8_000, 15_000, 30_000, 60_000, 10**9)):
        group = np.array([row["pulls"] for row in rows if low <= row["photons"] < high], float)
        if len(group) > 1:
            spread = " | ".join(f"{value:.2f}" for value in np.nanstd(group, axis=0))
            below = f"to {high:,}" if high < 10**9 else f"from {low:,}"
            lines.append(f"| {below} | {len(group)} | {spread} | {np.nanmax(np.abs(group)):.1f} |")
    return "\n".join(lines)


def named(rows: list[dict[str, Any]]) -> str:
    """Markdown: for each effect, or pair, of these streams, how many name all of it, and how many something else."""
    lines = [
        "| effect | photons | streams | named | other suspects | CPU s, mean | largest pull |",
        "|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        if row["effect"]:
            groups.setdefault((row["effect"], row["asked"]), []).append(row)
    for (effect, photons), group in groups.items():
        names = {NAMES[name] for name in effect.split("+")}
        whole = sum(names <= {*row["suspects"]} for row in group)
        others = sum(not {*row["suspects"]} <= names for row in group)
        # the dead time that electronics hide is an estimate only where they are named
        pulled = [abs(z) for row in group if names <= {*row["suspects"]} for z in row["pulls"] if z is not None]
        seconds = np.mean([row["seconds"] for row in group])
        lines.append(
            f"| {effect.replace('+', ' and ')} | {photons:,} | {len(group)} | {whole} | {others} | {seconds:.1f} | "
            f"{max(pulled, default=np.nan):.1f} |"
        )
    return "\n".join(lines)


def calibrated(
    number: int, effect: str | None, photons: int | None, ordinary: bool, background: list[float] | None = None
) -> dict[str, Any]:
    """The pulls, p-value, suspects and time of one stream."""
    truth, own = (ORDINARY, 100_000) if ordinary else random_truth(number)
    if background is not None:
        drawn = np.random.default_rng(number).uniform(*np.log(background))
        truth = replace(truth, background=float(np.exp(drawn)))
    truth = with_effect(truth, effect)
    t, cycles = photon_by_photon(truth, photons or own, number)
    began = time.process_time()
    result = ml.calibrate(as_timestamps(t, truth, cycles), seed=number)
    return {
        "number": number,
        "effect": effect,
        "asked": photons,
        "ordinary": ordinary,
        "range": background,
        "photons": t.size,
        "seconds": time.process_time() - began,
        "p": float(result.p_value),
        "pulls": [None if np.isnan(z) else float(z) for z in pulls(result, truth)],
        "errors": [float(result.estimates[name].error) if name in result.estimates else None for name in PULLED],
        "outside": outside(result, truth),
        "silent": silent(result, truth),
        "suspects": [suspect.name for suspect in result.suspects],
    }


if __name__ == "__main__":
    main()
