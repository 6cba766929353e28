"""The sweep: every case judged, suspicious ones drawn again with fresh numbers, and what came of it."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from types import TracebackType
from typing import Any

from mars_lidar._base.files import beside
from studies import OtherRunsError, Tell
from tests.domain.checks import FIRST_LEVEL, Check
from tests.domain.judge import FAILED, SLOW, UNJUDGED, VERIFIED, Budget, Outcome, blamed, judge, second_level
from tests.domain.systems import Case, draw


class Lines:
    """JSON records by number, one a line of a file that is only appended to: a study that was stopped goes on with it.

    The first line is the configuration; a file of another one is refused. A last line that was cut short is dropped.
    """

    def __init__(self, path: Path, config: Mapping[str, Any]) -> None:
        self.path, self.records, self._lock = path, dict[int, Any](), Lock()
        head = json.dumps(config)
        lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
        if lines and lines[0] != head:
            raise OtherRunsError(f"{path} holds runs of another configuration; give another --out, or delete it")
        self.records.update(json.loads(line) for line in lines[1:])
        with beside(path) as unfinished:
            unfinished.write_text("\n".join(lines or [head]) + "\n", encoding="utf-8")

    def add(self, number: int, record: Any) -> None:
        """Keep a record; from any thread."""
        self.records[number] = record
        with self._lock, self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([number, record]) + "\n")


PATIENCE = 2.1  # seconds of processor time of one step before it is stopped
_WALL = 8.0  # the same on the clock, for what sleeps or machines that are busy, in units of the patience


class Watched:
    """Judges cases in a second process, which is started again where a step had to be stopped.

    A step that takes longer than `patience` seconds is "slower than real use", one that ends the process "failed"; the
    case then goes on without it.
    """

    def __init__(self, patience: float = PATIENCE) -> None:
        self.patience = patience
        self.seconds = 0.0  # of processor time, of all processes so far; of those that were stopped their patience
        self.process: multiprocessing.process.BaseProcess | None = None
        self.pipe: Connection | None = None

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.process is not None:
            self.process.kill()
            self._ended()

    def judge(self, case: Case, seed: int, budget: Budget, patience: float | None = None) -> list[Outcome]:
        """All outcomes of `case`, those of stopped steps among them."""
        stopped: list[Outcome] = []
        while True:
            skip = [o.subject for o in stopped]
            ended = self._once(case, seed, budget, skip, patience or self.patience)
            if isinstance(ended, list):
                return stopped + ended
            stopped.append(ended)
            if ended.subject == "between steps":
                return stopped

    def _once(
        self, case: Case, seed: int, budget: Budget, skip: Sequence[str], patience: float
    ) -> list[Outcome] | Outcome:
        """The outcomes, or the one outcome of the step that ended the process."""
        if self.pipe is None:
            self._start()
        assert self.pipe is not None
        subject = "between steps"
        try:
            self.pipe.send((case, seed, budget, list(skip), patience))
            while isinstance(message := self.pipe.recv(), str):
                subject = message
        except (EOFError, OSError):
            self.seconds += patience
            code = self._ended()
            if code in (-signal.SIGPROF, -signal.SIGALRM):
                return Outcome(subject, SLOW, patience, f"stopped after {patience:g} s")
            return Outcome(subject, FAILED, 0.0, f"the process ended with code {code}")
        outcomes, seconds = message
        self.seconds += seconds
        return list(outcomes)

    def _start(self) -> None:
        context: Any = multiprocessing.get_context("spawn")
        if "forkserver" in multiprocessing.get_all_start_methods():  # a new process begins with everything imported
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(["tests.domain.judge"])
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()

    def _ended(self) -> int | None:
        """Clear up after the process; its exit code, less than 0 of a signal."""
        assert self.process is not None
        assert self.pipe is not None
        self.process.join()
        self.pipe.close()
        self.pipe = None
        return self.process.exitcode


def _work(pipe: Connection) -> None:
    """The second process: case after case, until the pipe is closed; timers that run out end it, in native code too."""
    os.environ["OMP_NUM_THREADS"] = "1"
    while True:
        try:
            case, seed, budget, skip, patience = pipe.recv()

            def tell(subject: str, what: str, patience: float = patience) -> None:
                _timers(patience)
                pipe.send(subject if what == "begin" else "between steps")

            _timers(patience)
            began = time.process_time()
            outcomes = judge(case, seed, budget, tell, skip)
            _timers(0.0)
            pipe.send((outcomes, time.process_time() - began))
        except (EOFError, KeyboardInterrupt, BrokenPipeError):
            return


def _timers(patience: float) -> None:
    """End this process after so many seconds of processor time, or times as many on the clock; 0 for never."""
    signal.setitimer(signal.ITIMER_PROF, patience)
    signal.setitimer(signal.ITIMER_REAL, _WALL * patience)


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
