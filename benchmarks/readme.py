"""README's table of speed, from the saved full run: ``python -m benchmarks.readme`` writes it, a test compares it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from benchmarks.__main__ import RESULTS
from benchmarks.report import number, table

README = Path(__file__).resolve().parents[1] / "README.md"
SAVED = RESULTS / "full.json"
BLOCK = re.compile(r"(<!-- speed: benchmarks/results/full.json -->\n).*?(<!-- end of speed -->)", re.DOTALL)

_EXACT, _PIPELINE, _LONG = "Exact engine, canonical cube", "The paper's pipeline in NumPy", "One cube over the exposure"
_PATHS, _LAWS, _CLI = "Paths of the exact engine", "Laws of a finite exposure", "Command line, prompt to prompt"


class Saved:
    """Rows of a saved report by title of the section and by what they say of themselves."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.machine: dict[str, Any] = data["machine"]
        self._sections: dict[str, list[dict[str, Any]]] = {s["title"]: s["rows"] for s in data["sections"]}

    def row(self, title: str, case: str, **more: Any) -> dict[str, Any]:
        """The one row of a section with this case."""
        wanted = {"case": case, **more}
        (found,) = (r for r in self._sections[title] if all(r.get(k) == v for k, v in wanted.items()))
        return found

    def ms(self, title: str, case: str, **more: Any) -> str:
        """Its median wall time."""
        value = self.row(title, case, **more)["ms"]
        return f"{number(value)} ms" if value < 1000 else f"{number(value / 1000)} s"

    def ns(self, title: str, case: str, **more: Any) -> str:
        """Its processor time per registration."""
        return f"{self.row(title, case, **more)['ns/reg/core']:.1f} ns"


def _rows(saved: Saved) -> dict[str, str]:
    def long(engine: str) -> str:
        return ", ".join(saved.ms(_LONG, f"N_r = {10**k:,}", engine=engine) for k in range(3, 8))

    one, two, avx2 = "avx512, 1 thread", "avx512, all threads", "avx2, all threads"
    laws = saved.row(_LAWS, "moments and mean histogram"), saved.row(_LAWS, "count pmf")
    return {
        "`exact`, one core / two": (
            f"{saved.ms(_EXACT, one)} ({saved.ns(_EXACT, one)} a registration) / {saved.ms(_EXACT, two)}"
        ),
        "`exact`, AVX2 only, two cores": f"{saved.ms(_EXACT, avx2)} ({saved.ns(_EXACT, avx2)})",
        "`mars` with a table, two cores, at 1e3, 1e4, 1e5, 1e6, 1e7 cycles": long("mars"),
        "`feedback`, two cores, at the same exposures": long("feedback"),
        "`sequential`, two cores": saved.ms(_EXACT, "sequential, all threads"),
        "`poisson`, two cores": saved.ms(_EXACT, "poisson, all threads"),
        "the paper's pipeline in NumPy, one core": saved.ms(
            _PIPELINE, "NumPy, lookup + alignment + multinomial"
        ),
        "waveforms / timestamps (two passes), per registration": (
            f"{saved.ns(_PATHS, 'waveform of 1024 samples')} / {saved.ns(_PATHS, 'timestamps (two passes)')}"
        ),
        "exact mean, variance and mean histogram of one (S, B)": f"{number(laws[0]['ms per (S, B)'])} ms",
        "exact law of the count of one (S, B)": f"{number(laws[1]['ms per (S, B)'])} ms",
        "whole command line of [Start](#start), with / without picture": " / ".join(
            f"{number(saved.row(_CLI, case)['s median'])} s" for case in ("with picture", "without picture")
        ),
    }


def speed(path: Path = SAVED) -> str:
    """The table in Markdown, with a line on where it was measured."""
    saved = Saved(json.loads(path.read_text(encoding="utf-8")))
    machine = saved.machine
    where = (
        f"{machine['processors of this process']} cores of an {machine['processor']} "
        f"({machine['vector levels'].split(',')[0]}), {machine['date'].split()[0]}, from `python -m benchmarks --full` "
        "([all figures](benchmarks/results/full.md)):"
    )
    return f"{where}\n\n{table([{'': what, 'time': time} for what, time in _rows(saved).items()])}\n"


def main() -> None:
    """Write it into README.md."""
    text = README.read_text(encoding="utf-8")
    if not BLOCK.search(text):
        raise SystemExit("README.md has no block for the table of speed")
    README.write_text(BLOCK.sub(lambda m: m[1] + speed() + m[2], text), encoding="utf-8")


if __name__ == "__main__":
    main()
