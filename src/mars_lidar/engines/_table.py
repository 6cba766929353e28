"""What an engine asks of a lookup table: that it belongs to the system, and a record for the file of a cube."""

from __future__ import annotations

from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar.system import System

if TYPE_CHECKING:
    from mars_lidar.table import Table


def check_table(table: Table | None, system: System | None = None) -> Table | None:
    """The table, if it is one, and of this system but for the number of cycles."""
    if table is None:
        return None
    if not (callable(getattr(table, "lookup", None)) and callable(getattr(table, "shapes", None))):
        raise TypeError(f"table must be a mars_lidar.Table, got {table!r}")
    if system is not None:
        ours, theirs = system.to_dict(), table.system.to_dict()
        for name in ours:
            if name != "cycles" and ours[name] != theirs[name]:
                raise ValueError(f"table must be of this system: {name} is {ours[name]}, the table's {theirs[name]}")
    return table
