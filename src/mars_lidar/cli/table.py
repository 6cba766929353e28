"""`mars-lidar table`: build the lookup table of a system, describe a file or the cache, clear the cache."""

import time
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from mars_lidar._base.progress import span
from mars_lidar.cli.console import progress_bar, refuse_existing, table
from mars_lidar.cli.options import COMMAND_LINE, Integer, OutPath, Text, command
from mars_lidar.cli.system_options import Effects, SystemOptions
from mars_lidar.table import Table
from mars_lidar.table.error import QuantisationError
from mars_lidar.table.storage import cache_folder, cached_tables


def build(
    *,
    instrument: SystemOptions = SystemOptions(),
    effects: Effects = Effects(),
    signal: Text = "0.01,10,256",
    background: Text = "0.01,10,100",
    method: Text = "exposure",
    rearm: Text = "centre",
    threads: Integer | None = None,
    out: OutPath | None = None,
    overwrite: bool = False,
) -> None:
    """Build the table of a system, in a file or in the cache; a cached table is reused.

    Grid
    ----
    signal : LOW,HIGH,POINTS
        Signal axis, photons per period, log-spaced; 0 is added. [default: 0.01,10,256]
    background : LOW,HIGH,POINTS
        Background axis, likewise. [default: 0.01,10,100]
    method
        exposure (exact, start-up included) or mars (the paper's). [default: exposure]
    rearm
        For mars: re-arming at the centre or the edge of a bin. [default: centre]

    Simulation
    ----------
    threads
        Threads; the counts do not depend on it. [default: all cores]

    Options
    -------
    out
        The table: .h5 or .hdf5. Without it: the cache.

    Output
    ------
    overwrite
        Replace an existing table.
    """
    began = time.perf_counter()
    refuse_existing(out, overwrite)
    system = instrument.build(effects)
    axes = _grid("--signal", signal), _grid("--background", background)
    chosen: dict[str, Any] = {"method": method, "rearm": rearm, "threads": threads}
    with progress_bar("building") as progress:
        if out is None:
            path = Table.cached_path(system, *axes, progress=progress, **chosen)
        else:
            Table.build(system, *axes, progress=progress, **chosen).save(out, overwrite=overwrite)
            path = out
    table(_rows(path) | {"time": f"{span(time.perf_counter() - began)} in all"})


def info(file: Path | None = None, /) -> None:
    """Describe a table, or list the tables in the cache.

    Arguments
    ---------
    file
        A table: .h5 or .hdf5. Without it: the cache.
    """
    if file is not None:
        table(_rows(file))
        return
    files = cached_tables()
    total = sum(path.stat().st_size for path in files)
    rows = [("cache", f"{cache_folder()}: {len(files)} files, {total / 1e6:,.4g} MB")]
    table(rows + [(f"{path.stat().st_size / 1e6:,.4g} MB", _line(path)) for path in files])


def clear(*, yes: Annotated[bool, Parameter(("--yes", "-y"))] = False) -> None:
    """Remove the tables in the cache.

    Options
    -------
    yes
        Do not ask.
    """
    files = cached_tables()
    if not files:
        print(f"{cache_folder()} holds no tables")
        return
    what = f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:,.4g} MB"
    if not yes and not _confirmed(f"remove {what}, from {cache_folder()}?"):
        print("nothing was removed")
        return
    for path in files:
        path.unlink()
    print(f"removed {what}")


def _confirmed(question: str) -> bool:
    try:
        return input(f"{question} [y/N]: ").strip().lower() in ("y", "yes")
    except EOFError:  # there is nobody to ask
        return False


def _grid(name: str, text: str) -> tuple[float, float, int]:
    try:
        low, high, points = text.split(",")
        return float(low), float(high), int(points)
    except ValueError:
        raise ValueError(f"{name} must be LOW,HIGH,POINTS, such as 0.01,10,256, got {text!r}") from None


