"""The entries under `scenes` of a recipe: where scenes come from, and what stands before them, as plain data."""

from __future__ import annotations

from typing import Any

from mars_lidar.dataset import values
from mars_lidar.dataset.yaml_lines import Key, RecipeError

KINDS = ("example", "path", "transient")
_BEFORE = ("fog", "pane")  # what stands before surfaces
_EXAMPLE = ("example", "size", "seeds", *_BEFORE)
_PATH = ("path", "pattern", "image", "manifest", "depth_unit_m", "focal_px", "frames", *_BEFORE)
_TRANSIENT = ("transient", "pattern", "bin_ns", "start_ns", "name", "channel", "pulse")
_FOG = ("extinction_per_m", "backscatter", "nearest_m")
_PANE = ("depth_m", "reflectivity", "transmission")


def read_scenes(data: Any) -> tuple[dict[str, Any], ...]:
    """The list under `scenes`, or its only entry."""
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("scenes",), "scenes must have at least one entry")
    return tuple(_scene(("scenes", k) if isinstance(data, list) else ("scenes",), e) for k, e in enumerate(entries))


def _scene(key: Key, entry: Any) -> dict[str, Any]:
    kinds = [kind for kind in KINDS if isinstance(entry, dict) and kind in entry]
    if len(kinds) != 1:
        raise RecipeError(key, f"{values.key_name(key)} must give one of example, path and transient, got {entry!r}")
    return {"example": _example, "path": _path, "transient": _transient}[kinds[0]](key, entry)


def _example(key: Key, entry: dict[str, Any]) -> dict[str, Any]:
    from mars_lidar.scene.scene import Scene

    known = values.mapping(key, entry, _EXAMPLE)
    return {
        "example": values.choice((*key, "example"), known["example"], Scene.example_names()),
        "size": values.listed(values.size((*key, "size"), known.get("size", 128))),
        "seeds": values.numbers((*key, "seeds"), known.get("seeds", [0])),
        **_before(key, known),
    }


def _path(key: Key, entry: dict[str, Any]) -> dict[str, Any]:
    known = {name: value for name, value in values.mapping(key, entry, _PATH).items() if value is not None}
    for name in ("path", "pattern", "manifest"):
        if name in known:
            values.text((*key, name), known[name])
    for name in ("depth_unit_m", "focal_px"):
        if name in known:
            known[name] = values.real((*key, name), known[name], low=0.0, strict_low=True)
    if "frames" in known:
        known["frames"] = values.numbers((*key, "frames"), known["frames"], "frames")
    if "image" in known:
        image = known["image"]
        texts = image if isinstance(image, list) else [image]
        if not all(isinstance(one, str) and one for one in texts) or len(texts) > 2:
            raise RecipeError((*key, "image"), f"image must be a file, or two texts with a pattern, got {image!r}")
    return known | _before(key, known)


def _transient(key: Key, entry: dict[str, Any]) -> dict[str, Any]:
    """Keys and values as in a scene file of `mars-lidar simulate`; a pattern where it is a folder."""
    known = {name: value for name, value in values.mapping(key, entry, _TRANSIENT).items() if value is not None}
    for name in ("transient", "pattern", "name"):
        if name in known:
            values.text((*key, name), known[name])
    if "bin_ns" in known:
        known["bin_ns"] = values.real((*key, "bin_ns"), known["bin_ns"], low=0.0, strict_low=True)
    if "start_ns" in known:
        known["start_ns"] = values.real((*key, "start_ns"), known["start_ns"])
    if "channel" in known:
        known["channel"] = values.integer((*key, "channel"), known["channel"], low=0, high=2**31)
    if not isinstance(known.get("pulse", True), bool):
        raise RecipeError((*key, "pulse"), f"pulse must be true or false, got {known['pulse']!r}")
    return known


def _before(key: Key, known: dict[str, Any]) -> dict[str, Any]:
    """Fog, a list of them, each a scene of its own; and a pane."""
    told: dict[str, Any] = {}
    if known.get("fog") is not None:
        given = known["fog"]
        place: Key = (*key, "fog")
        if isinstance(given, list):
            told["fog"] = [_fog((*place, k), one) for k, one in enumerate(given)]
        else:
            told["fog"] = [_fog(place, given)]
        if not told["fog"] or any(one in told["fog"][:k] for k, one in enumerate(told["fog"])):
            raise RecipeError(place, f"fog must be one or several that differ from each other, got {given!r}")
    if known.get("pane") is not None:
        place = (*key, "pane")
        pane = values.mapping(place, known["pane"], _PANE, needed=("depth_m", "reflectivity"))
        told["pane"] = {
            "depth_m": values.real((*place, "depth_m"), pane["depth_m"], low=0.0, strict_low=True),
            "reflectivity": values.real((*place, "reflectivity"), pane["reflectivity"], low=0.0, high=1.0),
            "transmission": values.real(
                (*place, "transmission"), pane.get("transmission", 1.0), low=0.0, high=1.0, strict_low=True
            ),
        }
    return told


def _fog(key: Key, given: Any) -> dict[str, float]:
    known = values.mapping(key, given, _FOG, needed=("extinction_per_m", "backscatter"))
    return {
        "extinction_per_m": values.real(
            (*key, "extinction_per_m"), known["extinction_per_m"], low=0.0, strict_low=True
        ),
        "backscatter": values.real((*key, "backscatter"), known["backscatter"], low=0.0),
        "nearest_m": values.real((*key, "nearest_m"), known.get("nearest_m", 1.0), low=0.0, strict_low=True),
    }
