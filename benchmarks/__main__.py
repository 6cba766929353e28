"""``python -m benchmarks``: run, print and save."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks import (
    engines,
    estimators,
    exposures,
    forward,
    laws,
    paths,
    startup,
    storage,
    stream,
    user,
)
from benchmarks.config import DEFAULT, FULL, QUICK, Config
from benchmarks.floor import Bandwidth, measure_bandwidth
from benchmarks.machine import describe_machine, load
from benchmarks.report import Report, Section

RESULTS = Path(__file__).parent / "results"

SECTIONS: dict[str, Callable[[Config, Bandwidth], Section]] = {
    "exact": engines.exact_levels,
    "user": user.first_calls,
    "long": exposures.long_exposures,
    "paths": paths.exact_paths,
    "effects": paths.detector_effects,
    "exposure": laws.exposure_laws,
    "reconstruction": estimators.reconstruction,
    "codecs": storage.codecs,
    "datasets": storage.datasets,
    "epochs": storage.epochs,
    "waveforms": storage.waveforms,
    "stream": stream.stream,
    "forward": forward.forward,
    "import": startup.import_time,
    "cli": startup.command_line,
}
QUICK_SECTIONS = ("exact", "user", "long", "exposure", "reconstruction", "import")  # some 40 s of a processor


def run(config: Config, names: Sequence[str] = tuple(SECTIONS), tell: Callable[[str], object] = str) -> Report:
    """Run the named sections; `tell` hears each as it is done."""
    began, machine = time.perf_counter(), describe_machine(config)
    bandwidth = measure_bandwidth(config)
    configuration = {
        "mode": config.mode,
        "canonical": config.describe(),
        "turns": f"at most {config.repeats}, and {config.seconds:g} s a group",
        "fill bandwidth, GB/s": ", ".join(
            f"{name.replace('_', ' ')} {rate / 1e9:.1f}" for name, rate in vars(bandwidth).items()
        ),
    }
    report = Report(machine, configuration)
    for name in names:
        start = time.perf_counter()
        report.sections.append(SECTIONS[name](config, bandwidth))
        tell(f"{name}: {time.perf_counter() - start:.1f} s")
    machine["load"] = f"{machine['load']} before, {load()} after"
    machine["run time"] = f"{time.perf_counter() - began:.0f} s"
    return report


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Time mars_lidar and print and save a table."
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="under a minute: without effects, files, learning")
    size.add_argument("--full", action="store_true", help="many turns, tables unscaled: for the record")
    parser.add_argument(
        "--only",
        action="append",
        choices=list(SECTIONS),
        metavar="NAME",
        help=f"this section, may be repeated: {', '.join(SECTIONS)}",
    )
    parser.add_argument(
        "--out", type=Path, default=RESULTS, metavar="DIR", help="where to save, default benchmarks/results"
    )
    chosen = parser.parse_args(arguments)
    config = QUICK if chosen.quick else FULL if chosen.full else DEFAULT
    report = run(config, chosen.only or (QUICK_SECTIONS if chosen.quick else tuple(SECTIONS)), _tell)
    print(report.markdown())
    stem = "-".join([config.mode, *(chosen.only or ())])
    for path in report.save(chosen.out, stem):
        _tell(f"wrote {path}")


if __name__ == "__main__":
    main()
