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
    words = "folder of the reference cases, *.json (studies 'reference', 'joint-covariance')"
    add("--data", type=Path, metavar="DIR", help=words)
    words = "measured photon stream: a .mat with times in units of 64 ps (study 'hardware')"
    add("--stream", type=Path, metavar="FILE", help=words)
    words = (
        "reference engine (study 'count-law'): 'sequential' shares no code with the laws, 'exact' is several "
        "times faster (default: %(default)s)"
    )
    add("--truth", choices=("sequential", "exact"), default="sequential", help=words)
    words = (
        "size of the study 'downstream': some five minutes of one core, or some twenty "
        "(default: %(default)s); with --quick a tiny one, seconds"
    )
    add("--config", choices=("small", "full", "held-out"), default="small", help=words)
    words = "seed of the random systems (studies 'domain', 'long-exposures'), or of scenes for coverage (study 'image')"
    add("--seed", type=int, metavar="N", help=words)
    add("--systems", type=int, metavar="N", help="number of random systems (studies 'domain', 'long-exposures')")
    words = "folder of RGB-D pairs, NAME_depth.png and NAME_colors.png or Middlebury folders (study 'image')"
    add("--rgbd", type=Path, metavar="DIR", help=words)
    words = "folder of measured cubes, .zarr, .h5 or .npz, as `mars_lidar.io.save` writes them (study 'image')"
    add("--captures", type=Path, metavar="DIR", help=words)
    words = (
        "weights of a DRUNet of one channel, such as deepinv's drunet_deepinv_gray_finetune_26k.pth (study 'image'; "
        "without, a small one is trained first)"
    )
    add("--drunet", type=Path, metavar="FILE", help=words)
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
    if "reference" in given.studies and given.data is None:
        parser.error("study 'reference' needs --data DIR, the folder of the reference cases")
    if given.data is not None and not any(given.data.glob("*.json")):
        parser.error(f"--data must be a folder with *.json cases, got {str(given.data)!r}")
    if given.train and given.studies != ["image"]:
        parser.error(f"--train is of study 'image' alone, got {' '.join(given.studies)}")
    for name in ("stream", "drunet"):
        file = getattr(given, name)
        if file is not None and not file.is_file():
            parser.error(f"--{name} must be a file, got {str(file)!r}")
    for name in ("rgbd", "captures"):
        folder = getattr(given, name)
        if folder is not None and not folder.is_dir():
            parser.error(f"--{name} must be a folder, got {str(folder)!r}")
    if given.systems is not None and given.systems < 1:
        parser.error(f"--systems must be at least 1, got {given.systems}")
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
