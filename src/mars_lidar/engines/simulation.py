"""`simulate` and `simulate_timestamps`: checks of arguments, and the call of an engine."""

from __future__ import annotations

import math
from typing import Any, Literal, Unpack

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import check_memory, thread_count
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray, Progress
from mars_lidar.engines.engine import IN_PARTS, Engine, EngineOptions, PhaseRecords, Records, Task
from mars_lidar.engines.registry import check_detector, find_engine
from mars_lidar.instrument.system import System
from mars_lidar.instrument.units import check_delays
from mars_lidar.light.flux import Flux, StoredFlux
from mars_lidar.light.timestamps import DrawnTimestamps, Timestamps
from mars_lidar.light.tolerances import TOL

_MAX_REGISTRATIONS = 2.0**32  # the event counter of one pixel's random stream


@checked
def simulate(
    flux: Flux,
    system: System,
    *,
    engine: str | Engine = "exact",
    realizations: int = 1,
    first_realization: int = 0,
    pixel_index: ArrayLike | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    out: Any = None,
    progress: Progress | bool | None = None,
    report: dict[str, float] | None = None,
    **options: Unpack[EngineOptions],
) -> NDArray[Any]:
    """Simulate histogram cubes of an image.

    Parameters
    ----------
    flux
        The light, (H, W); one pixel is an image of 1 x 1, N pixels are a row.
    system
        Laser, detector and histogram.
    engine
        ``"exact"`` (default), ``"feedback"`` (whole histograms, at a cost independent of the exposure),
        ``"auto"`` (the faster of these two, pixel by pixel), ``"sequential"`` (slow, independent reference),
        ``"mars"`` (count law x shape), ``"renewal"`` and ``"poisson"`` (baselines), or an `Engine`
        with other settings.
    realizations
        Independent exposures of the whole image.
    first_realization
        Number of the first realization: ``realizations=2, first_realization=4`` gives numbers 4 and 5 of a larger run.
    pixel_index
        (H * W,) or (H, W) integers in [0, 2**32): the place of each pixel in a larger image, row-major. With
        it any part of a cube can be simulated alone, with the same bits. Default: 0 .. H * W - 1.
    seed
        Integer in [0, 2**64).
    threads
        Threads to run on; default: all processors this process may use. The result does not depend on it.
    device
        ``"cpu"`` (default), or ``"cuda"``: ``"exact"``, ``"feedback"`` and, with a table, ``"mars"`` on CuPy's current
        device and stream, with the same bits (extras ``cuda12`` and ``cuda13``; docs/gpu.md). The result is then a
        CuPy array, which
        ``torch.from_dlpack`` takes without a copy.
    out
        C-contiguous array or memory map (realizations, H, W, bins) of ``system.histogram_dtype`` to fill, such as the
        cube of an earlier call: new memory takes a fifth more time, because the system clears its pages; with
        ``device="cuda"`` a CuPy array.
    progress
        Called as ``progress(done, total)`` a few times a second; an exception from it stops the run. True: a bar, or
        a line every 30 s without a terminal.
    report
        A dictionary into which the engine writes its report, numbers by name.
    **options
        Options of the engines ``"mars"`` and ``"renewal"`` (`mars_lidar.engines.EngineOptions`): `table`, a
        `mars_lidar.Table`; `count`, the law of the count: ``"exact"`` (default), ``"matched"`` (to four cumulants) or
        ``"gaussian"`` (the paper's), for ``"mars"``; and for a table `interpolation`, ``"bilinear"`` (default) or
        ``"nearest"`` (the paper's), and `outside`, for pixels beyond its range: ``"error"`` (default), or ``"exact"``,
        some ms each.

    Returns
    -------
    NDArray
        (realizations, H, W, bins), uint16, or uint32 if a bin could exceed 65535 (`out` if given); a CuPy array
        with ``device="cuda"``.

    Raises
    ------
    ValueError
        An argument out of range, or a detector, start or light that the engine does not support; nothing was drawn.
    TypeError
        An argument of another type, or an unknown keyword.
    MemoryError
        The cube, or the working memory of the engine, does not fit in the available memory.
    ConvergenceError
        (`mars_lidar.statistics`) A count law of ``engine="mars"`` does not converge; the message names the pixel.

    See Also
    --------
    simulate_timestamps, count_law, reconstruct, System

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> cube = ml.simulate(ml.Flux([[0.5, 2.0]], 1.0, [[20.0, 60.0]]), system, realizations=3, seed=0)
    >>> cube.shape  # (realizations, H, W, bins)
    (3, 1, 2, 128)
    >>> bool(cube.sum(-1).max() <= system.cycles * 100 / 75 + 1)  # at most one count a dead time
    True
    """
    chosen = find_engine(engine, **options)
    task = _task(flux, system, chosen, realizations, first_realization, pixel_index, seed, threads, progress)
    shape = (task.realizations, *task.flux.shape, system.bins)
    if device == "cuda":
        there: NDArray[Any] = _on_cuda(chosen, task, shape, out)
        if report is not None:
            report.update(task.report)
        return there
    if out is None:
        _check_memory(shape, system.histogram_dtype.itemsize, "histograms")
        out = np.empty(shape, system.histogram_dtype)
    else:
        _check_out(out, shape, system.histogram_dtype)
    chosen.histogram(task, out.reshape(task.items, system.bins))
    if report is not None:
        report.update(task.report)
    cube: NDArray[Any] = out
    return cube


