"""Progress of a long run: a line that is rewritten on a terminal, a line every half minute in a log."""

import sys
import time
from typing import Any

from mars_lidar._base.tolerances import TOL
from mars_lidar._base.types import Progress


def callback_of(progress: Any, label: str) -> Progress | None:
    """The callback of an argument `progress`: a function, True for a `Bar`, None or False for none."""
    if progress is None or progress is False:
        return None
    if progress is True:
        return Bar(label)
    if not callable(progress):
        raise TypeError(f"progress must be callable as progress(done, total), or True, got {progress!r}")
    callback: Progress = progress
    return callback


def of_part(progress: Progress | None, first: int, last: int, total: int) -> Progress | None:
    """The callback for one part of the work, from `first` to `last` of `total`; never backward."""
    if progress is None:
        return None
    reached = first

    def update(done: int, of: int) -> object:
        nonlocal reached
        reached = max(reached, first + (last - first) * done // max(of, 1))
        return progress(reached, total)

    return update


class Bar:
    """A callback (done, total) that prints the progress and the remaining time on standard error."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._live = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._began = self._last = time.monotonic()
        self._warned, self._width = False, 0
        self._before: int | None = None  # done by an earlier run: no part of this one's speed

    def __call__(self, done: int, total: int) -> None:
        """Print the progress, at most every 0.2 s on a terminal and every 30 s in a log."""
        now = time.monotonic()
        spent = now - self._began
        if self._before is None:
            self._before = done if done < total and spent < TOL.patience_s else 0
        if done >= total:
            self.close()
        elif self._live and done and spent > TOL.patience_s and now - self._last > TOL.often_s:
            self._last = now
            text = self._text(done, total, spent)
            sys.stderr.write("\r" + text.ljust(self._width))
            sys.stderr.flush()
            self._width = len(text)
        elif not self._live and (now - self._last > TOL.seldom_s or self._first_is_due(done, total, spent)):
            self._last, self._warned = now, True
            print(f"mars-lidar: {self._text(done, total, spent)}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Clear the line on the terminal."""
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")
            sys.stderr.flush()
            self._width = 0

    def _first_is_due(self, done: int, total: int, spent: float) -> bool:
        own, rest = done - (self._before or 0), total - (self._before or 0)
        return not self._warned and own > 0 and own >= 0.05 * rest and spent > 2.0 and spent * rest / own > TOL.long_s

    def _text(self, done: int, total: int, spent: float) -> str:
        own = done - (self._before or 0)
        remaining = f", about {span(spent * (total - done) / own)} left" if own > 0 else ""
        return f"{self._label}: {100 * done / total:.0f} % after {span(spent)}{remaining}"


def span(seconds: float) -> str:
    """A duration as text: two or three digits and a suitable unit."""
    if seconds < 120:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"
    return f"{seconds / 60:.3g} minutes" if seconds < 7200 else f"{seconds / 3600:.3g} hours"
