"""Distributions of the settings of a sample: numbers and instruments."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked_fields
from mars_lidar._base.display import brief
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System


@dataclass(frozen=True)
class Uniform:
    """Uniform distribution on [low, high].

    Parameters
    ----------
    low, high
        Ends of the range, in the unit of the quantity.

    Raises
    ------
    TypeError
        An end that is not a number.
    ValueError
        An end that is not finite, or `low` above `high`.

    See Also
    --------
    LogUniform, Choice, SystemRange, CubeStream

    Examples
    --------
    >>> import numpy as np
    >>> from mars_lidar.learn import Uniform
    >>> 20.0 <= Uniform(20.0, 100.0).draw(np.random.default_rng(0)) <= 100.0
    True
    """

    low: float
    high: float
    _positive: ClassVar[bool] = False

    def __post_init__(self) -> None:
        low = 0.0 if self._positive else -math.inf
        for name in ("low", "high"):
            number = checks.real(name, getattr(self, name), low=low, strict_low=self._positive)
            object.__setattr__(self, name, number)
        if self.low > self.high:
            raise ValueError(f"low must be at most high, got {self.low:g} and {self.high:g}")

    def draw(self, random: np.random.Generator) -> float:
        """One number, drawn by the generator `random`."""
        return float(random.uniform(self.low, self.high))

    @property
    def ends(self) -> tuple[float, ...]:
        """The least and the largest."""
        return self.low, self.high


@dataclass(frozen=True)
class LogUniform(Uniform):
    """Log-uniform distribution on [low, high]: the logarithm is uniform.

    Parameters
    ----------
    low, high
        Ends of the range, > 0, in the unit of the quantity.

    Raises
    ------
    TypeError
        An end that is not a number.
    ValueError
        An end that is not finite and > 0, or `low` above `high`.

    See Also
    --------
    Uniform, Choice, SystemRange, CubeStream

    Examples
    --------
    >>> import numpy as np
    >>> from mars_lidar.learn import LogUniform
    >>> 0.01 <= LogUniform(0.01, 1.0).draw(np.random.default_rng(0)) <= 1.0
    True
    """

    _positive: ClassVar[bool] = True

    def draw(self, random: np.random.Generator) -> float:
        """One number, drawn by the generator `random`."""
        drawn = math.exp(random.uniform(math.log(self.low), math.log(self.high)))
        return min(max(drawn, self.low), self.high)  # the rounding of exp stays inside


@dataclass(frozen=True)
class Choice:
    """Uniform distribution over a list of numbers.

    Parameters
    ----------
    values
        The numbers, at least one, in the unit of the quantity.

    Raises
    ------
    TypeError
        Not a list of numbers, or an empty list.
    ValueError
        A number that is NaN.

    See Also
    --------
    Uniform, LogUniform, SystemRange, CubeStream

    Examples
    --------
    >>> import numpy as np
    >>> from mars_lidar.learn import Choice
    >>> Choice((50.0, 75.0)).draw(np.random.default_rng(0)) in (50.0, 75.0)
    True
    """

    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.values, list | tuple) or not self.values:
            raise TypeError(f"values must be numbers, at least one, got {self.values!r}")
        object.__setattr__(self, "values", tuple(_number("values", number) for number in self.values))

    def draw(self, random: np.random.Generator) -> float:
        """One of them, by the generator `random`."""
        return self.values[int(random.integers(len(self.values)))]

    @property
    def ends(self) -> tuple[float, ...]:
        """All of them."""
        return self.values


Range = Uniform | LogUniform | Choice
_DRAWN = ("cycles", "period_ns", "dead_time_ns", "sigma_ns")


def as_range(name: str, value: float | Range, *, low: float = 0.0, infinite: bool = False) -> Range:
    """A range, or a number as a range of one value; all values must be above `low`."""
    if isinstance(value, list | tuple | str | bytes | bool) or value is None:
        raise TypeError(f"{name} must be a number, Uniform, LogUniform or Choice, got {value!r}")
    given = value if isinstance(value, Uniform | Choice) else Choice((_number(name, value),))
    for end in given.ends:
        if not end > low or (math.isinf(end) and not infinite):
            most = "inf included" if infinite else "finite"
            raise ValueError(f"{name} must be above {low:g}, {most}, got {end:g}")
    return given


@checked_fields
@dataclass(frozen=True, kw_only=True)
class SystemRange:
    """Distribution of instruments: those of `base`, with the given fields drawn from ranges or set to numbers.

    All fields are drawn independently. The number of bins is that of `base`, so that cubes can be stacked.

    Parameters
    ----------
    base
        The instrument whose other fields are used.
    cycles
        Laser periods per exposure, rounded to integers.
    period_ns, dead_time_ns
        Laser period and dead time, ns. The dead time may be 0.
    sigma_ns
        Width of the pulse, ns; the pulse is then a `mars_lidar.GaussianPulse`.

    Raises
    ------
    TypeError
        A base that is not a `System`; a field that is neither a number nor a range.
    ValueError
        An invalid instrument at some combination of the ends of the ranges; all combinations are checked.

    See Also
    --------
    CubeStream, LogUniform

    Examples
    --------
    >>> import numpy as np
    >>> import mars_lidar as ml
    >>> base = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> systems = ml.learn.SystemRange(base=base, dead_time_ns=ml.learn.LogUniform(20, 100))
    >>> 20.0 <= systems.draw(np.random.default_rng(0)).detector.dead_time_ns <= 100.0
    True
    """

    base: System
    cycles: float | Range | None = None
    period_ns: float | Range | None = None
    dead_time_ns: float | Range | None = None
    sigma_ns: float | Range | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        for name in _DRAWN:
            value = getattr(self, name)
            if value is not None:
                least = -math.ulp(0.0) if name == "dead_time_ns" else 0.0
                object.__setattr__(self, name, as_range(name, value, low=least))
        self.corners()

    def draw(self, random: np.random.Generator) -> System:
        """One instrument, drawn by the generator `random`."""
        return self._system({name: given.draw(random) for name, given in self._ranges().items()})

    def corners(self) -> list[System]:
        """The instruments at the ends of all ranges."""
        ranges = self._ranges()
        ends = itertools.product(*(given.ends for given in ranges.values()))
        return [self._system(dict(zip(ranges, values, strict=True))) for values in ends]

    def _ranges(self) -> dict[str, Range]:
        named = {name: getattr(self, name) for name in _DRAWN}
        return {name: given for name, given in named.items() if given is not None}

    def _system(self, values: dict[str, float]) -> System:
        changes: dict[str, Any] = {}
        if "cycles" in values:
            changes["cycles"] = max(1, round(values["cycles"]))
        if "period_ns" in values:
            changes["period_ns"] = values["period_ns"]
        if "dead_time_ns" in values:
            changes["detector"] = dataclasses.replace(self.base.detector, dead_time_ns=values["dead_time_ns"])
        if "sigma_ns" in values:
            changes["pulse"] = GaussianPulse(sigma_ns=values["sigma_ns"])
        return self.base.replace(**changes)


class SystemList:
    """Uniform distribution over a list of instruments."""

    def __init__(self, systems: Sequence[System]) -> None:
        self._systems = list(systems)
        for system in self._systems:
            if not isinstance(system, System):
                raise TypeError(f"systems must be a System, several, or a SystemRange, got a {type(system).__name__}")
        if not self._systems:
            raise ValueError("systems must be at least one, got none")
        bins = {system.bins for system in self._systems}
        if len(bins) > 1:
            raise ValueError(f"systems must have equally many bins, so that cubes can be stacked, got {sorted(bins)}")

    def draw(self, random: np.random.Generator) -> System:
        """One of them."""
        return self._systems[int(random.integers(len(self._systems)))]

    def corners(self) -> list[System]:
        """All of them."""
        return self._systems


def as_systems(value: System | Sequence[System] | SystemRange) -> SystemRange | SystemList:
    """Distribution from which instruments are drawn."""
    if isinstance(value, SystemRange):
        return value
    if isinstance(value, System):
        return SystemList([value])
    if isinstance(value, list | tuple):
        return SystemList(value)
    raise TypeError(f"systems must be a System, several, or a SystemRange, got {value!r}")


def _number(name: str, value: Any) -> float:
    return math.inf if value == math.inf else checks.real(name, value)
