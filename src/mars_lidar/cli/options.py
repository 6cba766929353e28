"""Options that several commands take, and the headings under which options stand in the help."""

from __future__ import annotations

from typing import Any

from mars_lidar.cli.groups import option, panel
from mars_lidar.instrument.presets import PRESETS

of_system, of_run, of_output = (panel(name) for name in ("System", "Simulation", "Output"))

SYSTEM = of_system("YAML or JSON file (see mars-lidar init); single options replace its values.")
DETECTOR = of_system(f"Detector by name, in place of the file's (docs/detectors.md): {', '.join(PRESETS)}.")
SEED = of_run("Seed: the same command gives the same counts.", default=0)
THREADS = of_run("Threads; the counts do not depend on it.", "all cores")


def out(help: str, default: Any = ..., panel: str | None = "Output") -> Any:
    """Where a command writes to: -o, --out."""
    return option(help, None, "-o", "--out", default=default, rich_help_panel=panel)
