"""What each effect of a detector does to histogram, count law and intervals: simulated, and in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.instrument.avalanches import Afterpulsing, Crosstalk
from mars_lidar.instrument.detector import Detector
from mars_lidar.instrument.effects import Jitter
from mars_lidar.light.flux import Flux
from mars_lidar.simulate import simulate
from mars_lidar.statistics import constant_light_rate
from studies import Request
from studies.detectors import DEAD_NS, SEED, Shown, _settings, outcome, row
from studies.report import configuration, save_csv, save_text, table

CODES = tuple(1.0 + 0.25 * np.sin(2.0 * np.pi * k / 8.0) for k in range(8))
SHOWN = (
    Shown("free running", "", Detector(dead_time_ns=DEAD_NS)),
    Shown("efficiency 0.3", "light", Detector(dead_time_ns=DEAD_NS, detection_efficiency=0.3)),
    Shown("dark counts 5 MHz", "light", Detector(dead_time_ns=DEAD_NS, dark_count_hz=5e6)),
    Shown(
        "p 0.1, 30 ns",
        "afterpulsing",
        Detector(dead_time_ns=DEAD_NS, afterpulsing=Afterpulsing(probability=0.1, delay_ns=30.0)),
    ),
    Shown(
        "p 0.4, 30 ns",
        "afterpulsing",
        Detector(dead_time_ns=DEAD_NS, afterpulsing=Afterpulsing(probability=0.4, delay_ns=30.0)),
    ),
    Shown(
        "p 0.4, 200 ns",
        "afterpulsing",
        Detector(dead_time_ns=DEAD_NS, afterpulsing=Afterpulsing(probability=0.4, delay_ns=200.0)),
    ),
    Shown("alpha 3 ns", "twilight", Detector(dead_time_ns=DEAD_NS, twilight_ns=3.0)),
    Shown("alpha 15 ns", "twilight", Detector(dead_time_ns=DEAD_NS, twilight_ns=15.0)),
    Shown("p 0.1", "crosstalk", Detector(dead_time_ns=DEAD_NS, crosstalk=Crosstalk(probability=0.1))),
    Shown("p 0.5", "crosstalk", Detector(dead_time_ns=DEAD_NS, crosstalk=Crosstalk(probability=0.5))),
    Shown("t_e 60 ns", "electronics", Detector(dead_time_ns=DEAD_NS, electronics_dead_time_ns=60.0)),
    Shown("t_e 130 ns", "electronics", Detector(dead_time_ns=DEAD_NS, electronics_dead_time_ns=130.0)),
    Shown("Gaussian, 2 ns", "jitter", Detector(dead_time_ns=DEAD_NS, jitter=Jitter(sigma_ns=2.0))),
    Shown(
        "Gaussian and tail of 6 ns, 40 %",
        "jitter",
        Detector(dead_time_ns=DEAD_NS, jitter=Jitter(sigma_ns=0.5, tail_ns=6.0, tail_fraction=0.4)),
    ),
    Shown("codes of 0.75 to 1.25 bins", "converter", Detector(dead_time_ns=DEAD_NS, code_density=CODES)),
    Shown("1 event a period", "limits", Detector(dead_time_ns=DEAD_NS, max_events_per_period=1)),
    Shown("400 events an exposure", "limits", Detector(dead_time_ns=DEAD_NS, max_events_per_exposure=400)),
)


def run(request: Request) -> list[Path]:
    """Write effects.md, effects.csv, effects_rate.csv and a figure for each group of effects."""
    from studies.detector_figures import draw_all

    exposures = 400 if request.quick else 10_000
    outcomes = []
    for shown in SHOWN:
        request.tell(f"effects: {shown.name}")
        outcomes.append(outcome(shown, exposures))
    figures = draw_all(request.out, outcomes, "effects")
    rows = [{"effect": each.shown.figure or "none", **row(each)} for each in outcomes]
    rates = constant_light(40 if request.quick else 4000)
    parts = [
        "# Effects of a detector, compared",
        "The same free-running pixel with each effect of its detector alone (definitions, typical values and sources: "
        "[detectors.md](../detectors.md)). Simulated with the exact engine, crosstalk with the sequential one, whose "
        "exposures are the pixels of one image; predicted where there is a law. `z mean` and `z variance` are "
        "differences in standard errors of the simulation, `worst z of a bin` is the largest of the histogram, `p of "
        "the law` is that of a chi-squared test of the counts. Values are larger than those of real modules, so that "
        "the figures show what an effect does.",
        configuration(_settings(outcomes[0].system, exposures)),
        table(rows),
        "In the figures dots are simulated and lines predicted. Inter-registration times are simulated.",
        *(f"![{path.stem}]({path.name})" for path in figures),
        "## Constant light: the preset `excelitas-spcm-aqrh`",
        "Rate of registrations, simulated and by `constant_light_rate` (Straka et al. 2020).",
        table(rates),
    ]
    text = save_text(request.out / "effects.md", parts)
    return [
        text,
        save_csv(request.out / "effects.csv", rows),
        save_csv(request.out / "effects_rate.csv", rates),
        *figures,
    ]


def constant_light(exposures: int) -> list[dict[str, Any]]:
    """Rate under constant light of the preset module: one line for each rate of photons."""
    from mars_lidar.instrument.pulse import GaussianPulse
    from mars_lidar.instrument.system import System

    detector, lines = Detector.preset("excelitas-spcm-aqrh"), []
    for rate in (1e5, 1e6, 1e7, 3e7, 1e8):
        system = System(
            period_ns=100.0,
            cycles=2000,
            bins=2,
            pulse=GaussianPulse(sigma_ns=1.0),
            detector=detector,
            start="stationary",
        )
        flux = Flux(np.zeros((1, exposures)), rate * 1e-9 * system.period_ns, 0.0)
        found = simulate(flux, system, seed=SEED).sum(-1).ravel() / (system.exposure_ns * 1e-9)
        error = float(found.std(ddof=1)) / found.size**0.5
        expected = constant_light_rate(rate, detector)
        lines.append(
            {
                "photons per s": rate,
                "simulated per s": float(found.mean()),
                "predicted per s": expected,
                "z": (float(found.mean()) - expected) / error,
                "dead time only per s": 1.0 / (1.0 / rate + detector.dead_time_ns * 1e-9),
            }
        )
    return lines
