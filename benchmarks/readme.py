"""Tables of README, paper and pages from the saved run: ``python -m benchmarks.readme``; a test compares them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from benchmarks.__main__ import RESULTS
from benchmarks.report import number, table

ROOT = Path(__file__).resolve().parents[1]
SAVED = RESULTS / "default.json"
_NUMPY = "the paper's pipeline in NumPy, one core ([runtime](docs/results/runtime.md))"

_EXACT, _LONG = "Exact engine, canonical cube", "One cube over the exposure"
_PATHS, _LAWS, _CLI = "Paths of the exact engine", "Laws of a finite exposure", "Command line, prompt to prompt"


class Saved:
    """Rows of a saved report by title of the section and by what they say of themselves."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.machine: dict[str, Any] = data["machine"]
        self._sections: dict[str, list[dict[str, Any]]] = {s["title"]: s["rows"] for s in data["sections"]}

    def section(self, title: str) -> list[dict[str, Any]]:
        """All its rows."""
        return self._sections[title]

    def row(self, title: str, case: str, **more: Any) -> dict[str, Any]:
        """The one row of a section with this case."""
        wanted = {"case": case, **more}
        (match,) = (r for r in self._sections[title] if all(r.get(k) == v for k, v in wanted.items()))
        return match

    def ms(self, title: str, case: str, **more: Any) -> str:
        """Its median wall time."""
        return _time(self.row(title, case, **more)["ms"])

    def ns(self, title: str, case: str, **more: Any) -> str:
        """Its processor time per registration."""
        return f"{self.row(title, case, **more)['ns/reg/core']:.1f} ns"


def _time(ms: float) -> str:
    return f"{number(ms)} ms" if ms < 1000 else f"{number(ms / 1000)} s"


def _numpy_pipeline() -> str:
    """The same cube by the paper's pipeline, from the page of the study "runtime"."""
    text = ROOT.joinpath("docs/results/runtime.md").read_text(encoding="utf-8")
    (seconds,) = re.findall(r"^\| MaRS pipeline in NumPy, table \| ([\d.]+) \|", text, re.MULTILINE)
    return _time(1e3 * float(seconds))


def _rows(saved: Saved) -> dict[str, str]:
    def long(engine: str) -> str:
        return ", ".join(saved.ms(_LONG, f"N_r = {10**k:,}", engine=engine) for k in range(3, 8))

    single, two, avx2 = "avx512, 1 thread", "avx512, all threads", "avx2, all threads"
    laws = saved.row(_LAWS, "moments and mean histogram"), saved.row(_LAWS, "count pmf")
    return {
        "`exact`, one core / two": (
            f"{saved.ms(_EXACT, single)} ({saved.ns(_EXACT, single)} a registration) / {saved.ms(_EXACT, two)}"
        ),
        "`exact`, AVX2 only, two cores": f"{saved.ms(_EXACT, avx2)} ({saved.ns(_EXACT, avx2)})",
        "`mars` with a table, two cores, at 1e3, 1e4, 1e5, 1e6, 1e7 cycles": long("mars"),
        "`feedback`, two cores, at the same exposures": long("feedback"),
        "`sequential`, two cores": saved.ms(_EXACT, "sequential, all threads"),
        "`poisson`, two cores": saved.ms(_EXACT, "poisson, all threads"),
        _NUMPY: _numpy_pipeline(),
        "waveforms / timestamps (into fresh memory), one core": (
            f"{saved.ns(_PATHS, 'waveform of 1024 samples')} / {saved.ns(_PATHS, 'timestamps, fresh memory')}"
        ),
        "exact mean, variance and mean histogram of one (S, B)": f"{number(laws[0]['ms per (S, B)'])} ms",
        "exact law of the count of one (S, B)": f"{number(laws[1]['ms per (S, B)'])} ms",
        "whole command line of [Start](#start), with / without picture": " / ".join(
            f"{number(saved.row(_CLI, case)['s median'])} s" for case in ("with picture", "without picture")
        ),
    }


def _where(saved: Saved) -> str:
    machine = saved.machine
    return (
        f"{machine['processors of this process']} cores of an {machine['processor']} "
        f"({machine['vector levels'].split(',')[0]}), {machine['date'].split()[0]}, from `python -m benchmarks` "
        "([all figures](benchmarks/results/default.md)):"
    )


def speed(saved: Saved) -> str:
    """The whole table, with a line on where it was measured."""
    return f"{_where(saved)}\n\n{table([{'': what, 'time': time} for what, time in _rows(saved).items()])}\n"


def figures(saved: Saved) -> str:
    """README's few figures."""
    rows, million = _rows(saved), "N_r = 1,000,000"
    selected = (
        "`exact`, one core / two",
        _NUMPY,
        "exact law of the count of one (S, B)",
    )
    chosen = {what: rows[what] for what in selected}
    chosen["`auto`, two cores, at a million cycles"] = saved.ms(_LONG, million, engine="auto")
    return f"{_where(saved)}\n\n{table([{'': what, 'time': time} for what, time in chosen.items()])}\n"


def exposures(saved: Saved) -> str:
    """The table of docs/engines.md: one image over the exposure."""
    return table([_exposure(saved, 10**k) for k in range(3, 8)]) + "\n"


def epochs(saved: Saved) -> str:
    """The table of docs/generate.md: epochs of a store."""
    rows: dict[str, dict[str, str]] = {}
    for row in saved.section("Epochs over a store, one process"):
        name = row["epoch"]
        columns = rows.setdefault(name, {"cubes of 64 × 64 × 1024 a CPU-second": name})
        columns[f"S = {row['S']:g}"] = f"{row['cubes per CPU s']:.0f}"
    return f"{table(list(rows.values()))}\n\n{saved.machine['processor']}, {saved.machine['date'].split()[0]}.\n"


def _exposure(saved: Saved, cycles: int) -> dict[str, str]:
    row = {"laser cycles": f"{cycles:,}"}
    for engine in ("exact", "feedback", "auto", "mars"):
        try:
            row[f"`{engine}`"] = saved.ms(_LONG, f"N_r = {cycles:,}", engine=engine)
        except ValueError:
            row[f"`{engine}`"] = "-"
    return row


BLOCKS = {"speed": speed, "figures": figures, "exposures": exposures, "epochs": epochs}
TABLES = ("README.md", "docs/engines.md", "docs/generate.md", "docs/speed.md")


def filled(name: str) -> tuple[str, str]:
    """A document as it is, and with its tables made anew."""
    text = new = ROOT.joinpath(name).read_text(encoding="utf-8")
    saved, blocks = Saved(json.loads(SAVED.read_text(encoding="utf-8"))), 0
    for what, make in BLOCKS.items():
        made = make(saved)
        if name.startswith("docs/"):
            made = (
                made.replace("](benchmarks/", "](../benchmarks/")
                .replace("](docs/", "](")
                .replace("](#start)", "](start.md)")
            )
        block = re.compile(rf"(<!-- {what}: [^>]*-->\n).*?(<!-- end of {what} -->)", re.DOTALL)
        new, count = block.subn(lambda m, made=made: m[1] + made + m[2], new)
        blocks += count
    if not blocks:
        raise SystemExit(f"{name} has no block <!-- {', '.join(BLOCKS)}: ... -->")
    return text, new


def main() -> None:
    """Write them."""
    for name in TABLES:
        ROOT.joinpath(name).write_text(filled(name)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
