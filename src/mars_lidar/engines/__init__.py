"""Engines: one file each, under the names that `simulate` takes."""

from mars_lidar.engines.base import Engine
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.poisson import PoissonEngine
from mars_lidar.engines.sequential import SequentialEngine

ENGINES: dict[str, Engine] = {
    engine.name: engine for engine in (ExactEngine(), SequentialEngine(), PoissonEngine())
}

__all__ = ["ENGINES", "Engine"]
