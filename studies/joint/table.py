"""Study "joint-table": joint statistics of the histogram's bins for every engine, relative to the closed form.

The count and the mean histogram do not tell a joint law: given N the bins are not multinomial. Reported are the
variance of the count in a signal window, the variance of single bins, and the covariance of neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

from mars_lidar.engines import ANY_SYSTEM
from studies import Facts, Request, Tell
from studies.common.report import crossed, marked
from studies.common.sample import PERIOD_NS
from studies.joint.cases import COARSE, OFTEN, RATIOS, REFERENCE, SEVEN, TOLERANCE, Case, Law, Sample

__all__ = ["COARSE", "OFTEN", "SCORES", "TOLERANCE", "Scores", "beyond", "compute", "run"]  # the first for the report

# `RATIOS` in words
_WORDS = dict(
    zip(RATIOS, ("window variance", "bin variance", "neighbours", "count variance", "window mean"), strict=True)
)
SCORES = 4.0  # standard errors beyond which a figure is marked
Scores = dict[tuple[str, str], dict[str, tuple[float, float]]]  # by case and engine, `RATIOS`


@dataclass(frozen=True)
class Settings:
    """Configuration of the study."""

    cases: tuple[Case, ...]
    realizations: int
    bins: int = 1024
    seed: int = 20267


FULL = Settings(cases=(*REFERENCE, *SEVEN), realizations=20_000)
QUICK = Settings(cases=(REFERENCE[0], REFERENCE[7], SEVEN[6]), realizations=400, bins=256)


def compute(settings: Settings, tell: Tell) -> Scores:
    """All engines that draw any system in all cases, over the closed form."""
    results: Scores = {}
    for number, case in enumerate(settings.cases):
        seed, law = (settings.seed << 16) + 100 * number, Law(case, settings.bins)
        for k, engine in enumerate(ANY_SYSTEM):
            x = Sample.of(case, settings.bins, engine, settings.realizations, seed + k)
            results[case.name, engine] = law.ratios(x)
        tell(f"joint-table: {case.name}")
    return results


def beyond(pair: tuple[float, float], key: str) -> bool:
    """Whether a value, with its standard error, differs from the closed form's by more than chance."""
    value, error = pair
    return abs(value - (0.0 if key == "window mean" else 1.0)) > SCORES * error


def run(settings: Settings, request: Request) -> Facts:
    """All engines in all cases."""
    result = compute(settings, request.tell)
    return {
        "engines": list(ANY_SYSTEM),
        "period_ns": PERIOD_NS,
        "findings": [_finding(engine, result) for engine in ANY_SYSTEM],
        "compared": {
            key: crossed((*who, marked(item[key], beyond(item[key], key))) for who, item in result.items())
            for key in RATIOS
        },
        "rows": [
            {"case": case, "engine": engine}
            | {f"{key.replace(' ', '_')}{end}": item[key][k] for key in RATIOS for k, end in enumerate(("", "_error"))}
            for (case, engine), item in result.items()
        ],
    }


def _finding(engine: str, result: Scores) -> dict[str, object]:
    here = {case: item for (case, name), item in result.items() if name == engine}
    worst = max(here, key=lambda case: abs(here[case]["window"][0] - 1.0))
    return {
        "engine": engine,
        "cases": len(here),
        "off": {words: sum(beyond(item[key], key) for item in here.values()) for key, words in _WORDS.items()},
        "worst": worst,
        "window": here[worst]["window"][0],
    }
