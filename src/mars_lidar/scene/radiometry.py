"""From surfaces to photons: signal level, attenuation, ambient light, dark counts. Formulas: `Scene.flux`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

ATTENUATIONS = ("none", "inverse_square")
AMBIENTS = ("uniform", "reflectivity", "map")


class Surface(Protocol):
    """What radiometry needs to know of a surface, such as a `Scene`; maps are (H, W)."""

    @property
    def depth_m(self) -> FloatArray:
        """Range along the ray, m; NaN where there is no return."""

    @property
    def reflectivity(self) -> FloatArray:
        """Share of the laser light that comes back, relative."""

    @property
    def background(self) -> FloatArray | None:
        """Relative ambient light, where there is a map of it."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels with a return."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""


def scene_flux(
    layers: Sequence[Surface],
    system: System,
    signal: float,
    sbr: float,
    attenuation: str,
    ambient: str | None,
    dark_counts_per_s: float,
) -> Flux:
    """The body of `Scene.flux` and `LayeredScene.flux`, which document arguments, formulas and warnings.

    `layers` are surfaces on the rays of the same pixels; the ambient map is that of the first.
    """
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {system!r}")
    level = checks.real("signal", signal, low=0.0, strict_low=True)
    ratio = _ratio(sbr)
    checks.choice("attenuation", attenuation, ATTENUATIONS)
    scene = layers[0]
    light_name = ("uniform" if scene.background is None else "map") if ambient is None else ambient
    checks.choice("ambient", light_name, AMBIENTS)
    rate = checks.real("dark_counts_per_s", dark_counts_per_s, low=0.0)
    light = _ambient_light(layers, light_name)
    valid = _any([one.valid for one in layers])
    number = int(np.count_nonzero(valid))
    if number == 0:
        raise ValueError("depth_m is NaN at every pixel: there is no return to set a signal level with")
    reach = system.unambiguous_range_m

    def seen(image: FloatArray) -> FloatArray:
        """The pixels with a return."""
        return image.reshape(-1) if number == valid.size else image[valid]

    s = _scaled(_returned(layers, attenuation), level, seen, "reflectivity", f"signal={level:g}")
    b = np.zeros(scene.shape)
    if ratio < math.inf:
        (b,) = _scaled([light], level / ratio, seen, "ambient light", f"sbr={ratio:g}")
    dark = rate * system.period_ns * 1e-9 / system.detector.detection_efficiency  # photons for as many counts
    wrapped = int(np.count_nonzero(_any([one.depth_m >= reach for one in layers])))
    info = {
        "source": "Scene.flux",
        "signal": level,
        "signal_definition": "mean signal photons per laser period over the pixels with a return",
        "sbr": _plain(ratio),
        "sbr_definition": "mean signal / mean ambient photons over the pixels with a return; no dark counts",
        "attenuation": attenuation,
        "ambient": light_name,
        "dark_counts_per_s": rate,
        "n_pixels": int(valid.size),
        "n_valid": number,
        "n_wrapped": wrapped,
        "unambiguous_range_m": reach,
        **_means(seen(_sum(s)), seen(b), dark),
    }
    flux = Flux(signal=s[0], background=b + dark, delay_ns=system.delay_ns(scene.depth_m), info=info)
    if len(layers) > 1:
        delays = [system.delay_ns(one.depth_m) for one in layers[1:]]
        others = [Flux(signal=one, delay_ns=tau) for one, tau in zip(s[1:], delays, strict=True)]
        flux = Flux.multi(flux, *others, info=info)
    _warn(valid.size - number, wrapped, valid.size, reach)
    return flux


def _ambient_light(layers: Sequence[Surface], name: str) -> FloatArray:
    """Relative ambient light (H, W)."""
    scene = layers[0]
    if name == "uniform":
        return np.ones(scene.shape)
    if name == "reflectivity":  # each surface scatters it, and what has no known range all the same
        surfaces = np.stack([np.where(one.valid, one.reflectivity, 0.0) for one in layers])
        nowhere = ~_any([one.valid for one in layers])
        beyond = np.max([one.reflectivity for one in layers], axis=0)
        return np.asarray(np.where(nowhere, beyond, surfaces.sum(0)), dtype=np.float64)
    if scene.background is None:
        raise ValueError("ambient='map' needs a scene with a background map, got one without")
    return scene.background


def _returned(layers: Sequence[Surface], attenuation: str) -> list[FloatArray]:
    """Relative returned laser light of each layer (H, W), 0 where nothing returns."""
    share = [np.where(one.valid, one.reflectivity, 0.0) for one in layers]
    if attenuation == "inverse_square":
        # Relative to the nearest depth: the same after normalisation, and nothing overflows.
        nearest = min(np.nanmin(one.depth_m) for one in layers if one.valid.any())
        for one, light in zip(layers, share, strict=True):
            light *= (nearest / np.where(one.valid, one.depth_m, np.inf)) ** 2
    return share


def _scaled(
    light: list[FloatArray], mean: float, seen: Callable[[FloatArray], FloatArray], what: str, asked: str
) -> list[FloatArray]:
    """Relative maps scaled together, so that their sum has a mean over the pixels that are `seen`."""
    total = _sum(light)
    top = float(seen(total).max())
    if top == 0.0:
        raise ValueError(f"{what} is zero at every pixel with a return: {asked} cannot be reached")
    # to order one first: a map of 1e-300 scales as well as one of 1e300
    scale = mean / float((seen(total) / top).mean())
    return [one / top * scale for one in light]


def _sum(images: list[FloatArray]) -> FloatArray:
    return images[0] if len(images) == 1 else np.sum(images, axis=0)


def _any(images: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    return images[0] if len(images) == 1 else np.logical_or.reduce(images)


def _means(s: FloatArray, ambient: FloatArray, dark: float) -> dict[str, float | None]:
    """What was achieved over the valid pixels, photons per laser period."""
    mean_s, mean_a = float(s.mean()), float(ambient.mean())
    mean_b = float((ambient + dark).mean())
    return {
        "mean_signal": mean_s,
        "mean_ambient": mean_a,
        "mean_dark": dark,
        "mean_background": mean_b,
        "achieved_sbr": _plain(mean_s / mean_a if mean_a > 0.0 else math.inf),
        "achieved_sbr_with_dark": _plain(mean_s / mean_b if mean_b > 0.0 else math.inf),
    }


def _ratio(sbr: Any) -> float:
    allowed = "a number in (0, inf], inf for no ambient light"
    if isinstance(sbr, bool) or not isinstance(sbr, Real):
        raise TypeError(f"sbr must be {allowed}, got {sbr!r} ({type(sbr).__name__})")
    if not float(sbr) > 0.0:
        raise ValueError(f"sbr must be {allowed}, got {sbr!r}")
    return float(sbr)


def _plain(ratio: float) -> float | None:
    """JSON knows no infinity."""
    return None if math.isinf(ratio) else ratio


def _warn(lost: int, wrapped: int, pixels: int, reach: float) -> None:
    level = 4  # the caller of Scene.flux
    if lost:
        text = f"{lost} of {pixels} pixels have no return (depth NaN): their signal is 0"
        warnings.warn(text, UserWarning, stacklevel=level)
    if wrapped:
        warnings.warn(
            f"{wrapped} of {pixels} pixels lie beyond the unambiguous range of {reach:.6g} m (c t_r / 2): "
            f"their returns wrap into a later laser period and will look nearer by multiples of that range",
            UserWarning,
            stacklevel=level,
        )
