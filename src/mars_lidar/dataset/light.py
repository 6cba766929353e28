"""The light of a recipe: levels, and what all samples share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mars_lidar.dataset import values
from mars_lidar.dataset.yaml_lines import Key, RecipeError


@dataclass(frozen=True, kw_only=True)
class Light:
    """Levels of light, and the arguments of `mars_lidar.Scene.flux` that all samples share.

    `levels` are pairs (signal, sbr).
    """

    levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    attenuation: str = "none"
    ambient: str | None = None
    dark_counts_per_s: float = 0.0


def read_light(data: Any) -> Light:
    """The mapping under `light`."""
    key: Key = ("light",)
    names = ("signal", "sbr", "levels", "attenuation", "ambient", "dark_counts_per_s")
    known = values.mapping(key, data, names)
    if "levels" in known:
        if "signal" in known or "sbr" in known:
            raise RecipeError((*key, "levels"), "levels are pairs of signal and sbr: give them, or signal and sbr")
        pairs = known["levels"]
        if not isinstance(pairs, list) or not pairs or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
            raise RecipeError((*key, "levels"), f"levels must be a list of pairs [signal, sbr], got {pairs!r}")
        levels = [
            (values.level((*key, "levels", k), "signal", s), values.level((*key, "levels", k), "sbr", b))
            for k, (s, b) in enumerate(pairs)
        ]
    else:
        grid = [
            [values.level((*key, name), name, one) for one in (value if isinstance(value, list) else [value])]
            for name, value in (("signal", known.get("signal", 1.0)), ("sbr", known.get("sbr", 1.0)))
        ]
        levels = [(s, b) for s in grid[0] for b in grid[1]]
    if not levels or len(set(levels)) < len(levels):
        where = "levels" if "levels" in known else "signal"
        raise RecipeError((*key, where), f"light must have levels that differ from each other, got {levels}")
    ambient = known.get("ambient")
    if ambient is not None:
        ambient = values.choice((*key, "ambient"), ambient, ("uniform", "reflectivity", "map"))
    return Light(
        levels=tuple(levels),
        attenuation=values.choice((*key, "attenuation"), known.get("attenuation", "none"), ("none", "inverse_square")),
        ambient=ambient,
        dark_counts_per_s=values.real((*key, "dark_counts_per_s"), known.get("dark_counts_per_s", 0.0), low=0.0),
    )


def refuse_for_transients(light: Light) -> None:
    """Raise where a dataset with rendered light says of all of it what only surfaces have."""
    if light.attenuation != "none":
        told = f"attenuation is for surfaces; transients have it in them, got {light.attenuation!r}"
        raise RecipeError(("light", "attenuation"), told)
    if light.ambient not in (None, "uniform"):
        raise RecipeError(("light", "ambient"), f"ambient must be uniform with transients, got {light.ambient!r}")
