"""The batteries of TestU01 on the exact engine's random words, and their report: docs/results/randomness.md.

    python tests/randomness/report.py --minutes 60             # SmallCrush in every order, then Crush as far as it gets
    python tests/randomness/report.py --battery BigCrush --minutes 2000

P-values go to docs/results/randomness.csv as they come; tests that it has, of the same seed and generator, are not
repeated. The page tabulates the first seed and lists the tests of others. Debian has TestU01 in its section non-free
(libtestu01-0-dev); `--library` names the folder of another installation, with `include` and `lib` in it.
"""

import argparse
import csv
import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from scipy.stats import kstest

ROOT = Path(__file__).resolve().parents[2]
NATIVE = ROOT / "src" / "mars_lidar" / "native"
RESULTS = ROOT / "docs" / "results"
SOURCES = ("numbers/word_stream.h", "numbers/random.h")  # what draws the words
ORDERS = (  # streams side by side, words of each
    ("pixels", 32, 24),
    ("pixels", 1, 24),
    ("pixels", 32, 3_000_000),
    ("realizations", 32, 24),
    ("seeds", 32, 24),
)
TESTS = {"SmallCrush": 10, "Crush": 96, "BigCrush": 106}
BITS = ("", "-reversed")  # TestU01 looks at the upper bits of a word more than at the lower ones
SUSPECT = 1e-3  # p-values outside of [SUSPECT, 1 - SUSPECT] are listed; TestU01's authors call 1e-10 a clear failure
COLUMNS = ("generator", "seed", "battery", "order", "streams", "words", "test", "p", "seconds", "name")


def generator() -> str:
    """Fingerprint of the code that draws the words."""
    return hashlib.sha256(b"".join((NATIVE / name).read_bytes() for name in SOURCES)).hexdigest()[:12]


def build(folder: Path, library: Path | None) -> Path:
    """The program that runs the batteries."""
    program = folder / "crush"
    command = ["c++", "-std=c++17", "-O3", "-march=native", f"-I{NATIVE}", str(ROOT / "tests/randomness/crush.cpp")]
    tried = []
    for names in (
        ("testu01", "testu01probdist", "testu01mylib"),
        ("testu01", "probdist", "mylib"),
    ):  # Debian's, upstream's
        more = [f"-I{path}" for path in (library / "include").rglob("*") if path.is_dir()] if library else []
        more += [f"-I{library / 'include'}"] if library else []
        more += [f"-L{path.parent}" for path in (library / "lib").rglob("libtestu01.a")] if library else []
        linked = [f"-l:lib{name}.a" if library else f"-l{name}" for name in names]
        done = subprocess.run([*command, *more, "-o", str(program), *linked, "-lm"], text=True, capture_output=True)
        if not done.returncode:
            return program
        tried.append(done.stderr[-2000:])
    raise SystemExit("\n".join(tried) + "\nTestU01 is needed: apt-get install libtestu01-0-dev (Debian, non-free)")


