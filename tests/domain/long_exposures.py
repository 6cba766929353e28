"""The feedback engine's means and variances at long exposures, against the closed form."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import JointLaw, joint_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine, draw_rest
from mars_lidar.statistics import ConvergenceError
from studies import Facts, Request
from tests.domain.sweep import Lines
from tests.domain.systems import LONG, PERIOD_NS, Case, draw_long

MEAN_OFF = 0.3  # standard deviations of a bin or window that its mean may be off
VARIANCE_OFF = 0.05  # of the variance of a bin or window, or of the mean over the bins near the pulse
SIGMAS = 5.0  # standard errors that the sample's own noise may add
AGAIN = 4  # times as many exposures, and fresh numbers, where the first sample is beyond
TOLERANCE = 1e-4  # of the closed form
_FEWEST = 30.0  # expected counts of a bin in the whole sample, for its mean; in one exposure, for its variance
_WINDOWS = 24  # linear functions of the histogram that are compared beside the bins
_MOST_PIXELS = 64
_REDRAWN, _TIMES = 2, 10  # systems of the most redrawn exposures, that so many times as many exposures are drawn of


@dataclass(frozen=True)
class Settings:
    """Systems that the engine draws and a law is known of, exposures of each, seed."""

    systems: int
    items: int
    seed: int


FULL, QUICK = Settings(300, 3000, 20_261_124), Settings(10, 1000, 20_261_124)


class _Sampled(FeedbackEngine):
    """Leaves the rows of pixels that it would give to the exact engine at 0."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        out[...] = 0
        rest = self.sample(task, out, np.arange(task.pixel_index.size))
        task.report["refused"] = float(rest.pixels.size)
        task.report["again"] = rest.realization.size + task.report.get("exposures drawn again by feedback", 0.0)
        # single exposures that did not settle: a simulation would draw them again
        draw_rest(ExactEngine(), task, out, replace(rest, pixels=rest.pixels[:0]))


def run(settings: Settings, request: Request) -> Facts:
    """Random systems, compared one by one until so many were drawn by the engine and have a law."""
    config = {"seed": settings.seed, "items": settings.items}
    lines = Lines(request.out / "long_exposures.jsonl", config)
    number = judged = 0
    while judged < settings.systems:
        if number not in lines.records:
            lines.add(number, compare(draw_long(settings.seed, number), settings.items, number))
            request.tell(f"{judged + 1} of {settings.systems}: {lines.records[number]}")
        judged += lines.records[number]["outcome"] in ("right", "wrong")
        number += 1
    every = [lines.records[k] for k in range(number)]
    often = sorted((k for k in range(number) if every[k]["again"]), key=lambda k: -every[k]["again"])[:_REDRAWN]
    bias = Lines(request.out / "long_exposures_redrawn.jsonl", config)
    for k in often:
        if k not in bias.records:
            bias.add(k, redrawn(draw_long(settings.seed, k), settings.items, k))
            request.tell(f"redrawn: {bias.records[k]}")
    rows = [row for row in every if row["outcome"] in ("right", "wrong")]
    return {
        "every": every,
        "outcomes": Counter(row["outcome"] for row in every),
        "families": [_family(every, family) for family in LONG],
        "wrong": [row for row in rows if row["outcome"] == "wrong"],
        "drawn": rows,
        "seconds": sum(row["seconds"] for row in every),
        "redrawn": [bias.records[k] for k in often],
        "error": 1.0 / np.sqrt(settings.items),
        "rows": every,
    }


def _family(every: list[dict[str, Any]], family: str) -> dict[str, Any]:
    some = [row for row in every if row["family"] == family]
    drawn = [row for row in some if row["outcome"] in ("right", "wrong")]
    return {
        "family": family,
        "drawn": len(drawn),
        "wrong": sum(row["outcome"] == "wrong" for row in some),
        "given to exact": sum(row["outcome"] == "given to exact" for row in some),
        "law refused": sum(row["outcome"] == "law refused" for row in some),
        "largest mean off": max((row["mean"] for row in drawn), default=0.0),
        "largest of windows": max((row["window"] for row in drawn), default=0.0),
    }


def compare(case: Case, items: int, seed: int) -> dict[str, Any]:
    """A row of the study: outcome, and by how much the sample is off."""
    began, system = time.process_time(), case.system
    row = _facts(case) | {"cycles": system.cycles, "bins": system.bins, "start": system.start, "outcome": "right"}
    row |= dict.fromkeys(("again", "mean", "window", "variance", "window variance", "near", "seconds"), 0.0)
    row["note"] = ""
    report: dict[str, float] = {}
    _sample(case, 1, 1, seed, report)
    if report["refused"]:
        [why] = [key.partition(", ")[2] for key in report if key.startswith("pixels given to exact, ")]
        return row | {"outcome": "given to exact", "note": why}
    try:
        law = joint_law(case.flux()[0, 0], system, tolerance=TOLERANCE)
    except (ConvergenceError, ValueError, MemoryError) as error:
        return row | {"outcome": "law refused", "note": f"{type(error).__name__}: {error}"[:200]}
    judged = judged_row(case, law, items, seed, report)
    if judged["outcome"] == "wrong":
        judged = judged_row(case, law, AGAIN * items, seed + 500_000, report)
    return row | judged | {"seconds": round(time.process_time() - began, 2)}