@checked
def simulate_timestamps(
    flux: Flux,
    system: System,
    *,
    engine: str | Engine = "exact",
    realization: int = 0,
    pixel_index: ArrayLike | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    progress: Progress | bool | None = None,
) -> Timestamps:
    """Simulate the registration times of an image in one realization.

    The histogram of the result equals ``simulate(..., first_realization=realization)[0]`` of the same seed exactly.

    Parameters
    ----------
    flux, system
        The light (H, W), photons per period, and the system.
    engine
        ``"exact"`` (default) or ``"sequential"``, or an `Engine`.
    realization
        Number of the exposure, from 0.
    pixel_index
        Place of each pixel in a larger image, as for `simulate`.
    seed
        Integer in [0, 2**64).
    threads
        Threads to run on; default: all processors this process may use. The result does not depend on it.
    device
        ``"cpu"`` (default) or ``"cuda"``; the result is in host memory for either.
    progress
        As for `simulate`.

    Returns
    -------
    Timestamps
        Packed times (ns), cycles and bins of all pixels; with `exact` 8 bytes a registration, times and bins on first
        use.

    Raises
    ------
    TypeError
        An argument of another type, or an unknown keyword.
    ValueError
        As for `simulate`; also for an engine that draws histograms only.
    MemoryError
        The expected registrations do not fit in the available memory.

    See Also
    --------
    simulate, Timestamps

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> times = ml.simulate_timestamps(ml.Flux(0.5, 0.5, 40.0), system, seed=0)
    >>> times.histogram().shape
    (1, 1, 128)
    """
    chosen = find_engine(engine)
    task = _task(flux, system, chosen, 1, realization, pixel_index, seed, threads, progress, first_name="realization")
    if device == "cuda":
        from mars_lidar.engines import cuda

        cuda.check(chosen, task.flux, task.system)
        records: Records | PhaseRecords = cuda.records(chosen, task)
    else:
        detected = task.flux.detected(system)
        expected = float((_share_registered(detected, system) * _expected_arrivals(detected, system)).sum())
        _check_memory((math.ceil(0.5 * expected),), PhaseRecords.BYTES, "timestamps")  # before any work
        records = chosen.records(task, expected)
    info = {"system": system.to_dict(), "engine": chosen.name, "seed": int(seed), "realization": int(realization)}
    height, width = task.flux.shape
    what: dict[str, Any] = {"cycle": records.cycle, "offsets": records.offsets, "shape": (height, width), "info": info}
    what |= {"bins": system.bins, "dtype": system.histogram_dtype}
    what |= {"period_ns": system.period_ns, "cycles": system.cycles}
    if isinstance(records, PhaseRecords):
        return DrawnTimestamps.of(phase=records.phase, **what)
    return Timestamps(times_ns=records.times * system.period_ns, bin=records.bin, **what)


def _on_cuda(engine: Engine, task: Task, shape: tuple[int, ...], out: Any) -> Any:
    from mars_lidar.engines import cuda
    from mars_lidar.engines.cuda.machine import cupy_with_device

    cuda.check(engine, task.flux, task.system)
    cupy = cupy_with_device()
    dtype = task.system.histogram_dtype
    if out is None:
        out = cupy.empty(shape, dtype)
    elif not isinstance(out, cupy.ndarray):
        raise TypeError(f"out must be a CuPy array with device='cuda', got {type(out).__name__}")
    elif out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous:
        raise ValueError(
            f"out must be C-contiguous, of shape {shape} and dtype {dtype}, got {out.shape} and {out.dtype}"
        )
    cuda.histogram(engine, task, out.reshape(task.items, task.system.bins))
    return out