def run(program: Path, battery: str, order: tuple[str, int, int], seed: int, rows: list[dict[str, str]], until: float,
        path: Path) -> None:  # fmt: skip
    """The tests of a battery that `rows` does not have, until a time; `rows` and the file grow by each."""
    kind, streams, words = order
    named = dict(zip(COLUMNS, (generator(), seed, battery, kind, streams, words), strict=False))
    every = set(range(1, 1 + TESTS[battery.removesuffix("-reversed")]))
    while time.monotonic() < until:
        same = [row for row in rows if all(row[key] == str(value) for key, value in named.items())]
        done = {int(row["test"]) for row in same}
        if done == every:
            return
        command = [str(program), battery, kind, str(streams), str(words), str(seed), str(min(every - done))]
        with subprocess.Popen(command, text=True, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            try:
                for line in process.stdout:
                    values = dict(zip(COLUMNS[6:], line.strip().split(",", 3), strict=True))
                    if int(values["test"]) in done or time.monotonic() > until:
                        break  # the process prints all p-values of a test at once, so that none is lost
                    rows.append({**{key: str(value) for key, value in named.items()}, **values})
                    save(rows, path)
                else:
                    if process.wait() != 0:
                        raise RuntimeError(f"{command[0]} ended with exit status {process.returncode}")
            finally:
                process.kill()


def save(rows: list[dict[str, str]], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def report(rows: list[dict[str, str]]) -> str:
    """The page."""
    table, listed, values = [], [], []
    batteries = [name + bits for name in TESTS for bits in BITS]
    for battery in batteries:
        for kind, streams, words in ORDERS:
            key = (rows[0]["seed"], battery, kind, str(streams), str(words))
            own = [row for row in rows if tuple(row[name] for name in COLUMNS[1:6]) == key]
            if not own:
                continue
            tests, of = len({row["test"] for row in own}), TESTS[battery.removesuffix("-reversed")]
            far = [row for row in own if not SUSPECT <= float(row["p"]) <= 1.0 - SUSPECT]
            p = [float(row["p"]) for row in own]
            values += p
            seconds = sum({row["test"]: float(row["seconds"]) for row in own}.values())
            table.append(
                f"| {battery} | {kind} | {streams} | {words:,} | {tests} of {of} | {len(own)} | {min(p):.2g} | "
                f"{max(p):.5g} | {len(far)} | {seconds / 60:.1f} |"
            )
            listed += [f"- {battery}, {kind} x {streams}: test {r['test']}, {r['name']}: p = {r['p']}" for r in far]
    done = {row["battery"] for row in rows}
    again = [f"- test {r['test']}, {r['name']}: p = {r['p']}" for r in rows if r["seed"] != rows[0]["seed"]]
    open_ = [name for name in ("Crush", "BigCrush") if name not in done]
    open_ += [f"the rest of {name}" for name in ("Crush", "BigCrush") if name in done and not _complete(rows, name)]
    return (
        (Path(__file__).parent / "report.md")
        .read_text()
        .format(
            seed=rows[0]["seed"],
            generator=rows[0]["generator"],
            date=time.strftime("%Y-%m-%d"),
            rows="\n".join(table),
            suspect=SUSPECT,
            number=len(values),
            expected=2.0 * SUSPECT * len(values),
            listed="\n".join(listed) or "None.",
            uniform=kstest(values, "uniform").pvalue,
            again="\n".join(again) or "None.",
            open=", ".join([*open_, "PractRand beyond 8 GiB (1 TB was asked for)"]),
        )
    )


def _complete(rows: list[dict[str, str]], battery: str) -> bool:
    own = {row["test"] for row in rows if (row["seed"], row["battery"]) == (rows[0]["seed"], battery)}
    return len(own) == TESTS[battery]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--battery", choices=TESTS, action="append", help="default: SmallCrush, then Crush")
    parser.add_argument("--minutes", type=float, default=60.0, help="then it ends with the tests that are complete")
    parser.add_argument("--seed", type=int, default=20_261_123)
    parser.add_argument("--library", type=Path, help="folder of an installation of TestU01")
    given = parser.parse_args()
    until = time.monotonic() + 60.0 * given.minutes
    path = RESULTS / "randomness.csv"
    rows: list[dict[str, str]] = []
    if path.exists():
        with path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["generator"] == generator()]
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder), given.library)
        for battery in given.battery or ("SmallCrush", "Crush"):
            for order in ORDERS if battery == "SmallCrush" else ORDERS[:1]:
                for bits in BITS if battery == "SmallCrush" else BITS[:1]:
                    run(program, battery + bits, order, given.seed, rows, until, path)
                    if rows:
                        (RESULTS / "randomness.md").write_text(report(rows))
    print(f"{len(rows)} p-values", file=sys.stderr)


if __name__ == "__main__":
    main()