def _rows(path: Path) -> dict[str, str]:
    stored = Table.load(path)
    system, provenance, made = stored.system, stored.provenance, stored.provenance["error"]
    size, shapes, enough = path.stat().st_size, stored.entries.shape.nbytes, stored.entries.enough
    never, later = int((enough < 0).sum()), int(enough.max())
    if never:
        serves = f"{system.cycles:,}; {never} entries have not settled by then and serve no other number"
    else:
        serves = f"any number from {later:,} on (made for {system.cycles:,})"
    method = stored.method + (f", re-arming at the {stored.rearm}" if stored.method == "mars" else "")
    return {
        "table": f"{path} (mars-lidar {provenance['version']}, built in {provenance['build_s']:.3g} s)",
        "method": method,
        "signal": provenance["signal"],
        "background": provenance["background"],
        "size": f"{size / 1e6:,.4g} MB, shapes {shapes / 1e6:,.4g} MB of them; with a delay axis of 1024 values "
        f"{shapes * 1024 / 1e9:,.4g} GB (the paper: 105 MB, 108 GB with delays)",
        "cycles": serves,
        "exact laws": _laws(stored),
        "system": f"period {system.period_ns:.6g} ns, {system.bins} bins, {system.pulse!r}, dead time "
        f"{system.detector.dead_time_ns:.6g} ns, start {system.start}",
        "start phases": f"{phases}"
        if (phases := stored.start_phases.phase.size)
        else "none: nothing depends on the delay",
        f"error at {made['cycles']:,} cycles": _error(made),
        "error at any": _any_error(provenance.get("error_longest"), never),
    }


def _error(made: dict[str, Any]) -> str:
    return (
        f"between entries, {made['samples']} random pixels: mean {made['mean_max']:.2g} and variance "
        f"{made['variance_max']:.2g} at most (in standard deviations), shape {made['shape_max']:.2g} in total "
        f"variation; at random delays {made['delayed_mean_max']:.2g}, {made['delayed_variance_max']:.2g}, "
        f"{made['delayed_shape_max']:.2g}"
    )


def _any_error(longest: dict[str, Any] | None, unsettled: int) -> str:
    """What becomes of the error in longer exposures."""
    if unsettled:
        return "as above: the table serves no other number of cycles"
    grows = "that of the mean grows as the root of the number of cycles (in standard deviations)"
    if longest is None:
        return f"{grows}; at long exposures it was not measured when this table was built"
    error = QuantisationError(**longest)
    allowed = 0.05  # standard deviations of the mean count: invisible beside the count's own scatter
    within = error.cycles_within(allowed)
    mean, variance = max(error.mean_max, error.delayed_mean_max), max(error.variance_max, error.delayed_variance_max)
    limit = "any number" if within >= error.cycles else f"up to some {within:.2g}"
    return (
        f"{grows}: at {error.cycles:,} cycles {mean:.2g} at most, variance {variance:.2g}; the mean is within "
        f"{allowed:g} standard deviations for {limit} of cycles"
    )


def _laws(stored: Table) -> str:
    number, entries = stored.laws.row.size, stored.entries.enough.size
    if stored.method == "mars":
        return "none: the paper's count is a Gaussian"
    if not number:
        return "none: four cumulants determine the law of every entry"
    return f"{number:,} of {entries:,} entries have the law of their count, {stored.laws.pmf.nbytes / 1e6:,.3g} MB"


def _line(path: Path) -> str:
    try:
        stored = Table.load(path)
    except (OSError, ValueError, KeyError) as error:
        return f"{path.name}: cannot be read ({error})"
    system, provenance = stored.system, stored.provenance
    return (
        f"{path.name}: {stored.method}, S {provenance['signal']}, B {provenance['background']}, {system.bins} bins, "
        f"{system.cycles:,} cycles, dead time {system.detector.dead_time_ns:.6g} ns of {system.period_ns:.6g} ns"
    )


table_command = App(name="table", help_epilogue="", **COMMAND_LINE)
for _place, _command in enumerate((command(build), command(info), command(clear))):
    _command.sort_key = _place
    table_command.command(_command)
