"""`python -m benchmarks.training_set --write`: measured figures of docs/generate.md, processor time, cases in turn."""

from __future__ import annotations

import argparse
import datetime
from pathlib import Path

import numpy as np

import mars_lidar as ml
from benchmarks.cluster import SYSTEM
from benchmarks.config import QUICK, Config
from benchmarks.floor import measure_bandwidth
from benchmarks.machine import processor
from benchmarks.storage import epochs
from benchmarks.timing import in_turn
from mars_lidar.dataset import Light
from mars_lidar.dataset.scenes import Rendered, Surfaces
from mars_lidar.light.fog import Fog
from mars_lidar.light.transient import Transient

PAGE = Path(__file__).parents[1] / "docs" / "generate.md"
BEGIN, END = "<!-- python -m benchmarks.training_set -->", "<!-- end -->"
SIDE = 64
CONFIG = Config(mode="quick", side=256, repeats=3)  # 128 cubes: an epoch beside which opening a store is short


def waveforms() -> str:
    """A sentence on the processor time of waveforms, and of simulating one exposure of them."""
    room, nothing = ml.Scene.example("room", SIDE), np.full((SIDE, SIDE), np.nan)
    light = np.random.default_rng(0).exponential(size=(SIDE, SIDE, SYSTEM.bins))
    kinds = {
        "rendered light": Rendered(Transient(light, SYSTEM.bin_ns), nothing, nothing),
        "fog": Surfaces(room, Fog(extinction_per_m=0.05, backscatter=0.3, nearest_m=1.0)),
    }
    texts = []
    for name, content in kinds.items():
        flux = content.flux(SYSTEM, Light(), 1.0, 1.0)
        whole = flux[:]
        took = in_turn(
            {"make": lambda f=flux: f[:], "draw": lambda f=whole: ml.simulate(f, SYSTEM, seed=0, threads=1)}, QUICK
        )
        make, draw = (min(took[what].cpu) for what in ("make", "draw"))
        texts.append(
            f"{name} of {content.waveform_parts(SYSTEM)} parts {make:.2f} s (drawing an exposure {draw:.2f} s)"
        )
    return f"Waveforms of {SIDE} × {SIDE} pixels: {', '.join(texts)}."


def block() -> str:
    """The table of epochs and the sentences below it."""
    rows = epochs(CONFIG, measure_bandwidth(QUICK)).rows
    levels = list(dict.fromkeys(row["S"] for row in rows))
    rates = {(row["epoch"], row["S"]): float(str(row["cubes per CPU s"])) for row in rows}
    lines = [
        "| cubes of 64 × 64 × 1024 a CPU-second | " + " | ".join(f"S = {level:g}" for level in levels) + " |",
        "|---|" + "---:|" * len(levels),
    ]
    for name in dict.fromkeys(row["epoch"] for row in rows):
        lines.append(f"| {name} | " + " | ".join(f"{rates[name, level]:.0f}" for level in levels) + " |")
    date = datetime.datetime.now(datetime.UTC).date()
    note = (
        f"{date}, {processor()}, one process, the best of {CONFIG.repeats} turns; 1000 cycles, SBR 1, batches of 4. "
        f"{waveforms()}"
    )
    return "\n".join([*lines, "", note])


def main() -> None:
    """Print the block, or write it into the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.training_set", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write it into docs/generate.md")
    options = parser.parse_args()
    made = block()
    print(made)
    if options.write:
        text = PAGE.read_text()
        before, rest = text.split(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n\n{made}\n\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
