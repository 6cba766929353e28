"""Engines on a GPU: the native headers compiled for CUDA at run time.

This module selects the engines; those of the processor do not depend on it.
"""

from typing import Any

import numpy as np

from mars_lidar.engines.cuda.exact import exact_histogram, exact_records
from mars_lidar.engines.cuda.feedback import feedback_histogram
from mars_lidar.engines.cuda.machine import Cuda
from mars_lidar.engines.cuda.mars import check_mars, mars_histogram
from mars_lidar.engines.engine import Engine, PhaseRecords, Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.engines.mars import MarsEngine
from mars_lidar.instrument.detector import require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

ABLE: tuple[type[Engine], ...] = (ExactEngine, FeedbackEngine, MarsEngine)


def check(engine: Engine, flux: Flux, system: System) -> None:
    """Raise ValueError, naming the alternative, for tasks that `engine` cannot do on a GPU."""
    match engine:
        case ExactEngine():
            _check_exact(engine, flux, system)
        case FeedbackEngine():
            if system.dead_time_periods == 0.0:  # counts of bins are Poisson numbers, which no kernel draws
                raise ValueError(
                    "dead_time_ns must be > 0 for engine 'feedback' on device 'cuda'; use engine 'exact' there, or "
                    "device 'cpu'"
                )
        case MarsEngine():
            if engine.reader is None:
                raise ValueError(
                    "table must be given for engine 'mars' on device 'cuda': without one every pixel is evaluated by "
                    "the processor; build a mars_lidar.Table, or use device 'cpu'"
                )
            check_mars(flux, system)
        case _:
            names = " or ".join(repr(able.name) for able in ABLE)
            raise ValueError(
                f"engine {engine.name!r} does not run on device 'cuda', only on 'cpu'; use engine {names}, or device "
                "'cpu'"
            )


def histogram(engine: Engine, task: Task, out: Any) -> None:
    """Fill `out` (items, bins), a C-contiguous CuPy array, with the same bits as on the processor.

    Runs on CuPy's current device and stream, for a task that `check` accepts.
    """
    match engine:
        case ExactEngine():  # one exposure a thread
            exact_histogram(task, out, Cuda())
        case FeedbackEngine():  # one pixel a thread; pixels that the sweeps refuse are drawn exactly
            machine = Cuda()
            feedback_histogram(task, out, machine, _exactly(engine, machine))
        case MarsEngine():  # one pixel a block; pixels beyond the table are evaluated by the processor
            mars_histogram(engine, task, out, Cuda())
        case _:
            check(engine, task.flux, task.system)


def records(engine: Engine, task: Task) -> PhaseRecords:
    """Registrations of a task that `check` accepts, in host memory; ValueError for an engine without timestamps."""
    if not isinstance(engine, ExactEngine):
        raise ValueError(f"engine {engine.name!r} draws histograms only, not timestamps; use 'exact'")
    return exact_records(task, Cuda())


def _check_exact(engine: ExactEngine, flux: Flux, system: System) -> None:
    """Refuse waveforms, and effects other than efficiency and dark counts."""
    if flux.waveform is not None:
        raise ValueError("flux must have returns, not a waveform, on device 'cuda'; use device 'cpu'")
    able = tuple(effect for effect in LIGHT_EFFECTS if effect in engine.effects)
    require_effects("device 'cuda'", system.detector, able, lambda effect: "; use device 'cpu'")


def _exactly(engine: FeedbackEngine, machine: Cuda) -> Any:
    """The exact engine for pixels that feedback refuses: a waveform is drawn by the processor."""

    def draw(part: Task, rows: Any) -> None:
        if part.flux.waveform is None:
            exact_histogram(part, rows, machine)
            return
        on_host = np.empty((part.items, part.system.bins), rows.dtype)
        ExactEngine(engine.level).histogram(part, on_host)
        rows[...] = machine.array(on_host)

    return draw
