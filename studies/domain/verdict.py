"""What becomes of a subject (an engine or a prediction) in a case, and who is to blame where two disagree."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field

from mars_lidar.statistics import ConvergenceError
from studies.domain.checks import FIRST_LEVEL, Check

VERIFIED, REFUSED, HANDED, SLOW, FAILED, UNJUDGED = (
    "verified",
    "refused",
    "given to exact",
    "slower than real use",
    "failed",
    "not judged",
)
STATES = (VERIFIED, HANDED, REFUSED, SLOW, UNJUDGED, FAILED)
ENGINES = ("exact", "feedback", "auto", "mars", "sequential")
LAWS = ("count_law", "pmf", "mean_histogram", "stationary shape", "joint_law", "cramer_rao")
SUBJECTS = (*ENGINES, "timestamps", *LAWS)
_SUSPECTS = (
    "feedback",
    "auto",
    "mars",
    "cramer_rao",
    "stationary shape",
    "pmf",
    "joint_law",
    "mean_histogram",
    "count_law",
    "timestamps",
    "exact",
    "sequential",
    "simulator",
    "closed form",
)
_ADVICE = re.compile(
    r"\b(use|engines?|instead|simulat\w*|give|take|methods?|shorter|fewer|must|at most|at least|mode)\b", re.IGNORECASE
)

FAMILY_LEVEL = 1e-3  # of the sweep: both drawings of a check reject


@dataclass
class Outcome:
    """What one subject did in a case."""

    subject: str
    state: str
    seconds: float = 0.0
    note: str = ""
    checks: list[Check] = field(default_factory=list)


def refusal(error: BaseException) -> bool:
    """Whether an exception says what to do, as a refusal has to."""
    return isinstance(error, (ValueError, MemoryError, ConvergenceError)) and bool(_ADVICE.search(str(error)))


def blamed(failing: list[Check]) -> dict[str, list[Check]]:
    """Checks by the party at fault: whoever is in most of the failing pairs, again and again until none is left.

    Of two that stand alone against each other it is the one further from first principles (`_SUSPECTS`, in order).
    """
    remaining, result = list(failing), {}
    while remaining:
        times = Counter(name for check in remaining for name in {check.a, check.b})
        pairs = {name: len({frozenset((c.a, c.b)) for c in remaining if name in (c.a, c.b)}) for name in times}
        worst = min(times, key=lambda name: (-pairs[name], (*_SUSPECTS, name).index(name)))
        result[worst] = [check for check in remaining if worst in (check.a, check.b)]
        remaining = [check for check in remaining if worst not in (check.a, check.b)]
    return result


def second_level(checks: int) -> float:
    """Level of the second drawing, so that `checks` true hypotheses all survive with probability 1 - `FAMILY_LEVEL`."""
    return FAMILY_LEVEL / (max(checks, 1) * FIRST_LEVEL)
