"""Study "effects": what each effect of a detector does to the same flux, simulated and in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np

from mars_lidar import Afterpulsing, Crosstalk, Detector, Flux, GaussianPulse, Jitter, System, simulate
from mars_lidar.statistics import constant_light_rate
from studies import Facts, Request
from studies.common.sample import settings_of
from studies.detectors.run import LIGHT, SEED, example_of, outcome, row

CODES = tuple(1.0 + 0.25 * np.sin(2.0 * np.pi * k / 8.0) for k in range(8))
EXAMPLES = (
    example_of("free running", ""),
    example_of("efficiency 0.3", "light", detection_efficiency=0.3),
    example_of("dark counts 5 MHz", "light", dark_count_hz=5e6),
    *(
        example_of(f"p {p:g}, {delay:g} ns", "afterpulsing", afterpulsing=Afterpulsing(probability=p, delay_ns=delay))
        for p, delay in ((0.1, 30.0), (0.4, 30.0), (0.4, 200.0))
    ),
    example_of("alpha 3 ns", "twilight", twilight_ns=3.0),
    example_of("alpha 15 ns", "twilight", twilight_ns=15.0),
    example_of("p 0.1", "crosstalk", crosstalk=Crosstalk(probability=0.1)),
    example_of("p 0.5", "crosstalk", crosstalk=Crosstalk(probability=0.5)),
    example_of("t_e 60 ns", "electronics", electronics_dead_time_ns=60.0),
    example_of("t_e 130 ns", "electronics", electronics_dead_time_ns=130.0),
    example_of("Gaussian, 2 ns", "jitter", jitter=Jitter(sigma_ns=2.0)),
    example_of(
        "Gaussian and tail of 6 ns, 40 %",
        "jitter",
        jitter=Jitter(sigma_ns=0.5, tail_ns=6.0, tail_fraction=0.4),
    ),
    example_of("codes of 0.75 to 1.25 bins", "converter", code_density=CODES),
    example_of("1 event a period", "limits", max_events_per_period=1),
    example_of("400 events an exposure", "limits", max_events_per_exposure=400),
)


def run(request: Request) -> Facts:
    """Every effect, and the rate under constant light; a figure for each group of effects."""
    from studies.detectors.run import draw_all

    exposures = 400 if request.quick else 10_000
    outcomes = []
    for example in EXAMPLES:
        request.tell(f"effects: {example.name}")
        outcomes.append(outcome(example, exposures))
    rows = [{"effect": each.example.figure or "none", **row(each)} for each in outcomes]
    rates = constant_light(40 if request.quick else 4000)
    settings = settings_of(outcomes[0].system, LIGHT, exposures, SEED)
    return {
        "settings": settings,
        "rows": rows,
        "figures": draw_all(outcomes),
        "rates": rates,
        "tables": {"rate": rates},
    }


def constant_light(exposures: int) -> list[dict[str, Any]]:
    """Rate under constant light of the preset module: one line for each rate of photons."""
    detector, lines = Detector.preset("excelitas-spcm-aqrh"), []
    for rate in (1e5, 1e6, 1e7, 3e7, 1e8):
        pulse = GaussianPulse(sigma_ns=1.0)
        system = System(period_ns=100.0, cycles=2000, bins=2, pulse=pulse, detector=detector, start="stationary")
        flux = Flux(np.zeros((1, exposures)), rate * 1e-9 * system.period_ns, 0.0)
        measured = simulate(flux, system, seed=SEED).sum(-1).ravel() / (system.exposure_ns * 1e-9)
        error = float(measured.std(ddof=1)) / measured.size**0.5
        expected = constant_light_rate(rate, detector)
        lines.append(
            {
                "photons per s": rate,
                "simulated per s": float(measured.mean()),
                "predicted per s": expected,
                "z": (float(measured.mean()) - expected) / error,
                "dead time only per s": 1.0 / (1.0 / rate + detector.dead_time_ns * 1e-9),
            }
        )
    return lines
