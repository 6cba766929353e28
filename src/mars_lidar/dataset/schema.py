"""JSON Schema of the files that people write, for editors: made of the declarations that also read them."""

from __future__ import annotations

import dataclasses
import re
import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar.dataset import values
from mars_lidar.dataset.light import LIGHT
from mars_lidar.dataset.recipe import ROOT
from mars_lidar.dataset.scene_entries import KINDS, SINGLE
from mars_lidar.dataset.values import Fields
from mars_lidar.engines import ENGINES
from mars_lidar.instrument.presets import PRESETS
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import Detector, System

FILES = ("scene", "recipe", "system")
_PLAIN = {float: "number", int: "integer", str: "string", bool: "boolean", Path: "string"}


@checked
def json_schema(file: str = "recipe") -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scene file, a recipe of `generate`, or a system file.

    An editor that knows it completes keys and underlines what is wrong: in VS Code with the YAML extension, put
    ``# yaml-language-server: $schema=recipe.json`` in the first line of the file.
    """
    checks.choice("file", file, FILES)
    light = values.mapping("Levels of light; one of them for one scene.", LIGHT)
    made = _kinds({"light": light}) if file == "scene" else _recipe() if file == "recipe" else _system()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"mars-lidar {file}", **made}


def _recipe() -> dict[str, Any]:
    made = values.schema_of(ROOT, ("scenes", "systems"))
    system = {"anyOf": [values.schema_of({"file": values.text("A system file.")}, ("file",)), _system()]}
    made["properties"] |= {
        "scenes": _one_or_more(_kinds({}), ROOT["scenes"].schema),
        "systems": _one_or_more(system, ROOT["systems"].schema),
        "light": {**ROOT["light"].schema, **values.schema_of(LIGHT)},
        "engine": {**ROOT["engine"].schema, "enum": list(ENGINES)},
    }
    return made


def _kinds(more: Fields) -> dict[str, Any]:
    made = []
    for kind, fields in KINDS.items():
        every = values.schema_of({**SINGLE[kind], **fields, **more})
        made.append(every | ({"anyOf": [{"required": [name]} for name in ("path", "depth")]} if kind == "path" else {}))
        if kind != "path":
            made[-1]["required"] = [kind]
    return {"anyOf": made}


def _one_or_more(entry: dict[str, Any], about: dict[str, Any]) -> dict[str, Any]:
    return {**about, "anyOf": [entry, {"type": "array", "items": entry, "minItems": 1}]}


def _system() -> dict[str, Any]:
    made = _of_class(System)
    made["properties"]["pulse"] = _pulse()
    detector = made["properties"]["detector"]
    detector["properties"] |= {"preset": {"enum": list(PRESETS), "description": "A published detector by name."}}
    detector.pop("required", None)  # a preset has them
    return made


def _pulse() -> dict[str, Any]:
    gaussian = {"kind": {"const": "gaussian"}, **_of_class(GaussianPulse)["properties"]}
    gaussian["fwhm_ns"] = {"type": "number", "description": "Full width at half maximum, ns, instead of sigma_ns."}
    sampled: dict[str, Any] = {"kind": {"const": "sampled"}}
    sentences = _sentences(SampledPulse)
    sampled["values"] = {"type": "array", "items": {"type": "number"}, "description": sentences.get("values", "")}
    sampled["bin_ns"] = {"type": "number", "description": sentences.get("bin_ns", "")}
    sampled["origin"] = {"enum": ["peak", "centroid", "first"], "description": sentences.get("origin", "")}
    closed = {"type": "object", "additionalProperties": False}
    return {"anyOf": [{**closed, "properties": kind, "required": ["kind"]} for kind in (gaussian, sampled)]}


def _of_class(kind: Any) -> dict[str, Any]:
    """Schema of the plain form of a frozen dataclass of the package: types of its fields, texts of its docstring."""
    hints, sentences = get_type_hints(kind), _sentences(kind)
    properties: dict[str, Any] = {}
    needed = []
    for field in dataclasses.fields(kind):
        properties[field.name] = _of_type(hints[field.name])
        if field.name in sentences:
            properties[field.name]["description"] = sentences[field.name]
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            needed.append(field.name)
    made = {"type": "object", "properties": properties, "additionalProperties": False}
    return made | ({"required": needed} if needed else {})


def _of_type(kind: Any) -> dict[str, Any]:
    origin = get_origin(kind)
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if origin is Literal:
        return {"enum": list(get_args(kind))}
    if origin in (Union, types.UnionType):
        inner = [_of_type(each) for each in get_args(kind) if each is not type(None)]
        return inner[0] if len(inner) == 1 else {"anyOf": inner}
    if origin in (tuple, list, np.ndarray):
        return {"type": "array", "items": {"type": "number"}}
    if dataclasses.is_dataclass(kind):
        made = _of_class(kind)
        if kind is not Detector:  # effects have a kind beside their fields, and other ways to give them
            made.pop("required", None)
            made["additionalProperties"] = True
        return made
    return {"type": "object"}


def _sentences(kind: type) -> dict[str, str]:
    """First sentence on each parameter in a docstring."""
    parameters = re.findall(r"^    (\w[\w, ]*)\n((?:        .*\n|\n)+)", kind.__doc__ or "", flags=re.MULTILINE)
    first = {names: " ".join(text.split()).split(". ")[0] for names, text in parameters}
    return {name.strip(): text for names, text in first.items() for name in names.split(",")}
