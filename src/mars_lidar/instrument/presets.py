"""Detectors and instruments by name: published parameters, each with its source (docs/detectors.md).

A value of an instrument is a pair (value, source). The source of a value without a data sheet begins with "assumption";
check such values before use. The table in docs/detectors.md is `table` of this.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar.instrument.avalanches import Afterpulsing

# --- Instruments ---------------------------------------------------------------------------------------------------

ASSUMED = "assumption"
_QUOTED = f"{ASSUMED}: as it is commonly quoted, the data sheet was not read"
_OFF = f"{ASSUMED}: not found"
_S512 = "SPAD512S, a camera of this kind (axiomoptics.com/products/spad512s)"
_TMF = "TMF8820/21/28 data sheet DS000693 v8-00"
_TMF_BINS = "SparkFun library of the TMF882X, TMF882X_HIST_NUM_BINS"
_ST = "DS14161 (VL53L8CX)"
_CNH = "ST plugin_cnh.h of the VL53L8CH, CNH_BIN_WIDTH_MM = 37.5348"
_FIFO = "Becker & Hickl, SPC_data_file_structure.h: ADC of 12 bits"
_TAC = "Wahl, Time-Correlated Single Photon Counting, technical note: one photon in a cycle of the TAC"

Sourced = dict[str, tuple[Any, str]]

# detector: fields of `Detector`; laser: period_ns, cycles, bins, pulse_fwhm_ns, where the instrument has them
INSTRUMENTS: dict[str, dict[str, Sourced]] = {
    "swissspad2-like": {
        "detector": {
            "dead_time_ns": (50.0, f"{ASSUMED}: of no effect, as a pixel holds one photon a frame"),
            "mode": ("gated", _S512),
            "gate_start_ns": (0.0, f"{ASSUMED}: where the gate is put"),
            "gate_width_ns": (6.0, f"{_S512}: down to 6 ns, moved in steps of 17 ps"),
            "detection_efficiency": (0.0525, f"{_S512}: 50 % at 520 nm; {ASSUMED}: fill factor 10.5 %, no microlenses"),
            "dark_count_hz": (25.0, f"{_S512}: less than 25/s"),
            "max_events_per_exposure": (1, f"{_S512}: one bit of memory in a pixel"),
        },
        "laser": {
            "period_ns": (50.0, f"{ASSUMED}: 20 MHz"),
            "cycles": (200, f"{_S512}: 100 000 frames/s, 10 us of the period"),
            "bins": (50, f"{ASSUMED}: the camera has no time bins, the position of its gate is the time"),
            "pulse_fwhm_ns": (0.2, _OFF),
        },
    },
    **{
        name: {
            "detector": {"dead_time_ns": (10.0, _OFF)},
            "laser": {
                "period_ns": (2 * 5.0 / 0.299792458, f"{ASSUMED}: of its range, 5 m ({_TMF}, abstract)"),
                "cycles": (500_000, _OFF),
                "bins": (128, _TMF_BINS),
                "pulse_fwhm_ns": (1.0, _OFF),
            },
        }
        for name in ("tmf8820", "tmf8828")
    },
    "vl53l8cx": {
        "detector": {"dead_time_ns": (10.0, _OFF)},
        "laser": {
            "period_ns": (128 * 2 * 0.0375348 / 0.299792458, f"128 bins of 37.5348 mm ({_CNH}); beyond 4 m ({_ST})"),
            "cycles": (500_000, _OFF),
            "bins": (128, f"{ASSUMED}: of {_CNH.split(',')[0]}, whose number of bins is set by the user"),
            "pulse_fwhm_ns": (1.0, _OFF),
        },
    },
    "ads6311": {
        "detector": {"dead_time_ns": (10.0, _OFF)},
        "laser": {
            "period_ns": (200.0, f"{ASSUMED}: 30 m"),
            "cycles": (10_000, _OFF),
            "bins": (200, f"{ASSUMED}: 1 ns"),
            "pulse_fwhm_ns": (2.0, _OFF),
        },
    },
    "spc-150": {
        "detector": {
            "dead_time_ns": (0.0, f"{ASSUMED}: electronics alone; give that of the detector"),
            "electronics_dead_time_ns": (100.0, _QUOTED),
            "max_events_per_period": (1, _TAC),
        },
        "laser": {
            "period_ns": (50.0, f"{ASSUMED}: 20 MHz"),
            "cycles": (1_000_000, f"{ASSUMED}: 50 ms"),
            "bins": (4096, _FIFO),
            "pulse_fwhm_ns": (0.2, f"{ASSUMED}: of laser and detector"),
        },
    },
    "mpd-pdm": {"detector": {"dead_time_ns": (77.0, _QUOTED), "dark_count_hz": (50.0, f"{_QUOTED}; 50 um, by grade")}},
    "id-quantique-id100": {
        "detector": {"dead_time_ns": (45.0, _QUOTED), "dark_count_hz": (20.0, f"{_QUOTED}; by grade")}
    },
    "id-quantique-id120": {
        "detector": {"dead_time_ns": (400.0, f"{_QUOTED}; set by the user"), "dark_count_hz": (200.0, _QUOTED)}
    },
}


def detector_of(name: str) -> dict[str, Any]:
    """The fields of the `Detector` of an instrument."""
    return {field: value for field, (value, _) in INSTRUMENTS[name]["detector"].items()}


def sourced(name: str) -> Sourced:
    """All values of an instrument, with their sources; ValueError with all names if there is none."""
    fields = INSTRUMENTS[checks.choice("preset", name, tuple(INSTRUMENTS))]
    return {**fields.get("laser", {}), **fields["detector"]}


def table() -> str:
    """All instruments as the table of docs/detectors.md."""
    lines = ["| name | field | value | source |", "|---|---|---|---|"]
    for name in INSTRUMENTS:
        label = f"`{name}`"
        for field, (value, source) in sourced(name).items():
            lines.append(f"| {label} | `{field}` | {value if isinstance(value, str) else f'{value:.6g}'} | {source} |")
            label = ""
    return "\n".join(lines)


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
