"""Study "neighbourhood": depth of dim cubes with and without the pixels around, and how well the stated errors hold."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mars_lidar import Detector, Flux, GaussianPulse, Scene, System, cramer_rao, reconstruct, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.figures import _draw_map, _limits
from studies import Facts, Request
from studies.common.draw import panels
from studies.common.report import Row

SEED = 3
SIGMA_NS = 0.5
RADII = (2, 4)
SBR = 1.0
SHOWN = 1.0  # photons a pixel of the picture
SYSTEM = System(
    period_ns=100.0,
    cycles=1000,
    bins=500,
    pulse=GaussianPulse(sigma_ns=SIGMA_NS),
    detector=Detector(dead_time_ns=75.0),
)


@dataclass(frozen=True)
class Settings:
    """Side of the images, and mean signal photons of a pixel in the whole exposure."""

    size: int
    photons: tuple[float, ...]


FULL = Settings(64, (0.5, 1.0, 3.0))
QUICK = Settings(24, (1.0,))


def run(request: Request) -> Facts:
    """Every scene at every brightness, by every method."""
    settings = QUICK if request.quick else FULL
    rows, maps = [], {}
    for name, delay in scenes(settings.size).items():
        for photons in settings.photons:
            request.tell(f"neighbourhood: {name}, {photons:g} photons a pixel")
            lines, found = case(name, delay, photons, settings)
            rows += lines
            if name == "room" and photons == SHOWN:
                maps = found
    room = [row for row in rows if row["scene"] == "room"]
    return {
        "s": settings,
        "room": [{k: v for k, v in row.items() if k != "scene"} for row in room],
        "others": [row for row in rows if row["scene"] != "room" and row["method"] == f"neighbourhood={RADII[-1]}"],
        "least": min(row["in 95 %"] for row in rows if row["method"].startswith("neighbourhood")),
        "least68": min(row["in 68 %"] for row in rows if row["method"].startswith("neighbourhood")),
        "rows": rows,
        "figures": {"": _figure(maps)},
    }


def scenes(size: int) -> dict[str, FloatArray | None]:
    """Delays (size, size), ns, by name; None of the room, which has its own light too."""
    y, x = np.mgrid[:size, :size] / size
    right = x >= 0.5
    return {
        "room": None,
        "flat": np.full((size, size), 40.0),
        "slope": 40.0 + 19.2 * x + 3.2 * y,
        "bowl": 40.0 + 12.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2),
        "step of 1 sigma": 40.0 + SIGMA_NS * right,
        "step of 3 sigma": 40.0 + 3.0 * SIGMA_NS * right,
        "step of 20 sigma": 40.0 + 20.0 * SIGMA_NS * right,
    }


def case(
    name: str, delay: FloatArray | None, photons: float, settings: Settings
) -> tuple[list[Row], dict[str, FloatArray]]:
    """A line for each method, and maps of delay, ns."""
    level = photons / SYSTEM.cycles
    if delay is None:
        flux = Scene.example("room", size=settings.size).flux(SYSTEM, signal=level, sbr=SBR)
    else:
        flux = Flux(np.full(delay.shape, level), level / SBR, delay)
    cube = simulate(flux, SYSTEM, seed=SEED)[0]
    alone: dict[str, dict[str, Any]] = {"matched filter": {"method": "matched_filter"}, "alone": {}}
    ways = alone | {f"neighbourhood={radius}": {"neighbourhood": radius} for radius in RADII}
    lines: list[Row] = []
    maps = {"truth": flux.delay_ns}
    # at the mean light of each pixel, seen from the middle of the period: with so little light any delay is alike
    bound = cramer_rao(np.quantile(flux.signal, [0.25, 0.5, 0.75]), level / SBR, SYSTEM, delay_ns=40.0).delay_ns[1]
    for way, options in ways.items():
        began = time.process_time()
        found = reconstruct(cube, SYSTEM, **options)
        seconds = time.process_time() - began
        off = (found.delay_ns - flux.delay_ns + 50.0) % 100.0 - 50.0
        maps[way] = found.delay_ns
        line: dict[str, Any] = {
            "scene": name,
            "photons": photons,
            "method": way,
            "median error mm": 1e3 * float(SYSTEM.depth_m(np.nanmedian(np.abs(off)))),
            "off by 3 sigma %": 100.0 * float(np.mean(~(np.abs(off) < 3.0 * SIGMA_NS))),
            "s for 1000 pixels": 1e3 * seconds / off.size,
        }
        error = found.delay_error_ns
        stated = np.zeros(off.shape, bool) if error is None else np.isfinite(error) & np.isfinite(off)
        line["error stated %"] = 100.0 * float(stated.mean())
        for words, times in (("68 %", 1.0), ("95 %", 1.96)):
            inside = "-" if error is None else 100.0 * float((np.abs(off) <= times * error)[stated].mean())
            line[f"in {words}"] = inside
        line["median stated mm"] = "-" if error is None else 1e3 * float(SYSTEM.depth_m(np.median(error[stated])))
        lines.append(line)
    lines.append(
        dict.fromkeys(lines[0], "-")
        | {
            "scene": name,
            "photons": photons,
            "method": "bound, alone",
            # of a normal error at the bound
            "median error mm": 1e3 * float(SYSTEM.depth_m(0.6745 * bound)),
        }
    )
    return lines, maps


def _figure(maps: Mapping[str, FloatArray]) -> Figure:
    """Maps of depth: the truth and each way."""
    figure, axes = panels(1.35, 1, len(maps))
    depth = {name: np.asarray(SYSTEM.depth_m(delay)) for name, delay in maps.items()}
    limits = _limits(depth["truth"])
    for ax, (name, values) in zip(axes[0], depth.items(), strict=True):
        _draw_map(ax, values, "depth (m)" if ax is axes[0, -1] else "", "viridis", limits, name)
        ax.images[0].set_interpolation("nearest")
    return figure
