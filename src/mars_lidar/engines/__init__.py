"""Engines: one file each, under the names that `simulate` takes."""

from mars_lidar import _validate
from mars_lidar.engines.auto import AutoEngine
from mars_lidar.engines.base import Engine
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.engines.poisson import PoissonEngine
from mars_lidar.engines.sequential import SequentialEngine

ENGINES: dict[str, Engine] = {
    engine.name: engine
    for engine in (ExactEngine(), SequentialEngine(), PoissonEngine(), FeedbackEngine(), AutoEngine())
}


def find_engine(engine: str | Engine) -> Engine:
    """The engine of that name with its default settings, or the engine itself."""
    return engine if isinstance(engine, Engine) else ENGINES[_validate.choice("engine", engine, tuple(ENGINES))]


__all__ = ["ENGINES", "Engine", "find_engine"]
