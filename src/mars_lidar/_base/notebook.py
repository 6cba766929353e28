"""HTML of an object for notebooks: its ``repr`` and small pictures of its maps and curves."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from mars_lidar._base.tolerances import TOL


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
