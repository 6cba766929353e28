"""Argument checks: every message names the argument, the value given and what is allowed."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base.spelling import did_you_mean
from mars_lidar._base.types import FloatArray


def real(
    name: str,
    value: Any,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    strict_low: bool = False,
    infinite: bool = False,
) -> float:
    """A finite real number in [low, high] (or (low, high] with `strict_low`), as float; inf too where `infinite`."""
    opening = "(" if strict_low or math.isinf(low) else "["
    closing = ")" if math.isinf(high) and not infinite else "]"
    allowed = f"a {'' if infinite else 'finite '}number in {opening}{low:g}, {high:g}{closing}"
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be {allowed}, got {value!r} ({type(value).__name__})")
    number = float(value)
    if infinite and number == math.inf:
        return number
    if not math.isfinite(number) or number > high or number < low or (strict_low and number == low):
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def integer(name: str, value: Any, *, low: int, high: int) -> int:
    """An integer in [low, high]; a float that is whole, such as 1e6, is one."""
    allowed = f"an integer in [{low}, {high}]"
    value = whole(value)
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{name} must be {allowed}, got {value!r} ({type(value).__name__})")
    number = int(value)
    if not low <= number <= high:
        raise ValueError(f"{name} must be {allowed}, got {value!r}")
    return number


def whole(value: Any) -> Any:
    """A float with an integer value as int, anything else unchanged: users write 1e6 in Python, YAML and a shell."""
    is_whole = isinstance(value, Real) and not isinstance(value, Integral) and math.isfinite(value)
    return int(value) if is_whole and float(value).is_integer() else value


def choice(name: str, value: Any, allowed: tuple[str, ...]) -> str:
    """One of a few strings."""
    if not isinstance(value, str) or value not in allowed:
        message = f"{name} must be one of {', '.join(map(repr, allowed))}"
        raise ValueError(f"{message}, got {value!r}{did_you_mean(value, allowed)}")
    return value


def suffix(name: str, path: Path, allowed: Sequence[str]) -> None:
    """ValueError for a path with another suffix than those `allowed`."""
    if path.suffix not in allowed:
        raise ValueError(f"{name} must end in {'one of ' * (len(allowed) > 1)}{', '.join(allowed)}, got {str(path)!r}")


def unmasked(name: str, value: Any) -> Any:
    """The value; ValueError if elements are masked, because an array made of it would contain the hidden elements."""
    if np.ma.is_masked(value):
        raise ValueError(f"{name} must have no masked elements, got {np.ma.getmaskarray(value).sum()}: fill them first")
    return value


def even_rows(name: str, value: Any) -> Any:
    """The value; ValueError for a list of rows of different lengths."""
    if isinstance(value, list | tuple):
        try:
            np.shape(value)
        except ValueError:
            raise ValueError(f"{name} must have rows of equal lengths") from None
    return value


def numbers(name: str, value: Any) -> Any:
    """The value; ValueError if an array made of it would contain anything but real numbers."""
    even_rows(name, value)
    dtype = getattr(value, "dtype", None)
    if not isinstance(dtype, np.dtype):
        try:
            dtype = np.asarray(value).dtype
        except Exception as error:  # whatever makes an array of it, such as a tensor on another device
            why = " ".join(str(error).split())
            raise TypeError(f"{name} must be real numbers, got {type(value).__name__} ({why[:200]})") from None
    if dtype.kind not in "biuf":
        given = type(value).__name__ if dtype.kind == "O" else f"dtype {dtype}"
        raise TypeError(f"{name} must be real numbers, got {given}")
    return value


def weights(name: str, value: Any, *, most: int, least: int = 1, what: str = "weights") -> FloatArray:
    """`least` to `most` numbers (n,), finite and non-negative, not all 0: `what` they are, for errors."""
    array = np.asarray(numbers(name, unmasked(name, value)))
    if array.ndim != 1 or not least <= array.size <= most:
        raise ValueError(f"{name} must be {least} to {most} {what} (n,), got shape {array.shape} of {array.dtype}")
    array = array.astype(np.float64)
    bad = ~(np.isfinite(array) & (array >= 0.0))
    if bad.any() or not 0.0 < array.sum() < math.inf:
        k = int(np.argmax(bad))
        got = f"{name}[{k}] = {array[k]}" if bad.any() else f"a sum of {array.sum()}"
        raise ValueError(f"{name} must be finite and non-negative, with a positive and finite sum, got {got}")
    return array


def known_keys(name: str, mapping: Any, allowed: tuple[str, ...], needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """A mapping whose keys are known and include the `needed` ones; a misspelt key is an error, never ignored."""
    if not isinstance(mapping, dict):
        raise TypeError(f"{name} must be a mapping with keys {', '.join(allowed)}, got {mapping!r}")
    unknown = [key for key in mapping if key not in allowed]
    if unknown:
        meant = did_you_mean(unknown[0], allowed)
        raise ValueError(f"{name} has unknown key {unknown[0]!r}{meant}; allowed: {', '.join(allowed)}")
    for key in needed:
        if key not in mapping:
            raise ValueError(f"{name} must give {key}; needed: {', '.join(needed)}")
    return mapping
