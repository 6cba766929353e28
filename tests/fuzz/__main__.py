"""Hours of it: ``python -m tests.fuzz --examples 2000``; a table of counts, and every bad input kept beside it."""

import argparse
import collections
import datetime
import platform
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from tests.fuzz.formats import make
from tests.fuzz.run import BAD, fuzz
from tests.fuzz.server import Server

KINDS = ("read", "refused", *BAD)
HEAD = f"""# Mutated files

Each row gives the outcomes of reading mutations of a valid file of one format, each in a separate process with limits
on memory and time (`python -m tests.fuzz --examples N --seed S`, Python {platform.python_version()}).
*read*: the mutation had no effect on the content, or changed numbers without a checksum; *refused*: one error that
names the file. The other columns are faults: an error without the file's name (*unnamed*), an exception of a library
(*foreign*), a crash of the process (*crash*), more than 10 s of CPU time (*hang*), more than 1 GiB, or a refusal that
takes more than 3 s or 200 MiB (*memory*). *most s*, *most MiB*: CPU time and memory of the costliest refusal, in
addition to those of the process before it.
"""


def head() -> str:
    """The commit of this checkout, in short."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def write(out: Path, rows: dict[str, list[str]], run: str) -> None:
    """The report: a row a format, and one of sums."""
    columns = list(zip(*rows.values(), strict=True))
    sums = [str(sum(map(int, column))) for column in columns[: len(KINDS)]]
    most = [f"{max(map(float, column)):g}" for column in columns[len(KINDS) :]]
    rows = rows | {f"all {sum(map(int, sums))}": [*sums, *most]}
    heading = f"| format | {' | '.join([*KINDS, 'most s', 'most MiB'])} |\n|---|{'--:|' * (len(KINDS) + 2)}\n"
    body = "".join(f"| {name} | {' | '.join(row)} |\n" for name, row in rows.items())
    note = f"All rows are of one run (commit, date, N, S): {run}."
    out.write_text(f"{HEAD}\n{note}\n\n{heading}{body}", encoding="utf-8")


def main() -> int:
    """Exit code: 1 for a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=500, help="of each format")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="names that contain one of these, with commas between them")
    parser.add_argument("--keep", type=Path, default=Path("fuzz_bad"), help="folder for the inputs that fared badly")
    parser.add_argument(
        "--commit", default="", help="of the code that is read, for the report; default: of this folder"
    )
    parser.add_argument("--out", type=Path, help="a Markdown file for the table")
    given = parser.parse_args()
    code = f"{given.commit or head()}, {datetime.date.today()}, {given.examples}, {given.seed}"
    total: collections.Counter[str] = collections.Counter()
    rows: dict[str, list[str]] = {}
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        good = Path(folder) / "good"
        good.mkdir()
        names = [name for name in make(good) if any(part in name for part in given.only.split(","))]
        server = Server()
        print(f"{'':22}" + "".join(f"{kind:>9}" for kind in KINDS), flush=True)
        for name in names:
            counts: collections.Counter[str] = collections.Counter()
            refusals: list[tuple[float, float]] = [(0.0, 0.0)]  # CPU seconds and MiB
            errors: collections.Counter[str] = collections.Counter()

            def add(outcome: dict, path: Path, name=name, counts=counts, refusals=refusals, errors=errors) -> None:
                kind, error = outcome["kind"], outcome["told"]
                counts[kind] += 1
                if kind == "refused":
                    refusals.append((outcome["seconds"], outcome["mib"]))
                if kind in BAD:
                    errors[error[:60]] += 1
                    if errors[error[:60]] <= 2:
                        copy = given.keep / f"{given.seed}_{sum(counts.values())}_{name.replace('/', '_')}"
                        given.keep.mkdir(parents=True, exist_ok=True)
                        (shutil.copytree if path.is_dir() else shutil.copy)(path, copy)
                        print(f"  {kind}: {copy}: {error[:300]}", flush=True)

            fuzz(name, good, Path(folder), server, given.examples, given.seed, add)
            print(f"{name:22}" + "".join(f"{counts[kind]:9}" for kind in KINDS), flush=True)
            total += counts
            most_s, most_mib = (max(column) for column in zip(*refusals, strict=True))
            rows[name] = [*(str(counts[kind]) for kind in KINDS), f"{most_s:.2f}", f"{most_mib:.0f}"]
            if given.out:
                write(given.out, rows, code)
        print(f"{'all ' + str(sum(total.values())):22}" + "".join(f"{total[kind]:9}" for kind in KINDS))
        print(f"{time.monotonic() - began:.0f} s")
        server.close()
    return 1 if any(total[kind] for kind in BAD) else 0


raise SystemExit(main())