def redrawn(case: Case, items: int, seed: int) -> dict[str, Any]:
    """What exposures that did not settle, drawn again, do to the means of a system: a row of the study.

    Those that settle may differ in law from the others, whose place exposures without that condition take.
    """
    law = joint_law(case.flux()[0, 0], case.system, tolerance=TOLERANCE)
    weights = _linear(case)
    mean, variance = law.window(weights)
    moving = np.minimum(mean, variance) * items >= _FEWEST
    weights, mean, variance = weights[moving], mean[moving], variance[moving]
    total, number, again = np.zeros(len(weights)), 0, 0.0
    for part in range(_TIMES):
        report: dict[str, float] = {}
        x = _sample(case, items, min(_MOST_PIXELS, items), seed + 1_000_000 * (part + 1), report)
        total += (x @ weights.T).sum(0)
        number, again = number + len(x), again + report["again"]
    off = (total / number - mean) / np.sqrt(variance)
    share = again / number
    return _facts(case) | {
        "exposures": number,
        "redrawn": share,
        "bound": float(np.sqrt(share / (1.0 - share))),
        "count off": float(off[0]),
        "largest of windows off": float(off[np.argmax(np.abs(off))]),
        "sample error": 1.0 / float(np.sqrt(number)),
    }


def _facts(case: Case) -> dict[str, Any]:
    light = {"S": sum(case.signal), "B": case.background}
    return {"case": case.name, "family": case.family, **light, "t_d": case.system.dead_time_periods}


def _sample(case: Case, items: int, pixels: int, seed: int, report: dict[str, float]) -> NDArray[Any]:
    cube = simulate(
        case.flux(pixels), case.system, engine=_Sampled(), realizations=-(-items // pixels), seed=seed, report=report
    )
    return cube.reshape(-1, case.system.bins)


def judged_row(case: Case, law: JointLaw, items: int, seed: int, report: dict[str, float]) -> dict[str, Any]:
    """By how much `items` drawn exposures are off; outcome "wrong": by more than is allowed and the sample's noise."""
    x = _sample(case, items, min(_MOST_PIXELS, items), seed, report).astype(np.float64)
    n = len(x)
    weights = _linear(case)
    weights = weights[weights @ law.mean * n >= _FEWEST]
    mean, variance = law.window(weights)
    moving = variance * n >= _FEWEST  # else no more can be said than that it did not change
    weights, mean, variance = weights[moving], mean[moving], variance[moving]
    windows = _off(x @ weights.T, mean, variance)
    rare = np.minimum(law.mean, law.variance) * n < _FEWEST
    bins = _off(x, law.mean, law.variance)
    scaled = np.where(rare, 0.0, (x - law.mean) / np.sqrt(np.maximum(law.variance, 1e-300)))
    near = _near(case) & (law.mean > 1.0)
    each = np.mean(scaled[:, near] ** 2, axis=1) - 1.0 if near.any() else np.zeros(n)
    near_off, near_error = float(each.mean()), float(each.std() / np.sqrt(n))
    bins = {key: value[~rare] for key, value in bins.items()}
    many = law.mean[~rare] > _FEWEST
    errors = [np.abs(both["mean"]) - MEAN_OFF - SIGMAS * both["mean error"] for both in (bins, windows)]
    errors += [
        (np.abs(both["variance"]) - VARIANCE_OFF - SIGMAS * both["variance error"])[some]
        for both, some in ((bins, many), (windows, mean > _FEWEST))
    ]
    errors.append(np.array([abs(near_off) - VARIANCE_OFF - SIGMAS * near_error]))
    wrong = any((e > 0.0).any() for e in errors)

    def largest(values: FloatArray) -> float:
        return float(values[np.argmax(np.abs(values))]) if values.size else 0.0

    means = {"mean": abs(largest(bins["mean"])), "window": abs(largest(windows["mean"]))}
    variances = {"variance": largest(bins["variance"][many])}
    variances["window variance"] = largest(windows["variance"][mean > _FEWEST])
    outcome = {"outcome": "wrong" if wrong else "right", "again": report["again"]}
    return outcome | means | variances | {"near": near_off}


def _off(x: FloatArray, mean: FloatArray, variance: FloatArray) -> dict[str, FloatArray]:
    """Difference of means in standard deviations, ratio of variances less 1, and the standard errors of both."""
    n, scaled = len(x), (x - mean) / np.sqrt(np.maximum(variance, 1e-300))
    square = (scaled - scaled.mean(0)) ** 2
    return {
        "mean": scaled.mean(0),
        "mean error": scaled.std(0) / np.sqrt(n),
        "variance": square.mean(0) * n / (n - 1) - 1.0,
        "variance error": np.maximum(square.std(0), np.sqrt(2.0)) / np.sqrt(n),
    }


def _near(case: Case) -> NDArray[np.bool_]:
    """Bins that the light of a return or its echoes of one and two dead times reach; all of a waveform."""
    bins = case.system.bins
    low, high = (t / PERIOD_NS for t in case.system.pulse.support_ns())
    phase, near = (np.arange(bins) + 0.5) / bins, np.full(bins, case.waveform is not None)
    for echo in range(3):
        for delay in case.delay:
            start = delay + low + echo * case.system.dead_time_periods - 1.5 / bins
            near |= (phase - start) % 1.0 <= min(high - low + 3.0 / bins, 1.0)
    return near


def _linear(case: Case) -> FloatArray:
    """Weights (n, bins) of the count, of intervals of bins, and of random halves of the bins near the pulse."""
    random, bins = np.random.default_rng(case.number), case.system.bins
    near = np.flatnonzero(_near(case))
    rows = [np.ones(bins)]
    for _ in range(_WINDOWS // 2):
        row = np.zeros(bins)
        size = int(np.exp(random.uniform(0.0, np.log(bins))))
        row[(int(random.choice(near)) + np.arange(size)) % bins] = 1.0
        rows.append(row)
        row = np.zeros(bins)
        row[near[random.random(near.size) < 0.5]] = 1.0
        rows.append(row)
    return np.array(rows)
