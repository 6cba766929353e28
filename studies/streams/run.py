"""Study "streams": false alarms, what is not known, and how well stated errors hold."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from studies import Request
from studies.common.draw import panels
from studies.common.report import Row, configuration, machine, save_csv, save_figure, save_text, table
from studies.streams.cases import FULL, QUICK, Coverage, Law, Outcome, Settings, coverage, outcomes, tail

LEVEL = 1e-4  # false-alarm probability of an inspection, as it is stated
FAMILY = 1e-3  # of all tests of coverage together, by Holm


def run(request: Request) -> list[Path]:
    """Compute and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    found = outcomes(settings, request.tell)
    spent = time.process_time() - began + sum(one.seconds for one in found)
    return written(request, settings, found, spent)


def written(request: Request, settings: Settings, found: list[Outcome], spent: float) -> list[Path]:
    """The report of the outcomes, with its table and figure; `spent`: processor time, s."""
    covered = coverage(found)
    findings = _findings(found, covered)
    for line in findings:
        request.tell(line)
    text = save_text(request.out / "streams.md", _text(settings, found, covered, findings, request.quick, spent))
    rows = save_csv(request.out / "streams.csv", [_csv_row(one) for one in found])
    return [text, rows, save_figure(request.out / "streams.png", figure(found, covered))]


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
    wanted = sum(one.stated * tail(5.0, one.law) for one in covered)
    lines.append(
        f"Of {total:,} stated errors {beyond} are exceeded by more than 5 times, where {wanted:.2g} are expected."
    )
    for number, one in enumerate(found):
        far = [f"{name} {pull:.3g}" for name, pull in one.pulls.items() if abs(pull) > 5.0]
        if far:
            ideal = one.ideal
            lines.append(
                f"Stream {number} (S {ideal.signal:.3g}, B {ideal.background:.2g}, jitter {ideal.jitter_ns:.2g} and "
                f"pulse {ideal.sigma_ns:.2g} of {ideal.period_ns:.4g} ns): off by " + ", ".join(far) + " stated errors."
            )
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
        "Differences from the truth over the stated error (normal: 0.683 within 1, 0.954 within 2; exponential: 0.632 "
        "and 0.865). *Not stated*: streams with an error of NaN, and of the jitter those in which none is seen. The "
        "error of a dead time by the smallest interval is that of an exponential law, with what a hidden jitter could "
        "do in it: all dead times down to 0 are possible where no light would have shown them.",
        "![Errors beside the truth](streams.png)",
        table([_row(one, _streams(one, found)) for one in covered]),
        "## What is not known",
        table([{"sentence of `calibrate` (its beginning)": text, "streams": n} for text, n in words.most_common()]),
        "## Jitter by its share of the period",
        table(_by_share(jittered)),
    ]


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
        if one.values.size:
            above = (one.values[:, None] > at).mean(0)
            right.plot(at, np.where(above > 0.0, above, np.nan), lw=1, label=one.name)
    laws: list[tuple[Law, str]] = [("normal", "k--"), ("exponential", "k:")]
    for law, style in laws:
        right.plot(at, [tail(value, law) for value in at], style, lw=1, label=law)
    right.set(yscale="log", ylim=(1e-3, 1.0), xlabel="stated errors", ylabel="share of streams beyond")
    right.legend(fontsize=6, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return drawing


def _streams(one: Coverage, found: list[Outcome]) -> int:
    """Of how many streams the estimate could have been stated."""
    ways = [outcome for outcome in found if outcome.by and one.name.endswith(outcome.by)]
    return len(ways) if one.name.startswith("dead time") else len(found)


def _row(one: Coverage, streams: int) -> Row:
    return {
        "estimate": one.name,
        "law": one.law,
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
