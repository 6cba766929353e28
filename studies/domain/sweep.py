"""The sweep: every case judged, suspicious ones drawn again with fresh numbers, and what came of it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from queue import SimpleQueue
from typing import Any

from studies import Tell
from studies.common.kept import Lines
from studies.domain.case import Case
from studies.domain.checks import FIRST_LEVEL, Check
from studies.domain.judge import Budget
from studies.domain.systems import draw
from studies.domain.verdict import (
    FAILED,
    UNJUDGED,
    VERIFIED,
    Outcome,
    blamed,
    second_level,
)
from studies.domain.watch import Watched

AGAIN = 4  # times as much is drawn the second time


@dataclass(frozen=True)
class Settings:
    """Systems, seed, and the checks foreseen, from which the level of the second drawing follows."""

    systems: int
    seed: int
    budget: Budget
    checks: int


@dataclass
class Judged:
    """A case with its outcomes; `failing`: checks that both drawings reject; `suspects`: the first did.

    `seconds` of processor time.
    """

    case: Case
    outcomes: list[Outcome]
    failing: list[Check]
    suspects: list[Check]
    seconds: float

    def record(self) -> dict[str, Any]:
        """Plain data, from which `of_record` makes it again."""
        outcomes = [asdict(outcome) for outcome in self.outcomes]
        failing, suspects = ([asdict(check) for check in some] for some in (self.failing, self.suspects))
        return {"outcomes": outcomes, "failing": failing, "suspects": suspects, "seconds": self.seconds}

    @classmethod
    def of_record(cls, case: Case, record: dict[str, Any]) -> Judged:
        """A case that was judged before."""

        def checks(some: list[dict[str, Any]]) -> list[Check]:
            return [Check(**each) for each in some]

        outcomes = [Outcome(**(each | {"checks": checks(each["checks"])})) for each in record["outcomes"]]
        return cls(case, outcomes, checks(record["failing"]), checks(record["suspects"]), record["seconds"])

    @property
    def checks(self) -> int:
        """Comparisons made in the first drawing."""
        return sum(len(outcome.checks) for outcome in self.outcomes)


def sweep(settings: Settings, tell: Tell, lines: Lines, workers: int = 1) -> Iterator[Judged]:
    """Judge system after system, in order, `workers` at a time, each in a process of its own.

    Those that `lines` has are taken from there, all others added.
    """
    idle: SimpleQueue[Watched] = SimpleQueue()

    def judged(number: int) -> Judged:
        case = draw(settings.seed, number)
        if number in lines.records:
            return Judged.of_record(case, lines.records[number])
        watched = idle.get()
        try:
            result = judge_case(case, settings, watched, settings.seed * 1_000_003 + number)
            lines.add(number, result.record())
            return result
        finally:
            idle.put(watched)

    with ExitStack() as stack, ThreadPoolExecutor(workers) as pool:
        for _ in range(workers):
            idle.put(stack.enter_context(Watched()))
        for result in pool.map(judged, range(settings.systems)):
            for subject in sorted({o.subject for o in result.outcomes if o.state == FAILED}):
                tell(f"{result.case.name} ({result.case.family}): {subject} failed")
            yield result


def judge_case(case: Case, settings: Settings, watched: Watched, seed: int) -> Judged:
    """First drawing; a second one, of other random numbers and `AGAIN` times the size, where a check looks wrong."""
    before = watched.seconds
    outcomes = watched.judge(case, 10_000 * seed, settings.budget)
    suspects = [check for outcome in outcomes for check in outcome.checks if not check.p >= FIRST_LEVEL]
    failing: list[Check] = []
    if suspects:
        again = watched.judge(case, 10_000 * seed + 5_000, settings.budget.times(AGAIN), 2.0 * watched.patience)
        level = second_level(settings.checks)
        recorded = {(c.a, c.b, c.what): c for outcome in again for c in outcome.checks}
        for check in suspects:
            if check.a == check.b:  # what must hold of every registration: no chance is in it
                failing.append(check)
                continue
            result = recorded.get((check.a, check.b, check.what))
            if result is None:  # not made a second time: kept only where no chance is in it
                failing += [check] if check.p == 0.0 else []
            elif not result.p >= level:
                failing.append(result)
    for party, checks in blamed(failing).items():
        _blame(outcomes, party, checks)
    return Judged(case, outcomes, failing, suspects, watched.seconds - before)


def _blame(outcomes: list[Outcome], party: str, checks: list[Check]) -> None:
    words = "; ".join(f"{c.what} ({c.a} against {c.b}): p {c.p:.1g}, effect {c.effect:.3g}" for c in checks[:4])
    for outcome in outcomes:
        if outcome.subject == party:
            if outcome.state != FAILED:
                outcome.note = words + (f" [{outcome.state}]" if outcome.state not in (VERIFIED, UNJUDGED) else "")
            outcome.state = FAILED
            return
    outcomes.append(Outcome(party, FAILED, note=words))
