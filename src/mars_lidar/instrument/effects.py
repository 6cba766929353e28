"""Effects of a pixel and its electronics beside dead time and mode: the optional fields of `Detector`.

Every effect is declared here once: its check, its form in files, its option, its native fields. All are off by default,
and then the bits are those of the ideal pixel. docs/detectors.md defines each effect and the order in which they act;
docs/architecture.md lists the steps to add one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.avalanches import Afterpulsing, Crosstalk
from mars_lidar.instrument.jitter import Jitter as Jitter
from mars_lidar.instrument.jitter import SampledJitter as SampledJitter
from mars_lidar.instrument.jitter import jitter_from_dict
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.tolerances import TOL

# --- Native forms of pulses ----------------------------------------------------------------------------------------


@lru_cache(maxsize=16)
def native_pulse(pulse: Pulse, period_ns: float) -> _core.PulseTable:
    """The native form of a pulse for a laser period, ns."""
    return pulse._native(period_ns)


# --- Effects -------------------------------------------------------------------------------------------------------


Kind = Literal["light", "avalanche", "recording", "timing"]


@dataclass(frozen=True)
class Effect:
    """Declaration of a field of `Detector` that is an effect.

    kind
        What it changes. ``"light"``: the flux only (`Flux.detected`), supported by every engine and statistic.
        ``"avalanche"``: further arrivals that an avalanche causes in the same pixel or in its neighbours.
        ``"recording"``: which registrations of a pixel are recorded; ``"timing"``: at what time, but not how many.
    off
        The value that switches it off, with the bits of the ideal pixel.
    checked
        The converted value; TypeError or ValueError, naming the field, for an invalid one.
    example
        Its lines in the commented file of ``mars-lidar init``.
    read
        The value from plain data (JSON, YAML); None: as it is.
    native
        The fields of the native job (avalanche) or of its recording (recording, timing) for a value and the laser
        period, ns; times in periods. None for light.
    help, default
        Of its command-line option of the same name; None: it has separate options (cli/system_options.py).
    """

    kind: Kind
    off: Any
    checked: Callable[[Any], Any]
    example: str
    read: Callable[[Any], Any] | None = None
    native: Callable[[Any, float], dict[str, Any]] | None = None
    help: str | None = None
    default: str | None = None


def _instance(name: str, value: Any, *of: type) -> Any:
    if not isinstance(value, of):
        raise TypeError(f"{name} must be of type {' or '.join(each.__name__ for each in of)}, got {value!r}")
    return value


def _code_density(value: Any) -> tuple[float, ...]:
    what = "relative widths of TDC codes"
    return tuple(checks.weights("code_density", value, least=2, most=TOL.codes, what=what).tolist())


def _native_traps(traps: Afterpulsing, period_ns: float) -> dict[str, Any]:
    fields: dict[str, Any] = {"traps": traps.probability, "trap_delay": traps.mean_delay_ns / period_ns}
    if traps.delays is not None:
        fields |= {"trap_delays": traps.edges_below, "trap_sample": (traps.bin_ns or 0.0) / period_ns}
    if traps.generations is not None:
        fields["generations"] = traps.generations
    return fields


def _native_jitter(jitter: Jitter | SampledJitter, period_ns: float) -> dict[str, Any]:
    if isinstance(jitter, SampledJitter):
        return {"jitter": native_pulse(jitter.shape, period_ns)}
    return {
        "jitter": native_pulse(GaussianPulse(sigma_ns=jitter.sigma_ns), period_ns),
        "tail": jitter.tail_ns / period_ns,
        "tail_fraction": jitter.tail_fraction,
    }


FIELDS: dict[str, Effect] = {
    "detection_efficiency": Effect(
        "light",
        1.0,
        lambda v: checks.real("detection_efficiency", v, low=0.0, high=1.0, strict_low=True),
        "detection_efficiency: 0.25       # then S and B are photons on the pixel, not detectable ones",
        help="Photon detection efficiency, fill factor included, in (0, 1].",
        default="1: --signal counts detectable photons",
    ),
    "dark_count_hz": Effect(
        "light",
        0.0,
        lambda v: checks.real("dark_count_hz", v, low=0.0, high=TOL.rate_hz),
        "dark_count_hz: 100.0             # counts/s of every pixel",
        help="Dark counts of every pixel, counts/s; not reduced by the efficiency.",
        default="0",
    ),
    "afterpulsing": Effect(
        "avalanche",
        None,
        lambda v: _instance("afterpulsing", v, Afterpulsing),
        """\
