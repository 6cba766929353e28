"""A small recipe that every test of datasets begins with."""

from pathlib import Path
from typing import Any

import pytest
from harness import make_system

import mars_lidar as ml

SYSTEM = make_system(30.0, 50, 32)


@pytest.fixture
def recipe() -> dict[str, Any]:
    """2 scenes x 2 systems x 2 levels, 3 realizations of 12 x 10 pixels; several chunks and shards."""
    return {
        "seed": 5,
        "scenes": [{"example": "room", "size": [12, 10], "seeds": [0, 3]}],
        "systems": [SYSTEM, SYSTEM.replace(cycles=80)],
        "light": {"signal": [0.2, 1.0], "sbr": "inf", "dark_count_hz": 1e5},
        "realizations": 3,
        "store": {"chunk_mib": 0.004, "shard_mib": 0.016},
    }


def files(store: Path) -> dict[str, bytes]:
    """Every file of a store, by its path."""
    return {str(path.relative_to(store)): path.read_bytes() for path in sorted(store.rglob("*")) if path.is_file()}


@pytest.fixture
def whole(tmp_path, recipe) -> dict[str, bytes]:
    """The files of a run that nothing stopped."""
    ml.generate(recipe, tmp_path / "whole.zarr")
    return files(tmp_path / "whole.zarr")
