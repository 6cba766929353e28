"""Small files, and damage to them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np


def write_h5(path: Path, data: dict[str, Any]) -> Path:
    """An HDF5 file of these data sets."""
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file[name] = values
    return path


def overwrite(path: Path, at: int | bytes, new: int | bytes, after: int = 0) -> None:
    """Put bytes at a place, or `after` bytes behind the first `at`; a number is xored with the byte there."""
    content = bytearray(path.read_bytes())
    place = after + (content.index(at) if isinstance(at, bytes) else at)
    if isinstance(new, int):
        content[place] ^= new
    else:
        content[place : place + len(new)] = new
    path.write_bytes(content)


def rewrite(path: Path, name: str, change: Callable[[Any], Any]) -> None:
    """Replace one member of an archive by `change` of it; of the attributes, a dictionary that is changed in place."""
    with np.load(path) as archive:
        members = dict(archive)
    if name == "attributes":
        attributes = json.loads(members[name].item())
        change(attributes)
        members[name] = np.asarray(json.dumps(attributes))
    elif (changed := change(members.pop(name))) is not None:  # None: it is gone
        members[name] = changed
    np.savez(path, **members)
