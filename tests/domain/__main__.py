"""Hours of random systems: ``python -m tests.domain``; each sweep resumes where it was stopped."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from studies import Request
from studies.common.report import make
from tests.domain import long_exposures, run

SWEEPS = {"domain": run, "long-exposures": long_exposures}


def main(arguments: list[str] | None = None) -> int:
    """Write the report of a sweep."""
    parser = argparse.ArgumentParser(prog="python -m tests.domain", description=__doc__)
    parser.add_argument("sweep", nargs="?", choices=list(SWEEPS), default="domain", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("study-results"), help="folder to write into (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="few systems")
    parser.add_argument("--seed", type=int, help="of the random systems")
    parser.add_argument("--systems", type=int, help="number of random systems")
    given = parser.parse_args(arguments)
    sweep = SWEEPS[given.sweep]
    changes = {name: value for name in ("seed", "systems") if (value := getattr(given, name)) is not None}
    settings = replace(sweep.QUICK if given.quick else sweep.FULL, **changes)
    given.out.mkdir(parents=True, exist_ok=True)
    request = Request(out=given.out, quick=given.quick, tell=partial(print, file=sys.stderr, flush=True))
    print(*make(request, given.sweep, sweep, settings), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
