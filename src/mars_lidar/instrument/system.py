"""The instrument: laser, detector and histogram, as one frozen object that accompanies every result."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, constructed_by_name
from mars_lidar._base.display import as_html, brief
from mars_lidar._base.files import check_claim, reading, write_text
from mars_lidar._base.yaml import Lines, located, read_yaml
from mars_lidar.instrument.detector import Detector as Detector
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.presets import sourced
from mars_lidar.instrument.pulse import Pulse, pulse_from_dict
from mars_lidar.instrument.tolerances import TOL
from mars_lidar.instrument.units import check_units, period_hint

SPEED_OF_LIGHT_M_PER_NS = 0.299792458
_STARTS = ("armed", "stationary")
_SUFFIXES = (".json", ".yaml", ".yml")


@constructed_by_name
@dataclass(frozen=True, kw_only=True)
class System:
    """Laser, detector and histogram.

    Parameters
    ----------
    period_ns
        Laser period t_r, ns.
    cycles
        Laser periods per exposure N_r, at most 1e8 in a simulation; the exposure lasts ``cycles * period_ns``.
    bins
        Histogram bins over one period n_b.
    pulse
        Shape of the returned pulse, including the detector response unless the detector has a jitter.
    detector
        Dead time, mode, gate and effects of the pixel.
    start
        State of the pixel at the start of the exposure: ``"armed"`` (ready at t = 0) or ``"stationary"``
        (warmed up). The two differ by up to half a count in the mean.

    Raises
    ------
    ValueError
        A number out of its range, a pulse that does not fit in the period, a dead time above 2^20 periods, or settings
        that exclude each other; the message names the setting.
    TypeError
        A pulse or detector of another type, a value that is not a number, or an unknown keyword.

    Warns
    -----
    UnitWarning
        A possible time that was probably meant in ps or s: a dead time of 75,000 ns, a pulse of 100 ns.

    See Also
    --------
    Detector, GaussianPulse, simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> system.bin_ns
    0.78125
    >>> system.replace(cycles=50).cycles
    50
    """

    period_ns: float
    cycles: int
    bins: int
    pulse: Pulse
    detector: Detector
    start: Literal["armed", "stationary"] = "armed"

    __repr__ = brief

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "period_ns", checks.real("period_ns", self.period_ns, low=0.0, strict_low=True))
        set_field(self, "cycles", checks.integer("cycles", self.cycles, low=1, high=TOL.recorded_cycles))
        set_field(self, "bins", checks.integer("bins", self.bins, low=1, high=TOL.bins))
        if not isinstance(self.pulse, Pulse):
            raise TypeError(f"pulse must be a GaussianPulse or a SampledPulse, got {self.pulse!r}")
        if not isinstance(self.detector, Detector):
            raise TypeError(f"detector must be a Detector, got {self.detector!r}")
        checks.choice("start", self.start, _STARTS)
        try:
            self.pulse.check(self.period_ns)
        except ValueError as error:
            hint = period_hint(self.period_ns)
            raise ValueError(f"{hint}; {error}" if hint else str(error)) from error
        if self.dead_time_periods > TOL.dead_periods:
            raise ValueError(
                f"dead_time_ns must be at most {TOL.dead_periods} periods of {self.period_ns:g} ns, "
                f"got {self.detector.dead_time_ns:g} ns"
            )
        self.detector.check(self.period_ns, self.bins, self.start)
        if self.electronics_dead_time_periods > TOL.dead_periods:
            raise ValueError(
                f"electronics_dead_time_ns must be at most {TOL.dead_periods} periods of {self.period_ns:g} ns, "
                f"got {self.detector.electronics_dead_time_ns:g} ns"
            )
        check_units(self.period_ns, self.pulse, self.detector)

    def _repr_html_(self) -> str:
        t = self.time_ns
        pulse = self.pulse.bin_energy(0.5 * self.period_ns, self.period_ns, self.bins)
        return as_html(self, {"pulse, share per bin, over the period (ns)": (t, pulse)})

    @property
    def bin_ns(self) -> float:
        """Width of a histogram bin, ns."""
        return self.period_ns / self.bins

    @property
    def exposure_ns(self) -> float:
        """Length of one exposure, ns."""
        return self.period_ns * self.cycles

    @property
    def dead_time_periods(self) -> float:
        """Dead time in laser periods, t_d / t_r."""
        return self.detector.dead_time_ns / self.period_ns

    @property
    def electronics_dead_time_periods(self) -> float:
        """Dead time of the electronics in laser periods, t_e / t_r."""
        return self.detector.electronics_dead_time_ns / self.period_ns

    def detected(self) -> System:
        """This system for a flux of detected photons, `Flux.detected`, which includes efficiency and dark counts."""
        bare = self.detector.without(*LIGHT_EFFECTS)
        return self if bare == self.detector else self.replace(detector=bare)

    @property
    def unambiguous_range_m(self) -> float:
        """Depth c t_r / 2 beyond which returns wrap into the next period, m."""
        return 0.5 * SPEED_OF_LIGHT_M_PER_NS * self.period_ns

    @property
    def time_ns(self) -> NDArray[np.float64]:
        """Centres of the histogram bins (bins,), ns."""
        return (np.arange(self.bins, dtype=np.float64) + 0.5) * self.bin_ns

    @checked
    def delay_ns(self, depth_m: ArrayLike) -> NDArray[np.float64]:
        """Round-trip time 2 z / c of depths `depth_m` (...) in m, in ns, not wrapped."""
        return 2.0 / SPEED_OF_LIGHT_M_PER_NS * np.asarray(depth_m, dtype=np.float64)

    @checked
    def depth_m(self, delay_ns: ArrayLike) -> NDArray[np.float64]:
        """Depth c tau / 2 of delays `delay_ns` (...) in ns, in m."""
        return 0.5 * SPEED_OF_LIGHT_M_PER_NS * np.asarray(delay_ns, dtype=np.float64)

    @property
    def max_registrations(self) -> float:
        """Largest possible number of registrations of an exposure; inf for a dead time of 0.

        floor(exposure / t_d) + 1; a synchronous pixel registers once in max(1, ceil(t_d / t_r)) periods.
        """
        dead = self.detector.dead_time_ns
        if self.detector.mode == "synchronous":
            return math.ceil(self.cycles / max(1, math.ceil(self.dead_time_periods - 1e-9)))
        return math.inf if dead == 0.0 else self.exposure_ns // dead + 1

    @property
    def max_bin_count(self) -> float:
        """Largest possible count of one bin; inf for a dead time of 0.

        One bin width per period allows floor(width / t_d) + 1 registrations; only `max_registrations` holds where
        jitter moves records into the bin.
        """
        dead, most = self.detector.dead_time_ns, self.max_registrations
        if self.detector.mode == "synchronous" or dead == 0.0:
            return most
        if set(TIMING_EFFECTS) & set(self.detector.effects):
            return most
        return min(self.cycles * (self.bin_ns // dead + 1), most)

    @property
    def closed_bins(self) -> NDArray[np.bool_]:
        """(bins,) which bins a fixed gate never opens; none where jitter may move records there."""
        if (
            self.detector.mode != "gated"
            or self.detector.gate_moves
            or set(TIMING_EFFECTS) & set(self.detector.effects)
        ):
            return np.zeros(self.bins, np.bool_)
        start, _, width = self.detector.gate_periods(self.period_ns)
        low = (np.arange(self.bins) / self.bins - start) % 1.0  # of a bin's first edge after the gate's opening
        return (low >= width - 1e-9) & (low + 1.0 / self.bins <= 1.0 + 1e-9)

    def check_possible(self, counts: NDArray[Any]) -> None:
        """Raise ValueError where `counts` (..., bins) has some in bins that the gate never opens."""
        closed = self.closed_bins
        outside = int(counts[..., closed].sum()) if closed.any() else 0
        if outside:
            start, _, width = (self.period_ns * share for share in self.detector.gate_periods(self.period_ns))
            raise ValueError(
                f"{outside:,} of {int(counts.sum()):,} counts lie in bins that the gate, open from {start:g} to "
                f"{start + width:g} ns, never opens: correct gate_start_ns and gate_width_ns, or set these bins to 0"
            )

    @property
    def histogram_dtype(self) -> np.dtype[Any]:
        """uint16, or uint32 if a bin could exceed 65535; a function of the system alone."""
        return np.dtype(np.uint16 if self.max_bin_count <= np.iinfo(np.uint16).max else np.uint32)

    def replace(self, **changes: Any) -> System:
        """A copy with some fields changed; `changes` are arguments of `System`."""
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON and YAML, from which `System.from_dict` makes an equal system."""
        return {
            "period_ns": self.period_ns,
            "cycles": self.cycles,
            "bins": self.bins,
            "pulse": self.pulse.to_dict(),
            "detector": self.detector.to_dict(),
            "start": self.start,
        }

    @classmethod
    def from_dict(cls, data: Any) -> System:
        """The system that `to_dict` described by `data`; unknown or missing keys are errors that name them."""
        names = tuple(field.name for field in dataclasses.fields(cls))
        known = dict(checks.known_keys("system", data, names, needed=names[:-1]))  # all but the start
        known["pulse"] = pulse_from_dict(known["pulse"])
        known["detector"] = Detector.from_dict(known["detector"])
        return cls(**known)

    @classmethod
    def preset(cls, name: str) -> System:
        """An instrument by its `name` in `mars_lidar.instrument.presets.INSTRUMENTS`, with its laser and time bins.

        The source of each value, or that it is an assumption, is stated in docs/detectors.md and in the file that
        ``mars-lidar init --preset NAME`` writes. ValueError for a preset of a detector alone (`Detector.preset`).
        """
        fields = sourced(name)
        if "period_ns" not in fields:
            raise ValueError(f"{name} is a detector, without a laser: use Detector.preset({name!r})")
        period, cycles, bins, fwhm = (fields[key][0] for key in ("period_ns", "cycles", "bins", "pulse_fwhm_ns"))
        pulse = pulse_from_dict({"kind": "gaussian", "fwhm_ns": fwhm})
        return cls(period_ns=period, cycles=cycles, bins=bins, pulse=pulse, detector=Detector.preset(name))

    def to_json(self) -> str:
        """One line of JSON; floats are read back with the same bits."""
        return json.dumps(self.to_dict())

    @classmethod
    @checked
    def from_json(cls, text: str) -> System:
        """The system that `to_json` wrote as `text`."""
        try:
            document = json.loads(text)
        except ValueError as error:
            raise ValueError(f"text must be the JSON of a system, got {text[:60]!r} ({error})") from None
        return cls.from_dict(document)

    @checked
    def save(self, path: str | Path) -> None:
        """Write to a ``.json``, ``.yaml`` or ``.yml`` file `path`."""
        import yaml

        target = Path(path)
        checks.suffix("path", target, _SUFFIXES)
        data = self.to_dict()
        as_json = target.suffix == ".json"
        write_text(target, json.dumps(data, indent=2) + "\n" if as_json else yaml.safe_dump(data, sort_keys=False))

    @classmethod
    @checked
    def load(cls, path: str | Path) -> System:
        """Read the file `path` that `save` wrote; errors name the file, the line and the key."""
        source = Path(path)
        checks.suffix("path", source, _SUFFIXES)
        lines: Lines = {}
        if source.suffix != ".json" or (source.is_file() and source.stat().st_size <= TOL.lined_bytes):
            data, lines = read_yaml(source)  # JSON is YAML, and YAML has lines
        else:
            with reading(source, "a system"):
                check_claim(source, 8 * source.stat().st_size, "its numbers")
                data = json.loads(source.read_text(encoding="utf-8-sig"))
        with located(source, lines):
            return cls.from_dict(data)
