"""Public objects on a screen: a short `repr`, and in notebooks HTML with small pictures of maps and curves."""

import base64
import dataclasses
import html
import io
from collections.abc import Mapping
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


def as_html(thing: object, panels: Mapping[str, Any]) -> str:
    """The ``repr`` of `thing` above `panels`: maps (H, W) by their title and unit, or curves (x, y)."""
    text = f"<code>{html.escape(repr(thing))}</code>"
    drawn = {name: values for name, values in panels.items() if _has_values(values)}
    if not drawn:
        return text
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(drawn), 1.7), dpi=75, layout="constrained")
    for ax, (name, values) in zip(figure.subplots(1, len(drawn), squeeze=False).flat, drawn.items(), strict=True):
        ax.set_title(name, fontsize=7)
        ax.tick_params(labelsize=6)
        if isinstance(values, tuple):
            ax.plot(*values, lw=0.8, drawstyle="steps-mid")
            continue
        step = max(1, max(values.shape) // TOL.map_pixels)
        figure.colorbar(ax.imshow(values[::step, ::step]), ax=ax).ax.tick_params(labelsize=6)
        ax.set_xticks([])
        ax.set_yticks([])
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return f'{text}<br><img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'


def _has_values(values: Any) -> bool:
    parts = values if isinstance(values, tuple) else (values,)
    return all(np.ndim(part) > 0 and np.size(part) and np.isfinite(part).any() for part in parts)


def measured(value: float, error: float) -> str:
    """A value and its standard error, to two digits of the error; the value alone where it has none, "-" for NaN."""
    if not 0.0 < error < np.inf:
        return "-" if np.isnan(value) else f"{value:.4g}"
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 15))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"
