"""Study "reference": every count law against simulated reference cases, read from JSON files.

A case holds ``S``, ``B`` (photons per period); ``tau``, ``sigma``, ``dead`` (laser periods); ``cycles``; and
``count``, {registrations: realizations}: an exposure on [0, cycles), armed at 0, Gaussian pulse.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import Flux
from mars_lidar.statistics.count_pmf import Pmf, total_variation
from studies import Facts, Request
from studies.common import distance
from studies.common.sample import system_of
from studies.count_law.law import LAWS, laws_of, pmfs_of

DRAWS, QUICK_DRAWS = 20_000, 500
SEED = 20262
_PERIOD_NS = 100.0
_LIMIT_Z, _LIMIT_P = 4.0, 1e-4
_KEYS = ("S", "B", "tau", "sigma", "dead", "cycles", "count")


def run(request: Request) -> Facts:
    """Every law beside every case."""
    if request.data is None:
        raise ValueError("data must be the folder of the reference cases, got None")
    paths = sorted(request.data.glob("*.json"))
    draws = QUICK_DRAWS if request.quick else DRAWS
    results: list[dict[str, Any]] = []
    cases = {}
    for k, path in enumerate(paths):
        cases[path.stem] = case = _read(path)
        results += compare(path.stem, case, draws, np.random.default_rng([SEED, k]))
        request.tell(f"reference: {path.stem}")
    return {
        "cases": cases,
        "keys": _KEYS[:-1],
        "found": results,
        "exact": [c for c in results if c["law"] == "exact"],
        "laws": LAWS,
        "draws": draws,
        "rows": results,
    }


def compare(name: str, case: dict[str, Any], draws: int, random: np.random.Generator) -> list[dict[str, Any]]:
    """Every law beside one case, at the case's own delay; z in standard errors, p of the G-test.

    ``good``: mean and variance within 4 standard errors, total variation below the limit, p above 1e-4.
    """
    dead, sigma = case["dead"] * _PERIOD_NS, case["sigma"] * _PERIOD_NS
    system = system_of(dead, case["cycles"], period_ns=_PERIOD_NS, sigma_ns=sigma)
    signal, background, delay = float(case["S"]), float(case["B"]), case["tau"] * _PERIOD_NS
    counts = np.array([int(n) for n in case["count"]])
    times = np.array([int(m) for m in case["count"].values()])
    size = int(times.sum())
    frequency = np.bincount(counts - counts.min(), weights=times) / size
    sample = Pmf(int(counts.min()), frequency)
    mean = float((counts * (times / size)).sum())

    laws = laws_of(Flux([signal], background, delay), system)
    pmfs, exact = pmfs_of(laws, 0), laws["exact"].cumulants[0]
    noise = distance.sampling_floor(pmfs["exact"], size, draws, random)
    results = []
    for key, pmf in pmfs.items():
        # the Gaussian has mean and variance of the exact law
        expected, variance = (float(v) for v in laws.get(key, laws["exact"]).cumulants[0, :2])
        row: dict[str, Any] = {
            "case": name,
            "law": key,
            "size": size,
            "mean": expected,
            "variance": variance,
            # what the sample's mean and variance scatter by is known from the exact law
            "z_mean": distance.mean_score(expected, float(exact[1]), mean, size),
            "z_variance": distance.variance_score(exact, sample, size, variance),
            "distance": total_variation(pmf, sample),
            "floor": float(noise.mean()),
            "limit": float(np.quantile(noise, 0.999)),
            "p_value": distance.g_test(pmf, sample, size),
        }
        close = max(abs(row["z_mean"]), abs(row["z_variance"])) <= _LIMIT_Z
        results.append(row | {"good": close and row["distance"] <= row["limit"] and row["p_value"] > _LIMIT_P})
    return results


def _read(path: Path) -> dict[str, Any]:
    case: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    missing = [key for key in _KEYS if key not in case]
    if missing:
        raise ValueError(f"reference case {path.name} must hold {', '.join(_KEYS)}, it lacks {', '.join(missing)}")
    return case
