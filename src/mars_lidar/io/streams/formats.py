"""Photon streams on disk: choice of the format, checks of the output path, and NumPy's .npz."""

import importlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks, files
from mars_lidar.io.streams.photons import BEFORE_PTU, FORMAT, Photons, attributes, from_attributes
from mars_lidar.light.timestamps import Timestamps

STREAM_SUFFIXES = (".npz", ".ptu", ".h5", ".hdf5")
MODULES = {  # that read files of each suffix; of .npz, those of others
    ".npz": "bare_stream",
    ".ptu": "ptu",
    ".h5": "photon_hdf5",
    ".hdf5": "photon_hdf5",
    ".mat": "bare_stream",
    ".csv": "bare_stream",
    ".txt": "bare_stream",
    **dict.fromkeys(BEFORE_PTU, "ptu"),
    ".t3r": "time_harp",
    ".spc": "becker_hickl",
    ".sdt": "recorders",  # histograms, no photons
}
RECORDER_SUFFIXES = tuple(
    suffix for suffix, module in MODULES.items() if module in ("ptu", "time_harp", "becker_hickl", "recorders")
)
READ_SUFFIXES = tuple(suffix for suffix, module in MODULES.items() if module != "recorders")  # as photon streams
_BARE = (".mat", ".npz", ".csv", ".txt")  # may have no header


def save(path: str | Path, times: Timestamps, *, overwrite: bool = False, clock_ps: float | None = None) -> None:
    """Write timestamps; see `Timestamps.save`."""
    target = Path(path)
    write = _write_npz if target.suffix == ".npz" else _module(target, STREAM_SUFFIXES).write
    if not (times.cycles >= 1 and times.period_ns > 0 and math.isfinite(times.period_ns)):
        raise ValueError(
            f"times must tell the laser period and the cycles of the exposure to be written, "
            f"got period_ns {times.period_ns} and cycles {times.cycles}"
        )
    check_output(target, overwrite=overwrite, clock_ps=clock_ps)
    more = {} if clock_ps is None else {"clock_ps": clock_ps}
    with files.beside(target) as unfinished:
        write(unfinished, times, **more)


def check_output(path: str | Path, *, overwrite: bool = False, clock_ps: float | None = None) -> None:
    """Raise the errors that `save` raises for the path or the suffix, without writing."""
    if clock_ps is not None:
        checks.real("clock_ps", clock_ps, low=0.0, strict_low=True)
        if Path(path).suffix != ".ptu":
            raise ValueError(f"clock_ps belongs to a .ptu, got {str(path)!r}")
    module = _module(Path(path), STREAM_SUFFIXES)
    if Path(path).suffix != ".npz":
        module.check_library()
    files.check_target(Path(path), folder=False, overwrite=overwrite)


def load(
    path: str | Path,
    *,
    period_ns: float | None = None,
    bins: int | None = None,
    unit_ns: float | None = None,
    variable: str | None = None,
) -> Timestamps:
    """Read timestamps; see `Timestamps.load`."""
    if period_ns is not None:
        period_ns = checks.real("period_ns", period_ns, low=0.0, strict_low=True)
    if bins is not None:
        bins = checks.integer("bins", bins, low=1, high=2**20)
    if unit_ns is not None:
        unit_ns = checks.real("unit_ns", unit_ns, low=0.0, strict_low=True)
    source = Path(path)
    plain = files.finished_name(source)
    module = _module(plain)
    bare = plain.suffix in _BARE
    if not bare and (unit_ns is not None or variable is not None):
        raise ValueError(
            f"unit_ns and variable are for .mat, .npz and text: a {plain.suffix} tells both, got {str(path)!r}"
        )
    files.check_finished(source)
    if plain != source:
        raise files.IncompleteFileError(f"{source} is incomplete: a stopped run left it")
    with files.reading(source, "a photon stream"):
        if bare:
            return _read_bare(source, period_ns, bins, unit_ns, variable)
        if plain.suffix in STREAM_SUFFIXES:
            times: Timestamps = module.read(source, period_ns, bins)
            return times
        photons: Photons = module.photons(source)
        return photons.timestamps(period_ns, bins)


