"""Cases in a process of their own, with a watchman: what hangs or crashes is an outcome, not the end of the sweep."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

from studies.domain.case import Case
from studies.domain.judge import Budget, judge
from studies.domain.verdict import FAILED, SLOW, Outcome

PATIENCE = 2.1  # seconds of processor time of one step before it is stopped
_WALL = 8.0  # the same on the clock, for what sleeps or machines that are busy, in units of the patience


class Watched:
    """Judges cases in a second process, which is started again where a step had to be stopped.

    A step that takes longer than `patience` seconds is "slower than real use", one that ends the process "failed"; the
    case then goes on without it.
    """

    def __init__(self, patience: float = PATIENCE) -> None:
        self.patience = patience
        self.process: multiprocessing.process.BaseProcess | None = None
        self.pipe: Connection | None = None

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stop()

    def judge(self, case: Case, seed: int, budget: Budget, patience: float | None = None) -> list[Outcome]:
        """All outcomes of `case`, those of stopped steps among them."""
        stopped: list[Outcome] = []
        while True:
            ended = self._once(case, seed, budget, [o.subject for o in stopped], patience or self.patience)
            if isinstance(ended, list):
                return stopped + ended
            stopped.append(ended)

    def _once(
        self, case: Case, seed: int, budget: Budget, skip: Sequence[str], patience: float
    ) -> list[Outcome] | Outcome:
        """The outcomes, or the one outcome of the step that had to be stopped."""
        if self.process is None:
            self._start()
        assert self.pipe is not None
        self.pipe.send((case, seed, budget, list(skip)))
        subject = "between steps"
        while True:
            try:
                if not self._heard(patience):
                    self._stop()
                    slow = Outcome(case.name, subject, SLOW, patience, f"stopped after {patience:g} s")
                    return [slow] if subject == "between steps" else slow
                told = self.pipe.recv()
            except (EOFError, OSError):
                self._stop()
                ended = Outcome(case.name, subject, FAILED, 0.0, "the process ended")
                return [ended] if subject == "between steps" else ended
            if isinstance(told, list):
                return told
            subject = told[0] if told[1] == "begin" else "between steps"

    def _heard(self, patience: float) -> bool:
        """Wait for the next word of the process: False where it has worked for longer than `patience`."""
        assert self.pipe is not None
        assert self.process is not None
        began, work = time.monotonic(), processor_seconds(self.process.pid)
        while not self.pipe.poll(0.1):
            worked = processor_seconds(self.process.pid)
            if worked is not None and work is not None and worked - work > patience:
                return False
            if time.monotonic() - began > (_WALL if work is not None else 1.0) * patience:
                return False
        return True

    def _start(self) -> None:
        context: Any = multiprocessing.get_context("spawn")
        if "forkserver" in multiprocessing.get_all_start_methods():  # a new process begins with everything imported
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(["studies.domain.judge"])
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()

    def _stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
        if self.pipe is not None:
            self.pipe.close()
        self.process = self.pipe = None


def processor_seconds(pid: int | None) -> float | None:
    """Processor time that a process has had so far; None where the system does not say (Linux does)."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


def _work(pipe: Connection) -> None:
    """The second process: case after case, until the pipe is closed."""
    os.environ["OMP_NUM_THREADS"] = "1"
    while True:
        try:
            case, seed, budget, skip = pipe.recv()
            pipe.send(judge(case, seed, budget, lambda subject, what: pipe.send((subject, what)), skip))
        except (EOFError, KeyboardInterrupt, BrokenPipeError):
            return