afterpulsing:                    # carriers in traps: each that is released is an arrival like a photon
  probability: 0.02              # mean number per avalanche, those included that are lost in the dead time
  delay_ns: 60.0                 # exponential after the avalanche; or  delays: [0, 3, 2, 1]  with  bin_ns: 40.0""",
        read=Afterpulsing.from_dict,
        native=_native_traps,
    ),
    "twilight_ns": Effect(
        "avalanche",
        0.0,
        lambda v: checks.real("twilight_ns", v, low=0.0),
        "twilight_ns: 2.0                 # photons so late in the dead time fire at its end",
        native=lambda v, period_ns: {"twilight": v / period_ns},
        help="Arrivals up to this long before the end of the dead time trigger an avalanche at its end, ns.",
        default="0",
    ),
    "recovery_ns": Effect(
        "avalanche",
        0.0,
        lambda v: checks.real("recovery_ns", v, low=0.0),
        "recovery_ns: 3.0                 # sensitivity 1 - exp(-(t - end of the dead time) / recovery_ns)",
        native=lambda v, period_ns: {"recovery": v / period_ns},
        help="Time constant with which the sensitivity returns after the dead time, ns.",
        default="0: at once",
    ),
    "crosstalk": Effect(
        "avalanche",
        None,
        lambda v: _instance("crosstalk", v, Crosstalk),
        """\
crosstalk:                       # avalanches trigger neighbours; with the sequential engine
  probability: 0.01              # mean number of neighbours
  kernel: "8"                    # or "4", or 3 x 3 weights""",
        read=Crosstalk.from_dict,
        native=lambda v, period_ns: {"crosstalk": v.probabilities},
    ),
    "electronics_dead_time_ns": Effect(
        "recording",
        0.0,
        lambda v: checks.real("electronics_dead_time_ns", v, low=0.0),
        "electronics_dead_time_ns: 120.0  # of the TDC, beside that of the pixel; matters where it is longer",
        native=lambda v, period_ns: {"electronics_dead_time": v / period_ns},
        help="Dead time of the electronics after an event, ns; without effect unless longer than --dead-time-ns.",
        default="0",
    ),
    "max_events_per_period": Effect(
        "recording",
        None,
        lambda v: checks.integer("max_events_per_period", v, low=1, high=TOL.events),
        "max_events_per_period: 1         # the TDC records the first ones only, of a period ...",
        native=lambda v, period_ns: {"most_per_period": v},
        help="Largest number of events recorded in a period.",
        default="no limit",
    ),
    "max_events_per_exposure": Effect(
        "recording",
        None,
        lambda v: checks.integer("max_events_per_exposure", v, low=1, high=TOL.events),
        "max_events_per_exposure: 1000    # ... and of an exposure",
        native=lambda v, period_ns: {"most_per_exposure": v},
        help="Largest number of events recorded in an exposure.",
        default="no limit",
    ),
    "jitter": Effect(
        "timing",
        None,
        lambda v: _instance("jitter", v, Jitter, SampledJitter),
        """\
jitter:                          # of a record; leave it out of the pulse above then
  kind: gaussian                 # or sampled, with values, bin_ns and origin as for a pulse
  fwhm_ns: 0.1
  tail_ns: 0.2                   # exponential tail: its mean ...
  tail_fraction: 0.1             # ... and the share of the records that are in it""",
        read=jitter_from_dict,
        native=_native_jitter,
    ),
    "code_density": Effect(
        "timing",
        None,
        _code_density,
        "code_density: [1.1, 0.9, 1.05, 0.95]  # relative widths of TDC codes, repeated; their number divides the bins",
        native=lambda v, period_ns: {"code_edges": code_edges(v)},
    ),
}
"""Every effect by the name of its field of `Detector`, in the order in which they act."""


def _of(*kinds: Kind) -> tuple[str, ...]:
    return tuple(name for name, effect in FIELDS.items() if effect.kind in kinds)


LIGHT_EFFECTS, AVALANCHE_EFFECTS, TIMING_EFFECTS = _of("light"), _of("avalanche"), _of("timing")
RECORDING_EFFECTS = _of("recording", "timing")
EFFECTS = tuple(FIELDS)
"""Names of all effects."""


def native_fields(values: Mapping[str, Any], period_ns: float) -> dict[str, Any]:
    """The native fields of effects, by their names and values, that are on."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        effect = FIELDS[name]
        if effect.native is not None and value != effect.off:
            fields |= effect.native(value, period_ns)
    return fields


def plain(value: Any) -> Any:
    """A field as JSON and YAML have it."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    return list(value) if isinstance(value, tuple) else value


def code_edges(code_density: tuple[float, ...]) -> FloatArray:
    """Edges (n + 1,) of the codes of `Detector.code_density`, in mean code widths from 0 to n."""
    widths = np.array(code_density)
    edges = np.concatenate([[0.0], np.cumsum(widths)])
    return np.asarray(edges * (widths.size / edges[-1]), dtype=np.float64)
