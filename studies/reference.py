"""Accuracy of every count law against simulated reference cases, read from JSON files.

A case holds ``S``, ``B`` (photons per period); ``tau``, ``sigma``, ``dead`` (laser periods); ``cycles``; and
``count``, {registrations: realizations}: an exposure on [0, cycles), armed at 0, Gaussian pulse.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics import count_law
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.distance import (
    Pmf,
    g_test,
    mean_score,
    sampling_floor,
    total_variation,
    variance_score,
)
from mars_lidar.statistics.law import Method
from studies import Request
from studies.law import LAWS
from studies.report import Row, configuration, save_csv, save_text, table

DRAWS, QUICK_DRAWS = 20_000, 500
SEED = 20262
_PERIOD_NS = 100.0
_LIMIT_Z, _LIMIT_P = 4.0, 1e-4
_FLAG = {False: "", True: " --quick"}
_KEYS = ("S", "B", "tau", "sigma", "dead", "cycles", "count")


@dataclass(frozen=True, eq=False)
class Comparison:
    """One law beside one case; z in standard errors, p of the G-test."""

    case: str
    law: str
    size: int
    mean: float
    variance: float
    z_mean: float
    z_variance: float
    distance: float
    floor: float
    limit: float
    p_value: float

    @property
    def good(self) -> bool:
        """Mean and variance within 4 standard errors, total variation below the limit, p above 1e-4."""
        scores = max(abs(self.z_mean), abs(self.z_variance))
        return scores <= _LIMIT_Z and self.distance <= self.limit and self.p_value > _LIMIT_P


def run(request: Request) -> list[Path]:
    """Compare, and write the table; returns the paths written."""
    if request.data is None:
        raise ValueError("data must be the folder of the reference cases, got None")
    paths = sorted(request.data.glob("*.json"))
    draws = QUICK_DRAWS if request.quick else DRAWS
    found: list[Comparison] = []
    cases = []
    for k, path in enumerate(paths):
        case = _read(path)
        cases.append({"case": path.stem, **{key: f"{case[key]:g}" for key in _KEYS[:-1]}})
        found += compare(path.stem, case, draws, np.random.default_rng([SEED, k]))
        request.tell(f"reference: {path.stem}")
    rows = [{**vars(c), "good": c.good} for c in found]
    return [
        save_text(request.out / "reference.md", _text(cases, found, draws, request.quick)),
        save_csv(request.out / "reference.csv", rows),
    ]


def compare(name: str, case: dict[str, Any], draws: int, random: np.random.Generator) -> list[Comparison]:
    """Every law beside one case, at the case's own delay."""
    system = System(
        period_ns=_PERIOD_NS,
        cycles=case["cycles"],
        bins=1024,
        pulse=GaussianPulse(sigma_ns=case["sigma"] * _PERIOD_NS),
        detector=Detector(dead_time_ns=case["dead"] * _PERIOD_NS),
    )
    signal, background, delay = float(case["S"]), float(case["B"]), case["tau"] * _PERIOD_NS
    counts = np.array([int(n) for n in case["count"]])
    times = np.array([int(m) for m in case["count"].values()])
    size = int(times.sum())
    frequency = np.bincount(counts - counts.min(), weights=times) / size
    sample = Pmf(int(counts.min()), frequency)
    mean = float((counts * (times / size)).sum())

    exact = count_law(signal, background, system, delay_ns=delay)
    laws = {"exact": (exact.cumulants, Pmf(int(exact.support[0]), exact.pmf))}
    moments = np.array([exact.mean, exact.variance, 0.0, 0.0])
    laws["gaussian"] = (moments, Pmf.gaussian(float(exact.mean), float(exact.variance)))
    others: tuple[tuple[str, Method, Rearm | None], ...] = (
        ("mars", "mars", "centre"),
        ("mars_edge", "mars", "edge"),
        ("renewal", "renewal", None),
        ("poisson", "poisson", None),
    )
    for key, method, rearm in others:
        law = count_law(signal, background, system, method, delay_ns=delay, rearm=rearm)
        laws[key] = (law.cumulants, Pmf(int(law.support[0]), law.pmf))
    noise = sampling_floor(laws["exact"][1], size, draws, random)
    return [
        Comparison(
            name,
            key,
            size,
            float(cumulants[0]),
            float(cumulants[1]),
            # what the sample's mean and variance scatter by is known from the exact law
            z_mean=mean_score(float(cumulants[0]), float(exact.variance), mean, size),
            z_variance=variance_score(exact.cumulants, sample, size, float(cumulants[1])),
            distance=total_variation(pmf, sample),
            floor=float(noise.mean()),
            limit=float(np.quantile(noise, 0.999)),
            p_value=g_test(pmf, sample, size),
        )
        for key, (cumulants, pmf) in laws.items()
    ]


