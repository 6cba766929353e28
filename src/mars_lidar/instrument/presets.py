"""Detectors and instruments by name: published parameters, each with its source (docs/detectors.md).

A value of an instrument, in instruments.json, is a pair (value, source). The source of a value without a data sheet
begins with "assumption"; check such values before use.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar.instrument.avalanches import Afterpulsing

# --- Instruments ---------------------------------------------------------------------------------------------------

Sourced = dict[str, tuple[Any, str]]  # value and source

INSTRUMENTS: dict[str, dict[str, Sourced]] = json.loads(Path(__file__).with_name("instruments.json").read_text("utf-8"))
"""detector: fields of `Detector`; laser: period_ns, cycles, bins, pulse_fwhm_ns, where the instrument has them."""


def detector_of(name: str) -> dict[str, Any]:
    """The fields of the `Detector` of an instrument."""
    return {field: value for field, (value, _) in INSTRUMENTS[name]["detector"].items()}


def sourced(name: str) -> Sourced:
    """All values of an instrument, with their sources; ValueError with all names if there is none."""
    fields = INSTRUMENTS[checks.choice("preset", name, tuple(INSTRUMENTS))]
    return {**fields.get("laser", {}), **fields["detector"]}


# --- Detectors -----------------------------------------------------------------------------------------------------

# Afterpulses of the module of serial number 3605H by time after the recovery, ns, and the share of them up to then:
# the distribution that goes with Straka et al. (github.com/ivo-s/SPAD-counting-model, apDist_3605H.txt, 81 ps bins),
# condensed to nine steps. Those up to 57 ns are read off that histogram; how the remaining 6 % spread up to 227 ns is
# our estimate. Most of them come within a third of a nanosecond.
_UNTIL_NS = np.array([0.324, 2.43, 8.1, 16.2, 24.3, 32.4, 56.7, 113.4, 226.8])
_SHARE = np.array([0.593, 0.686, 0.784, 0.846, 0.883, 0.903, 0.938, 0.975, 1.0])


def _excelitas_spcm_aqrh() -> dict[str, Any]:
    """Straka et al., J. Lightwave Technol. 38, 4765 (2020), and the program that goes with it."""
    recovery_ns, step_ns = 24.0, 0.324
    edges = np.arange(round(_UNTIL_NS[-1] / step_ns) + 1) * step_ns
    share = np.diff(np.interp(edges, np.append(0.0, _UNTIL_NS), np.append(0.0, _SHARE)))
    blind = np.zeros(round(recovery_ns / step_ns))
    return {
        "dead_time_ns": recovery_ns,
        "afterpulsing": Afterpulsing(
            probability=0.0171, delays=tuple(np.concatenate([blind, share]).round(9)), bin_ns=recovery_ns / blind.size
        ),
        "twilight_ns": 3.2,
    }


def _thorlabs_spcm20a() -> dict[str, Any]:
    """Thorlabs' page of the photon counters SPCM20A and SPCM50A: a photon every 35 and 45 ns, typical dark counts."""
    return {"dead_time_ns": 35.0, "dark_count_hz": 25.0}


def _thorlabs_spcm50a() -> dict[str, Any]:
    """As `_thorlabs_spcm20a`, of a diode of 50 um instead of 20 um."""
    return {"dead_time_ns": 45.0, "dark_count_hz": 150.0}


PRESETS: dict[str, Callable[[], dict[str, Any]]] = {
    "excelitas-spcm-aqrh": _excelitas_spcm_aqrh,
    "thorlabs-spcm20a": _thorlabs_spcm20a,
    "thorlabs-spcm50a": _thorlabs_spcm50a,
    **{name: partial(detector_of, name) for name in INSTRUMENTS},
}


def preset(name: str) -> dict[str, Any]:
    """The fields of the `Detector` of that name; ValueError with all names if there is none."""
    return PRESETS[checks.choice("preset", name, tuple(PRESETS))]()
