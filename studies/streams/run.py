"""Study "streams": false alarms, what is not known, and how well stated errors hold."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from typing import Any

import numpy as np
from scipy.stats import binom

from studies import Facts, Request
from studies.common.draw import panels
from studies.common.report import Row, picked
from studies.streams.cases import FULL, QUICK, Outcome, outcomes
from studies.streams.coverage import Coverage, Law, coverage, tail

LEVEL = 1e-4  # false-alarm probability of an inspection, as it is stated
FAMILY = 1e-3  # of all tests of coverage together, by Holm
FAR = 5.0  # stated errors beyond which an estimate is named


def run(request: Request) -> Facts:
    """All streams, inspected and calibrated."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    found = outcomes(settings, request.tell)
    spent = time.process_time() - began + sum(one.seconds for one in found)
    covered = coverage(found)
    alarmed = sum(bool(one.alarms) for one in found)
    tests = {name: value for one in covered for name, value in one.p.items()}
    far = [{name: pull for name, pull in one.pulls.items() if abs(pull) > FAR} for one in found]
    return {
        "s": settings,
        "found": found,
        "covered": covered,
        "alarmed": alarmed,
        "alarmed_p": float(binom.sf(alarmed - 1, len(found), LEVEL)),
        "wrongly_flat": any("flat" in text for one in found for text in one.alarms),
        "tests": tests,
        "failed": refused_by_holm(tests, FAMILY),
        "exceeded": sum(one.beyond(FAR) for one in covered),
        "expected": sum(one.stated * tail(FAR, one.law) for one in covered),
        "far": [(k, found[k].ideal, pulls) for k, pulls in enumerate(far) if pulls],
        "refused": Counter(one.refused.split(",")[0] for one in found if one.refused),
        "unknown": Counter(text.split(":")[0] for one in found for text in one.unknown).most_common(),
        "by_share": _by_share([one for one in found if one.ideal.jitter_ns > 0]),
        "spent": spent,
        "rows": [_csv_row(one) for one in found],
        "figures": {"": figure(found, covered)},
    }


def refused_by_holm(p: dict[str, float], level: float) -> list[str]:
    """Names of the tests that fail at a family-wise level (Holm, Scand. J. Statist. 6, 65, 1979)."""
    failed = []
    for rank, (name, value) in enumerate(sorted(p.items(), key=lambda pair: pair[1])):
        if value >= level / (len(p) - rank):
            break
        failed.append(name)
    return failed


def figure(found: list[Outcome], covered: list[Coverage]) -> Any:
    """Pulls by the jitter's share of the period, and how many of each estimate are beyond a number of errors."""
    drawing, axes = panels(3.2, 1, 2)
    left, right = axes[0]
    for name, marker in (("jitter", "o"), ("dead time", "x"), ("all light, any shape", "+")):
        some = [one for one in found if one.ideal.jitter_ns > 0.0 and np.isfinite(one.pulls[name])]
        share = [one.ideal.jitter_ns / one.ideal.period_ns for one in some]
        left.plot(share, [one.pulls[name] for one in some], marker, ms=3, alpha=0.7, label=name)
    left.axhspan(-2.0, 2.0, color="0.92", zorder=0)
    left.set(xscale="log", xlabel="true jitter (periods)", ylabel="(estimate - truth) / stated error")
    left.legend(fontsize=7, frameon=False)
    at = np.linspace(0.0, 6.0, 121)
    for one in covered:
        if one.stated:
            above = (one.sizes[:, None] > at).mean(0)
            right.plot(at, np.where(above > 0.0, above, np.nan), lw=1, label=one.name)
    laws: list[tuple[Law, str]] = [("normal", "k--"), ("exponential", "k:")]
    for law, style in laws:
        right.plot(at, [tail(value, law) for value in at], style, lw=1, label=law)
    right.set(yscale="log", ylim=(1e-3, 1.0), xlabel="stated errors", ylabel="share of streams beyond")
    right.legend(fontsize=6, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return drawing


def _by_share(found: list[Outcome]) -> list[Row]:
    edges = (1e-5, 1e-4, 1e-3, 1e-2, 3e-2, 5e-2, 0.1)
    rows: list[Row] = []
    for low, high in itertools.pairwise(edges):
        some = [one for one in found if low <= one.ideal.jitter_ns / one.ideal.period_ns < high]
        seen = np.array([np.isfinite(one.pulls["jitter"]) for one in some])
        dead = np.array([np.isfinite(one.pulls["dead time"]) for one in some])
        pulls = np.abs([one.pulls["jitter"] for one in some if np.isfinite(one.pulls["jitter"])])
        rows.append(
            {
                "jitter (periods)": f"{low:g} to {high:g}",
                "streams": len(some),
                "found": int(seen.sum()),
                "not seen, or hides in the error": int((dead & ~seen).sum()),
                "not known": int((~dead & ~seen).sum()),
                "largest pull": float(pulls.max(initial=0.0)),
            }
        )
    return rows


def _csv_row(one: Outcome) -> Row:
    return {
        **picked(one.ideal, "signal background period_ns dead_ns sigma_ns jitter_ns unit_ns whole seed"),
        "registrations": one.registrations,
        "dead time by": one.by,
        **{f"pull of {name}": float(value) for name, value in one.pulls.items()},
        "alarms": "; ".join(one.alarms),
        "flat": one.flat,
        "unknown": "; ".join(one.unknown),
        **picked(one, "refused seconds"),
    }