def _task(
    flux: Flux,
    system: System,
    chosen: Engine,
    realizations: int,
    first_realization: int,
    pixel_index: ArrayLike | None,
    seed: int,
    threads: int | None,
    progress: Progress | bool | None,
    first_name: str = "first_realization",
) -> Task:
    flux = flux[:] if isinstance(flux, StoredFlux) else flux.image  # read into memory, or MemoryError
    first = checks.integer(first_name, first_realization, low=0, high=2**32 - 1)
    number = checks.integer("realizations", realizations, low=1, high=2**32 - first)
    seed = checks.integer("seed", seed, low=0, high=2**64 - 1)
    team = thread_count(threads)
    progress = callback_of(progress, "simulating")
    if len(flux.returns_signal) > TOL.returns:
        raise ValueError(
            f"flux must have at most {TOL.returns} returns, got {len(flux.returns_signal)}; use a waveform"
        )
    check_registrations(flux.detected(system), system)
    lit = flux.returns_delay_ns[flux.returns_signal > 0.0]
    if lit.size:
        check_delays(float(np.median(lit)), system.period_ns)
    check_detector(chosen, system)
    chosen.check(flux, system)
    index = checked_index(pixel_index, flux.shape)
    if system.detector.crosstalk is not None and not np.array_equal(index, np.arange(index.size)):
        raise ValueError(
            "pixel_index must be that of a whole image with crosstalk, 0 to H * W - 1: pixels depend on each other, "
            f"so that no part of it can be made alone, got {index[0]} to {index[-1]}"
        )
    return Task(flux, system, number, first, index, seed, team, progress)


def checked_index(pixel_index: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.uint32]:
    """The numbers (H * W,) of the random streams of an image of this shape; None: in row-major order from 0."""
    pixels = math.prod(shape)
    if pixel_index is None:
        return np.arange(pixels, dtype=np.uint32)
    index = np.asarray(checks.even_rows("pixel_index", checks.unmasked("pixel_index", pixel_index)))
    if index.dtype.kind not in "iu":
        raise TypeError(f"pixel_index must be integers, got dtype {index.dtype}")
    if index.shape not in ((pixels,), shape):
        raise ValueError(f"pixel_index must have shape ({pixels},) or {shape}, got {index.shape}")
    if index.min() < 0 or index.max() >= 2**32:
        raise ValueError(f"pixel_index must lie in [0, 2**32), got {index.min()} to {index.max()}")
    return np.ascontiguousarray(index.reshape(-1).astype(np.uint32))


def check_registrations(flux: Flux, system: System) -> None:
    """Raise ValueError where a pixel is expected to have more registrations than its random stream can draw."""
    expected = _expected_arrivals(flux, system)
    most, what = float(expected.max()), "registrations"
    if system.detector.mode == "paralyzable":  # each arrival is drawn, registered or not
        what = "arrivals of mode 'paralyzable'"
    elif system.detector.recovery_ns > 0.0:
        what = "arrivals after a dead time, those during recovery_ns included"
    if most > 0.5 * _MAX_REGISTRATIONS:
        photons = float(flux.total.flat[expected.argmax()])
        raise ValueError(
            f"a pixel must have at most {0.5 * _MAX_REGISTRATIONS:.3g} expected {what}, "
            f"got {most:.3g} ({photons:g} photons per period, {system.cycles} cycles)"
        )


def _share_registered(flux: Flux, system: System) -> FloatArray:
    """Fraction (H, W) of the drawn arrivals that are registered; below 1 if paralyzable or with a slow recovery."""
    if system.detector.mode == "paralyzable":
        return np.exp(-flux.total * system.dead_time_periods)
    # 1 / (light x mean wait) in constant light; the wait, below (22) of docs/theory_detectors.md, for long recovery
    recovery = system.detector.recovery_ns / system.period_ns
    return np.asarray(1.0 / (1.0 + np.sqrt(0.5 * np.pi * recovery * flux.total)))


def _expected_arrivals(flux: Flux, system: System) -> FloatArray:
    """Arrivals (H, W) that an engine draws for each pixel of detected photons, within a factor of two.

    They are the registrations; all arrivals if paralyzable; with a slow recovery also those lost during it.
    """
    photons, dead, mode = flux.total, system.dead_time_periods, system.detector.mode
    if mode == "gated":  # what arrives outside of the gate costs one draw a period
        photons = photons - (1.0 - system.detector.gate_periods(system.period_ns)[2]) * flux.background
    most = photons * system.cycles / (1.0 + photons * dead * _share_registered(flux, system))
    if mode == "paralyzable":
        most = photons * (system.cycles + dead)
    elif mode == "synchronous":
        most = np.minimum(most, float(system.cycles))
    traps = system.detector.afterpulsing  # each avalanche is followed by up to p / (1 - p) others
    return np.asarray(most if traps is None else most / (1.0 - traps.probability))


def _check_out(out: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    if not isinstance(out, np.ndarray):
        raise TypeError(f"out must be a NumPy array or memory map, got {type(out).__name__}")
    if out.shape != shape or out.dtype != dtype:
        raise ValueError(f"out must have shape {shape} and dtype {dtype}, got {out.shape} and {out.dtype}")
    if not out.flags.c_contiguous or not out.flags.writeable:
        raise ValueError("out must be C-contiguous and writeable")


def _check_memory(shape: tuple[int, ...], itemsize: int, what: str) -> None:
    check_memory(math.prod(shape) * itemsize, f"{what} of shape {shape}", IN_PARTS)
