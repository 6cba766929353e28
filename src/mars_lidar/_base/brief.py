"""Short ``repr`` of public objects, which fits on a screen."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mars_lidar._base.tolerances import TOL


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
    if isinstance(value, np.ndarray) and value.size > TOL.shown_values:
        return f"<{value.dtype} {value.shape}>"
    if isinstance(value, np.ndarray):
        return np.array2string(value, precision=6, separator=", ", max_line_width=10**6).replace("\n", "")
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple) and len(value) > TOL.shown_values:
        return f"<{type(value).__name__} of {len(value)}>"
    text = repr(value)
    return text if len(text) <= TOL.shown_text else f"{type(value).__name__}(...)"
