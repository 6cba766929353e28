"""Options of engines: what `simulate` takes for some of them and hands on, declared once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from mars_lidar.table import Table

Count = Literal["exact", "matched", "gaussian"]
Interpolation = Literal["bilinear", "nearest"]
Outside = Literal["error", "exact"]


class EngineOptions(TypedDict, total=False):
    """Arguments of the constructors of engines; None, or left out: the engine's default.

    Attributes
    ----------
    table
        For ``"mars"`` and ``"renewal"``: the lookup table (`mars_lidar.Table`).
    count
        For ``"mars"``: the law of the count, ``"exact"`` (default), ``"matched"`` (to four cumulants) or
        ``"gaussian"`` (the paper's).
    interpolation
        For a table: ``"bilinear"`` (default) or ``"nearest"`` (the paper's).
    outside
        For a table, of pixels beyond its range: ``"error"`` (default), or ``"exact"``, some ms each.

    See Also
    --------
    find_engine, mars_lidar.simulate

    Examples
    --------
    >>> from mars_lidar.engines import EngineOptions, find_engine
    >>> options = EngineOptions(count="gaussian")
    >>> find_engine("mars", **options).name
    'mars'
    """

    table: Table | None
    count: Count | None
    interpolation: Interpolation | None
    outside: Outside | None


NAMES = tuple(EngineOptions.__annotations__)


def given(options: EngineOptions) -> dict[str, Any]:
    """The options that are not None; TypeError for a name that is none of them."""
    for name in options:
        if name not in NAMES:
            raise TypeError(f"{name!r} is no argument of this function, nor an option of an engine: {', '.join(NAMES)}")
    return {name: value for name, value in options.items() if value is not None}
