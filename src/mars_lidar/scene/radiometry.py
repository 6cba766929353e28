"""From surfaces to photons: signal level, attenuation, ambient light, dark counts. Formulas: `Scene.flux`."""

import math
import warnings
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

ATTENUATIONS = ("none", "inverse_square")
AMBIENTS = ("uniform", "reflectivity", "map")


def scene_flux(
    depth_m: FloatArray,
    reflectivity: FloatArray,
    background: FloatArray | None,
    system: System,
    signal: float,
    sbr: float,
    attenuation: str,
    ambient: str | None,
    dark_count_hz: float,
) -> Flux:
    """The body of `Scene.flux` and `LayeredScene.flux`, which document arguments, formulas and warnings.

    Depth and reflectivity are (K, H, W), of K surfaces on the rays of the same pixels; the ambient map is (H, W).
    """
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {system!r}")
    level = checks.real("signal", signal, low=0.0, strict_low=True)
    ratio = _ratio(sbr)
    checks.choice("attenuation", attenuation, ATTENUATIONS)
    light_name = ("uniform" if background is None else "map") if ambient is None else ambient
    checks.choice("ambient", light_name, AMBIENTS)
    rate = checks.real("dark_count_hz", dark_count_hz, low=0.0)
    surface = ~np.isnan(depth_m)
    valid, share = surface.any(0), np.where(surface, reflectivity, 0.0)
    if light_name == "uniform":
        light = np.ones(valid.shape)
    elif light_name == "reflectivity":  # each surface scatters it, and what has no known range all the same
        light = np.where(valid, share.sum(0), reflectivity.max(0))
    elif background is None:
        raise ValueError("ambient='map' needs a scene with a background map, got one without")
    else:
        light = background
    number = int(np.count_nonzero(valid))
    if number == 0:
        raise ValueError("depth_m is NaN at every pixel: there is no return to set a signal level with")
    reach = system.unambiguous_range_m

    def with_return(image: FloatArray) -> FloatArray:
        """The pixels with a return."""
        return image.reshape(-1) if number == valid.size else image[valid]

    if attenuation == "inverse_square":
        # relative to the nearest depth: the same after normalisation, and nothing overflows
        share *= (np.nanmin(depth_m) / np.where(surface, depth_m, np.inf)) ** 2
    s = _scaled(share, level, with_return, "reflectivity", f"signal={level:g}")
    b = np.zeros(valid.shape)
    if ratio < math.inf:
        (b,) = _scaled(light[None], level / ratio, with_return, "ambient light", f"sbr={ratio:g}")
    dark = rate * system.period_ns * 1e-9 / system.detector.detection_efficiency  # photons for as many counts
    wrapped = int(np.count_nonzero((depth_m >= reach).any(0)))
    info = {
        "source": "Scene.flux",
        "signal": level,
        "signal_definition": "mean signal photons per laser period over the pixels with a return",
        "sbr": _plain(ratio),
        "sbr_definition": "mean signal / mean ambient photons over the pixels with a return; no dark counts",
        "attenuation": attenuation,
        "ambient": light_name,
        "dark_count_hz": rate,
        "n_pixels": int(valid.size),
        "n_valid": number,
        "n_wrapped": wrapped,
        "unambiguous_range_m": reach,
        **_means(with_return(s.sum(0)), with_return(b), dark),
    }
    delay = system.delay_ns(depth_m)
    flux = Flux(s[0], b + dark, delay[0], info=info) if len(s) == 1 else Flux(s, b + dark, delay, info=info)
    _warn(valid.size - number, wrapped, valid.size, reach)
    return flux


def _scaled(
    light: FloatArray, mean: float, with_return: Callable[[FloatArray], FloatArray], what: str, asked: str
) -> FloatArray:
    """Relative maps (K, H, W) with a common factor that gives their sum the `mean` over the pixels `with_return`."""
    total = light.sum(0)
    top = float(with_return(total).max())
    if top == 0.0:
        raise ValueError(f"{what} is zero at every pixel with a return: {asked} cannot be reached")
    # to order one first: a map of 1e-300 scales as well as one of 1e300
    scale = mean / float((with_return(total) / top).mean())
    return light / top * scale


def _means(s: FloatArray, ambient: FloatArray, dark: float) -> dict[str, float | None]:
    """Means over the valid pixels, photons per laser period, and the resulting SBR."""
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
