"""The detector pixel: dead time, mode, gate, effects. Definitions: docs/detectors.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, constructed_by_name
from mars_lidar._base.display import as_html, brief
from mars_lidar.instrument import effects
from mars_lidar.instrument.avalanches import Afterpulsing, Crosstalk
from mars_lidar.instrument.effects import Jitter, SampledJitter
from mars_lidar.instrument.presets import preset
from mars_lidar.instrument.tolerances import TOL

Mode = Literal["nonparalyzable", "paralyzable", "synchronous", "gated"]
MODES: tuple[Mode, ...] = ("nonparalyzable", "paralyzable", "synchronous", "gated")

_RECOVERING: tuple[Mode, ...] = ("nonparalyzable", "gated")
_GATE = ("gate_start_ns", "gate_width_ns", "gate_step_ns", "gate_cycles")


@constructed_by_name
@dataclass(frozen=True, kw_only=True)
class Detector:
    """A single-photon detector pixel.

    Fields from `detection_efficiency` on are effects, in the order in which they act (docs/detectors.md); all are off
    by default.

    Parameters
    ----------
    dead_time_ns
        After a registration the pixel is dead for this long, across period edges. 0, a fraction of the
        laser period or many periods.
    mode
        - ``"nonparalyzable"``: free-running; photons that arrive during the dead time have no effect,
        - ``"paralyzable"``: free-running; every arrival, registered or not, restarts the dead time, so that
          an arrival is registered if and only if none came within the dead time before it,
        - ``"synchronous"``: armed at the start of each laser period, registers the first photon of the period
          only; a dead time that extends beyond the start of a period makes the pixel dead for that whole period,
        - ``"gated"``: only photons within the gate count; inside, as ``"nonparalyzable"``. If the gate
          opens during the dead time, the pixel is armed when its dead time ends.
    gate_start_ns, gate_width_ns
        The gate is open on [start, start + width) of each period; one that reaches beyond the end of the period
        continues at its beginning. The start is taken modulo the period, the width is at most the period. Both
        are needed by mode ``"gated"``; with the other modes all gate fields are None.
    gate_step_ns
        The start advances by this much (modulo the period, either sign) ...
    gate_cycles
        ... every so many periods, for a gate that moves during the exposure. Default: 0 and 1, a fixed gate.

    detection_efficiency
        Probability, fill factor included, that a photon of the `Flux` triggers an avalanche; in (0, 1]. 1: the flux
        is given in detectable photons.
    dark_count_hz
        Rate of avalanches without a photon, counts/s: uniform in time, in the gate of a gated pixel only. Rates pixel
        by pixel: `Flux.with_dark_counts`.
    afterpulsing
        `Afterpulsing`: carriers that an avalanche leaves in traps and that trigger further avalanches when released.
    twilight_ns
        Arrivals within this time before the end of a dead time, ns, are not lost: the pixel fires at its end (a
        twilight pulse). At most the dead time; mode ``"nonparalyzable"`` only.
    recovery_ns
        Time constant r, ns, with which the sensitivity returns after a dead time t_d (Krause and Walenta, *Exponential-
        recovery model for free-running SPADs with capacity-induced dead-time imperfections*, arXiv 2507.10361, 2025):
        an arrival at t after a registration at T triggers an avalanche with the probability
        ``1 - exp(-(t - T - t_d) / r)``, in addition to `detection_efficiency`, independently for each photon, dark
        count, afterpulse and crosstalk event; otherwise it is lost. Twilight pulses are not affected. A pixel without
        a previous registration, as at an armed start, is fully sensitive. At most 1e6 laser periods; modes
        ``"nonparalyzable"`` and ``"gated"`` (recovery continues while the gate is closed).
    crosstalk
        `Crosstalk`: avalanches trigger neighbouring pixels. The pixels of an image then depend on each other.
    electronics_dead_time_ns
        An avalanche is recorded only if none was recorded within this time t_e before it, ns, in addition to the dead
        time of the pixel; without effect unless longer. The electronics are ready at the start of an exposure.
    max_events_per_period, max_events_per_exposure
        Largest number of events that the electronics record in a laser period, and in an exposure; later events are
        lost.
    jitter
        `Jitter` or `SampledJitter`: difference between the recorded time and that of the avalanche. Dead time, gate,
        limits and exposure are determined by the time of the avalanche.
    code_density
        Non-linearity of the time-to-digital converter: relative widths (n,) of n neighbouring codes, as a code-density
        test measures them. n divides the number of bins, and the pattern repeats (the taps of a delay line in each
        cycle of the clock); n = bins gives every bin its own.

    Raises
    ------
    ValueError
        A number out of its range, or settings that exclude each other, such as a gate without ``mode="gated"``.
    TypeError
        An effect of another type, or an unknown keyword.

    See Also
    --------
    System, Afterpulsing, Crosstalk, Jitter

    Examples
    --------
    >>> import mars_lidar as ml
    >>> ml.Detector(dead_time_ns=75.0, detection_efficiency=0.3).dead_time_ns
    75.0
    >>> ml.Detector(dead_time_ns=10.0, mode="synchronous").mode
    'synchronous'
    """

    dead_time_ns: float
    mode: Mode = "nonparalyzable"
    gate_start_ns: float | None = None
    gate_width_ns: float | None = None
    gate_step_ns: float | None = None
    gate_cycles: int | None = None
    detection_efficiency: float = 1.0
    dark_count_hz: float = 0.0
    afterpulsing: Afterpulsing | None = None
    twilight_ns: float = 0.0
    recovery_ns: float = 0.0
    crosstalk: Crosstalk | None = None
    electronics_dead_time_ns: float = 0.0
    max_events_per_period: int | None = None
    max_events_per_exposure: int | None = None
    jitter: Jitter | SampledJitter | None = None
    code_density: tuple[float, ...] | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        for name, field in effects.FIELDS.items():
            if getattr(self, name) is not None or field.off is not None:
                set_field(self, name, field.checked(getattr(self, name)))
        set_field(self, "dead_time_ns", checks.real("dead_time_ns", self.dead_time_ns, low=0.0))
        checks.choice("mode", self.mode, MODES)
        self._check_avalanches()
        if self.mode != "gated":
            for name in _GATE:
                if getattr(self, name) is not None:
                    raise ValueError(
                        f"{name} belongs to mode 'gated' and must be None with mode {self.mode!r}, "
                        f"got {getattr(self, name)!r}"
                    )
            return
        for name in ("gate_start_ns", "gate_width_ns"):
            if getattr(self, name) is None:
                raise ValueError(f"mode 'gated' needs {name}, in ns, got None")
        set_field(
            self, "gate_start_ns", checks.real("gate_start_ns", self.gate_start_ns, low=-TOL.gate_ns, high=TOL.gate_ns)
        )
        set_field(self, "gate_width_ns", checks.real("gate_width_ns", self.gate_width_ns, low=0.0, strict_low=True))
        step = 0.0 if self.gate_step_ns is None else self.gate_step_ns
        set_field(self, "gate_step_ns", checks.real("gate_step_ns", step, low=-TOL.gate_ns, high=TOL.gate_ns))
        cycles = 1 if self.gate_cycles is None else self.gate_cycles
        set_field(self, "gate_cycles", checks.integer("gate_cycles", cycles, low=1, high=TOL.cycles))
        if self.gate_cycles != 1 and self.gate_step_ns == 0.0:
            raise ValueError(
                "gate_cycles is the number of periods that a moving gate stays in place: give gate_step_ns too, "
                f"got gate_cycles={self.gate_cycles} with gate_step_ns=0"
            )

    @classmethod
    def preset(cls, name: str) -> Detector:
        """A published detector, by its `name` in `mars_lidar.instrument.presets.PRESETS` (docs/detectors.md).

        `dataclasses.replace` changes fields. Efficiencies stay at 1, because they depend on the wavelength.
        """
        return cls(**preset(name))

    def _repr_html_(self) -> str:
        """Draw the sensitivity over the time since the last registration."""
        blind, slow = self.dead_time_ns, self.recovery_ns
        t = np.linspace(0.0, 1.5 * blind + 5.0 * slow or 1.0, TOL.curve_points)
        after = np.maximum(t - blind, 0.0)
        recovered = 1.0 - np.exp(-after / slow) if slow else 1.0
        sensitivity = np.where(t < blind, 0.0, self.detection_efficiency * recovered)
        return as_html(self, {"sensitivity, after a registration (ns)": (t, sensitivity)})

    def _check_avalanches(self) -> None:
        if self.twilight_ns > 0.0 and self.mode != "nonparalyzable":
            raise ValueError(
                "twilight_ns belongs to mode 'nonparalyzable', whose pixel recovers at the end of the dead time, "
                f"and must be 0 with mode {self.mode!r}, got {self.twilight_ns:g}"
            )
        if self.twilight_ns > self.dead_time_ns:
            raise ValueError(
                f"twilight_ns must lie in [0, {self.dead_time_ns:g}], the dead time at whose end it is, "
                f"got {self.twilight_ns:g}"
            )
        if self.recovery_ns > 0.0 and self.mode not in _RECOVERING:
            raise ValueError(
                f"recovery_ns belongs to modes {' and '.join(map(repr, _RECOVERING))}, whose pixel recovers after the "
                f"dead time of a registration, and must be 0 with mode {self.mode!r}, got {self.recovery_ns:g}"
            )
        if self.crosstalk is not None and self.dead_time_ns == 0.0:
            raise ValueError(
                "crosstalk needs dead_time_ns > 0: pixels that are never blind would trigger each other back and "
                "forth at one instant, got dead_time_ns=0"
            )

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that are on and have an effect, in the order in which they act."""
        on = [name for name, field in effects.FIELDS.items() if getattr(self, name) != field.off]
        if self.electronics_dead_time_ns <= self.dead_time_ns:  # registrations are that far apart in every mode
            on = [name for name in on if name != "electronics_dead_time_ns"]
        return tuple(on)

    def without(self, *names: str) -> Detector:
        """This detector without the effects of these field `names`."""
        return dataclasses.replace(self, **{name: effects.FIELDS[name].off for name in names})

    @property
    def gate_moves(self) -> bool:
        """Whether the gate moves during the exposure."""
        return bool(self.gate_step_ns)

    def gate_periods(self, period_ns: float) -> tuple[float, float, float]:
        """Start and step in [0, 1), and width in (0, 1], in periods of `period_ns`; the whole period without a gate."""
        if self.gate_start_ns is None or self.gate_width_ns is None or self.gate_step_ns is None:
            return 0.0, 0.0, 1.0
        start, step = self.gate_start_ns % period_ns / period_ns, self.gate_step_ns % period_ns / period_ns
        return start % 1.0, step % 1.0, min(self.gate_width_ns / period_ns, 1.0)

    def check(self, period_ns: float, bins: int, start: str) -> None:
        """Raise ValueError, naming the field, for values that are invalid at this `period_ns`, `bins` and `start`."""
        if self.jitter is not None:
            self.jitter.check(period_ns)
        if self.afterpulsing is not None:
            self.afterpulsing.check(period_ns)
        if self.recovery_ns > TOL.delay_periods * period_ns:
            raise ValueError(
                f"recovery_ns must be at most {TOL.delay_periods * period_ns:g} ns (1e6 periods), "
                f"got {self.recovery_ns:g}"
            )
        if self.code_density is not None and bins % len(self.code_density):
            raise ValueError(
                f"code_density must have a number of codes that divides the {bins} bins of the histogram, "
                f"got {len(self.code_density)}"
            )
        least, most = TOL.gate_periods * period_ns, period_ns * (1 + 1e-12)
        if self.gate_width_ns is not None and not least <= self.gate_width_ns <= most:
            raise ValueError(
                f"gate_width_ns must lie in [{least:g}, {period_ns:g}] ns (1e-5 to 1 period), "
                f"got {self.gate_width_ns:g}"
            )
        if self.gate_moves and start == "stationary":
            raise ValueError(
                "start must be 'armed' with a gate that moves, which has no stationary state, got 'stationary' "
                f"with gate_step_ns={self.gate_step_ns:g}"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `Detector.from_dict` makes an equal detector; gate and effects only where used."""
        data = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            off = effects.FIELDS[field.name].off if field.name in effects.FIELDS else None
            if value != off:
                data[field.name] = effects.plain(value)
        return data

    @classmethod
    def from_dict(cls, data: Any) -> Detector:
        """The detector that `to_dict` described by `data`; ``preset: NAME`` stands for the fields of a preset."""
        names = tuple(field.name for field in dataclasses.fields(cls))
        known = dict(checks.known_keys("detector", data, (*names, "preset")))
        if "preset" in known:
            known = cls.preset(known.pop("preset")).to_dict() | known
        for name, field in effects.FIELDS.items():
            if field.read is not None and known.get(name) is not None:
                known[name] = field.read(known[name])
        return cls(**known)


def require_mode_of(what: str, chosen: Any, every: Iterable[Any], mode: str) -> None:
    """Raise ValueError if `mode` is none of the modes of `chosen`, with the names of those of `every` whose it is."""
    if mode not in chosen.modes:
        able = " or ".join(repr(each.name) for each in every if mode in each.modes)
        modes = ", ".join(map(repr, chosen.modes))
        raise ValueError(f"{what} {chosen.name!r} is not for detectors of mode {mode!r}, only for {modes}; use {able}")


def require_effects(what: str, detector: Detector, able: tuple[str, ...], instead: Callable[[str], str]) -> None:
    """Raise ValueError, naming the first effect that is on and not in `able`, with the alternative from `instead`."""
    for name in detector.effects:
        if name not in able:
            value = repr(getattr(detector, name))
            given = value if len(value) <= 100 else f"{value[:97]}..."
            raise ValueError(f"{what} does not do {name} of the detector, got {given}{instead(name)}")


@checked
def dark_count_map(
    shape: tuple[int, int],
    *,
    median_hz: float,
    spread: float = 0.5,
    hot_fraction: float = 0.02,
    hot_factor: float = 100.0,
    seed: int = 0,
) -> NDArray[np.float64]:
    """A realistic map (H, W) of dark count rates, counts/s, for `Flux.with_dark_counts`.

    Rates of the pixels of an array are log-normal, with a population of "hot" pixels far above the rest.

    Parameters
    ----------
    shape
        (H, W).
    median_hz
        Median of the pixels that are not hot, counts/s.
    spread
        Standard deviation of the logarithm of the rate.
    hot_fraction
        Probability that a pixel is hot, in [0, 1].
    hot_factor
        Ratio of the median of the hot pixels to that of the others; their logarithms have the same spread.
    seed
        Integer in [0, 2**64).

    Raises
    ------
    TypeError
        A rate, factor or shape is not a number.
    ValueError
        A shape that is not (H, W), or a number out of its range.

    See Also
    --------
    Detector, Flux

    Examples
    --------
    >>> import mars_lidar as ml
    >>> rates = ml.dark_count_map((4, 6), median_hz=50.0)
    >>> rates.shape
    (4, 6)
    """
    if not isinstance(shape, tuple | list) or len(shape) != 2:
        raise ValueError(f"shape must be (H, W), got {shape!r}")
    size = tuple(checks.integer("shape", n, low=1, high=2**20) for n in shape)
    median = checks.real("median_hz", median_hz, low=0.0)
    sigma = checks.real("spread", spread, low=0.0, high=10.0)
    share = checks.real("hot_fraction", hot_fraction, low=0.0, high=1.0)
    factor = checks.real("hot_factor", hot_factor, low=1.0)
    random = np.random.Generator(np.random.PCG64(checks.integer("seed", seed, low=0, high=2**64 - 1)))
    hot = random.random(size) < share
    return np.asarray(median * np.exp(sigma * random.standard_normal(size)) * np.where(hot, factor, 1.0))
