"""Hours of it: ``python -m tests.fuzz --examples 2000``; a table of counts, and every bad input kept beside it."""

from __future__ import annotations

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


def head() -> str:
    """The commit of this checkout, in short."""
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--examples", type=int, default=500, help="of each format")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--only", default="", help="names that contain this")
parser.add_argument("--keep", type=Path, default=Path("fuzz_bad"), help="folder for the inputs that fared badly")
parser.add_argument("--commit", default="", help="of the code that is read, for the report; default: of this folder")
parser.add_argument("--out", type=Path, help="a Markdown file to write the table to")
given = parser.parse_args()
kinds = ("read", "refused", *BAD)
rows: list[tuple[str, collections.Counter[str]]] = []
cost: list[tuple[float, float]] = []  # most CPU seconds and MiB of a file that was refused
total: collections.Counter[str] = collections.Counter()
began = time.monotonic()
with tempfile.TemporaryDirectory() as folder:
    good = Path(folder) / "good"
    good.mkdir()
    names = [name for name in make(good) if given.only in name]
    server = Server()
    print(f"{'':22}" + "".join(f"{kind:>9}" for kind in kinds), flush=True)
    for name in names:
        counts: collections.Counter[str] = collections.Counter()
        seen: collections.Counter[str] = collections.Counter()
        longest = largest = 0.0

        def tell(found: dict, path: Path, name=name, counts=counts, seen=seen) -> None:
            global longest, largest
            counts[found["kind"]] += 1
            if found["kind"] == "refused":
                longest, largest = max(longest, found["seconds"]), max(largest, found["mib"])
            if found["kind"] in BAD:
                label = found["told"][:60]
                seen[label] += 1
                if seen[label] <= 2:
                    kept = given.keep / f"{given.seed}_{sum(counts.values())}_{name.replace('/', '_')}"
                    given.keep.mkdir(parents=True, exist_ok=True)
                    (shutil.copytree if path.is_dir() else shutil.copy)(path, kept)
                    print(f"  {found['kind']}: {kept}: {found['told'][:300]}", flush=True)

        fuzz(name, good, Path(folder), server, given.examples, given.seed, tell)
        print(f"{name:22}" + "".join(f"{counts[kind]:9}" for kind in kinds), flush=True)
        total += counts
        rows.append((name, counts))
        cost.append((longest, largest))
    print(f"{'all ' + str(sum(total.values())):22}" + "".join(f"{total[kind]:9}" for kind in kinds))
    print(f"{time.monotonic() - began:.0f} s")
    server.close()
if given.out:
    words = [
        "# Mutated files",
        "",
        f"Made by `python -m tests.fuzz --examples {given.examples} --seed {given.seed}` on {datetime.date.today()} at "
        f"{given.commit or head()}, Python {platform.python_version()}: {given.examples} mutations of a good file of "
        "each format, each read in a "
        "process of its own with limits of memory and time. *Read*: as a file may be whose mutation changed nothing "
        "that matters, or numbers without a checksum; *refused*: by one error that names the file. The other columns "
        "are faults: an error without the file's name, one of a library, the end of the process, more than 10 s of CPU "
        "or 1 GiB, or a refusal that takes more than 3 s or 200 MiB. Most s, most MiB: CPU time and memory of the "
        "dearest refusal, above the process before it.",
        "",
        "| format | " + " | ".join(kinds) + " | most s | most MiB |",
        "|---|" + "--:|" * (len(kinds) + 2),
        *(
            f"| {name} | " + " | ".join(str(counts[kind]) for kind in kinds) + f" | {most_s:.2f} | {most_mib:.0f} |"
            for (name, counts), (most_s, most_mib) in zip(
                [*rows, (f"all {sum(total.values())}", total)],
                [*cost, (max(one for one, _ in cost), max(one for _, one in cost))],
                strict=True,
            )
        ),
        "",
    ]
    given.out.write_text("\n".join(words), encoding="utf-8")
raise SystemExit(1 if any(total[kind] for kind in BAD) else 0)
