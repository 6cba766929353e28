"""Before a long run: how long it will take, by drawing a few of its pixels, and whether another engine is faster."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from mars_lidar._base.progress import span
from mars_lidar._base.tolerances import TOL
from mars_lidar.engines import ENGINES, Engine, EngineOptions, check_detector, find_engine
from mars_lidar.engines.feedback import expected_registrations
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.light.stored_flux import StoredFlux
from mars_lidar.simulation import simulate

_SHORT_S = 1e-7  # an event, by the slowest engine: where all events of a run take less than a second, nothing is drawn
_PROBE_S = 0.1  # drawn at least, or the whole image; in two steps, unless the first takes longer than
_LONG_PROBE_S = 1.0
_PROBE_CYCLES = 20_000  # of engines that draw photon by photon: their time is proportional to the exposure
_BY_PHOTON = ("exact", "sequential", "poisson")
_FIRST_PIXELS = 16
_WORTH = 3.0  # times faster: below that nobody need be told


@dataclass(frozen=True)
class Advice:
    """Seconds that a run will take about, and those with engine `auto`, NaN where it does not draw the same law."""

    seconds: float
    auto_s: float = math.nan

    def __str__(self) -> str:
        """One line, empty for a run that is not long."""
        if self.seconds < TOL.long_s:
            return ""
        faster = f"; --engine auto: about {span(self.auto_s)}, same law" if self.auto_s * _WORTH < self.seconds else ""
        return f"about {span(self.seconds)} on this machine{faster}"


def advice(
    flux: Flux,
    system: System,
    engine: str | Engine = "exact",
    *,
    realizations: int = 1,
    threads: int | None = None,
    options: EngineOptions | None = None,
) -> Advice:
    """How long `mars_lidar.simulate` will take, measured on pixels spread over the image, a few tenths of a second.

    Nothing is drawn, and the answer is 0, where a run is short whatever the engine.
    """
    drawn_by = find_engine(engine, **(options or {}))
    if isinstance(flux, StoredFlux) or system.detector.crosstalk is not None:  # not to be had in single pixels
        return Advice(0.0)
    events = realizations * float(expected_registrations(flux, system).sum())
    if drawn_by.name in ("sequential", "poisson"):
        events = realizations * float(flux.total.sum()) * system.cycles
    by_pixel = "table" in drawn_by.options and getattr(drawn_by, "reader", None) is None
    if events * _SHORT_S < 1.0 and not by_pixel:
        return Advice(0.0)
    seconds = realizations * _measured(flux, system, drawn_by, threads)
    if seconds < TOL.long_s or drawn_by.name != "exact":
        return Advice(seconds)
    auto = ENGINES["auto"]
    try:
        check_detector(auto, system)
        auto.check(flux, system)
    except ValueError:
        return Advice(seconds)
    return Advice(seconds, realizations * _measured(flux, system, auto, threads))


def _measured(flux: Flux, system: System, engine: Engine, threads: int | None) -> float:
    """Seconds for one image: some of its pixels, more of them until it takes long enough to be measured."""
    share = 1.0
    if engine.name in _BY_PHOTON and system.cycles > _PROBE_CYCLES:
        share = system.cycles / _PROBE_CYCLES
        system = system.replace(cycles=_PROBE_CYCLES)
    pixels = math.prod(flux.shape)
    step = max(1, math.isqrt(pixels // _FIRST_PIXELS))
    drawn, spent = 0, 0.0
    while True:
        some = flux[step // 2 :: step, step // 2 :: step]
        before, number = (drawn, spent), math.prod(some.shape)
        began = time.perf_counter()
        simulate(some, system, engine=engine, threads=threads)
        drawn, spent = number, time.perf_counter() - began
        if step == 1 or spent > _LONG_PROBE_S or (before[0] and spent > _PROBE_S):
            # what the number of pixels does not change, such as a plan, is paid once
            each = (spent - before[1]) / (drawn - before[0]) if drawn > before[0] else spent / drawn
            return share * (spent + max(0.0, each) * (pixels - drawn))
        step = max(1, step // 2)
