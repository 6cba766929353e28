"""Options of a system, a run and its output, each with its unit and default in its help.

Those of scenes and light are in `scene_options`, those of effects in `effect_options`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mars_lidar.instrument.presets import PRESETS

_SYSTEM, _RUN, _OUTPUT = "System", "Simulation", "Output"


def _option(*names: str, panel: str, help: str, default: str | None = None, **more: Any) -> Any:
    told = help if default is None else f"{help} [dim]Default: {default}.[/dim]"
    return typer.Option(*names, rich_help_panel=panel, help=told, show_default=False, **more)


Out = Annotated[
    Path,
    _option(
        "-o",
        "--out",
        panel=_OUTPUT,
        help="The cube: .zarr (any size, written as it is simulated), .h5, .hdf5, .npz, .mat or .ptu.",
    ),
]
System = Annotated[
    Path | None,
    _option(
        "--system",
        panel=_SYSTEM,
        help="YAML or JSON file (see mars-lidar init); single options replace its values.",
    ),
]
PeriodNs = Annotated[
    float | None,
    _option("--period-ns", panel=_SYSTEM, help="Laser period, ns.", default="133.33, 7.5 MHz"),
]
DetectorPreset = Annotated[
    str | None,
    _option(
        "--detector",
        panel=_SYSTEM,
        help=f"Detector by name, in place of the file's (docs/detectors.md): {', '.join(PRESETS)}.",
    ),
]
DeadTimeNs = Annotated[
    float | None,
    _option("--dead-time-ns", panel=_SYSTEM, help="Dead time after a registration, ns.", default="75"),
]
Mode = Annotated[
    str | None,
    _option(
        "--mode",
        panel=_SYSTEM,
        default="nonparalyzable",
        help="When the pixel registers: nonparalyzable, paralyzable (every arrival restarts the dead time), "
        "synchronous (armed at each pulse, first photon only) or gated (with --gate-start-ns, --gate-width-ns).",
    ),
]
GateStartNs = Annotated[
    float | None,
    _option("--gate-start-ns", panel=_SYSTEM, help="Mode gated: opening of the gate in each period, ns."),
]
GateWidthNs = Annotated[
    float | None,
    _option("--gate-width-ns", panel=_SYSTEM, help="Mode gated: width of the gate, at most the period, ns."),
]
GateStepNs = Annotated[
    float | None,
    _option("--gate-step-ns", panel=_SYSTEM, help="Mode gated: the opening advances by this, ns ...", default="0"),
]
GateCycles = Annotated[
    int | None,
    _option("--gate-cycles", panel=_SYSTEM, help="... every so many periods.", default="1"),
]
Cycles = Annotated[
    int | None,
    _option("--cycles", panel=_SYSTEM, help="Laser periods per exposure.", default="1000"),
]
Bins = Annotated[
    int | None,
    _option("--bins", panel=_SYSTEM, help="Histogram bins per period.", default="1024"),
]
Start = Annotated[
    str | None,
    _option(
        "--start",
        panel=_SYSTEM,
        help="Pixel at the start of an exposure: armed (ready) or stationary (warmed up).",
        default="armed",
    ),
]
Engine = Annotated[
    str,
    _option(
        "--engine",
        panel=_RUN,
        default="exact",
        help="exact; feedback (long exposures, at a cost independent of them); auto (the faster of these, pixel by "
        "pixel); mars (count law x mean histogram); sequential (slow, independent gold standard); renewal, poisson "
        "(baselines).",
    ),
]
Table = Annotated[
    Path | None,
    _option(
        "--table",
        panel=_RUN,
        help="For --engine mars and renewal: a table of this system (mars-lidar table build), or none: every distinct "
        "pixel is evaluated by itself, some ms each.",
        default="one over the image's range, built and kept in the cache",
    ),
]
Count = Annotated[
    str | None,
    _option(
        "--count",
        panel=_RUN,
        default="exact",
        help="For --engine mars: the law of the count: exact, matched (to four cumulants, faster with --table) or "
        "gaussian (the paper's).",
    ),
]
Interpolation = Annotated[
    str | None,
    _option("--interpolation", panel=_RUN, default="bilinear", help="Of --table: bilinear or nearest."),
]
TableOutside = Annotated[
    str | None,
    _option(
        "--table-outside",
        panel=_RUN,
        default="error",
        help="Of --table, for pixels beyond its range: error, or exact (each is evaluated by itself, some ms).",
    ),
]
Realizations = Annotated[
    int,
    _option("--realizations", panel=_RUN, help="Independent exposures of the image.", default="1"),
]
Seed = Annotated[
    int,
    _option("--seed", panel=_RUN, help="Seed: the same command gives the same counts.", default="0"),
]
Threads = Annotated[
    int | None,
    _option("--threads", panel=_RUN, help="Threads; the counts do not depend on it.", default="all cores"),
]
Device = Annotated[
    str,
    _option("--device", panel=_RUN, help="cpu, or cuda: the current GPU, with the same counts.", default="cpu"),
]
Overwrite = Annotated[
    bool,
    _option("--overwrite", panel=_OUTPUT, help="Replace an existing cube and picture."),
]
Resume = Annotated[
    bool,
    _option("--resume", panel=_OUTPUT, help="Continue a .zarr that was interrupted: the same command, the same bits."),
]
Picture = Annotated[
    bool,
    _option("--picture/--no-picture", panel=_OUTPUT, help="A PNG overview beside the cube.", default="yes"),
]
