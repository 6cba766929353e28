"""Keys of recipes and scene files: each is declared once, with its check, description and JSON Schema."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mars_lidar._base import checks
from mars_lidar._base.tolerances import TOL
from mars_lidar._base.yaml import Key, RecipeError


@dataclass(frozen=True)
class Field:
    """A value of a description: `read` checks and converts it; `schema` is for editors."""

    read: Callable[[Key, Any], Any]
    schema: dict[str, Any]
    default: Any = None  # None: a missing key stays missing

    def or_else(self, default: Any) -> Field:
        """With a default."""
        return replace(self, default=default, schema=self.schema | {"default": default})


Fields = dict[str, Field]


def _field(about: str, read: Callable[[Key, Any], Any], **schema: Any) -> Field:
    return Field(read, {"description": about, **schema} if about else schema)


def real(
    about: str, *, low: float = -math.inf, high: float = math.inf, strict_low: bool = False, infinite: bool = False
) -> Field:
    """A number in [low, high]; inf too, where it may be `infinite`."""
    limits: dict[str, Any] = {"type": ["number", "string"] if infinite else "number"}
    if math.isfinite(low):
        limits["exclusiveMinimum" if strict_low else "minimum"] = low
    if math.isfinite(high):
        limits["maximum"] = high
    if infinite:
        limits["pattern"] = "^inf$"

    def read(key: Key, value: Any) -> float:
        given = number(value)
        limited = partial(checks.real, low=low, high=high, strict_low=strict_low, infinite=infinite)
        return float(checked(key, lambda: limited(key_name(key), given)))

    return _field(about, read, **limits)


def integer(about: str, *, low: int, high: int, name: str | None = None) -> Field:
    """An integer in [low, high]."""

    def read(key: Key, value: Any) -> int:
        return int(checked(key, lambda: checks.integer(name or key_name(key), number(value), low=low, high=high)))

    return _field(about, read, type="integer", minimum=low, maximum=high)


def choice(about: str, allowed: tuple[str, ...]) -> Field:
    """One of the `allowed` words."""
    return _field(about, lambda key, value: checked(key, checks.choice, key_name(key), value, allowed), enum=[*allowed])


def text(about: str) -> Field:
    """A non-empty text."""
    return _field(about, _kind(str, "a text"), type="string", minLength=1)


def flag(about: str) -> Field:
    """True or false."""
    return _field(about, _kind(bool, "true or false"), type="boolean")


def _kind(kind: type, words: str) -> Callable[[Key, Any], Any]:
    def read(key: Key, value: Any) -> Any:
        if not isinstance(value, kind) or value == "":
            raise RecipeError(key, f"{key[-1]} must be {words}, got {value!r}")
        return value

    return read


_SIDE = integer("", low=1, high=TOL.image_side)


def size(about: str) -> Field:
    """The longer side of an image, or [height, width]."""
    both = {"type": "array", "items": _SIDE.schema, "minItems": 2, "maxItems": 2}
    return _field(about, read_size, anyOf=[_SIDE.schema, both])


def read_size(key: Key, value: Any) -> int | list[int]:
    """The longer side of an image, or [height, width], as plain data."""
    if isinstance(value, list | tuple):
        if len(value) != 2:
            raise RecipeError(key, f"{key_name(key)} must be an integer or [height, width], got {value!r}")
        return [_SIDE.read(key, side) for side in value]
    side: int = _SIDE.read(key, value)
    return side


def numbers(about: str, name: str) -> Field:
    """A list of integers, or ``{first, count}``."""
    entry = integer("", low=0, high=2**64 - 1, name=name)
    run: Fields = {
        "first": integer("The first one.", low=0, high=2**63).or_else(0),
        "count": integer("How many.", low=1, high=2**20),
    }

    def read(key: Key, value: Any) -> Any:
        if isinstance(value, dict):
            return read_mapping(key, value, run, needed=("count",))
        if not isinstance(value, list) or not value:
            raise RecipeError(key, f"{name} must be a list of integers, or first and count, got {value!r}")
        listed = [entry.read((*key, k), each) for k, each in enumerate(value)]
        if len(set(listed)) < len(listed):
            raise RecipeError(key, f"{name} must differ from each other, got {listed}")
        return listed

    schema = {"type": "array", "items": entry.schema, "minItems": 1}
    return _field(about, read, anyOf=[schema, schema_of(run, needed=("count",))])


def listed_numbers(value: Any) -> list[int]:
    """The integers of ``[...]`` or ``{first, count}``."""
    if isinstance(value, dict):
        return list(range(value["first"], value["first"] + value["count"]))
    return list(value)


def mapping(about: str, fields: Fields, needed: tuple[str, ...] = ()) -> Field:
    """A mapping with the keys of `fields`."""
    return _field(about, lambda key, value: read_mapping(key, value, fields, needed), **schema_of(fields, needed))


def several(item: Field) -> Field:
    """One, or a list of them; read as a list."""

    def read(key: Key, value: Any) -> list[Any]:
        if not isinstance(value, list):
            return [item.read(key, value)]
        return [item.read((*key, k), each) for k, each in enumerate(value)]

    alone = {name: value for name, value in item.schema.items() if name != "description"}
    return _field(item.schema["description"], read, anyOf=[alone, {"type": "array", "items": alone, "minItems": 1}])


def other(about: str, schema: dict[str, Any]) -> Field:
    """A value that another function reads."""
    return _field(about, lambda key, value: value, **schema)


def read_mapping(
    key: Key, data: Any, fields: Fields, needed: tuple[str, ...] = (), name: str | None = None
) -> dict[str, Any]:
    """The values of a mapping of known keys, defaults among them; what is None is left out."""
    name = name or key_name(key) or "the recipe"
    given: dict[str, Any] = checked(key, checks.known_keys, name, data, tuple(fields))
    for each in needed:
        if given.get(each) is None:
            raise RecipeError(key, f"{name} must give {each}")
    result: dict[str, Any] = {}
    for each, field in fields.items():
        value = given.get(each)
        if value is not None:
            result[each] = field.read((*key, each), value)
        elif field.default is not None:
            result[each] = field.default
    return result


def schema_of(fields: Fields, needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """JSON Schema of a mapping."""
    properties = {name: field.schema for name, field in fields.items()}
    result: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    return result | {"required": [*needed]} if needed else result


def key_name(key: Key) -> str:
    """``scenes[0].path``."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in key).lstrip(".")


def number(value: Any) -> Any:
    """A number, also from the text inf, which YAML does not convert."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def checked(key: Key, call: Any, *arguments: Any) -> Any:
    """The result of a call; its errors are raised for `key`."""
    try:
        return call(*arguments)
    except RecipeError:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise RecipeError(key, str(error)) from error
