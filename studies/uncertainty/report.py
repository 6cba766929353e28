"""The report of the study "uncertainty": tables of what intervals cover, beside the closed form; figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from studies import Facts
from studies.common.kept import spread
from studies.common.report import Row
from studies.uncertainty import data, measured
from studies.uncertainty.data import CONFIGS, Config, instrument
from studies.uncertainty.figures import exposures, maps, reliability
from studies.uncertainty.prediction import at
from studies.uncertainty.run import LEVELS, Run, by_simulator

FULL = CONFIGS["full"]
SHOWN = (0.5, 0.9, 0.99)
WINDOWS = ((5.0, 0.5, 0.1), (2.0, 5.0, 0.95))  # S, B, t_d / t_r of the two variances told apart
LEFT, OFF = 0.01, 0.02  # by which exact-trained 90 % intervals, and the closed form, may be wrong


def facts(
    config: Config,
    found: Mapping[Run, Any],
    predicted: Mapping[float, Any],
    stream: Mapping[str, Any] | None,
) -> Facts:
    """What the report states of the results by run, and the figures."""
    dead = sorted(config.dead)
    pictures = {"reliability": reliability(found, predicted, dead), "coverage": maps(found, predicted, dead, config)}
    if stream is not None:
        pictures["stream"] = exposures(stream)
    lights = [(d, one) for d, rows in predicted.items() for one in rows]
    return {
        "c": config,
        "data": data,
        "system": instrument(0.0),
        "dead": dead,
        "table_rows": [row for d in dead for row in _rows(found, predicted, d)],
        "differences": [_difference(found, predicted, config, d) for d in dead],
        "cells": [_cells(found, predicted, d) for d in dead],
        "windows": [(s, b, d, at(s, b, instrument(d)).window) for s, b, d in WINDOWS],
        # where the variance of the window is furthest off in the map, either way
        "extremes": [pick(lights, key=lambda pair: pair[1]["window"]) for pick in (min, max)],
        "stream": stream,
        "measured": measured,
        "minutes": sum(result["seconds"] for result in found.values()) / 60.0,
        "figures": pictures,
        "rows": _csv(found),
    }


def _of(results: list[Any], test: str, measure: str, output: str = "log S") -> list[float]:
    return [result["tests"][test][output][measure] for result in results]


def _covered(results: list[Any], test: str, level: float, output: str = "log S") -> list[float]:
    return [one[LEVELS.index(level)] for one in _of(results, test, "coverage", output)]  # type: ignore[index]


def _closed(predicted: Mapping[float, Any], dead: float, level: float) -> float:
    return float(np.mean([one["coverage"][LEVELS.index(level)] for one in predicted[dead]]))


def _rows(found: Mapping[Run, Any], predicted: Mapping[float, Any], dead: float) -> list[Row]:
    rows: list[Row] = []
    for name, results in by_simulator(found, dead):
        closed = " ".join(f"{_closed(predicted, dead, level):.3f}" for level in SHOWN) if name == "mars" else "-"
        rows.append(
            {
                "t_d / t_r": f"{dead:g}",
                "trained on": name,
                "seeds": str(len(results)),
                "loss": spread(_of(results, "gold", "loss"), 3),
                "RMSE": spread(_of(results, "gold", "rmse"), 4),
                "50 / 90 / 99 % cover": " / ".join(spread(_covered(results, "gold", level), 3) for level in SHOWN),
                "closed form": closed,
                "90 % of own data": spread(_covered(results, "own", 0.9), 3),
                "of exact data": spread(_covered(results, "exact", 0.9), 3),
                "90 % of log B": spread(_covered(results, "gold", 0.9, "log B"), 3),
                "of the delay": spread(_covered(results, "gold", 0.9, "delay"), 3),
            }
        )
    return rows


def _difference(
    found: Mapping[Run, Any], predicted: Mapping[float, Any], config: Config, dead: float
) -> dict[str, Any]:
    """MaRS less exact, seed by seed; and what of the acceptance holds."""
    arms = dict(by_simulator(found, dead))
    mars, exact = arms["mars"], arms["exact"]

    def less(a: list[float], b: list[float]) -> list[float]:
        return [x - y for x, y in zip(a, b, strict=False)]

    growth = []
    for step in (str(step) for step in config.looks if step < config.steps["mars"]):
        one, other = ([result["looks"][step]["log S"]["loss"] for result in arm] for arm in (mars, exact))
        growth.append((step, float(np.mean(less(one, other)))))
    final = less(_of(mars, "gold", "loss"), _of(exact, "gold", "loss"))
    errors = zip(_of(mars, "gold", "rmse"), _of(exact, "gold", "rmse"), strict=False)
    covered = {name: float(np.mean(_covered(arms[name], "gold", 0.9))) for name in ("mars", "exact")}
    closed = _closed(predicted, dead, 0.9)
    return {
        "dead": dead,
        "loss": spread(final, 3),
        "loss_closed": float(np.mean([one["loss"] for one in predicted[dead]])),
        "rmse": spread([100.0 * (a / b - 1.0) for a, b in errors], 1),
        "covered": spread(less(_covered(mars, "gold", 0.9), _covered(exact, "gold", 0.9)), 3),
        "growth": [*growth, (str(config.steps["mars"]), float(np.mean(final)))],
        "exact": covered["exact"],
        "exact_holds": abs(covered["exact"] - 0.9) <= LEFT,
        "mars": covered["mars"],
        "closed": closed,
        "closed_holds": abs(covered["mars"] - closed) <= OFF,
    }


def _cells(found: Mapping[Run, Any], predicted: Mapping[float, Any], dead: float) -> dict[str, Any]:
    """Over the map: the worst cell, how far the closed form is off, and what one factor for all intervals leaves."""
    arms = dict(by_simulator(found, dead))
    closed = np.array([one["coverage"][LEVELS.index(0.9)] for one in predicted[dead]])
    mean = {name: _map(arms[name], "map") for name in ("mars", "exact")}
    worst = int(np.argmax(np.abs(mean["mars"] - 0.9)))
    light = predicted[dead][worst]
    dim = [k for k, one in enumerate(predicted[dead]) if one["signal"] < 0.3]
    return {
        "dead": dead,
        "signal": light["signal"],
        "background": light["background"],
        "covered": float(mean["mars"][worst]),
        "closed": float(closed[worst]),
        "off": float(np.sqrt(np.mean((mean["mars"] - closed) ** 2))),
        "exact": [float(v) for v in (mean["exact"].min(), mean["exact"].max())],
        "factor": float(np.mean([result["tests"]["gold"]["factor"] for result in arms["mars"]])),
        "stretched": [float(v) for v in (_map(arms["mars"], "stretched").min(), _map(arms["mars"], "stretched").max())],
        "dim": float(mean["mars"][dim].mean()) if dim else float("nan"),
    }


def _map(results: list[Any], which: str) -> Any:
    return np.mean([np.array(result["tests"]["gold"][which]).ravel() for result in results], axis=0)


def _csv(found: Mapping[Run, Any]) -> list[Row]:
    rows: list[Row] = []
    for one, result in found.items():
        for test, judged in result["tests"].items():
            for output in data.OUTPUTS:
                here = judged[output]
                row: dict[str, Any] = {"dead": one.dead, "trained": one.name, "seed": one.seed}
                row |= {"tested": test, "output": output, "loss": here["loss"], "rmse": here["rmse"]}
                row |= {f"covered_{level:g}": v for level, v in zip(LEVELS, here["coverage"], strict=True)}
                rows.append(row)
    return rows
