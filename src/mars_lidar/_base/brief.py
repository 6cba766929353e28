"""Short ``repr`` of public objects, which fits on a screen, and numbers with their errors."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

_MOST_VALUES = 4  # values of an array or sequence that is written out; larger ones by type and shape
_MOST_TEXT = 240  # characters of other values, such as a system inside a result


def brief(self: Any) -> str:
    """The ``__repr__`` of a dataclass: fields that differ from their defaults, large arrays by type and shape only."""
    fields = []
    for field in dataclasses.fields(self):
        value = getattr(self, field.name)
        if field.repr and not _is_default(field, value):
            fields.append(f"{field.name}={_value_text(value)}")
    return f"{type(self).__name__}({', '.join(fields)})"


def _is_default(field: dataclasses.Field[Any], value: Any) -> bool:
    default = field.default
    if field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    return default is value or (type(default) is type(value) and not isinstance(value, np.ndarray) and default == value)


def _value_text(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.size > _MOST_VALUES:
        return f"<{value.dtype} {value.shape}>"
    if isinstance(value, np.ndarray):
        return np.array2string(value, precision=6, separator=", ", max_line_width=10**6).replace("\n", "")
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple) and len(value) > _MOST_VALUES:
        return f"<{type(value).__name__} of {len(value)}>"
    text = repr(value)
    return text if len(text) <= _MOST_TEXT else f"{type(value).__name__}(...)"


def measured(value: float, error: float) -> str:
    """A value and its standard error, to two digits of the error; the value alone where it has none, "-" for NaN."""
    if not 0.0 < error < np.inf:
        return "-" if np.isnan(value) else f"{value:.4g}"
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 15))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"
