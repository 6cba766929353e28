"""Interface of the reconstruction methods."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from enum import IntFlag
from typing import Any, ClassVar, Literal

import numpy as np

from mars_lidar._base import arguments, checks
from mars_lidar._base.native import _core
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray
from mars_lidar.instrument.detector import Mode, require_mode_of
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import check_window, recording_of
from mars_lidar.reconstruction.histograms import Histograms, checked

Filter = Literal["log", "linear"]
FILTERS = ("log", "linear")

_NONE, _PASSES, _CHAIN = range(3)  # corrections, as the native core numbers them
_LOCATORS = {"peak": 0, "linear": 1, "log": 2}


class Flags(IntFlag):
    """Flags of a pixel, as bits; 0 for none.

    ``EMPTY``: no counts. ``NO_SIGNAL``: no return beyond what background reaches. ``SATURATED``: S or B has no upper
    bound. ``UNCONVERGED``: the iteration stopped early. ``MORE_RETURNS``: more returns than requested. ``FILLED``:
    filled from neighbouring pixels. ``MISFIT``: the test of fit rejects the estimate.

    Parameters
    ----------
    value
        Sum of the bits.

    See Also
    --------
    Reconstruction

    Examples
    --------
    >>> from mars_lidar.reconstruction import Flags
    >>> Flags(10) == Flags.NO_SIGNAL | Flags.UNCONVERGED
    True
    """

    EMPTY = 1
    """No registrations: signal and background 0, no depth."""
    NO_SIGNAL = 2
    """No signal that stands out from the background."""
    SATURATED = 4
    """Bins that registered whenever they could: the rate has no upper bound."""
    UNCONVERGED = 8
    """The iteration did not converge."""
    MORE_RETURNS = 16
    """More returns are significant than were requested."""
    FILLED = 32
    """No registrations, or an outlier with probability above 1/2: the delay is that of neighbouring pixels."""
    MISFIT = 64
    """The test of fit rejects the estimate (p below 1e-3): a wrong dead time or pulse, or another return."""


@dataclass(frozen=True, eq=False)
class Estimates:
    """Results of a method, each (pixels,); None for quantities that it does not estimate.

    Delay in periods, the rest in photons per period.
    """

    signal: FloatArray
    background: FloatArray
    delay: FloatArray
    flags: NDArray[np.uint8]
    signal_error: FloatArray | None = None
    background_error: FloatArray | None = None
    delay_error: FloatArray | None = None
    significance: FloatArray | None = None
    half_width: FloatArray | None = None  # of the 90 % interval of the delay
    outlier: FloatArray | None = None  # probability that the delay is another surface's
    p_value: FloatArray | None = None  # of the test of fit; NaN for too few photons
    longer: FloatArray | None = None  # scores, standard deviations: where a longer dead time, ...
    shorter: FloatArray | None = None  # ... a shorter one, ...
    wider: FloatArray | None = None  # ... a wider pulse would fit better
    returns: FloatArray | None = None  # (pixels, most, len(RETURN_COLUMNS)), NaN beyond those of a pixel

    @staticmethod
    def joined(parts: Sequence[Estimates]) -> Estimates:
        """Concatenation over several sets of pixels."""
        values = {each.name: [getattr(part, each.name) for part in parts] for each in fields(Estimates)}
        return Estimates(**{name: np.concatenate(v) for name, v in values.items() if v[0] is not None})


class Method(ABC):
    """A method that estimates depth and signal from histograms.

    See Also
    --------
    mars_lidar.reconstruct, MaximumLikelihood

    Examples
    --------
    >>> import mars_lidar as ml
    >>> isinstance(ml.reconstruction.METHODS["peak"], ml.reconstruction.Method)
    True
    """

    name: ClassVar[str]
    modes: ClassVar[tuple[Mode, ...]]  # modes of the detector to which the method applies
    windows: ClassVar[bool] = True  # signal and background come from inside and outside of a window
    of_images: ClassVar[bool] = False  # estimates use neighbouring pixels: cubes are (..., H, W, bins)

    def check(self, system: System) -> None:
        """Raise ValueError, naming mode and method, for a `system` to which this method does not apply."""
        require_mode_of("method", self, _known(), system.detector.mode)
        if system.detector.gate_moves:
            raise ValueError(
                f"method {self.name!r} needs a gate that repeats every period, got "
                f"gate_step_ns={system.detector.gate_step_ns:g}"
            )
        if self.windows:
            check_window(self.name, system)
        recording_of(system)

    @abstractmethod
    def estimate(self, histograms: Histograms) -> Estimates:
        """Estimates of every pixel of `histograms`, whose system `check` accepts."""


def _known(kind: Any = None) -> Iterator[type[Method]]:
    """All methods that were defined, in that order."""
    for each in (kind or Method).__subclasses__():
        if hasattr(each, "name"):
            yield each
        yield from _known(each)


def warn_of_effects(system: System) -> None:
    """Warn of detector effects that no method models, so that their counts are attributed to light."""
    beyond = [name for name in system.detector.effects if name not in LIGHT_EFFECTS]
    if beyond:
        warnings.warn(
            f"no reconstruction method models {', '.join(beyond)} of the detector: estimates are biased by it, "
            "and standard errors do not include this bias",
            UserWarning,
            stacklevel=3,
        )


@dataclass(frozen=True)
class RateMethod(Method):
    """A method that corrects the rates, then estimates the delay by a filter and signal and background by its window.

    `filter` on the rates: as for `MatchedFilter`.
    """

    filter: Filter = "log"

    correction: ClassVar[int] = _PASSES

    def __post_init__(self) -> None:
        checks.choice("filter", self.filter, FILTERS)

    @property
    def settings(self) -> dict[str, float]:
        """Settings of the correction, by their names in the native core."""
        return {"steps": 0, "tolerance": 0.0}

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay by the filter, signal and background by its window, and their standard errors."""
        return window_estimates(histograms, self.filter, self.correction, **self.settings)

    @arguments.checked
    def rates(
        self, cube: ArrayLike, system: System, *, total: ArrayLike | None = None, threads: int | None = None
    ) -> FloatArray:
        """Photons per period in each bin (..., bins); infinite above 1e4, as with a registration in every armed period.

        Parameters
        ----------
        cube
            (..., bins) counts.
        system
            The system that recorded them.
        total
            Total photons per period, a scalar or (...), if known, for example from the times between registrations:
            `ChainCorrection` uses it. None: the sum of the rates of `GeneralisedCoates`.
        threads
            Threads to run on; default: all processors that this process may use.

        Raises
        ------
        TypeError
            Counts that are not an array of numbers, or not a `System`.
        ValueError
            Counts that are not whole numbers >= 0, or more than the periods allow; a detector to which this does not
            apply.
        """
        given, shape = checked(cube, system, threads)
        self.check(system)
        flat = None
        if total is not None:
            known = np.asarray(total, np.float64)
            if known.shape not in ((), tuple(shape)):
                raise ValueError(f"total must be a number or {tuple(shape)} as the pixels, got shape {known.shape}")
            flat = np.ascontiguousarray(np.broadcast_to(known, shape).reshape(-1))
            if not ((flat > 0) & np.isfinite(flat)).all():
                raise ValueError("total must be finite and positive, photons per period")
        out, flags = np.empty(given.counts.shape), np.empty(len(given.counts), np.uint8)
        settings: Any = self.settings
        _core.corrected_rates(
            given.recording,
            given.counts,
            correction=self.correction,
            **settings,
            total=flat,
            out=out,
            flags=flags,
            threads=given.threads,
        )
        return out.reshape(*shape, system.bins)


def window_estimates(
    given: Histograms, locator: str, correction: int = _NONE, *, steps: float = 0, tolerance: float = 0.0
) -> Estimates:
    """Delay by a filter or the peak, signal and background by the window around it, of corrected rates."""
    out, flags = np.empty((len(given.counts), 5)), np.empty(len(given.counts), np.uint8)
    _core.window_estimates(
        given.recording,
        given.counts,
        correction=correction,
        locator=_LOCATORS[locator],
        steps=int(steps),
        tolerance=tolerance,
        total=None,
        out=out,
        flags=flags,
        threads=given.threads,
        progress=given.progress,
    )
    signal, background, delay, signal_error, background_error = np.ascontiguousarray(out.T)
    if correction != _PASSES:
        return Estimates(signal, background, delay, flags)
    return Estimates(signal, background, delay, flags, signal_error, background_error)