def _read(path: Path) -> dict[str, Any]:
    case: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    missing = [key for key in _KEYS if key not in case]
    if missing:
        raise ValueError(f"reference case {path.name} must hold {', '.join(_KEYS)}, it lacks {', '.join(missing)}")
    return case


def _text(cases: Sequence[Row], found: list[Comparison], draws: int, quick: bool) -> list[str]:
    exact = [c for c in found if c.law == "exact"]
    names = [c.case for c in exact]
    return [
        "# Count laws against the reference cases",
        "_Quick form: a look, not for citing._" if quick else "",
        "Cases simulated photon by photon by a program that shares nothing with this package. Every law is "
        "evaluated at the case's own delay.",
        "## Configuration",
        f"Command: `python -m studies reference --data DIR{_FLAG[quick]} --out DIR`",
        configuration(
            {
                "bootstrap": f"{draws} samples of the exact law for each case, seed {SEED}",
                "cases": len(cases),
            }
        ),
        table(cases),
        "S and B in photons per period; tau, sigma and the dead time in laser periods; armed start.",
        '## `count_law(method="exact")`',
        table([_exact_row(c) for c in exact]),
        f"{sum(c.good for c in exact)} of {len(exact)} good: mean and variance within 4 standard errors, "
        "total variation (TV) below the 99.9 % quantile of "
        "its parametric bootstrap under the law, G-test p above 1e-4. *floor* is the bootstrap's mean. z is "
        "simulation less law, in standard errors.",
        "## Every law: total variation",
        table([_distance_row([c for c in found if c.case == name]) for name in names]),
        "\\* beyond the 99.9 % limit. *best Gaussian* has the exact mean and variance.",
        "## Every law: standard errors of mean and variance",
        table([_score_row([c for c in found if c.case == name]) for name in names]),
    ]


def _exact_row(c: Comparison) -> Row:
    return {
        "case": c.case,
        "realizations": c.size,
        "mean": f"{c.mean:.4f}",
        "z of mean": f"{c.z_mean:+.2f}",
        "variance": c.variance,
        "z of variance": f"{c.z_variance:+.2f}",
        "TV": f"{c.distance:.5f}",
        "floor": f"{c.floor:.5f}",
        "99.9 % limit": f"{c.limit:.5f}",
        "G-test p": f"{c.p_value:.3g}",
        "": "good" if c.good else "**not good**",
    }


def _distance_row(laws: Sequence[Comparison]) -> Row:
    row = {"case": laws[0].case}
    for c in laws:
        row[LAWS[c.law]] = f"{c.distance:.4f}" + ("" if c.distance <= c.limit else "*")
    return row | {"floor": f"{laws[0].floor:.4f}"}


def _score_row(laws: Sequence[Comparison]) -> Row:
    row = {"case": laws[0].case}
    for c in laws:
        if c.law != "gaussian":  # its moments are those of the exact law
            row[LAWS[c.law]] = f"{c.z_mean:+.1f}, {c.z_variance:+.1f}"
    return row
