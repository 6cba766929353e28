"""Cases in a process of their own, with a watchman: what hangs or crashes is an outcome, not the end of the sweep."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
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
            context.set_forkserver_preload(["studies.domain.judge"])
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
