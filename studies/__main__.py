"""``python -m studies``: run studies and write their reports; `studies/__init__.py` says how to add one."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from cyclopts import App

from mars_lidar._base import checks
from mars_lidar.cli import console
from mars_lidar.cli.options import COMMAND_LINE, Text, command
from studies import Request
from studies.registry import STUDIES, run

_DEFAULTS = Request()


def studies(*study: Text, request: Request = _DEFAULTS, train: bool = False) -> int:
    """Run studies. Each writes NAME.md, its figures and NAME.csv into the output folder.

    Arguments
    ---------
    study : STUDY
        One or more of the list below.

    Options
    -------
    train
        Train the networks of the study image instead, and write weights and card into --out.

    Examples
    --------
    python -m studies covariance law --out docs/studies

    Notes
    -----
    Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
    """
    if not study:
        raise ValueError(f"STUDY is missing: one or more of {', '.join(STUDIES)}")
    names = [checks.choice("STUDY", name, tuple(STUDIES)) for name in dict.fromkeys(study)]
    if train and names != ["image"]:
        raise ValueError(f"--train is of study image alone, got {' '.join(names)}")
    request = replace(request, tell=partial(print, file=sys.stderr, flush=True))
    request.out.mkdir(parents=True, exist_ok=True)
    if train:
        from studies.image.train import FULL, QUICK
        from studies.image.train import train as train_networks

        print(*train_networks(request.out, QUICK if request.quick else FULL, request.tell), sep="\n")
        return 0
    for name in names:
        began = time.monotonic()
        print(*run(name, request), sep="\n")
        request.tell(f"{name}: done in {time.monotonic() - began:.0f} s")
    return 0


def studies_app(name: str = "python -m studies") -> App:
    """The command line, called `name`."""
    app = command(studies, name)
    listed = "\n".join(f"  {name:<17} {words}" for name, (_, words) in STUDIES.items())
    app.help_epilogue = f"Studies:\n{listed}\n\n{app.help_epilogue}"
    app.command("studies.compare.command:compare_app", name="compare", help="Engines side by side on one scene.")
    neural = App(name="neural", help="The network of the neural baseline.", **COMMAND_LINE)
    for verb in ("train", "info"):
        neural.command(f"studies.neural.command:{verb}_app", name=verb)
    app.command(neural)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return console.run(studies_app(), sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    sys.exit(main())
