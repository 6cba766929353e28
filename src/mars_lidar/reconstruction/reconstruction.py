"""`reconstruct`: from a histogram cube to depth and reflectivity."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import explained
from mars_lidar._base.display import as_html, brief
from mars_lidar._base.types import ArrayLike, FloatArray, NDArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.centroid import Centroid
from mars_lidar.reconstruction.fit_quality import FALSE_ALARM
from mars_lidar.reconstruction.histograms import checked
from mars_lidar.reconstruction.image import Image, UntrainedImage
from mars_lidar.reconstruction.matched_filter import MatchedFilter, Peak
from mars_lidar.reconstruction.maximum_likelihood import MaximumLikelihood, warn_of_bias
from mars_lidar.reconstruction.method import Estimates, Flags, Method, warn_of_effects
from mars_lidar.reconstruction.rates import ChainCorrection, Coates, GeneralisedCoates
from mars_lidar.reconstruction.returns import MOST_RETURNS, Returns, returns_of
from mars_lidar.scene.radiometry import ATTENUATIONS

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        MaximumLikelihood(),
        GeneralisedCoates(),
        ChainCorrection(),
        Coates(),
        MatchedFilter(),
        Centroid(),
        Peak(),
        Image(),
        UntrainedImage(),
    )
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstruction:
    """Maps reconstructed from a cube (..., bins), of shape (...), usually (H, W) or (realizations, H, W).

    Attributes
    ----------
    method
        Name of the method.
    system
        The system that recorded the cube.
    delay_ns, depth_m
        Delay tau in [0, period), ns, and depth c tau / 2, m; NaN without an estimate.
    signal, background
        S and B, detectable photons per laser period, including detection efficiency and dark counts. B is that of the
        whole period, also with a gate.
    reflectivity
        S over `level`, times depth^2 with ``attenuation="inverse_square"``.
    level
        Signal photons per period of a surface of reflectivity 1 (at 1 m with inverse-square attenuation).
    delay_error_ns, depth_error_m, signal_error, background_error
        Standard errors, or None for methods without them; NaN for an estimate on its bound. The delay and depth of a
        pixel flagged ``NO_SIGNAL`` have none.
    significance
        Square root of twice the gain in log likelihood by the signal, approximately in standard deviations; or None.
    flags
        (...) uint8, `Flags`.
    p_value
        Probability of a histogram at least as far from the law of the estimate; NaN for too few photons, None for
        methods without a law.
    longer, shorter, wider
        Scores of a longer dead time, a shorter dead time and a wider pulse, in standard deviations; see `advice`.
    returns
        All returns of each pixel, if several were requested; the maps above are then those of the strongest.
    delay_half_width_ns, depth_half_width_m
        Half width of the 90 % interval of delay and depth, for methods ``"image"`` and ``"image_untrained"``; NaN if
        the probability of an outlier is too large.
    outlier
        (...) probability that the depth is that of another surface, for the same methods.

    See Also
    --------
    reconstruct

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> maps = ml.reconstruct(ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)[0], system)
    >>> maps.depth_m.shape
    (1, 1)
    >>> maps.method
    'maximum_likelihood'
    """

    method: str
    system: System
    delay_ns: FloatArray
    depth_m: FloatArray
    signal: FloatArray
    background: FloatArray
    reflectivity: FloatArray
    level: float
    delay_error_ns: FloatArray | None
    depth_error_m: FloatArray | None
    signal_error: FloatArray | None
    background_error: FloatArray | None
    significance: FloatArray | None
    flags: NDArray[np.uint8]
    p_value: FloatArray | None = None
    longer: FloatArray | None = None
    shorter: FloatArray | None = None
    wider: FloatArray | None = None
    returns: Returns | None = None
    delay_half_width_ns: FloatArray | None = None
    depth_half_width_m: FloatArray | None = None
    outlier: FloatArray | None = None

    __repr__ = brief

    def _repr_html_(self) -> str:
        image = self.depth_m.ndim > 1 and (slice(0, 1),) * (self.depth_m.ndim - 2)
        first = {"depth (m)": self.depth_m, "reflectivity": self.reflectivity}
        return as_html(self, {} if image is False else {k: v[image].reshape(v.shape[-2:]) for k, v in first.items()})

    @property
    def detected(self) -> NDArray[np.bool_]:
        """(...) whether a return was detected: an estimated depth, and a signal above the background."""
        return _detected(self.depth_m, self.flags)

    @property
    def misfits(self) -> float:
        """Share of the pixels with a p-value whose estimate the test of fit rejects; NaN without p-values."""
        if self.p_value is None or not np.isfinite(self.p_value).any():
            return float("nan")
        return float((self.p_value[np.isfinite(self.p_value)] < FALSE_ALARM).mean())

    @property
    def advice(self) -> str:
        """Advice on settings that would fit more pixels; empty if the share of misfits is that of false alarms."""
        tested = 0 if self.p_value is None else int(np.isfinite(self.p_value).sum())
        if tested == 0 or self.misfits * tested <= FALSE_ALARM * tested + 4.0 * (FALSE_ALARM * tested) ** 0.5 + 1.0:
            return ""
        means = {}
        for name, values in (("longer", self.longer), ("shorter", self.shorter), ("wider", self.wider)):
            if values is not None and np.isfinite(values).any():
                some = values[np.isfinite(values)]
                means[name] = float(some.mean() * some.size**0.5)
        words = {"longer": "a longer dead time", "shorter": "a shorter dead time", "wider": "a wider pulse"}
        best = max(means, key=lambda name: abs(means[name]) if name == "wider" else means[name], default="")
        if not best or abs(means[best]) < 5.0:
            return "none of dead time and pulse alone: another return, a drift, or an effect of the detector"
        text = "a narrower pulse" if best == "wider" and means[best] < 0.0 else words[best]
        return f"{text} ({abs(means[best]):.0f} standard deviations over all pixels)"

    def maps(self) -> dict[str, NDArray[Any]]:
        """All maps that the method estimates, by the names of the attributes."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


