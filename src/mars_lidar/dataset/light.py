"""The light of a description: levels, and what all samples share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

from mars_lidar._base import checks
from mars_lidar._base.yaml import Key, RecipeError
from mars_lidar.dataset import values
from mars_lidar.dataset.values import Fields

_SIGNAL = values.real("Mean signal, detectable photons per laser period.", low=0.0, strict_low=True)
_SBR = values.real("Mean signal / mean ambient photons; inf: none.", low=0.0, strict_low=True, infinite=True)
_PAIR = {"type": "array", "items": {"type": ["number", "string"]}, "minItems": 2, "maxItems": 2}
LIGHT: Fields = {
    "signal": values.several(_SIGNAL),
    "sbr": values.several(_SBR),
    "levels": values.other("Pairs [signal, sbr] instead of all combinations.", {"type": "array", "items": _PAIR}),
    "photons_per_unit": values.real(
        "Of one transient, instead of signal: photons per period for one unit of its light.", low=0.0, strict_low=True
    ),
    "attenuation": values.choice("Signal against depth.", ("none", "inverse_square")).or_else("none"),
    "ambient": values.choice("Ambient light over the image.", ("uniform", "reflectivity", "map")),
    "dark_count_hz": values.real("Dark counts of a pixel, counts/s.", low=0.0).or_else(0.0),
}


@dataclass(frozen=True, kw_only=True)
class Light:
    """Levels of light, and the arguments of `mars_lidar.Scene.flux` that all samples share.

    `levels` are pairs (signal, sbr). `photons_per_unit` stands for the signal of a single rendered transient.
    """

    levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    attenuation: str = "none"
    ambient: str | None = None
    dark_count_hz: float = 0.0
    photons_per_unit: float | None = None

    def __post_init__(self) -> None:
        pairs = self.levels
        if not isinstance(pairs, list | tuple) or not pairs or not all(map(_is_pair, pairs)):
            raise ValueError(f"levels must be pairs (signal, sbr) of numbers >= 0, got {pairs!r}")
        checks.choice("attenuation", self.attenuation, ("none", "inverse_square"))
        if self.ambient is not None:
            checks.choice("ambient", self.ambient, ("uniform", "reflectivity", "map"))
        checks.real("dark_count_hz", self.dark_count_hz, low=0.0)
        if self.photons_per_unit is not None:
            checks.real("photons_per_unit", self.photons_per_unit, low=0.0, strict_low=True)


def _is_pair(pair: Any) -> bool:
    """Whether this is (signal, sbr); the latter may be infinite."""
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        return False
    numbers = all(isinstance(one, Real) and not isinstance(one, bool) for one in pair)
    return numbers and 0 <= pair[0] < math.inf and pair[1] >= 0


def read_light(data: Any, key: Key = ("light",)) -> Light:
    """The mapping under `light`."""
    told = values.read_mapping(key, data, LIGHT)
    if "levels" in told:
        if "signal" in told or "sbr" in told:
            raise RecipeError((*key, "levels"), "levels are pairs of signal and sbr: give them, or signal and sbr")
        pairs = told.pop("levels")
        if not isinstance(pairs, list) or not pairs or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
            raise RecipeError((*key, "levels"), f"levels must be a list of pairs [signal, sbr], got {pairs!r}")
        levels = [
            (_SIGNAL.read((*key, "levels", k), s), _SBR.read((*key, "levels", k), b)) for k, (s, b) in enumerate(pairs)
        ]
        where = "levels"
    else:
        if "signal" in told and "photons_per_unit" in told:
            raise RecipeError(
                (*key, "photons_per_unit"), "light must give one of signal and photons_per_unit, got both"
            )
        sbr = told.pop("sbr", [1.0])
        levels, where = [(s, b) for s in told.pop("signal", [1.0]) for b in sbr], "signal"
    if not levels or len(set(levels)) < len(levels):
        raise RecipeError((*key, where), f"light must have levels that differ from each other, got {levels}")
    return Light(levels=tuple(levels), **told)


def refuse_for_transients(light: Light, key: Key = ("light",)) -> None:
    """Raise where rendered light is given what only surfaces have."""
    if light.attenuation != "none":
        told = f"attenuation is for surfaces; transients have it in them, got {light.attenuation!r}"
        raise RecipeError((*key, "attenuation"), told)
    if light.ambient not in (None, "uniform"):
        raise RecipeError((*key, "ambient"), f"ambient must be uniform with transients, got {light.ambient!r}")


def plain_levels(light: Light) -> list[list[Any]]:
    """The levels as JSON has them."""
    return [[s, "inf" if math.isinf(b) else b] for s, b in light.levels]
