"""``python -m studies``: run studies and write their reports."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path

from mars_lidar._base.imports import MissingLibraryError
from studies import STUDIES, OtherRunsError, Request, run


def _parser(command: str) -> argparse.ArgumentParser:
    listed = "\n".join(f"  {name:<17} {words}" for name, (_, words) in STUDIES.items())
    listed += "\n\nthe network of the neural baseline:\n  neural train|info  see neural --help"
    listed += "\n\nengines side by side on a scene:\n  compare            see compare --help"
    parser = argparse.ArgumentParser(
        prog=command,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Run studies. Each writes NAME.md, its figures and NAME.csv into the output folder.",
        epilog=f"studies:\n{listed}\n\nexample:\n"
        f"  {command} covariance law --out docs/studies\n\n"
        "exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted",
    )
    add = parser.add_argument
    add("studies", nargs="+", choices=list(STUDIES), metavar="STUDY", help="one or more of the list below")
    out = Path("study-results")
    add("--out", type=Path, default=out, metavar="DIR", help="folder to write into, made if missing (%(default)s)")
    add("--quick", action="store_true", help="small grids, few realizations: a preview in seconds, not for citation")
    for option in fields(Request):
        if option.metadata:
            add(f"--{option.name}", default=option.default, **option.metadata)
    words = "train the networks of the study 'image' instead, and write weights and card into --out"
    add("--train", action="store_true", help=words)
    return parser


def main(arguments: Sequence[str] | None = None, command: str = "python -m studies") -> int:
    """Entry point; returns the exit code. `command` is what was called, for the help."""
    asked = list(sys.argv[1:] if arguments is None else arguments)
    if asked[:1] == ["neural"]:
        try:
            from studies.neural.command import main as neural
        except MissingLibraryError as error:
            print(f"{command} neural: {error}", file=sys.stderr)
            return 1
        return neural(asked[1:], f"{command} neural")
    if asked[:1] == ["compare"]:
        from studies.compare.command import main as compare

        return compare(asked[1:], f"{command} compare")
    parser = _parser(command)
    given = parser.parse_args(asked)
    if given.train and given.studies != ["image"]:
        parser.error(f"--train is of study 'image' alone, got {' '.join(given.studies)}")
    try:
        given.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--out must be a folder that can be made, got {str(given.out)!r}: {error.strerror}")
    given.tell = partial(print, file=sys.stderr, flush=True)
    request = Request(**{field.name: getattr(given, field.name) for field in fields(Request)})
    try:
        if given.train:
            from studies.image.train import FULL, QUICK, train

            print(*train(given.out, QUICK if given.quick else FULL, given.tell), sep="\n")
            return 0
        for name in dict.fromkeys(given.studies):
            began = time.monotonic()
            for path in run(name, request):
                print(path)
            request.tell(f"{name}: done in {time.monotonic() - began:.0f} s")
    except (MissingLibraryError, OtherRunsError) as error:
        request.tell(str(error))
        return 1
    except KeyboardInterrupt:
        request.tell("interrupted")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
