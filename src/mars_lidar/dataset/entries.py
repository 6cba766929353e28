"""The entries under `scenes` of a recipe: where scenes come from, as plain data."""

from __future__ import annotations

from typing import Any

from mars_lidar.dataset import values
from mars_lidar.dataset.lines import Key, RecipeError

_EXAMPLE = ("example", "size", "seeds")
_PATH = ("path", "pattern", "image", "manifest", "depth_unit_m", "focal_px", "frames")


def read_scenes(data: Any) -> tuple[dict[str, Any], ...]:
    """The list under `scenes`, or its only entry."""
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("scenes",), "scenes must have at least one entry")
    return tuple(_scene(("scenes", k) if isinstance(data, list) else ("scenes",), e) for k, e in enumerate(entries))


def _scene(key: Key, entry: Any) -> dict[str, Any]:
    if not isinstance(entry, dict) or ("example" in entry) == ("path" in entry):
        raise RecipeError(key, f"{values.key_name(key)} must give one of example and path, got {entry!r}")
    if "example" in entry:
        from mars_lidar.scene import Scene

        known = values.mapping(key, entry, _EXAMPLE)
        return {
            "example": values.choice((*key, "example"), known["example"], Scene.example_names()),
            "size": values.listed(values.size((*key, "size"), known.get("size", 128))),
            "seeds": values.numbers((*key, "seeds"), known.get("seeds", [0])),
        }
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
    return known
