"""Sweeps over flux, exposure and image size: every vector level and the sequential simulator, one thread."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Section
from benchmarks.rows import engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import PERIOD_NS, EngineRun, Workload, canonical, system
from mars_lidar import Flux, _core

_FEWEST_PIXELS = 64  # enough lanes for the widest level
_NOTE = (
    "One thread, warm memory. x reference: over exact at the widest level, in turn. Pixels are fewer where a "
    "pixel sees more photons."
)


def flux_sweep(config: Config, bandwidth: Bandwidth) -> Section:
    """Photons per period, half of them signal."""
    cases = {}
    for photons in config.fluxes:
        pixels = _pixels(config, photons * config.cycles)
        half = 0.5 * photons
        flux = Flux([[half] * pixels], half, 0.5 * PERIOD_NS)
        cases[f"S + B = {photons:g}"] = Workload(flux, system(config))
    return _sweep("Sweep over flux", cases, config, bandwidth)


def exposure_sweep(config: Config, bandwidth: Bandwidth) -> Section:
    """Laser cycles per exposure, canonical fluxes."""
    cases = {}
    for cycles in config.exposures:
        pixels = _pixels(config, 1.05 * cycles)  # S + B is 1.05 on average
        cases[f"N_r = {cycles}"] = canonical(config, pixels=pixels, cycles=cycles)
    return _sweep("Sweep over cycles", cases, config, bandwidth)


def image_sweep(config: Config, bandwidth: Bandwidth) -> Section:
    """Pixels, canonical fluxes; from a lane's worth to more than the caches hold."""
    cases = {f"H W = {pixels}": canonical(config, pixels=pixels) for pixels in config.images}
    return _sweep("Sweep over pixels", cases, config, bandwidth)


def _pixels(config: Config, photons_per_pixel: float) -> int:
    return max(min(_FEWEST_PIXELS, config.pixels), min(config.pixels, int(config.budget / photons_per_pixel)))


def _sweep(title: str, cases: dict[str, Workload], config: Config, bandwidth: Bandwidth) -> Section:
    section = Section(title, notes=[_NOTE])
    each = replace(config, seconds=2.0 * config.seconds / len(cases))
    for case, workload in cases.items():
        out = workload.warm()
        runs = {level: EngineRun(workload, level=level, out=out) for level in _core.levels()}
        runs["sequential"] = EngineRun(workload, engine="sequential", out=out)
        times = in_turn(runs, each)
        reference = times[_core.levels()[0]]
        section.rows += [engine_row(case, run, times[name], bandwidth, reference) for name, run in runs.items()]
    return section