@runtime_checkable
class Recorded(Protocol):
    """Counts with the system that recorded them, such as `mars_lidar.io.Cube`."""

    @property
    def system(self) -> System:
        """The system that recorded them."""

    @property
    def histogram(self) -> Any:
        """(..., bins)."""


@explained
def reconstruct(
    cube: ArrayLike | Recorded,
    system: System | None = None,
    method: str | Method = "maximum_likelihood",
    *,
    level: float | None = None,
    attenuation: Literal["none", "inverse_square"] = "none",
    returns: int = 1,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> Reconstruction:
    """Depth, signal and background of every pixel of a histogram cube.

    Parameters
    ----------
    cube
        (..., bins) counts, whole numbers of any type, e.g. (realizations, H, W, bins) of `simulate`.
        Or a cube of `mars_lidar.io.load`, which contains its system.
    system
        The system that recorded them. Flux is periodic, with the system's pulse. None: the system of the
        cube.
    method
        A name in `mars_lidar.reconstruction.METHODS` (default ``"maximum_likelihood"``; docs/reconstruction.md says
        what each assumes), or a `Method` with other settings. Each refuses detectors to which it does not apply.
        ``"image"``, for images (..., H, W, bins) of 1 to 20 photons a pixel, also uses neighbouring pixels.
    level
        Detectable signal photons per period of a surface of reflectivity 1 (at 1 m, with
        ``attenuation="inverse_square"``).
        None: relative reflectivity, with mean 1 over the pixels with a return.
    attenuation
        As in `Scene.flux`: ``"inverse_square"`` makes reflectivity proportional to S times depth squared.
    returns
        Largest number of returns in a pixel, 1 to 8 (panes of glass, foliage). Each is tested, and all are in
        `Reconstruction.returns`. For ``"maximum_likelihood"``, which treats each pixel alone, and ``"image"``.
    threads
        Threads to run on; default: all processors this process may use. The result does not depend on it.
    progress
        Called as ``progress(done, total)`` a few times a second; an exception from it stops the run.

    Returns
    -------
    Reconstruction
        Maps of shape (...).

    Raises
    ------
    TypeError
        Counts that are not an array of numbers, or without a system; an argument of another type.
    ValueError
        Counts that are not whole numbers >= 0, or with another number of bins than the system; an unknown method, or
        one that does not apply to the detector; a level or a number of returns out of range.

    See Also
    --------
    Reconstruction, cramer_rao, simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> counts = ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, seed=0)[0]
    >>> maps = ml.reconstruct(counts, system)
    >>> bool((abs(maps.delay_ns - 40.0) < 5 * maps.delay_error_ns).all())
    True
    """
    if isinstance(cube, Recorded):
        system, cube = cube.system if system is None else system, np.asarray(cube.histogram)
    if system is None:
        raise TypeError("system must be given for an array of counts (a cube of mars_lidar.io.load contains its own)")
    used = with_returns(find_method(method), returns)
    checks.choice("attenuation", attenuation, ATTENUATIONS)
    if level is not None:
        level = checks.real("level", level, low=0.0, strict_low=True)
    given, shape = checked(cube, system, threads, progress)
    if given.counts.dtype.kind == "f" and (given.counts != np.round(given.counts)).any():
        part = given.counts[given.counts != np.round(given.counts)].flat[0]
        raise ValueError(
            f"cube must hold whole counts, got {part}: add exposures instead of averaging them, and multiply cycles "
            "of the system by their number"
        )
    used.check(system)
    warn_of_effects(system)
    estimates = used.estimate(given)
    flag_impossible(estimates, given.counts.sum(-1, dtype=np.float64), system)
    warn_of_bias(used, system, estimates)
    return assembled(used.name, system, estimates, shape, level, attenuation)


def flag_impossible(estimates: Estimates, registrations: FloatArray, system: System) -> None:
    """Flag pixels as ``SATURATED`` whose `registrations` (pixels,) exceed those that the dead time allows."""
    estimates.flags[registrations > system.max_registrations] |= np.uint8(Flags.SATURATED)


def find_method(method: str | Method) -> Method:
    """The method of that name with default settings, or the given method."""
    if isinstance(method, Method):
        return method
    return METHODS[checks.choice("method", method, tuple(METHODS))]


def with_returns(method: Method, returns: int) -> Method:
    """The method with up to `returns` returns in each pixel; unchanged for 1."""
    if checks.integer("returns", returns, low=1, high=MOST_RETURNS) == 1:
        return method
    if not isinstance(method, MaximumLikelihood | Image):
        able = " or ".join(repr(each.name) for each in METHODS.values() if isinstance(each, MaximumLikelihood | Image))
        raise ValueError(f"returns={returns} needs method {able}, got {method.name!r}")
    return replace(method, returns=int(returns))


def assembled(
    name: str, system: System, estimates: Estimates, shape: tuple[int, ...], level: float | None, attenuation: str
) -> Reconstruction:
    """The result (...) from the estimates of a method (pixels,)."""
    period = system.period_ns

    def mapped(name: str, unit: float = 1.0) -> Any:
        values = getattr(estimates, name)
        return None if values is None else (values * unit).reshape(shape)

    same = ("signal_error", "background_error", "significance", "p_value", "longer", "shorter", "wider", "outlier")

    delay = (estimates.delay - np.floor(estimates.delay)).reshape(shape) * period
    delay = np.where(delay >= period, 0.0, delay)
    depth, signal = system.depth_m(delay), estimates.signal.reshape(shape)
    returned = signal * depth**2 if attenuation == "inverse_square" else signal
    flags = estimates.flags.reshape(shape)
    if level is None:
        detected = _detected(depth, flags)
        level = (float(returned[detected].mean()) if detected.any() else 0.0) or 1.0
    return Reconstruction(
        method=name,
        system=system,
        delay_ns=delay,
        depth_m=depth,
        signal=signal,
        background=estimates.background.reshape(shape),
        reflectivity=returned / level,
        level=level,
        delay_error_ns=mapped("delay_error", period),
        depth_error_m=mapped("delay_error", float(system.depth_m(period))),
        flags=flags,
        returns=returns_of(estimates.returns, system, shape),
        delay_half_width_ns=mapped("half_width", period),
        depth_half_width_m=mapped("half_width", float(system.depth_m(period))),
        **{name: mapped(name) for name in same},
    )


def _detected(depth: FloatArray, flags: NDArray[np.uint8]) -> NDArray[np.bool_]:
    lacking = np.uint8(Flags.EMPTY | Flags.NO_SIGNAL | Flags.FILLED)
    return np.asarray(np.isfinite(depth) & ((flags & lacking) == 0), dtype=np.bool_)
