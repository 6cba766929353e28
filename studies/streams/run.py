"""Study "streams": false alarms, what is not known, and how well stated errors hold."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from pathlib import Path

import numpy as np

from studies import Request
from studies.common.report import Row, configuration, machine, save_csv, save_text, table
from studies.streams.cases import ESTIMATES, FULL, QUICK, Coverage, Outcome, Settings, outcomes

LEVEL = 1e-4  # false-alarm probability of an inspection, as it is stated
FAMILY = 1e-3  # of all tests of coverage together, by Holm


def run(request: Request) -> list[Path]:
    """Compute and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    found = outcomes(settings, request.tell)
    covered = [Coverage.of(name, found) for name in ESTIMATES]
    findings = _findings(found, covered)
    for line in findings:
        request.tell(line)
    spent = time.process_time() - began + sum(one.seconds for one in found)
    text = save_text(request.out / "streams.md", _text(settings, found, covered, findings, request.quick, spent))
    return [text, save_csv(request.out / "streams.csv", [_csv_row(one) for one in found])]


def refused_by_holm(p: dict[str, float], level: float) -> list[str]:
    """Names of the tests that fail at a family-wise level (Holm, Scand. J. Statist. 6, 65, 1979)."""
    failed = []
    for rank, (name, value) in enumerate(sorted(p.items(), key=lambda pair: pair[1])):
        if value >= level / (len(p) - rank):
            break
        failed.append(name)
    return failed


def _findings(found: list[Outcome], covered: list[Coverage]) -> list[str]:
    from scipy.stats import binom

    alarmed = [one for one in found if one.alarms]
    p = float(binom.sf(len(alarmed) - 1, len(found), LEVEL))
    lines = [
        f"**False alarms**: {len(alarmed)} of {len(found)} ideal streams at a stated level of {LEVEL:g} each (p of as "
        f"many: {p:.2g})."
    ]
    flat = sum(one.flat for one in found)
    lines.append(
        f"In {flat} no signal is told to be seen; in none of them does it stand out."
        if not any("flat" in text for one in found for text in one.alarms)
        else f"In {flat} no signal is told to be seen, wrongly in some."
    )
    every = {name: value for one in covered for name, value in one.p.items()}
    failed = refused_by_holm(every, FAMILY)
    lines.append(
        f"**Errors**: of {len(every)} tests of coverage (shares within 1 and 2 standard errors at least as stated, "
        f"largest pull) {len(failed)} fail at a family-wise level of {FAMILY:g} (Holm)"
        + (f": {', '.join(failed)}." if failed else ".")
    )
    total = sum(one.stated for one in covered)
    beyond = sum(one.beyond_5 for one in covered)
    lines.append(f"Of {total:,} stated errors {beyond} are exceeded by more than 5 times.")
    refused = Counter(one.refused.split(",")[0] for one in found if one.refused)
    if refused:
        lines.append("Refused: " + "; ".join(f"{text} ({number})" for text, number in refused.items()) + ".")
    return lines


def _text(
    settings: Settings, found: list[Outcome], covered: list[Coverage], findings: list[str], quick: bool, spent: float
) -> list[str]:
    jittered = [one for one in found if one.ideal.jitter_ns > 0]
    words: Counter[str] = Counter(text.split(":")[0] for one in found for text in one.unknown)
    return [
        "# Ideal streams over the whole range",
        "_Quick form: a look, not for citing._" if quick else "",
        "Streams of one free-running pixel with one dead time, a Gaussian pulse on a background, Gaussian jitter and a "
        "clock, with nothing wrong and nothing told. Avalanches are drawn by the sequential engine (every photon, in "
        "double precision); jitter and clock are put on here. Whatever `inspect` says does not fit is a false alarm. "
        "Whatever `calibrate` states a finite error of is compared with the truth; an error of NaN says that the "
        "stream cannot tell, and a sentence says why. How it is done: [calibration.md](../calibration.md).",
        configuration(
            {
                "streams": f"{settings.streams}, seed {settings.seed}",
                "light": "S 1e-3 to 30, B 1e-4 to 10 photons per period, all ranges log-uniform",
                "times": "period 10 to 1000 ns, dead time 0.02 to 20 periods, pulse sigma 1e-4 to 0.1 period",
                "jitter": "sigma 1e-5 to 0.1 period; none in one of five",
                "clock": "units of 1 ps to 1 ns; in half of them a whole number of units a period, else free",
                "photons": f"about 1,000 to {settings.photons:,.0f}",
            }
        ),
        f"- machine: {machine()}\n- processor time: {spent:.0f} s",
        "## What is told",
        "\n".join(f"- {line}" for line in findings),
        "## Stated errors",
        "Differences from the truth over the stated error (Gaussian: 0.683 within 1, 0.954 within 2). *Not stated*: "
        "streams with an error of NaN, and of the jitter those in which none is seen. The error of a dead time by the "
        "smallest interval is that of an exponential law, and has in it what a hidden jitter could do.",
        table([_row(one, len(found)) for one in covered]),
        "## What is not known",
        table([{"sentence of `calibrate` (its beginning)": text, "streams": n} for text, n in words.most_common()]),
        "## Jitter by its share of the period",
        table(_by_share(jittered)),
    ]


def _row(one: Coverage, streams: int) -> Row:
    return {
        "estimate": one.name,
        "stated": one.stated,
        "not stated": streams - one.stated,
        "within 1": one.within_1,
        "within 2": one.within_2,
        "largest": one.largest,
        "beyond 5": one.beyond_5,
        "smallest p": f"{min(one.p.values()):.2g}",
    }


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
    ideal = one.ideal
    return {
        "signal": ideal.signal,
        "background": ideal.background,
        "period_ns": ideal.period_ns,
        "dead_ns": ideal.dead_ns,
        "sigma_ns": ideal.sigma_ns,
        "jitter_ns": ideal.jitter_ns,
        "unit_ns": ideal.unit_ns,
        "whole": ideal.whole,
        "seed": ideal.seed,
        "registrations": one.registrations,
        "dead time by": one.by,
        **{f"pull of {name}": float(value) for name, value in one.pulls.items()},
        "alarms": "; ".join(one.alarms),
        "flat": one.flat,
        "unknown": "; ".join(one.unknown),
        "refused": one.refused,
        "seconds": one.seconds,
    }
