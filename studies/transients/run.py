"""Study "transients": two returns in fog through the dead time of three detectors, simulated and predicted."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mars_lidar import Detector, Flux, GaussianPulse, System, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS, INK, MUTED
from mars_lidar.statistics import mean_histogram
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.sample import settings_of

GLASS, WALL = (0.15, 40.0), (3.0, 73.0)  # photons per period without fog, delay in ns
FOG = {"extinction_per_m": 0.08, "backscatter": 1.2, "nearest_m": 0.6}
BACKGROUND, DEAD_NS, SEED = 0.05, 30.0, 6
DETECTORS = {
    "non-paralyzable": Detector(dead_time_ns=DEAD_NS),
    "paralyzable": Detector(dead_time_ns=DEAD_NS, mode="paralyzable"),
    "synchronous": Detector(dead_time_ns=DEAD_NS, mode="synchronous"),
}


SYSTEM = System(
    period_ns=100.0,
    cycles=1000,
    bins=400,
    pulse=GaussianPulse(sigma_ns=0.3),
    detector=DETECTORS["non-paralyzable"],
)


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """What a detector makes of the waveform: mean counts (bins,), predicted and simulated, and its standard error."""

    name: str
    expected: FloatArray
    simulated: FloatArray
    error: FloatArray


def incident() -> FloatArray:
    """Waveform (bins,) of one pixel, photons: a pane of glass, a wall, and the fog before them."""
    clear = Flux.multi(Flux(GLASS[0], BACKGROUND, GLASS[1]), Flux(WALL[0], 0.0, WALL[1]))
    waveform = clear.in_fog(SYSTEM, parts=SYSTEM.bins, **FOG).waveform
    assert waveform is not None
    return waveform


def run(request: Request) -> Facts:
    """Simulate and predict every detector."""
    exposures = 200 if request.quick else 4000
    waveform = incident()
    flux = Flux(waveform=np.broadcast_to(waveform, (1, exposures, SYSTEM.bins)), background=BACKGROUND)
    arrivals = waveform + BACKGROUND / SYSTEM.bins  # per period
    examples = []
    for name, detector in DETECTORS.items():
        request.tell(f"transients: {name}")
        system = SYSTEM.replace(detector=detector)
        cube = simulate(flux, system, seed=SEED)[0, 0].astype(np.float64)
        expected = mean_histogram(Flux(waveform=waveform, background=BACKGROUND), system)
        examples.append(View(name, expected, cube.mean(0), cube.std(0, ddof=1) / np.sqrt(exposures)))
    light = {"glass (S, ns)": GLASS, "wall (S, ns)": WALL, **FOG, "background B": BACKGROUND, "dead_time_ns": DEAD_NS}
    return {
        "settings": settings_of(SYSTEM, light, exposures, SEED),
        "rows": [row(each, SYSTEM.cycles * arrivals) for each in examples],
        "figures": {"": _draw(examples, arrivals)},
    }


def row(each: View, arrivals: FloatArray) -> dict[str, Any]:
    """One line of the table."""
    line: dict[str, Any] = {"detector": each.name, "registrations": float(each.simulated.sum())}
    for name, low, high in (("fog", 0.0, 37.0), ("glass", 37.0, 43.0), ("wall", 70.0, 76.0)):
        inside = (SYSTEM.time_ns >= low) & (SYSTEM.time_ns < high)
        line[name] = float(each.simulated[inside].sum() / arrivals[inside].sum())
    often = each.error > 0
    line["worst z"] = float(np.abs((each.simulated - each.expected)[often] / each.error[often]).max())
    return line


def _draw(examples: list[View], arrivals: FloatArray) -> Figure:
    figure, axes = panels(2.8, 1, 2)
    scale = 1.0 / (SYSTEM.cycles * SYSTEM.bin_ns)
    for ax, low, high in ((axes[0, 0], 0.0, 100.0), (axes[0, 1], 66.0, 82.0)):
        ax.plot(SYSTEM.time_ns, arrivals / SYSTEM.bin_ns, color=INK, lw=0.7, ls=":", label="arrivals")
        for each, colour in zip(examples, [MUTED, *COLOURS], strict=False):
            simulated = np.where(each.simulated > 0, each.simulated * scale, np.nan)
            ax.plot(SYSTEM.time_ns, simulated, ".", ms=1.8, color=colour)
            ax.plot(SYSTEM.time_ns, each.expected * scale, color=colour, lw=0.8, label=each.name)
        ax.set(xlabel="time in the period, ns", xlim=(low, high), yscale="log")
    axes[0, 0].set_ylabel("per period and ns")
    axes[0, 0].set_title("fog, glass and wall")
    axes[0, 1].set_title("the wall")
    legend_below(figure, axes[0, :1], 4)
    return figure