def recorded(path: Path, *, unit_ns: float | None = None, variable: str | None = None) -> Photons:
    """The photons of another program's file in units of its recorder; arguments as for `Timestamps.load`."""
    module = _module(path)
    with files.reading(path, "a photon stream"):
        photons: Photons = module.photons(path, *((unit_ns, variable) if path.suffix in _BARE else ()))
        return photons


def _read_bare(
    source: Path, period_ns: float | None, bins: int | None, unit_ns: float | None, variable: str | None
) -> Timestamps:
    """Of a format that may have no header."""
    attrs = _npz_attributes(source) if source.suffix == ".npz" else {}
    if attrs.get("format") is None:
        times: Timestamps = _module(source).read(source, period_ns, bins, unit_ns, variable)
        return times
    if not (period_ns is None and bins is None and unit_ns is None and variable is None):
        raise ValueError(
            f"{source} describes its stream completely: period_ns, bins, unit_ns and variable are for "
            "streams of other programs"
        )
    return _read_npz(source, attrs)


def is_stream(path: Path) -> bool:
    """Whether the file at `path` is a photon stream; ValueError if damaged."""
    with files.reading(path, "cube or photon stream"):
        if path.suffix == ".npz":
            return _npz_attributes(path).get("format") == FORMAT
        return path.suffix in STREAM_SUFFIXES and bool(_module(path).is_stream(path))


def _module(path: Path, suffixes: tuple[str, ...] = READ_SUFFIXES) -> Any:
    checks.suffix("path of timestamps", path, suffixes)
    return importlib.import_module(f"mars_lidar.io.streams.{MODULES[path.suffix]}")


def _write_npz(path: Path, times: Timestamps) -> None:
    from mars_lidar.io import npz

    # 14 million photons: 10 s and 132 MB; NumPy's own level takes 36 s for 114 MB
    with npz.archive(path) as archive:
        for name in ("times_ns", "cycle", "bin", "offsets"):
            npz.add_array(archive, name, getattr(times, name))
        npz.add_attributes(archive, attributes(times))


def _npz_attributes(path: Path) -> dict[str, Any]:
    with files.open_npz(path) as archive:
        return dict(json.loads(archive["attributes"].item())) if "attributes" in archive.files else {}


def _read_npz(path: Path, attrs: dict[str, Any]) -> Timestamps:
    if attrs["format"] != FORMAT:
        raise ValueError(f"{path} is not a file of timestamps written by mars-lidar (no format = {FORMAT!r})")
    with files.open_npz(path) as archive:
        content = {name: archive[name] for name in ("offsets", "times_ns", "cycle", "bin")}
    for name, values in content.items():
        if values.ndim != 1 or values.dtype.kind not in ("f" if name == "times_ns" else "iu"):
            raise ValueError(f"{name} must be {'times' if name == 'times_ns' else 'integers'} (n,), got {values.dtype}")
    counts = np.diff(content["offsets"])
    times = from_attributes(attrs, content["times_ns"], content["cycle"], content["bin"], counts)
    since = times.times_ns / times.period_ns - times.cycle
    apart = np.abs(since - 0.5)
    if apart.max(initial=0.0) > 0.5 + 1e-6:
        raise ValueError(
            f"times_ns must lie in the laser periods that cycle tells, got {apart.max() - 0.5:.3g} periods off"
        )
    if times.bin.size and "code_density" not in json.dumps(attrs.get("info", {}), default=str):  # of uneven bins
        beyond = float(np.abs(since * times.bins - times.bin - 0.5).max()) - 0.5
        # of phases in single precision, and of times
        rounding = 2.0**-23 + 4.0 * np.finfo(float).eps * max(1, times.cycles)
        if beyond > 1e-6 + rounding * times.bins:
            raise ValueError(f"bin must be that of times_ns, got one {beyond:.3g} bins off")
    return times
