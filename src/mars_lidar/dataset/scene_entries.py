"""Where a scene comes from, and what stands before it, as plain data: recipes, scene files, command line, Python.

`KINDS` declares every key once; `mars_lidar.dataset.schema` makes of them what editors read.
"""

from __future__ import annotations

from typing import Any

from mars_lidar._base.yaml import Key, RecipeError
from mars_lidar.dataset import values
from mars_lidar.dataset.values import Fields
from mars_lidar.scene.scene import Scene

FOG: Fields = {
    "extinction_per_m": values.real("Extinction coefficient, 1/m: 3.91 / visibility.", low=0.0, strict_low=True),
    "backscatter": values.real("Photons per period that fog without a target sends back, per unit of signal.", low=0.0),
    "nearest_m": values.real("Depth from which on the laser is seen, m.", low=0.0, strict_low=True).or_else(1.0),
}
PANE: Fields = {
    "depth_m": values.real("Depth of the pane, m.", low=0.0, strict_low=True),
    "reflectivity": values.real("Reflectivity of the pane.", low=0.0, high=1.0),
    "transmission": values.real("What passes it, there and back.", low=0.0, high=1.0, strict_low=True).or_else(1.0),
}
_SIZE = values.size("Resample: the longer side, or [height, width].")
_BEFORE: Fields = {
    "fog": values.several(
        values.mapping("Fog before the surfaces; several are a scene each.", FOG, ("extinction_per_m", "backscatter"))
    ),
    "pane": values.mapping("A pane before the surfaces.", PANE, ("depth_m", "reflectivity")),
}
_IMAGE = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 2}]}
KINDS: dict[str, Fields] = {
    "example": {
        "example": values.choice("A built-in scene.", Scene.example_names()),
        "size": values.size("The longer side, or [height, width].").or_else(128),
        "seeds": values.numbers("Seeds, one scene each: a list, or first and count.", "seeds").or_else([0]),
        **_BEFORE,
    },
    "path": {
        "path": values.text("Depth: a file, or a folder of scenes."),
        "pattern": values.text("Of a folder: which depth files, such as **/*_depth.png."),
        "image": values.other("The image to a file; to a pattern, a text of it and what stands in its place.", _IMAGE),
        "manifest": values.text("Of a folder: a CSV with a column depth."),
        "depth_unit_m": values.real("Metres per stored unit of depth.", low=0.0, strict_low=True),
        "focal_px": values.real("Focal length, pixels: depth becomes range.", low=0.0, strict_low=True),
        "max_depth_m": values.real("Depths beyond this, m, are no return.", low=0.0, strict_low=True),
        "frames": values.numbers("Of NYUv2: which frames.", "frames"),
        "size": _SIZE,
        **_BEFORE,
    },
    "transient": {
        "transient": values.text("Rendered light (y, x, time): a file, or a folder of them."),
        "pattern": values.text("Of a folder: which files."),
        "bin_ns": values.real("Width of a time bin, ns.", low=0.0, strict_low=True),
        "start_ns": values.real("Travel time at the first bin, ns."),
        "name": values.text("Which array of the file."),
        "channel": values.integer("Which channel of (y, x, time, channel).", low=0, high=2**31),
        "pulse": values.flag("Whether the system's pulse is still to be applied."),
        "size": _SIZE,
    },
}
SINGLE: dict[str, Fields] = {
    "path": {
        "depth": values.text("Depth: a file, or a Middlebury folder; the same as path."),
        "index": values.integer("Of NYUv2: which frame; the same as frames of one.", low=0, high=2**31),
    },
    "example": {"seed": values.integer("Seed; the same as seeds of one.", low=0, high=2**64 - 1)},
    "transient": {},
}
_STANDS_FOR = {"depth": "path", "index": "frames", "seed": "seeds"}
"""Keys of a single scene, and those of many that they stand for."""


def read_scenes(data: Any) -> tuple[dict[str, Any], ...]:
    """The list under `scenes`, or its only entry."""
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("scenes",), "scenes must have at least one entry")
    return tuple(read_scene(("scenes", k) if isinstance(data, list) else ("scenes",), e) for k, e in enumerate(entries))


def read_scene(key: Key, entry: Any) -> dict[str, Any]:
    """One entry; keys of a single scene become those of many."""
    name = values.key_name(key) or "a scene file"
    kinds = [kind for kind in ("example", "depth", *KINDS) if isinstance(entry, dict) and kind in entry]
    kinds = list(dict.fromkeys(kinds))
    if len(kinds) != 1:
        got = " and ".join(kinds) or "none of them"
        raise RecipeError(key, f"{name} must give one of example, depth (or path) and transient, got {got}")
    if entry[kinds[0]] is None:
        raise RecipeError((*key, kinds[0]), f"{kinds[0]} must have a value, got nothing behind it")
    kind = _STANDS_FOR.get(kinds[0], kinds[0])
    told = values.read_mapping(key, entry, {**SINGLE[kind], **KINDS[kind]}, name=name)
    for one, many in _STANDS_FOR.items():
        if one in told:
            if entry.get(many) is not None:
                raise RecipeError((*key, one), f"{one} stands for {many} of one: give one of them")
            told[many] = told.pop(one) if many == "path" else [told.pop(one)]
    image = told.get("image")
    texts = image if isinstance(image, list) else [image]
    if image is not None and not (all(isinstance(one, str) and one for one in texts) and len(texts) in (1, 2)):
        raise RecipeError((*key, "image"), f"image must be a file, or two texts with a pattern, got {image!r}")
    fogs = told.get("fog", [None])
    if not fogs or any(one in fogs[:k] for k, one in enumerate(fogs)):
        raise RecipeError((*key, "fog"), f"fog must be one or several that differ from each other, got {fogs!r}")
    return told
